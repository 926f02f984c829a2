"""Other ways of running a motion than with a compensation, simulated on one drive.

What lives here: loops that are closed on the scale, a notch filter and scaled gains, offset and
torque by closed forms, and whether such a loop is stable. What may not: which of them are compared
and how each is tuned (``alternatives``).

The compiled loop closes on the scale through two reading terms: the reading that the controller
uses gets table minus motor added, with a weight, and that of the scale gets its weight taken away,
so that what the response calls motor and table still can be told apart.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import iirnotch

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import NonFinite
from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench, Controller
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.model.effect import split_name
from pmac_comp.physics.model.quasi_static import mechanical_error_m, motor_torque_Nm
from pmac_comp.physics.model.terms import Coordinate, Site, TableTerm
from pmac_comp.physics.signals.trajectory import trapezoid

_REACH_m = 10.0  # of the reading terms: beyond any travel
_MOST_REPEATS = 300  # of the dual loop, until no position of the table moves by more than this:
_AGREED_m = 2e-9
# Effects that a loop keeps whose stability is looked at: what slides hides it.
_LINEAR = frozenset({"viscous", "payload", "actuator_delay", "current_bandwidth"})
_NOTCH_QUALITY = 1.0
_SMOOTH_m_per_s = 1e-3  # within which closed forms turn friction over
_WINDOW_s = 0.25  # what is left in one must fade to this share in the next, or to this level:
_FADED = 0.6
_CALM_m = 1e-9


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
    """Position, speed, acceleration and direction (-1 to 1) of a command, SI, shape (n,) each."""
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
    """The drive without friction that slides, and with all of the motor's force at the table."""
    kept = tuple(name for name in model.effects if split_name(name)[0] in _LINEAR)
    prefixes = ("chain", *(split_name(name)[0] for name in kept))
    values = {k: v for k, v in model.parameters.items() if k.split(".")[0] in prefixes}
    if "chain.efficiency" in values:
        values["chain.efficiency"] = 1.0
    return replace(model, effects=kept, parameters=values)


def scaled_bench(bench: Bench, scaling: float, *, notch_Hz: float | None = None) -> Bench:
    """Bench whose loop gains are scaled, and with a notch; acceleration feedforward stays.

    The notch comes in place of one that the bench file states: a card has one.

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
    """I-variables of a bench with scaled loop gains and a notch (see ``scaled_bench``)."""
    motor = bench.encoder.motor_number
    given = dict(bench.controller.ivariables)
    gain, forward = given.get(f"I{motor}30", 2000.0), given.get(f"I{motor}35", 0.0)
    if notch_Hz is not None:
        names = [f"I{motor}{number}" for number in (36, 37, 38, 39)]
        gain *= _gain_at_rest(*(given.get(name, 0.0) for name in names))
        b, a = iirnotch(notch_Hz, _NOTCH_QUALITY, fs=1.0 / bench.servo_period_s)
        notch = [float(value) for value in (b[1] / b[0], b[2] / b[0], a[1], a[2])]
        gain /= _gain_at_rest(*notch)
        given |= zip(names, notch, strict=True)
    given[f"I{motor}30"] = gain * scaling
    given[f"I{motor}35"] = forward / scaling
    return given


def _gain_at_rest(n1: float, n2: float, d1: float, d2: float) -> float:
    """What a notch makes of a steady signal; one that integrates makes no definite value of it."""
    below = 1.0 + d1 + d2
    return (1.0 + n1 + n2) / below if below else 1.0
