"""What a user would do instead of model-based compensation, simulated on one identified drive.

What lives here: feedback from the scale, notch filter, friction feedforward and iterative learning
on the commands of runs that were not used for fitting. What may not: measurement; every figure
is of the identified model taken as the plant, on its own unquantised positions.

The compiled loop closes on the scale through two reading terms: the reading that the controller
uses gets table minus motor added, with a weight, and that of the scale gets its weight taken away,
so that what the response calls motor and table still can be told apart.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import iirnotch

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import NonFinite
from pmac_comp.base.progress import Progress
from pmac_comp.base.units import MM_PER_M, UM_PER_M
from pmac_comp.files.bench import Bench, Controller
from pmac_comp.physics.compensate.delay import drive_delay_s
from pmac_comp.physics.compensate.design import design_law
from pmac_comp.physics.compensate.exact import exact_correction, faded
from pmac_comp.physics.compensate.law import evaluate_law
from pmac_comp.physics.compensate.loop import load_torque_Nm, model_loop, without_static
from pmac_comp.physics.compensate.resting import with_unwinding
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.model.effect import split_name
from pmac_comp.physics.model.quasi_static import mechanical_error_m, modes_Hz, motor_torque_Nm
from pmac_comp.physics.model.terms import Coordinate, Site, TableTerm
from pmac_comp.physics.signals.trajectory import trapezoid

BASIS = (
    "simulated, not measured: the identified full model is the plant, on the commands of the "
    "captures that were not used for fitting; without sensor rounding, static errors and the mean "
    "of each run; ways that use the model know their plant exactly"
)
_REACH_m = 10.0  # of the reading terms: beyond any travel
_SCALINGS = tuple(2.0 ** (i / 3.0) for i in range(-9, 10))
_TRIED = 7  # scalings below the largest stable one among which the best is taken
_WINDOW_s = 0.25  # what is left in one must fade to this share in the next, or to this level:
_FADED = 0.6
_CALM_m = 1e-9
_MOST_REPEATS = 300
_AGREED_m = 2e-9
_LINEAR = frozenset({"viscous", "payload", "actuator_delay", "current_bandwidth"})
_NOTCH_QUALITY = 1.0
_WEIGHTS = (0.1, 0.25, 0.5, 0.75)
_SHARES = (0.5, 0.7, 0.85, 1.0)
_SMOOTH_m_per_s = 1e-3


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


@dataclass(frozen=True)
class Way:
    """A way of running one motion: drive with its controller, weight of the scale, inputs.

    Parameters
    ----------
    model : DriveModel
        Plant with the controller's gains.
    weight : float
        Share of the scale in the position that the controller uses, 0 (motor) to 1 (table).
    dual : bool
        Position loop on the scale, velocity loop on the motor; then ``weight`` is not used.
    correction_m, torque_Nm : callable or None
        Of the command, shape (n,): what is added to command and controller output.
    """

    model: DriveModel
    weight: float = 0.0
    dual: bool = False
    correction_m: Callable[[FloatArray], FloatArray] | None = None
    torque_Nm: Callable[[FloatArray], FloatArray] | None = None

    def run(self, command_m: FloatArray) -> "Errors":
        """Errors of one motion; raises NonFinite if the loop diverges."""
        if self.dual:
            motor, table = dual_positions_m(self.model, command_m)
            return Errors(table - motor, None, table - command_m)
        added = None if self.correction_m is None else self.correction_m(command_m)
        torque = None if self.torque_Nm is None else self.torque_Nm(command_m)
        motor, table = positions_m(self.model, command_m, added, torque, weight=self.weight)
        residual = None if added is None else table - motor + added
        return Errors(table - motor, residual, table - command_m)


@dataclass(frozen=True)
class Errors:
    """Errors of one motion in m, shape (n,) each."""

    mechanical_m: FloatArray
    residual_m: FloatArray | None
    total_m: FloatArray


def positions_m(
    model: DriveModel,
    command_m: FloatArray,
    correction_m: FloatArray | None = None,
    torque_Nm: FloatArray | None = None,
    *,
    weight: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Motor and table position in m, shape (n,), with a loop closed on a blend of the two.

    Parameters
    ----------
    model : DriveModel
        The drive.
    command_m, correction_m, torque_Nm : ndarray, shape (n,)
        Command, what is added to it, and what is added to the controller's output.
    weight : float
        The controller sees ``(1 - weight) motor + weight table``, for position and velocity.

    Raises
    ------
    NonFinite
        The loop diverges.
    """
    response = simulate(
        model,
        command_m,
        desired_position_m=None if correction_m is None else command_m + correction_m,
        torque_feedforward_Nm=torque_Nm,
        extra_terms=_blend(model, weight) if weight else (),
    )
    if not weight:
        return response.motor_position_m, response.table_position_m
    seen, motor = response.motor_position_m, response.table_position_m
    return motor, (seen - (1.0 - weight) * motor) / weight


def dual_positions_m(model: DriveModel, command_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Motor and table position in m, shape (n,): position loop on the scale, velocity on the motor.

    The compiled loop uses one reading. What its proportional and integral parts lack, the gains
    times table minus motor, enters as torque and is found by repetition until it stands still.

    Raises
    ------
    NonFinite
        The loop diverges, or the repetition does, as it must with a loop that is not stable.

    Source
    ------
    Turbo PMAC Software Reference Manual, Ixx03 (position feedback) and Ixx04 (velocity feedback).
    """
    vector = model.kernel_vector()
    cascade = vector[s.LAW] > 0.5
    proportional = vector[s.CASCADE_GAIN] * vector[s.CASCADE_KP] if cascade else vector[s.KP]
    per_cycle = 0.0 if cascade else vector[s.KI] * vector[s.PERIOD]
    torque = np.zeros(command_m.size)
    before = np.full(command_m.size, math.inf)
    for _ in range(_MOST_REPEATS):
        response = simulate(model, command_m, torque_feedforward_Nm=torque)
        table, error = response.table_position_m, response.mechanical_error_m
        if np.max(np.abs(table - before)) < _AGREED_m:
            return response.motor_position_m, table
        before = table
        torque = -proportional * error - per_cycle * (np.cumsum(error) - error)
    raise NonFinite("The dual loop does not settle on one motion.", code="PC-ALT-001")


def _blend(model: DriveModel, weight: float) -> tuple[TableTerm, ...]:
    """Terms by which the controller sees the blend, and the second reading is the motor's."""
    radians = _REACH_m / model.bench.lead_m_per_rad

    def line(coordinate: Coordinate, site: Site, reach: float, factor: float) -> TableTerm:
        ends = np.array([-_REACH_m, _REACH_m]) * factor
        return TableTerm(coordinate, site, -reach, 2.0 * reach, ends)

    table, angle = Coordinate.TABLE_POSITION_M, Coordinate.MOTOR_ANGLE_RAD
    return (
        line(table, Site.MOTOR_READING_M, _REACH_m, weight),
        line(angle, Site.MOTOR_READING_M, radians, -weight),
        line(table, Site.TABLE_READING_M, _REACH_m, -1.0),
        line(angle, Site.TABLE_READING_M, radians, 1.0),
    )


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


def offset_m(model: DriveModel, command_m: FloatArray) -> FloatArray:
    """Model's offset for a command: the quasi-static mechanical error with opposite sign, in m."""
    motion = _motion(model, command_m)
    return -mechanical_error_m(model, *motion)


def friction_Nm(model: DriveModel, command_m: FloatArray) -> FloatArray:
    """Friction torque of the model for a command in N m: what moves it slowly, by direction."""
    position, speed, _, direction = _motion(model, command_m)
    still = np.zeros(command_m.size)
    slow = direction * np.minimum(np.abs(speed), _SMOOTH_m_per_s)
    return motor_torque_Nm(model, position, slow, still, direction)


def _motion(
    model: DriveModel, command_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    period = model.bench.servo_period_s
    speed = np.gradient(command_m, period)
    return command_m, speed, np.gradient(speed, period), np.tanh(speed / _SMOOTH_m_per_s)


def settles(way: Way) -> bool:
    """Whether the loop is stable without sliding friction, at both ends and in the middle.

    Friction hides an unstable loop as long as the axis stands: it is left out, and what a short
    move leaves must fade.
    """
    bench = way.model.bench
    half = 0.45 * (bench.travel.max_mm - bench.travel.min_mm) / MM_PER_M
    window = round(_WINDOW_s / bench.servo_period_s)
    smooth = replace(way, model=_without_sliding(way.model), correction_m=None, torque_Nm=None)
    for place in (-half, 0.0, half):
        move = trapezoid(
            period_s=bench.servo_period_s,
            distance_m=0.02 if place <= 0.0 else -0.02,
            speed_m_per_s=0.1,
            acceleration_m_per_s2=2.0,
            s_curve_s=0.015,
            start_m=bench.mid_travel_m + place,
            dwell_s=3.0 * _WINDOW_s,
        )
        try:
            total = smooth.run(move.position_m).total_m
        except NonFinite:
            return False
        early, late = np.ptp(total[-2 * window : -window]), np.ptp(total[-window:])
        if late > max(_FADED * early, _CALM_m):
            return False
    return True


def _without_sliding(model: DriveModel) -> DriveModel:
    kept = tuple(name for name in model.effects if split_name(name)[0] in _LINEAR)
    prefixes = ("chain", *(split_name(name)[0] for name in kept))
    values = {k: v for k, v in model.parameters.items() if k.split(".")[0] in prefixes}
    if "chain.efficiency" in values:
        values["chain.efficiency"] = 1.0
    return replace(model, effects=kept, parameters=values)


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


def scaled_bench(bench: Bench, scaling: float, *, notch_Hz: float | None = None) -> Bench:
    """Bench whose loop gains are scaled, and with a notch; acceleration feedforward stays.

    Source
    ------
    Turbo PMAC Software Reference Manual, Ixx30-Ixx39: Ixx30 multiplies the whole law, the notch is
    (1 + N1 z^-1 + N2 z^-2) / (1 + D1 z^-1 + D2 z^-2) and has its gain at rest in Ixx30.
    """
    control = bench.controller
    changed: Controller
    if control.kind == "pmac":
        changed = control.model_copy(update={"ivariables": _scaled_pmac(bench, scaling, notch_Hz)})
    elif control.si is not None and control.kind == "si":
        names = ("Kp_Nm_per_mm", "Ki_Nm_per_mm_s", "Kd_Nm_s_per_mm", "Kvff_Nm_s_per_mm")
        values = {name: scaling * getattr(control.si, name) for name in names}
        changed = control.model_copy(update={"si": control.si.model_copy(update=values)})
    elif control.cascade is not None:
        gain = {"kv_V_per_m_per_s": scaling * control.cascade.kv_V_per_m_per_s}
        changed = control.model_copy(update={"cascade": control.cascade.model_copy(update=gain)})
    else:
        changed = control
    return bench.model_copy(update={"controller": changed})


def _scaled_pmac(bench: Bench, scaling: float, notch_Hz: float | None) -> dict[str, float]:
    motor = bench.encoder.motor_number
    given = dict(bench.controller.ivariables)
    gain, forward = given.get(f"I{motor}30", 2000.0), given.get(f"I{motor}35", 0.0)
    at_rest = 1.0
    if notch_Hz is not None:
        b, a = iirnotch(notch_Hz, _NOTCH_QUALITY, fs=1.0 / bench.servo_period_s)
        at_rest = float(b[0])
        coefficients = (b[1] / b[0], b[2] / b[0], a[1], a[2])
        given |= {f"I{motor}{36 + i}": float(value) for i, value in enumerate(coefficients)}
    given[f"I{motor}30"] = gain * scaling * at_rest
    given[f"I{motor}35"] = forward / scaling
    return given


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
