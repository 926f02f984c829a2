"""Torque that repeats with the turn of the screw, found in captures: cogging and friction.

What lives here: the orders of the cogging from steady runs, and the amplitudes from all runs. What
may not: the model's fit, controllers.

Cogging pushes whichever way the motor turns. A motor whose torque constant ripples, or teeth that
grip, give a wave that changes its sign with the friction: it has the order of the cogging or is the
nut's, once per turn. A motor may also have a second order of cogging, as of its poles beside that
of its slots. A law has room for one cogging and one of the others: for the two that explain most.

A model without these effects misses the motor's position by what the loop lets through of them.
What it would let through of a known torque is simulated, so the amplitudes come out of a linear
regression with the loop, the delay and the friction in it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.design import LoopRunner, LoopSignals
from pmac_comp.physics.compensate.grip import gripping_torque
from pmac_comp.physics.compensate.law import CompensationLaw, friction_state
from pmac_comp.physics.compensate.starts import held_at_start_Nm

_HIGHEST_ORDER = 60
_LEAST_TURNS = 3.0
_STEADY_FRAC = 0.02
_STANDS_OUT = 6.0  # times the typical amplitude of the neighbouring orders
_NEIGHBOURS = 6
_MOST_ORDERS = 3  # that are tried
_LEAST_ORDER = 3  # below, friction per turn and lead wobble live
_PROBE_Nm = 0.02  # torque whose effect is simulated
_LEAST_GAIN_FRAC = 0.01  # of the residual's power: less is not worth its time in each pass
_DECIMATION = 3
_FIRST, _SECOND = slice(0, 2), slice(2, 4)  # columns of the regression
_MOTOR = 0  # of the channels; the other is table minus motor


@dataclass(frozen=True)
class TurnTorque:
    """Torque to be added per turn of the screw.

    Parameters
    ----------
    order : int
        Order of the cogging per turn, 0 for none.
    ripple_Nm, ripple_phase_rad : float
        Amplitude and phase of ``sin(order angle + phase)``.
    second_Nm, second_phase_rad : float
        The same of the second wave.
    second_order : int
        Order of that per turn.
    second_pushes : bool
        Whether it is cogging as well; else it is friction, times the direction.
    explained : float
        Share of what the model left of the motor's position that these explain.
    """

    order: int
    ripple_Nm: float
    ripple_phase_rad: float
    second_Nm: float
    second_phase_rad: float
    second_order: int
    second_pushes: bool
    explained: float


@dataclass(frozen=True)
class _Wave:
    """A wave over the turn and what it does.

    ``responses`` of its cosine and its sine, in m per N m, shape (n, 2, 2): of all runs, by part of
    the wave, and of motor and table minus motor.
    """

    order: int
    pushes: bool
    responses: FloatArray


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
    rests = [_rest(law, loop, capture) for capture in captures]
    rest = np.concatenate([r[::_DECIMATION] for r in rests])
    orders = cogging_orders(captures, [r[:, _MOTOR] for r in rests], law.turn_m)
    plain = [loop(capture.commanded_position_m, None, None) for capture in captures]

    def wave(order: int, *, pushes: bool) -> _Wave:
        shapes = [_shapes(law, c, order, drive_delay_s, pushes=pushes) for c in captures]
        return _Wave(order, pushes, _responses(loop, captures, plain, shapes))

    once = wave(1, pushes=False)
    coggings = [wave(order, pushes=True) for order in orders]
    pairs = [(_nothing(once), once)] if not coggings else []
    for first in coggings:
        others = [other for other in coggings if other is not first]
        pairs += [(first, second) for second in (once, wave(first.order, pushes=False), *others)]
    steady = _responses(loop, captures, plain, [_steady_shapes(law, c) for c in captures])
    tried = [(*pair, np.hstack([*(one.responses for one in pair), steady])) for pair in pairs]
    first, second, responses = min(tried, key=lambda one: float(_missed(one[2], rest).sum()))
    found = _regression(responses[:, :, _MOTOR], rest[:, _MOTOR])
    least = _missed(responses, rest)
    # Share of the residual's power that a wave explains beyond all else, where it explains more.
    shares = [_missed(_without(responses, pair), rest) - least for pair in (_FIRST, _SECOND)]
    gains = [float(gain) if gain > _LEAST_GAIN_FRAC else 0.0 for gain in map(np.max, shares)]
    ripple_Nm, ripple_phase_rad = _wave(found[_FIRST], gains[0])
    second_Nm, second_phase_rad = _wave(found[_SECOND], gains[1])
    return TurnTorque(
        order=first.order if ripple_Nm else 0,
        ripple_Nm=ripple_Nm,
        ripple_phase_rad=ripple_phase_rad,
        second_Nm=second_Nm,
        second_phase_rad=second_phase_rad,
        second_order=second.order,
        second_pushes=second.pushes,
        explained=sum(max(float(s[_MOTOR]), 0.0) for s, g in zip(shares, gains, strict=True) if g),
    )


def _nothing(like: _Wave) -> _Wave:
    return _Wave(0, pushes=True, responses=np.zeros_like(like.responses))


def _missed(responses: FloatArray, rest: FloatArray) -> FloatArray:
    """Share of its power that the waves leave of motor and of table minus motor, shape (2,).

    The motor tells how large they are. But a wave of a high order hardly moves it and shakes the
    table where it passes the first mode: whether it is worth its time, and which of several orders
    is, shows in both.
    """
    found = _regression(responses[:, :, _MOTOR], rest[:, _MOTOR])
    left = rest - np.einsum("ijk,j->ik", responses, found)
    return np.asarray(np.sum(left**2, axis=0) / np.maximum(np.sum(rest**2, axis=0), 1e-30))


def _without(responses: FloatArray, pair: slice) -> FloatArray:
    fewer = responses.copy()
    fewer[:, pair] = 0.0
    return fewer


def _wave(found: FloatArray, gain_frac: float) -> tuple[float, float]:
    """Amplitude and phase of a sine from its cosine and sine parts; nothing without a gain."""
    if gain_frac <= 0.0:
        return 0.0, 0.0
    cosine, sine = (float(part) for part in found)
    return math.hypot(cosine, sine), math.atan2(cosine, sine)


def with_turn_torque(law: CompensationLaw, found: TurnTorque) -> CompensationLaw:
    """Law with the torque per turn, which it looks ahead for as for friction."""
    order, phase_rad = found.second_order, found.second_phase_rad
    if found.second_pushes:  # the law knows it by an order below zero: sin(x) = sin(pi - x)
        order, phase_rad = -order, math.pi - phase_rad
    return law.with_values(
        ripple_Nm=found.ripple_Nm,
        ripple_order=float(found.order),
        ripple_phase_rad=found.ripple_phase_rad,
        turn_friction_Nm=found.second_Nm,
        turn_order=float(order),
        turn_phase_rad=phase_rad,
    )


def cogging_orders(
    captures: Sequence[Capture], rests: Sequence[FloatArray], turn_m: float
) -> tuple[int, ...]:
    """Orders per turn that stand out of the motor's residual at steady speed, the first the most.

    Orders below three are left to friction per turn; both directions must show an order.
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


def _rest(law: CompensationLaw, loop: LoopRunner, capture: Capture) -> FloatArray:
    """Motor and table minus motor that the model does not explain, m, shape (n, 2)."""
    missing = gripping_torque(law, capture)
    held_Nm = held_at_start_Nm(capture)
    simulated = loop(capture.commanded_position_m, None, missing, held_Nm)
    motor = capture.motor_position_m - simulated.motor_position_m
    table = capture.table_position_m
    if table is None:
        return np.column_stack([motor, np.zeros(capture.n)])
    error = table - capture.motor_position_m - _error(simulated)
    return np.column_stack([motor, error - np.mean(error)])


def _error(signals: LoopSignals) -> FloatArray:
    return signals.table_position_m - signals.motor_position_m


def _shapes(
    law: CompensationLaw, capture: Capture, order: int, delay_s: float, *, pushes: bool
) -> list[FloatArray]:
    """Cosine and sine of an order over the turn, times the friction unless it pushes."""
    v = _speed(capture)
    angle = order * 2.0 * math.pi * (capture.motor_position_m + v * delay_s) / law.turn_m
    state = 1.0 if pushes else _state(law, capture)
    return [state * np.cos(angle), state * np.sin(angle)]


def _steady_shapes(law: CompensationLaw, capture: Capture) -> list[FloatArray]:
    """What else friction may have that the model has not, so that it is not put on the turn."""
    state, v = _state(law, capture), _speed(capture)
    return [state, state * np.exp(-np.abs(v) / 5e-3), v, np.ones_like(v)]


def _speed(capture: Capture) -> FloatArray:
    return np.gradient(capture.commanded_position_m, capture.sample_period_s)


def _state(law: CompensationLaw, capture: Capture) -> FloatArray:
    return friction_state(_speed(capture), law.torque_breakaway_m, capture.sample_period_s)


def _responses(
    loop: LoopRunner,
    captures: Sequence[Capture],
    plain: Sequence[LoopSignals],
    shapes: Sequence[Sequence[FloatArray]],
) -> FloatArray:
    """Motor and table minus motor in m per N m of torque shapes, shape (n, shapes, 2).

    ``plain`` are the loop's signals without them.
    """
    parts = []
    for capture, without, own in zip(captures, plain, shapes, strict=True):
        r = capture.commanded_position_m
        moved = [loop(r, None, -_PROBE_Nm * shape) for shape in own]
        motor = [m.motor_position_m - without.motor_position_m for m in moved]
        error = [_error(m) - _error(without) for m in moved]
        both = np.stack([np.column_stack(motor), np.column_stack(error)], axis=2)
        parts.append(both[::_DECIMATION] / _PROBE_Nm)
    return np.concatenate(parts)


def _regression(matrix: FloatArray, rest: FloatArray) -> FloatArray:
    scale = np.maximum(np.sqrt(np.mean(matrix**2, axis=0)), 1e-30)
    found, *_ = np.linalg.lstsq(matrix / scale, rest, rcond=1e-5)
    return np.asarray(found / scale)
