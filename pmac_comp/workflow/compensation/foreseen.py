"""What forbids a compensation before it is computed: options, the motion, captures, the amplitude.

What lives here: refusals that bench file, model, captures and options settle within seconds. What
may not: the computing itself (``computing``), which takes a minute and refuses what only it can
know.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pmac_comp.base.errors import AmplitudeExceeded, ConfigError
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.design import start_law
from pmac_comp.physics.compensate.exact import Aim, LEARNING_CUTOFF_Hz, zero_phase
from pmac_comp.physics.compensate.loop import model_loop
from pmac_comp.physics.compensate.motions import design_motions
from pmac_comp.workflow.accuracy.late_scale import in_time
from pmac_comp.workflow.law.dynamic_law import without_fed_forward
from pmac_comp.workflow.law.rendering import cam_shape
from pmac_comp.workflow.law.routes import LATENCY_CYCLES, MOTION_ROUTES, TORQUE_ROUTES
from pmac_comp.workflow.law.static_map import bench_map, require_covered
from pmac_comp.workflow.motion.motions import Motion

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

# The loop and the captures change the regression's correction by less; nearer to the limit only the
# whole computation tells.
_SURE = 1.25
_LESS = " --aim mechanical leaves the lag of the loop alone and needs less."


def check_options(bench: Bench, route: str, motion: Motion | None, every_cycles: int = 1) -> None:
    """Refuse options that do not belong to a route, and a motion that it cannot carry.

    Raises
    ------
    ConfigError
        No motion, one too long for a cam, or a rhythm for a route that runs in each servo cycle.
    """
    if route != "law" and every_cycles != 1:
        raise ConfigError(
            f"The route {route} has no --every: only PLC 0 of the route law runs less often.",
            code="PC-DEP-013",
            hint="Leave --every out, or use --route law.",
        )
    if route in MOTION_ROUTES:
        known = require_motion(route, motion)
        if route == "cam":
            cam_shape(known.position_m.size, bench)


def require_motion(route: str, motion: Motion | None) -> Motion:
    """The motion of a route for one known motion; ConfigError where none is given."""
    if motion is None:
        raise ConfigError(
            f"The route {route} needs the motion it is for.",
            code="PC-DEP-011",
            hint="Give it with --command: a CSV with time_s,commanded_position_mm, or a motion as "
            "`capture --motion` takes it.",
        )
    return motion


def check_uncompensated(bench: Bench, captures: Sequence[Capture], names: Sequence[str]) -> None:
    """Refuse captures made with a compensation on: what it took away would be missing in the new.

    Raises
    ------
    ConfigError
        The desired position departs from the commanded one by more than a count.
    """
    for capture, name in zip(captures, names, strict=True):
        added_m = capture.largest_added_m
        if added_m > bench.motor_resolution_m:
            raise ConfigError(
                f"{name} was made with a compensation on: up to {added_m * UM_PER_M:.1f} um were "
                "added to its command.",
                code="PC-DEP-014",
                hint="Use runs of `pmac-comp capture` without compensation; `pmac-comp rollback` "
                "takes an uploaded one off.",
            )


def check_slow_runs(
    bench: Bench, route: str, slow: Sequence[Capture], *, whole_travel: bool
) -> None:
    """Refuse slow runs that give no map, or one of a part of the travel only.

    Raises
    ------
    NotIdentifiable
        They do.
    ConfigError
        There are none, and the route is nothing but their map.
    """
    if route == "table" and not slow:
        raise ConfigError(
            "Without slow runs there is no table, and the route table carries nothing else.",
            code="PC-DEP-015",
            hint="Give the runs of `capture --campaign lead` with --slow, or use another route.",
        )
    if slow:
        lead = bench_map(bench, slow)
        if whole_travel:
            require_covered(bench, lead)


def check_amplitude(
    bench: Bench, model: "DriveModel", route: str, motion: Motion | None, aim: Aim
) -> None:
    """Refuse a model whose correction passes the limit by far.

    Raises
    ------
    AmplitudeExceeded
        What the model does without compensation asks for it.
    """
    model = in_time(model, {})
    if route in MOTION_ROUTES:
        largest_um = _largest_of_motion_um(bench, model, require_motion(route, motion), aim)
    elif route in TORQUE_ROUTES:
        motions = design_motions(bench)
        loop = model_loop(without_fed_forward(model))
        law = start_law(bench, loop, motions, latency_cycles=LATENCY_CYCLES[route])
        largest_um = law.largest_correction_m * UM_PER_M
    else:
        return
    limit_um = bench.safety.max_correction_um
    if largest_um > _SURE * limit_um:
        raise too_large(route, aim, f"by the model it needs {largest_um:.0f} of {limit_um:g} um")


def _largest_of_motion_um(bench: Bench, model: "DriveModel", motion: Motion, aim: Aim) -> float:
    """Largest error of one motion in the band in which an exact correction is learned."""
    r = motion.position_m
    signals = model_loop(model)(r, None, None)
    of = signals.motor_position_m if aim is Aim.MECHANICAL else r
    slow = zero_phase(signals.table_position_m - of, bench.servo_period_s, LEARNING_CUTOFF_Hz)
    return float(np.max(np.abs(slow - np.mean(slow)))) * UM_PER_M


def too_large(route: str, aim: Aim, what: str) -> AmplitudeExceeded:
    """Error of a correction beyond the limits of the bench file."""
    return AmplitudeExceeded(
        f"The correction passes the limits: {what}.",
        code="PC-DEP-010",
        hint="Check the model, raise [safety] max_correction_um, or use --limit to clip."
        + _LESS * (route in MOTION_ROUTES and aim is Aim.TOTAL),
    )
