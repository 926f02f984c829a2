"""What a user would do instead of model-based compensation, as rows of a table.

What lives here: feedback from the scale, notch filter, friction feedforward and iterative learning
beside this project's law, on the commands of runs that were not used for fitting; what has a free
choice takes the best. What may not: how such a way runs a motion (``other_ways``); measurement:
every figure is of the identified model taken as the plant, on its own unquantised positions.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import NonFinite
from pmac_comp.base.progress import Progress
from pmac_comp.base.units import UM_PER_M
from pmac_comp.physics.compensate.delay import drive_delay_s
from pmac_comp.physics.compensate.design import design_law
from pmac_comp.physics.compensate.evaluation import evaluate_law
from pmac_comp.physics.compensate.exact import exact_correction, faded
from pmac_comp.physics.compensate.loop import load_torque_Nm, model_loop, without_static
from pmac_comp.physics.compensate.resting import with_unwinding
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.quasi_static import modes_Hz
from pmac_comp.workflow.model.other_ways import (
    Errors,
    Way,
    friction_Nm,
    offset_m,
    scaled_bench,
    settles,
)

BASIS = (
    "simulated, not measured: the identified full model is the plant, on the commands of the "
    "captures that were not used for fitting; without sensor rounding, static errors and the mean "
    "of each run; ways that use the model know their plant exactly"
)
_SCALINGS = tuple(2.0 ** (i / 3.0) for i in range(-9, 10))  # of the loop gains that are tried
_TRIED = 7  # scalings below the largest stable one among which the best is taken
_WEIGHTS = (0.1, 0.25, 0.5, 0.75)  # of the scale in a blend with the motor that are tried
_SHARES = (0.5, 0.7, 0.85, 1.0)  # of the model's friction torque that are tried


@dataclass(frozen=True)
class AlternativeRow:
    """One way of working and what it leaves, rms over all motions in um; None if unstable.

    Parameters
    ----------
    name, how : str
        What it is and what was chosen for it.
    mechanical_rms_um : float or None
        Table minus motor, which a command offset or a feedback does not make smaller.
    residual_rms_um : float or None
        Table minus motor plus correction, where a correction is added to the command.
    total_rms_um : float or None
        Table minus command.
    total_per_motion_um : tuple of float
        The same for each motion.
    """

    name: str
    how: str
    mechanical_rms_um: float | None
    residual_rms_um: float | None
    total_rms_um: float | None
    total_per_motion_um: tuple[float, ...]


def compare_alternatives(
    model: DriveModel, commands_m: Sequence[FloatArray], *, progress: Progress | None = None
) -> tuple[AlternativeRow, ...]:
    """Rows of the table: the baseline first, this project's law last; none for a rigid drive.

    Parameters
    ----------
    model : DriveModel
        Identified model, taken as the plant.
    commands_m : sequence of ndarray
        Commands at the servo period; what has a free choice takes the best on the first of them.
    progress : callable or None
        ``progress(text, fraction)``.
    """
    if model.is_rigid or not commands_m:
        return ()
    plant = without_static(model)
    steps: tuple[tuple[str, Callable[[], list[AlternativeRow]]], ...] = (
        ("baseline", lambda: [_baseline(plant, commands_m)]),
        ("scale feedback", lambda: _scale_rows(plant, commands_m)),
        ("scale feedback with offset", lambda: [_scale_with_offset(plant, commands_m)]),
        ("notch filter", lambda: _notch_rows(plant, commands_m)),
        ("friction feedforward", lambda: [_friction(plant, commands_m)]),
        ("iterative learning", lambda: [_learning(plant, commands_m)]),
        ("this project's law", lambda: [_law(plant, commands_m)]),
    )
    rows: list[AlternativeRow] = []
    for i, (text, step) in enumerate(steps):
        if progress is not None:
            progress(f"alternatives: {text}", i / len(steps))
        rows += step()
    return tuple(rows)


def _baseline(plant: DriveModel, commands: Sequence[FloatArray]) -> AlternativeRow:
    name = "velocity and acceleration feedforward only (baseline)"
    return _row(name, "gains of the bench file, motor encoder", Way(plant), commands)


def _scale_rows(plant: DriveModel, commands: Sequence[FloatArray]) -> list[AlternativeRow]:
    """Both loops on the scale, or the position loop alone: gains of the bench, and the best."""
    rows = []
    for name, weight, dual in (
        ("linear-scale feedback alone", 1.0, False),
        ("linear-scale feedback, velocity loop on the motor", 0.0, True),
    ):
        way = Way(plant, weight=weight, dual=dual)
        as_is = AlternativeRow(name, "gains of the bench file: unstable", None, None, None, ())
        if settles(way):
            as_is = _row(name, "gains of the bench file", way, commands)
        rows.append(as_is)
        scaled = f"{name}, gains scaled"
        rows.append(_best_row(plant, commands, scaled, weight=weight, dual=dual))
    return rows


def _scale_with_offset(plant: DriveModel, commands: Sequence[FloatArray]) -> AlternativeRow:
    """Blend of motor and scale; the offset enters with the share of the motor.

    What the scale sees needs no offset: added whole to a loop closed on the table it would be an
    error of its own size.
    """
    ways = {
        w: Way(plant, w, correction_m=lambda r, k=1.0 - w: k * offset_m(plant, r))  # type: ignore[misc]
        for w in _WEIGHTS
    }
    stable = {w: way for w, way in ways.items() if settles(way)}
    name = "linear-scale feedback with the model's offset"
    if not stable:
        return AlternativeRow(name, "unstable at every weight tried", None, None, None, ())
    best = min(stable, key=lambda w: _total_um(stable[w], commands[0]))
    how = f"scale weighs {best:g}, the best; offset from the model; gains of the bench file"
    return _row(name, how, stable[best], commands)


def _notch_rows(plant: DriveModel, commands: Sequence[FloatArray]) -> list[AlternativeRow]:
    """Notch at the first mode in the middle of the travel, and the gain that it allows.

    Before it the gain that the loop allows without, so that the two are not mistaken.
    """
    rows = [_best_row(plant, commands, "higher gains alone, motor encoder")]
    if plant.bench.controller.kind == "pmac":  # the other control laws have no filter
        mode_Hz = float(modes_Hz(plant, plant.bench.mid_travel_m)[0])
        if mode_Hz < 0.45 / plant.bench.servo_period_s:
            name = f"notch filter at the first mode ({mode_Hz:.0f} Hz)"
            rows.append(_best_row(plant, commands, name, notch_Hz=mode_Hz))
    return rows


def _best_row(
    plant: DriveModel,
    commands: Sequence[FloatArray],
    name: str,
    *,
    weight: float = 0.0,
    dual: bool = False,
    notch_Hz: float | None = None,
) -> AlternativeRow:
    start = Way(plant, weight=weight, dual=dual)
    scaling, largest, way = _best_gain(start, commands[0], notch_Hz=notch_Hz)
    if way is None:
        return AlternativeRow(name, "unstable at every gain tried", None, None, None, ())
    how = f"gains x {scaling:.2f}, the best (stable up to x {largest:.2f})"
    return _row(name, how, way, commands)


def _friction(plant: DriveModel, commands: Sequence[FloatArray]) -> AlternativeRow:
    ways = {
        share: Way(plant, torque_Nm=lambda r, k=share: k * friction_Nm(plant, r))  # type: ignore[misc]
        for share in _SHARES
    }
    best = min(ways, key=lambda share: _total_um(ways[share], commands[0]))
    how = f"{best:.0%} of the model's friction torque, the best; gains of the bench file"
    return _row("torque compensation (friction feedforward)", how, ways[best], commands)


def _learning(plant: DriveModel, commands: Sequence[FloatArray]) -> AlternativeRow:
    """Each motion is learned for itself, from the table, without the model."""
    period, loop = plant.bench.servo_period_s, model_loop(plant)
    limit = plant.bench.safety.max_correction_um / UM_PER_M
    learned = [exact_correction(loop, r, period, limit_m=limit) for r in commands]
    errors = [
        Way(plant, correction_m=lambda _r, c=faded(one.correction_m): c).run(r)  # type: ignore[misc]
        for one, r in zip(learned, commands, strict=True)
    ]
    most = max(len(one.history_um) - 1 for one in learned)
    how = f"each motion repeated up to {most} times; of no use for another motion"
    return _row_of("iterative learning on the repeated motion", how, errors)


def _law(plant: DriveModel, commands: Sequence[FloatArray]) -> AlternativeRow:
    period = plant.bench.servo_period_s
    delay_s = drive_delay_s(plant)
    loop = model_loop(plant)
    load_Nm = load_torque_Nm(plant)
    law = design_law(plant.bench, loop, delay_s=delay_s, latency_cycles=0, load_Nm=load_Nm)
    law = with_unwinding(law, loop, plant.bench, 0, load_Nm)
    way = Way(
        plant,
        correction_m=lambda r: evaluate_law(law, r, period).correction_m,
        torque_Nm=lambda r: evaluate_law(law, r, period).torque_Nm,
    )
    how = "route servo, any motion, no scale needed while running; made from this very model"
    return _row("this project's law", how, way, commands)


def _best_gain(
    start: Way, command: FloatArray, *, notch_Hz: float | None = None
) -> tuple[float, float, Way | None]:
    """Best scaling of the loop gains, the largest stable one, and the way with the best."""
    stable: list[tuple[float, Way]] = []
    for scaling in _SCALINGS:
        bench = scaled_bench(start.model.bench, scaling, notch_Hz=notch_Hz)
        way = replace(start, model=replace(start.model, bench=bench))
        if settles(way):
            stable.append((scaling, way))
        elif stable:
            break
    if not stable:
        return math.nan, math.nan, None
    left = [(_total_um(way, command), scaling, way) for scaling, way in stable[-_TRIED:]]
    _, scaling, way = min(left, key=lambda item: item[0])
    return scaling, stable[-1][0], way


def _total_um(way: Way, command: FloatArray) -> float:
    try:
        return float(np.std(way.run(command).total_m)) * UM_PER_M
    except NonFinite:
        return math.inf


def _row(name: str, how: str, way: Way, commands: Sequence[FloatArray]) -> AlternativeRow:
    try:
        return _row_of(name, how, [way.run(command) for command in commands])
    except NonFinite:
        return AlternativeRow(name, f"{how}: diverges", None, None, None, ())


def _row_of(name: str, how: str, errors: Sequence[Errors]) -> AlternativeRow:
    residuals = [e.residual_m for e in errors if e.residual_m is not None]
    return AlternativeRow(
        name=name,
        how=how,
        mechanical_rms_um=_pooled_um([e.mechanical_m for e in errors]),
        residual_rms_um=_pooled_um(residuals) if residuals else None,
        total_rms_um=_pooled_um([e.total_m for e in errors]),
        total_per_motion_um=tuple(_pooled_um([e.total_m]) for e in errors),
    )


def _pooled_um(parts: Sequence[FloatArray]) -> float:
    centred = np.concatenate([part - np.mean(part) for part in parts])
    return float(np.sqrt(np.mean(centred**2))) * UM_PER_M
