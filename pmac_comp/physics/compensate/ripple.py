"""Torque that repeats with the turn of the screw, found in captures: cogging and friction.

What lives here: the orders of the cogging from steady runs, and the amplitudes from all runs. What
may not: the model's fit, controllers.

Cogging pushes whichever way the motor turns. Teeth that grip give a wave that changes its sign with
the friction: it has the order of the cogging or is the nut's, once per turn. A motor may also have
a second order of cogging, as of its poles beside that of its slots. The torque constant of a motor
ripples too: that wave goes with the torque, a load's among it, shows most where a run accelerates,
and has an order of its own. A law has room for one cogging and one of the others: for the two that
explain most.

A model without these effects misses the motor's position by what the loop lets through of them.
What it would let through of a known torque is simulated, so the amplitudes come out of a linear
regression with the loop, the delay and the friction in it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import fftconvolve

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate import delay
from pmac_comp.physics.compensate.constant import constant_torque
from pmac_comp.physics.compensate.evaluation import friction_state
from pmac_comp.physics.compensate.grip import gripping_torque
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import LoopRunner, LoopSignals, model_loop
from pmac_comp.physics.compensate.starts import held_at_start_Nm
from pmac_comp.physics.model import slots
from pmac_comp.physics.signals.trajectory import trapezoid

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

RIPPLE = "torque_ripple"
TURNING = ("cogging", "friction_per_rev")  # what else of a model goes by the turn
_HIGHEST_ORDER = 60
_LEAST_TURNS = 3.0
_STEADY_FRAC = 0.02
_STANDS_OUT = 6.0  # times the typical amplitude of the neighbouring orders
_NEIGHBOURS = 6
_MOST_ORDERS = 3  # that are tried
_LEAST_ORDER = 3  # below, friction per turn and lead wobble live
_PROBE_Nm = 0.02  # torque whose effect is simulated
_LEAST_RUNS = 4  # fewer do not tell how far the share of the torque that ripples scatters
_SURE = 5.0  # standard deviations of it: of 60 orders none came out above 3 by chance
_LEAST_SHARE = 0.005  # of the torque: a model's errors make up to 0.0015; less hides nothing
_PULSE_LASTS_s = 0.3  # of the answer of the loop to a pulse of torque
_CRUISE_FRAC = 0.99  # of the highest speed of a move
_LEAST_GAIN_FRAC = 0.01  # of the residual's power: less is not worth its time in each pass
_DECIMATION = 3
_FIRST, _SECOND = slice(0, 2), slice(2, 4)  # columns of the regression
_MOTOR = 0  # of the channels; the other is table minus motor


class Kind(Enum):
    """What a wave over the turn goes with."""

    PUSHES = auto()  # nothing: cogging
    GRIPS = auto()  # the friction
    RIPPLES = auto()  # the torque


@dataclass(frozen=True)
class TurnTorque:
    """Torque to be added per turn of the screw.

    Parameters
    ----------
    order : int
        Order of the cogging per turn, 0 for none.
    ripple_Nm, ripple_phase_rad : float
        Amplitude and phase of ``sin(order angle + phase)``.
    second_size, second_phase_rad : float
        The same of the second wave, in N m, or the share of the torque where that ripples.
    second_order : int
        Order of that per turn.
    second_kind : Kind
        What it goes with: cogging as well, friction or torque.
    explained : float
        Share of what the model left of the motor's position that these explain.
    whole_Nm_s2_per_m, whole_Nm_s_per_m : float
        Torque per acceleration and per speed of the model.
    """

    order: int
    ripple_Nm: float
    ripple_phase_rad: float
    second_size: float
    second_phase_rad: float
    second_order: int
    second_kind: Kind
    explained: float
    whole_Nm_s2_per_m: float = 0.0
    whole_Nm_s_per_m: float = 0.0


@dataclass(frozen=True)
class _Wave:
    """A wave over the turn and what it does.

    ``responses`` of its cosine and its sine, in m per N m, shape (n, 2, 2): of all runs, by part of
    the wave, and of motor and table minus motor; of a wave that goes with the torque, in m.
    """

    order: int
    kind: Kind
    responses: FloatArray


@dataclass(frozen=True)
class _Runs:
    """Captures, and what the loop of a model makes of their commands.

    Parameters
    ----------
    law : CompensationLaw
        Its turn and its break-away distance are used, and what it has room for.
    loop : LoopRunner
        Closed loop of the model.
    captures : tuple of Capture
        Runs without compensation.
    plain : tuple of LoopSignals
        The loop's signals along them.
    torques_Nm : tuple of ndarray, shape (n,) each
        What the motor is asked for: the model's torque and a load beside it.
    rests_m : tuple of ndarray, shape (n, 2) each
        Motor, and table minus motor, that the model does not explain.
    delay_s : float
        From the torque command to the torque at the shaft.
    """

    law: CompensationLaw
    loop: LoopRunner
    captures: tuple[Capture, ...]
    plain: tuple[LoopSignals, ...]
    torques_Nm: tuple[FloatArray, ...]
    rests_m: tuple[FloatArray, ...]
    delay_s: float

    @classmethod
    def of(
        cls, law: CompensationLaw, loop: LoopRunner, captures: Sequence[Capture], delay_s: float
    ) -> "_Runs":
        """Captures with what the loop makes of them."""
        plain = tuple(loop(capture.commanded_position_m, None, None) for capture in captures)
        load = constant_torque(loop, captures)
        torques_Nm = tuple(
            one.torque_Nm + (0.0 if load is None else load.at(capture.commanded_position_m))
            for capture, one in zip(captures, plain, strict=True)
        )
        rests_m = tuple(_rest_m(law, loop, capture) for capture in captures)
        return cls(law, loop, tuple(captures), plain, torques_Nm, rests_m, delay_s)

    def coggings(self) -> tuple[int, ...]:
        """Orders of the cogging that the runs show."""
        motor_m = [rest_m[:, _MOTOR] for rest_m in self.rests_m]
        return cogging_orders(self.captures, motor_m, self.law.turn_m)

    def wave(self, order: int, kind: Kind) -> _Wave:
        """What a wave of an order does in all runs."""
        both = zip(self.captures, self.torques_Nm, strict=True)
        shapes = [self.shapes(c, order, _goes_with(self.law, c, own, kind)) for c, own in both]
        return _Wave(order, kind, self.responses(shapes))

    def shapes(self, capture: Capture, order: int, size: FloatArray) -> list[FloatArray]:
        """Cosine and sine of an order over the turn along a run, times a size."""
        v = _speed(capture)
        place_m = capture.motor_position_m + v * self.delay_s
        angle = order * 2.0 * math.pi * place_m / self.law.turn_m
        return [size * np.cos(angle), size * np.sin(angle)]

    def responses(self, shapes: Sequence[Sequence[FloatArray]]) -> FloatArray:
        """Motor and table minus motor in m per N m of torque shapes, shape (n, shapes, 2)."""
        parts = []
        for capture, without, own in zip(self.captures, self.plain, shapes, strict=True):
            r = capture.commanded_position_m
            moved = [self.loop(r, None, -_PROBE_Nm * shape) for shape in own]
            motor = [m.motor_position_m - without.motor_position_m for m in moved]
            error = [_table_minus_motor(m) - _table_minus_motor(without) for m in moved]
            both = np.stack([np.column_stack(motor), np.column_stack(error)], axis=2)
            parts.append(both[::_DECIMATION] / _PROBE_Nm)
        return np.concatenate(parts)


def turn_torque(
    law: CompensationLaw,
    loop: LoopRunner,
    captures: Sequence[Capture],
    *,
    drive_delay_s: float,
) -> TurnTorque:
    """Cogging and friction per turn that captures show and a model does not hold.

    Parameters
    ----------
    law : CompensationLaw
        Law of the model; its turn and its break-away distance are used.
    loop : LoopRunner
        Closed loop of the model.
    captures : sequence of Capture
        Runs without compensation.
    drive_delay_s : float
        From the torque command to the torque at the shaft.
    """
    runs = _Runs.of(law, loop, captures, drive_delay_s)
    rest_m = np.concatenate([rest[::_DECIMATION] for rest in runs.rests_m])
    steady = runs.responses([_steady_shapes(law, capture) for capture in captures])
    tried = [
        (first, second, np.hstack([first.responses, second.responses, steady]))
        for first, second in _candidates(runs)
    ]
    first, second, responses = min(tried, key=lambda one: float(_missed(one[2], rest_m).sum()))
    found = _regression(responses[:, :, _MOTOR], rest_m[:, _MOTOR])
    least = _missed(responses, rest_m)
    # Share of the residual's power that a wave explains beyond all else, where it explains more.
    shares = [_missed(_without(responses, pair), rest_m) - least for pair in (_FIRST, _SECOND)]
    gains = [float(gain) if gain > _LEAST_GAIN_FRAC else 0.0 for gain in map(np.max, shares)]
    ripple_Nm, ripple_phase_rad = _as_sine(found[_FIRST], gains[0])
    second_size, second_phase_rad = _as_sine(found[_SECOND], gains[1])
    per_acceleration, per_speed = _torque_of_motion(runs)
    return TurnTorque(
        order=first.order if ripple_Nm else 0,
        ripple_Nm=ripple_Nm,
        ripple_phase_rad=ripple_phase_rad,
        second_size=second_size,
        second_phase_rad=second_phase_rad,
        second_order=second.order,
        second_kind=second.kind,
        explained=sum(max(float(s[_MOTOR]), 0.0) for s, g in zip(shares, gains, strict=True) if g),
        whole_Nm_s2_per_m=per_acceleration,
        whole_Nm_s_per_m=per_speed,
    )


def _candidates(runs: _Runs) -> list[tuple[_Wave, _Wave]]:
    """Pairs of a cogging, or none, and a second wave, of which a law has room for one."""
    orders = runs.coggings()
    once = runs.wave(1, Kind.GRIPS)
    coggings = [runs.wave(order, Kind.PUSHES) for order in orders]
    rippling = _rippling(runs, orders)
    ripples = [] if rippling is None else [runs.wave(rippling[0], Kind.RIPPLES)]
    if not coggings:
        nothing = _Wave(0, Kind.PUSHES, np.zeros_like(once.responses))
        return [(nothing, second) for second in (once, *ripples)]
    pairs: list[tuple[_Wave, _Wave]] = []
    for first in coggings:
        others = [other for other in coggings if other is not first]
        gripping = runs.wave(first.order, Kind.GRIPS)
        pairs += [(first, second) for second in (once, gripping, *others, *ripples)]
    return pairs


def _missed(responses: FloatArray, rest_m: FloatArray) -> FloatArray:
    """Share of its power that the waves leave of motor and of table minus motor, shape (2,).

    The motor tells how large they are. But a wave of a high order hardly moves it and shakes the
    table where it passes the first mode: whether it is worth its time, and which of several orders
    is, shows in both.
    """
    found = _regression(responses[:, :, _MOTOR], rest_m[:, _MOTOR])
    left = rest_m - np.einsum("ijk,j->ik", responses, found)
    return np.asarray(np.sum(left**2, axis=0) / np.maximum(np.sum(rest_m**2, axis=0), 1e-30))


def _without(responses: FloatArray, pair: slice) -> FloatArray:
    """Responses of all waves but one."""
    fewer = responses.copy()
    fewer[:, pair] = 0.0
    return fewer


def _as_sine(found: FloatArray, gain_frac: float) -> tuple[float, float]:
    """Amplitude and phase of a sine from its cosine and sine parts; nothing without a gain."""
    if gain_frac <= 0.0:
        return 0.0, 0.0
    cosine, sine = (float(part) for part in found)
    return math.hypot(cosine, sine), math.atan2(cosine, sine)


def rippling_model(model: "DriveModel", captures: Sequence[Capture]) -> "DriveModel | None":
    """A model with the ripple of the torque that runs show beyond it; None where they show none.

    Where a fit may begin: the wave is read at one order, before anything else is fitted beside it.

    Parameters
    ----------
    model : DriveModel
        Without ``torque_ripple``.
    captures : sequence of Capture
        Runs without compensation, hard ones among them.
    """
    pitch_m = 2.0 * math.pi * model.bench.lead_m_per_rad
    law = CompensationLaw(turn_m=pitch_m, torque_limit_Nm=model.bench.drive.torque_limit_Nm)
    runs = _Runs.of(law, model_loop(model), captures, delay.drive_delay_s(model))
    found = _rippling(runs, runs.coggings())
    if found is None:
        return None
    order, (cosine, sine) = found
    whole = model.with_effect(RIPPLE, {"amplitude_Nm": 1.0})
    share_per_Nm = float(whole.kernel_vector()[slots.RIPPLE])
    # What the motor lacks; the effect is what it has more, a cosine.
    values = {
        "amplitude_Nm": math.hypot(cosine, sine) / share_per_Nm,
        "order_per_rev": float(order),
        "phase_rad": math.atan2(sine, -cosine),
    }
    return model.with_effect(RIPPLE, values)


def turning_model(model: "DriveModel", captures: Sequence[Capture]) -> "DriveModel":
    """A model with the cogging and the friction by the turn that runs show beyond it.

    Where a fit may begin. The model itself where they show none, or where it has its own.

    Parameters
    ----------
    model : DriveModel
        Its friction grips as the drive's does.
    captures : sequence of Capture
        Runs without compensation.
    """
    if not set(TURNING).isdisjoint(model.effects):
        return model
    pitch_m = 2.0 * math.pi * model.bench.lead_m_per_rad
    law = CompensationLaw(turn_m=pitch_m, torque_limit_Nm=model.bench.drive.torque_limit_Nm)
    loop, delay_s = model_loop(model), delay.drive_delay_s(model)
    found = turn_torque(law, loop, captures, drive_delay_s=delay_s)
    grown = model
    # What the law would send: against cogging, and with friction; both are cosines of the model.
    if found.ripple_Nm > 0.0:
        phase_rad = found.ripple_phase_rad + 0.5 * math.pi
        grown = _with_wave(grown, "cogging", found.ripple_Nm, found.order, phase_rad)
    if found.second_kind is Kind.GRIPS and found.second_size > 0.0:
        phase_rad = found.second_phase_rad - 0.5 * math.pi
        wave = ("friction_per_rev", found.second_size, found.second_order, phase_rad)
        grown = _with_wave(grown, *wave)
    return grown


def _with_wave(
    model: "DriveModel", effect: str, amplitude_Nm: float, order: int, phase_rad: float
) -> "DriveModel":
    values = {"amplitude_Nm": amplitude_Nm, "order_per_rev": float(order)}
    wrapped_rad = math.remainder(phase_rad, 2.0 * math.pi)
    return model.with_effect(effect, {**values, "phase_rad": wrapped_rad})


def with_turn_torque(law: CompensationLaw, found: TurnTorque) -> CompensationLaw:
    """Law with the torque per turn, which it looks ahead for as for friction."""
    order, phase_rad = found.second_order, found.second_phase_rad
    if found.second_kind is Kind.PUSHES:  # the law knows it by an order below zero
        order, phase_rad = -order, math.pi - phase_rad  # sin(x) = sin(pi - x)
    ripples = found.second_kind is Kind.RIPPLES and found.second_size > 0.0
    loop_Nm_s2_per_m = found.whole_Nm_s2_per_m - law.torque_inertia_Nm_s2_per_m
    loop_Nm_s_per_m = found.whole_Nm_s_per_m - law.torque_viscous_Nm_s_per_m
    return law.with_values(
        ripple_Nm=found.ripple_Nm,
        ripple_order=float(found.order),
        ripple_phase_rad=found.ripple_phase_rad,
        turn_friction_Nm=0.0 if ripples else found.second_size,
        turn_share=found.second_size if ripples else 0.0,
        torque_loop_Nm_s2_per_m=loop_Nm_s2_per_m if ripples else 0.0,
        torque_loop_Nm_s_per_m=loop_Nm_s_per_m if ripples else 0.0,
        turn_order=float(order),
        turn_phase_rad=phase_rad,
    )


def cogging_orders(
    captures: Sequence[Capture], rests: Sequence[FloatArray], turn_m: float
) -> tuple[int, ...]:
    """Orders per turn that stand out of the motor's residual at steady speed, the first the most.

    Orders below three are left to friction per turn; both directions must show an order.
    ``rests`` are what no model explains of each capture's motor position, in m, shape (n,) each.
    """
    scores = [
        _order_scores(capture, rest, turn_m, direction)
        for capture, rest in zip(captures, rests, strict=True)
        for direction in (1.0, -1.0)
    ]
    known = [score for score in scores if score is not None]
    if not known:
        return ()
    # An order that only some speeds let through counts where it is seen best, in both directions.
    best = np.sort(np.array(known), axis=0)[-2:].min(axis=0) if len(known) > 1 else known[0]
    first = np.argsort(-best, kind="stable")[:_MOST_ORDERS]
    return tuple(int(i) + _LEAST_ORDER for i in first if best[i] > _STANDS_OUT)


def _order_scores(
    capture: Capture, rest: FloatArray, turn_m: float, direction: float
) -> FloatArray | None:
    """Amplitude of each order over that of its neighbours, None without a steady stretch."""
    r = capture.commanded_position_m
    speed = direction * np.gradient(r, capture.sample_period_s)
    top = float(np.max(speed))
    use = (speed > (1.0 - _STEADY_FRAC) * top) & capture.mask & (speed > 1e-4)
    if np.ptp(r[use]) < _LEAST_TURNS * turn_m if use.any() else True:
        return None
    angle = 2.0 * math.pi * r[use] / turn_m
    values = rest[use] - np.polyval(np.polyfit(angle, rest[use], 3), angle)
    orders = np.arange(1, _HIGHEST_ORDER + _NEIGHBOURS + 1)
    amplitude = np.array([abs(np.mean(values * np.exp(-1j * n * angle))) for n in orders])
    scores = np.empty(_HIGHEST_ORDER - _LEAST_ORDER + 1)
    for i, n in enumerate(range(_LEAST_ORDER, _HIGHEST_ORDER + 1)):
        low = max(_LEAST_ORDER - 1, n - 1 - _NEIGHBOURS)
        near = np.delete(amplitude[low : n + _NEIGHBOURS], n - 1 - low)
        scores[i] = amplitude[n - 1] / max(float(np.median(near)), 1e-12)
    return scores


def _rippling(runs: _Runs, coggings: Sequence[int]) -> tuple[int, FloatArray] | None:
    """Ripple of the torque that the motor's residual shows: order per turn, cosine and sine part.

    None without one. The parts are the share of the torque that the motor lacks.

    A motor ripples by the same share in all runs, whatever torque they take: what only fits to one
    of them is none. What the loop makes of torque is taken from its answer to a pulse: simulated
    for each order it would take minutes. A law with a gap and a bed has no room for one.

    Source
    ------
    Scatter of the share by leaving out one run after another (jackknife, Efron 1982).
    """
    law, n = runs.law, len(runs.captures)
    no_room = law.gap_half_m > 0.0 and law.bed_share > 0.0
    if no_room or law.torque_limit_Nm == 0.0 or n < _LEAST_RUNS:
        return None
    normal, moment = _ripple_equations(runs, coggings)
    share = _solved(normal.sum(0), moment.sum(0))
    others = _solved(normal.sum(0) - normal, moment.sum(0) - moment)
    variance = (n - 1.0) / n * np.sum((others - others.mean(axis=0)) ** 2, axis=(0, 2))
    sure = np.hypot(*share.T) / np.sqrt(np.maximum(variance, 1e-30))
    best = int(np.argmax(sure))
    told = sure[best] > _SURE and np.hypot(*share[best]) > _LEAST_SHARE
    return (best + 1, share[best]) if told else None


def _ripple_equations(runs: _Runs, coggings: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Normal equations of a ripple of each order in each run: matrix and right side.

    Shapes (runs, orders, 2, 2) and (runs, orders, 2): by cosine and sine. Cogging is fitted beside
    it, of any size in each run: neighbouring orders of a run of few turns look alike.
    """
    n = len(runs.captures)
    normal, moment = np.empty((n, _HIGHEST_ORDER, 2, 2)), np.empty((n, _HIGHEST_ORDER, 2))
    answer = _pulse_answer(runs.loop, runs.captures[0])
    together = zip(runs.captures, runs.torques_Nm, runs.rests_m, strict=True)
    for k, (capture, torque_Nm, rest_m) in enumerate(together):
        one = np.ones(capture.n)
        pushed = [row for order in coggings for row in runs.shapes(capture, order, one)]
        beside, _ = np.linalg.qr(np.vstack([one, *_answered(pushed, answer)]).T)
        left = _apart(rest_m[:, _MOTOR], beside)
        for i in range(_HIGHEST_ORDER):
            shapes = _apart(
                np.array(_answered(runs.shapes(capture, i + 1, torque_Nm), answer)), beside
            )
            normal[k, i], moment[k, i] = shapes @ shapes.T, shapes @ left
    return normal, moment


def _answered(torques: Sequence[FloatArray], answer: FloatArray) -> list[FloatArray]:
    """What torques move by the answer to a pulse of one sample."""
    return [fftconvolve(torque, answer)[: torque.size] for torque in torques]


def _apart(values: FloatArray, beside: FloatArray) -> FloatArray:
    """Rows, shape (..., n), less what columns at right angles, shape (n, m), have of them."""
    return values - values @ beside @ beside.T


def _solved(normal: FloatArray, moment: FloatArray) -> FloatArray:
    """Cosine and sine parts of orders, shape (..., 2), by their normal equations."""
    little = 1e-12 * np.trace(normal, axis1=-2, axis2=-1)[..., None, None] + 1e-30
    return np.linalg.solve(normal + little * np.eye(2), moment[..., None])[..., 0]


def _pulse_answer(loop: LoopRunner, like: Capture) -> FloatArray:
    """Motor's answer in m per N m to one sample of torque while it moves."""
    period = like.sample_period_s
    r = like.commanded_position_m
    move = trapezoid(
        period_s=period,
        distance_m=max(float(np.ptp(r)), 0.02),
        speed_m_per_s=0.05,
        acceleration_m_per_s2=0.5,
        s_curve_s=0.05,
        start_m=float(np.min(r)),
    ).position_m
    cruising = np.flatnonzero(np.diff(move) > _CRUISE_FRAC * np.max(np.diff(move)))
    at = int(cruising[cruising.size // 3])  # friction, which would hold the motor, stays as it is
    pulse = np.zeros(move.size)
    pulse[at] = _PROBE_Nm
    moved = loop(move, None, -pulse).motor_position_m - loop(move, None, None).motor_position_m
    return np.asarray(moved[at : at + round(_PULSE_LASTS_s / period)] / _PROBE_Nm)


def _torque_of_motion(runs: _Runs) -> tuple[float, float]:
    """Torque of the model per acceleration in N m per m/s2, per speed in N m per m/s."""
    columns, torques = [], []
    for capture, one in zip(runs.captures, runs.plain, strict=True):
        v = _speed(capture)
        a = np.gradient(v, capture.sample_period_s)
        columns.append(np.column_stack([a, v, _state(runs.law, capture), np.ones_like(v)]))
        torques.append(one.torque_Nm)
    found = _regression(np.concatenate(columns), np.concatenate(torques))
    return float(found[0]), float(found[1])


def _rest_m(law: CompensationLaw, loop: LoopRunner, capture: Capture) -> FloatArray:
    """Motor and table minus motor that the model does not explain, m, shape (n, 2)."""
    missing = gripping_torque(law, capture)
    held_Nm = held_at_start_Nm(capture)
    simulated = loop(capture.commanded_position_m, None, missing, held_Nm)
    motor = capture.motor_position_m - simulated.motor_position_m
    table = capture.table_position_m
    if table is None:
        return np.column_stack([motor, np.zeros(capture.n)])
    error = table - capture.motor_position_m - _table_minus_motor(simulated)
    return np.column_stack([motor, error - np.mean(error)])


def _table_minus_motor(signals: LoopSignals) -> FloatArray:
    return signals.table_position_m - signals.motor_position_m


def _goes_with(
    law: CompensationLaw, capture: Capture, torque_Nm: FloatArray, kind: Kind
) -> FloatArray:
    """What a wave is multiplied by: friction's direction, the torque in N m, or one."""
    if kind is Kind.GRIPS:
        return _state(law, capture)
    return torque_Nm if kind is Kind.RIPPLES else np.ones(capture.n)


def _steady_shapes(law: CompensationLaw, capture: Capture) -> list[FloatArray]:
    """What else friction may have that the model has not, so that it is not put on the turn."""
    state, v = _state(law, capture), _speed(capture)
    return [state, state * np.exp(-np.abs(v) / 5e-3), v, np.ones_like(v)]


def _speed(capture: Capture) -> FloatArray:
    """Commanded speed in m/s, shape (n,)."""
    return np.gradient(capture.commanded_position_m, capture.sample_period_s)


def _state(law: CompensationLaw, capture: Capture) -> FloatArray:
    """Direction of the motor's friction along a run, -1 to 1, shape (n,)."""
    return friction_state(_speed(capture), law.torque_breakaway_m, capture.sample_period_s)


def _regression(matrix: FloatArray, rest: FloatArray) -> FloatArray:
    """Coefficients of columns of any size, shape (columns,)."""
    scale = np.maximum(np.sqrt(np.mean(matrix**2, axis=0)), 1e-30)
    found, *_ = np.linalg.lstsq(matrix / scale, rest, rcond=1e-5)
    return np.asarray(found / scale)
