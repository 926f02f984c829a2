"""Torque that repeats with the turn of the screw, found in captures: cogging and friction.

What lives here: the order of the cogging from steady runs, and the amplitudes from all runs. What
may not: the model's fit, controllers.

Cogging pushes whichever way the motor turns. A motor whose torque constant ripples, or teeth that
grip, give a wave that changes its sign with the friction: it has the order of the cogging or is the
nut's, once per turn. The larger of these two is taken.

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
from pmac_comp.physics.compensate.design import LoopRunner
from pmac_comp.physics.compensate.grip import gripping_torque
from pmac_comp.physics.compensate.law import CompensationLaw, friction_state
from pmac_comp.physics.compensate.starts import held_at_start_Nm

_HIGHEST_ORDER = 60
_LEAST_TURNS = 3.0
_STEADY_FRAC = 0.02
_STANDS_OUT = 6.0  # times the typical amplitude of the neighbouring orders
_NEIGHBOURS = 6
_LEAST_ORDER = 3  # below, friction per turn and lead wobble live
_PROBE_Nm = 0.02  # torque whose effect is simulated
_LEAST_GAIN_FRAC = 0.01  # of the residual's power: less is not worth its time in each pass
_DECIMATION = 3
_COGGING, _ONCE, _AGAIN = slice(0, 2), slice(2, 4), slice(4, 6)  # columns of the regression


@dataclass(frozen=True)
class TurnTorque:
    """Torque to be added per turn of the screw.

    Parameters
    ----------
    order : int
        Order of the cogging per turn, 0 for none.
    ripple_Nm, ripple_phase_rad : float
        Amplitude and phase of ``sin(order angle + phase)``.
    friction_Nm, friction_phase_rad : float
        The same of friction, times the direction.
    friction_order : int
        Order of that per turn.
    explained : float
        Share of what the model left of the motor's position that these explain.
    """

    order: int
    ripple_Nm: float
    ripple_phase_rad: float
    friction_Nm: float
    friction_phase_rad: float
    friction_order: int
    explained: float


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
    order = cogging_order(captures, rests, law.turn_m)
    parts = [_responses(law, loop, c, order, drive_delay_s)[::_DECIMATION] for c in captures]
    matrix = np.concatenate(parts)
    rest = np.concatenate([r[::_DECIMATION] for r in rests])
    # The wave of friction once per turn, or of the cogging's order: what explains more.
    both = (_ONCE, _without(matrix, _AGAIN)), (_AGAIN, _without(matrix, _ONCE))
    tried = [(_left(columns, rest), wave, columns) for wave, columns in both]
    least, wave, matrix = min(tried, key=lambda one: one[0])
    found = _regression(matrix, rest)
    whole = max(float(np.sum(rest**2)), 1e-30)
    # Share of the residual's power that a wave explains beyond all else.
    gains = [(_left(_without(matrix, pair), rest) - least) / whole for pair in (_COGGING, wave)]
    gains = [gain if gain > _LEAST_GAIN_FRAC else 0.0 for gain in gains]
    ripple_Nm, ripple_phase_rad = _wave(found[_COGGING], gains[0])
    friction_Nm, friction_phase_rad = _wave(found[wave], gains[1])
    return TurnTorque(
        order=order if ripple_Nm else 0,
        ripple_Nm=ripple_Nm,
        ripple_phase_rad=ripple_phase_rad,
        friction_Nm=friction_Nm,
        friction_phase_rad=friction_phase_rad,
        friction_order=order if wave == _AGAIN else 1,
        explained=sum(gains),
    )


def _without(matrix: FloatArray, pair: slice) -> FloatArray:
    fewer = matrix.copy()
    fewer[:, pair] = 0.0
    return fewer


def _left(matrix: FloatArray, rest: FloatArray) -> float:
    """Sum of squares that a regression leaves."""
    return float(np.sum((rest - matrix @ _regression(matrix, rest)) ** 2))


def _wave(found: FloatArray, gain_frac: float) -> tuple[float, float]:
    """Amplitude and phase of a sine from its cosine and sine parts; nothing without a gain."""
    if gain_frac <= 0.0:
        return 0.0, 0.0
    cosine, sine = (float(part) for part in found)
    return math.hypot(cosine, sine), math.atan2(cosine, sine)


def with_turn_torque(law: CompensationLaw, found: TurnTorque) -> CompensationLaw:
    """Law with the torque per turn, which it looks ahead for as for friction."""
    return law.with_values(
        ripple_Nm=found.ripple_Nm,
        ripple_order=float(found.order),
        ripple_phase_rad=found.ripple_phase_rad,
        turn_friction_Nm=found.friction_Nm,
        turn_order=float(found.friction_order),
        turn_phase_rad=found.friction_phase_rad,
    )


def cogging_order(captures: Sequence[Capture], rests: Sequence[FloatArray], turn_m: float) -> int:
    """Order per turn that stands out most of the motor's residual at steady speed, 0 for none.

    Orders below three are left to friction per turn; both directions must show the order.
    """
    scores = [
        _order_scores(capture, rest, turn_m, direction)
        for capture, rest in zip(captures, rests, strict=True)
        for direction in (1.0, -1.0)
    ]
    known = [score for score in scores if score is not None]
    if not known:
        return 0
    # An order that only some speeds let through counts where it is seen best, in both directions.
    best = np.sort(np.array(known), axis=0)[-2:].min(axis=0) if len(known) > 1 else known[0]
    order = int(np.argmax(best)) + _LEAST_ORDER
    return order if best[order - _LEAST_ORDER] > _STANDS_OUT else 0


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
    """Motor position that the model does not explain, m."""
    missing = gripping_torque(law, capture)
    held_Nm = held_at_start_Nm(capture)
    simulated = loop(capture.commanded_position_m, None, missing, held_Nm).motor_position_m
    return np.asarray(capture.motor_position_m - simulated)


def _responses(
    law: CompensationLaw, loop: LoopRunner, capture: Capture, order: int, delay_s: float
) -> FloatArray:
    """Motor position in m per N m of each torque shape, shape (n, shapes)."""
    r, period = capture.commanded_position_m, capture.sample_period_s
    v = np.gradient(r, period)
    state = friction_state(v, law.torque_breakaway_m, period)
    angle = 2.0 * math.pi * (capture.motor_position_m + v * delay_s) / law.turn_m
    shapes = [
        np.cos(order * angle) if order else np.zeros_like(r),
        np.sin(order * angle) if order else np.zeros_like(r),
        state * np.cos(angle),
        state * np.sin(angle),
        state * np.cos(order * angle) if order else np.zeros_like(r),
        state * np.sin(order * angle) if order else np.zeros_like(r),
        # What else friction may have that the model has not, so that it is not put on the turn.
        state,
        state * np.exp(-np.abs(v) / 5e-3),
        v,
        np.ones_like(r),
    ]
    plain = loop(r, None, None).motor_position_m
    moved = [loop(r, None, -_PROBE_Nm * shape).motor_position_m for shape in shapes]
    return np.column_stack([(m - plain) / _PROBE_Nm for m in moved])


def _regression(matrix: FloatArray, rest: FloatArray) -> FloatArray:
    scale = np.maximum(np.sqrt(np.mean(matrix**2, axis=0)), 1e-30)
    found, *_ = np.linalg.lstsq(matrix / scale, rest, rcond=1e-5)
    return np.asarray(found / scale)
