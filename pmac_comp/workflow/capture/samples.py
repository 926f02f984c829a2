"""What a run gathers, and the capture in SI that its samples become.

What lives here: the sources of a run, the room that they take on the card, and the conversion of
raw counts to a ``Capture``. What may not: the run itself (``axis``).
"""

from collections.abc import Callable, Mapping

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray, IntArray
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.files.sidecar import Attribute
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.card import registers as reg
from pmac_comp.machine.controller.gather import gather
from pmac_comp.machine.controller.gather.gather_plan import (
    GatherMode,
    GatherPlan,
    GatherSource,
    motor_source,
    output_source,
)
from pmac_comp.machine.controller.gather.gather_samples import GatherResult
from pmac_comp.machine.controller.motors.supervision import SensorWatch
from pmac_comp.workflow.bench.scales import Scales
from pmac_comp.workflow.capture.run_cut import moving_range
from pmac_comp.workflow.capture.sensors import MISMATCH_m, require_agreement
from pmac_comp.workflow.motion.approach import APPROACHED, RELAXED
from pmac_comp.workflow.motion.motions import Motion


def gather_plan(link: Commander, bench: Bench) -> GatherPlan:
    """What a run gathers: command, feedback, following error, scale and output."""
    motor = bench.encoder.motor_number
    sources: list[GatherSource] = [
        motor_source("commanded", motor, reg.COMMANDED),
        motor_source("actual", motor, reg.ACTUAL),
        motor_source("following_error", motor, reg.FOLLOWING_ERROR),
    ]
    if bench.scale is not None:
        sources.append(motor_source("scale", bench.scale.motor_number, reg.ACTUAL))
    sources.append(output_source("output", motor))
    ring = bench.controller.dpram != "none" and link.capabilities.memory
    return GatherPlan(
        tuple(sources),
        mode=GatherMode.RING if ring else GatherMode.RAM,
        dpram=bench.controller.dpram if ring else "large",
    )


def stored(plan: GatherPlan, duration_s: float, period_s: float) -> tuple[int, int]:
    """Samples of a run in the card's own buffer, and the long words that they take."""
    n_samples = 1 + int(np.ceil(duration_s / (period_s * plan.period_cycles)))
    return n_samples, plan.layout.long_words * n_samples + gather.HEADER_LONG_WORDS


def capture_of_samples(
    result: GatherResult,
    motion: Motion,
    scales: Scales,
    attributes: Mapping[str, Attribute],
    *,
    skipped: int,
    with_rests: bool,
) -> Capture:
    """Capture in SI of raw samples, cut to the motion with a little rest at both ends.

    Parameters
    ----------
    result, scales : GatherResult, Scales
        The samples of a run in counts, and what a count is.
    motion, skipped : Motion, int
        What was run; its first samples only prepared it.
    attributes : Mapping
        What else is known of the run.
    with_rests : bool
        Whether the motion is judged over its rests as well.

    Raises
    ------
    CaptureError
        Encoder and scale disagree, or the samples do not hold the motion.
    """
    first, last = moving_range(
        scales.motor_m(result.raw["commanded"]),
        scales.period_s,
        motion.position_m,
        skipped,
        with_rests=with_rests,
    )
    capture = capture_in_SI(
        result.raw,
        scales,
        lambda values: values[first:last],
        {
            **attributes,
            "start": RELAXED if skipped else APPROACHED,
            "first_servo_cycle": int(result.servo_cycle[first]),
        },
    )
    if capture.table_position_m is not None:
        watch = SensorWatch(MISMATCH_m)
        require_agreement(watch.feed(capture.motor_position_m, capture.table_position_m))
    return capture


def capture_in_SI(
    raw: Mapping[str, IntArray],
    scales: Scales,
    laid: Callable[[FloatArray], FloatArray],
    attributes: Mapping[str, Attribute],
    valid: BoolArray | None = None,
) -> Capture:
    """Gathered words as a capture: each signal, shape (n,), is ``laid`` on the capture's samples.

    What was not gathered, or is no longer there, the capture does not have.
    """
    commanded, motor_m = laid(scales.motor_m(raw["commanded"])), scales.motor_m(raw["actual"])
    # Feedback plus following error is the net desired position whatever sign convention the
    # compensation register has (Software Reference Manual p. 382 and p. 516 differ).
    following = raw.get("following_error")
    desired_m = None if following is None else motor_m + scales.motor_m(following)
    return Capture(
        time_s=np.arange(commanded.size, dtype=np.float64) * scales.period_s,
        commanded_position_m=commanded,
        desired_position_m=None if desired_m is None else laid(desired_m),
        motor_position_m=laid(motor_m),
        table_position_m=laid(scales.table_m(raw["scale"])) if "scale" in raw else None,
        # The word gathered in a cycle is the output of that cycle.
        torque_command_Nm=laid(scales.torque_Nm(raw["output"])) if "output" in raw else None,
        valid=valid,
        attributes=dict(attributes),
    )
