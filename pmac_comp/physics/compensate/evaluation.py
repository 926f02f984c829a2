"""The dynamic law evaluated on a commanded trajectory: the equations of ``law``, letter by letter.

What lives here: the arithmetic of the law, with what it does at rest. What may not: the meaning of
its coefficients (``law``), counts and registers.
"""

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numba import njit

from pmac_comp.base.arrays import FloatArray, finite_array
from pmac_comp.physics.compensate.law import TORQUE_TERMS, CompensationLaw

REST_CYCLES = 100.0  # servo cycles of rest in which the friction states fade
OUTPUT_SMOOTHING = 0.05  # of what the output has beyond the law at rest, per pass
WOUND_FADE = 0.9999  # of the torque against the integrator, per pass in motion
WOUND_YIELD = 0.01  # of the friction torque, that it gives way per cycle of the next REST_CYCLES
_HARDNESS_SHARE = 0.1  # of the way to the present acceleration, per pass in motion
_SOFT_FRAC = 0.3  # of the acceleration that loads the nut as friction does: so soft half unwinds
_NO_ACCELERATION = 1e-12  # m/s2
_WOBBLE_LEAD_rad = 0.25 * math.pi  # of the torque against a wobble, in the way it goes
_STEP = 2.0  # of the jerk limit: beyond, the acceleration steps
_SOFT_STEPS = 4.0  # of the largest step that is a rest: one after less is no step of the speed
_Speed = TypeVar("_Speed", float, FloatArray)


@dataclass(frozen=True)
class LawSignals:
    """What a law sends along a trajectory.

    Parameters
    ----------
    correction_m, torque_Nm : ndarray, shape (n,)
        Added to the command (m) and to the controller's output (N m).
    clamped : ndarray of bool, shape (n,)
        Samples at which the amplitude clamp acted.
    """

    correction_m: FloatArray
    torque_Nm: FloatArray
    clamped: FloatArray


def evaluate_law(
    law: CompensationLaw,
    position_m: FloatArray,
    period_s: float,
    *,
    latency_cycles: int = 0,
    output_Nm: FloatArray | None = None,
) -> LawSignals:
    """Correction in m and torque in N m along a commanded position.

    Parameters
    ----------
    law : CompensationLaw
        Coefficients.
    position_m : FloatArray, shape (n,)
        Commanded position in m at the servo period, starting at rest.
    period_s : float
        Servo period in s.
    latency_cycles : int
        Cycles by which the servo receives the values late (1 from PLC 0, 0 in the open servo). What
        goes against a wobble comes a cycle late by either door.
    output_Nm : FloatArray, shape (n,), or None
        Output of the controller along this trajectory, which tells what rests wound; None means
        that they wound nothing.

    Returns
    -------
    LawSignals
        What the servo receives in each cycle, clamped to the law's limits; a law that runs every
        second cycle holds its values for two.
    """
    position = finite_array("position_m", position_m)
    groups = [np.array([float(getattr(law, name)) for name in group]) for group in _EVALUATED]
    every = law.every_cycles
    output = np.zeros(0) if output_Nm is None else finite_array("output_Nm", output_Nm)
    correction, torque = _evaluate(
        *groups,
        position[::every],
        output[::every],
        every * period_s,
        law.jerk_limit_m_per_s3,
        float(every),
        max(0, 1 - latency_cycles) * period_s,
    )
    correction = np.repeat(correction, every)[: position.size]
    torque = np.repeat(torque, every)[: position.size]
    clamped = np.abs(correction) > law.amplitude_limit_m
    correction = np.clip(correction, -law.amplitude_limit_m, law.amplitude_limit_m)
    torque = np.clip(torque, -law.torque_limit_Nm, law.torque_limit_Nm)
    return LawSignals(
        correction_m=delayed(correction, latency_cycles),
        torque_Nm=delayed(torque, latency_cycles),
        clamped=clamped,
    )


def end_hardness(law: CompensationLaw, position_m: FloatArray, period_s: float) -> FloatArray:
    """Share of the table's friction that can unwind at a rest which does, shape (n,).

    From 0 after a motion that ended softly to 1, as ``law`` has it: by how hard the command has
    accelerated lately.
    """
    period_s *= law.every_cycles
    seen_m = position_m[:: law.every_cycles]
    shares: FloatArray = _end_hardness(
        np.diff(seen_m, prepend=seen_m[0]) / period_s,
        period_s,
        _soft(law.bed_share, _over(law.coulomb_m + law.stribeck_m, law.inertia_s2)),
    )
    return np.repeat(shares, law.every_cycles)[: position_m.size]


def friction_levels(
    law: CompensationLaw, speed_m_per_s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Friction of a law at speeds, shape (n,): its elastic error in m and its torque in N m."""
    slow = _slow_share(speed_m_per_s / law.stribeck_speed_m_per_s)
    return (
        law.coulomb_m + law.stribeck_m * slow,
        law.torque_coulomb_Nm + law.torque_stribeck_Nm * slow,
    )


def friction_state(
    speed_m_per_s: FloatArray, breakaway_m: float, period_s: float, start: float = 0.0
) -> FloatArray:
    """Direction of a motion as its friction has it, -1 to 1, shape (n,).

    It follows the distance over ``breakaway_m`` and holds at rest.
    """
    states: FloatArray = _friction_states(speed_m_per_s * period_s / breakaway_m, start)
    return states


def delayed(values: FloatArray, cycles: int) -> FloatArray:
    """Values, shape (n,), shifted to later samples; the first fills the front."""
    if cycles <= 0:
        return values
    head = np.full(min(cycles, values.size), values[0])
    return np.concatenate([head, values[: values.size - cycles]])


@njit(cache=True, nogil=True)
def _followed(state: float, way: float) -> float:
    """Friction state after a way, implicit Euler: holds at standstill, never overshoots."""
    return (state + way) / (1.0 + abs(way))


@njit(cache=True, nogil=True)
def _lagging(state: float, lagged: float, way: float, share: float) -> tuple[float, float]:
    """Friction state after a way, and the same with a lag: a share of the way to it in a pass."""
    followed = _followed(state, way)
    return followed, lagged + share * (followed - lagged)


@njit(cache=True, nogil=True)
def _turned(state: float, change: float, way: float) -> tuple[float, float, float]:
    """Friction state after a way, by how much it turned over with it, and in the last pass."""
    followed = _followed(state, way)
    return followed, followed - state, change


@njit(cache=True, nogil=True)
def _faded(
    states: tuple[float, float, float],
    rest: float,
    goes: tuple[float, float, float, float],
    unwinds: float,
) -> tuple[float, float, float]:
    """Friction states of table and torque, and the torque against the integrator, after a pass.

    ``goes`` are the shares of the states that fade in a pass as a rest begins, the table's where
    it ``unwinds`` wholly, and the torque by which the last gives way in one after that where
    friction pushes along with all it has; up to the last of them it stays.
    """
    s, t, wound = states
    if rest < REST_CYCLES:
        return s * (1.0 - goes[0] * unwinds), t * (1.0 - goes[1]), wound
    if rest <= 2.0 * REST_CYCLES and wound * t > 0.0 and abs(wound) > goes[3]:
        wound -= goes[2] * t
    return s, t, wound


@njit(cache=True, nogil=True)
def _soft(bed_share: float, most: float) -> float:
    """Hardness of a motion's end after which half unwinds; with a bed none, all does always."""
    return max(_NO_ACCELERATION, 0.0 if bed_share > 0.0 else _SOFT_FRAC * most)


@njit(cache=True, nogil=True)
def _hardened(hardness: float, acceleration: float) -> float:
    """How hard a motion accelerates, lately, a pass later."""
    return hardness + _HARDNESS_SHARE * (abs(acceleration) - hardness)


@njit(cache=True, nogil=True)
def _over(holds: float, inertia: float) -> float:
    """Acceleration of the table whose elastic error is as large as that of friction."""
    return holds / inertia if inertia > 0.0 else math.inf


@njit(cache=True, nogil=True)
def _flank(force: float, width: float) -> float:
    """Flank from -1 to 1 that a force holds; it and the width by the correction they make, m."""
    return force / max(width, abs(force))


@njit(cache=True, nogil=True)
def _taken_over(state: float, wound: float, beyond: float, breaks_Nm: float) -> tuple[float, float]:
    """Friction state as the output held it over a rest, and the rest of the torque it winds."""
    stands = min(max(state + (beyond + wound) / breaks_Nm, -1.0), 1.0)
    return stands, wound + breaks_Nm * (state - stands)


@njit(cache=True, nogil=True)
def _slow_share(speed: _Speed) -> _Speed:
    """Share of Stribeck friction at a speed over its own: exp(-speed^2), its series inverted."""
    square = speed * speed
    return 1.0 / (1.0 + square * (1.0 + 0.5 * square))


@njit(cache=True, nogil=True)
def _by_turn(p: FloatArray, share: float, place: float) -> tuple[float, float, float]:
    """Friction, cogging and share of the torque by the turn at a place.

    ``p`` is turn, TR, m, PR, TH, n, PH.
    """
    angle = 2.0 * math.pi * place / p[0]
    sine, cogging = math.sin(p[2] * angle + p[3]), p[4] * math.sin(p[5] * angle + p[6])
    wave = p[1] * sine
    return (wave, cogging, share * sine) if p[2] > 0.0 else (0.0, cogging + wave, share * sine)


@njit(cache=True, nogil=True)
def _following(p: FloatArray, size: float, place: float, way: float) -> float:
    """Torque that lets the loop follow the table: turn, m and PR of ``p``, its size, the way."""
    phase = p[3] + _WOBBLE_LEAD_rad * way
    return size * math.sin(p[2] * 2.0 * math.pi * place / p[0] + phase)


@njit(cache=True, nogil=True)
def _swung(
    p: FloatArray, acceleration: float, speed: float, place: float, period: float
) -> tuple[float, float, float]:
    """Acceleration, speed and place of a bed on its spring, a period later; ``p`` is M, D, O."""
    swing = -p[0] * acceleration - p[1] * speed - p[2] * place
    speed += period * swing
    return swing, speed, place + period * speed


@njit(cache=True, nogil=True)
def _followed_share(state: float, goal: float, way: float) -> float:
    """State that goes to its goal with a way, implicit Euler: holds at standstill."""
    return (state + way * goal) / (1.0 + way)


@njit(cache=True, nogil=True)
def _crossed(flank: float, lagged: float, share: float) -> tuple[float, float]:
    """The flank that the motor has reached, and by how much it was behind."""
    return lagged + share * (flank - lagged), flank - lagged


@njit(cache=True, nogil=True)
def _held_between(felt: float, swing: float, state: float, most: float) -> float:
    """What the guide lets the table feel of a bed: friction holds no more than its most either way.

    All of it by the acceleration of the table that takes as much force; ``state`` from -1 to 1 of
    the friction is in use already.
    """
    return min(max(felt, swing - most * (1.0 + state)), swing + most * (1.0 - state))


@njit(cache=True, nogil=True)
def _friction_states(way: FloatArray, start: float) -> FloatArray:
    state = np.empty_like(way)
    value = start
    for k in range(way.size):
        value = _followed(value, way[k])
        state[k] = value
    return state


@njit(cache=True, nogil=True)
def _speed(step_m: float, still_m: float, period: float) -> float:
    """Speed of the command by its step in a pass, none where it rests."""
    return step_m / period if abs(step_m) >= still_m else 0.0


@njit(cache=True, nogil=True)
def _before(
    speed: float, last: float, acceleration: float, soft: float, period: float
) -> tuple[float, float]:
    """Speed and acceleration of the pass before; none where so slow a motion has come to rest."""
    slow = 0.0 < abs(last) < soft and abs(acceleration) * period < soft
    return (0.0, 0.0) if speed == 0.0 and slow else (last, acceleration)


@njit(cache=True, nogil=True)
def _jerks(wanted: float, limit: float) -> tuple[float, float]:
    """The jerk with which the acceleration follows, and what of it the torque answers."""
    followed = min(max(wanted, -limit), limit)
    return followed, followed if abs(wanted) <= _STEP * limit else 0.0


@njit(cache=True, nogil=True)
def _end_hardness(speed: FloatArray, period: float, soft: float) -> FloatArray:
    shares = np.empty_like(speed)
    hard = acceleration = last = 0.0
    for k in range(speed.size):
        if speed[k] != 0.0:
            hard = _hardened(hard, acceleration)
        acceleration, last = (speed[k] - last) / period, speed[k]
        shares[k] = hard / (hard + soft)
    return shares


# The groups of coefficients that ``_evaluate`` takes, each in the order in which it unpacks them.
_ELASTIC = (
    "inertia_s2",
    "viscous_s",
    "viscous_uneven_s",
    "coulomb_m",
    "stribeck_m",
    "compliance_slope_per_m",
    "jerk_s3",
    "breakaway_m",
    "coulomb_lag_s",
    "drag_m",
)
_TORQUE = (*TORQUE_TERMS, "torque_breakaway_m")
_BOTH = (
    "lookahead_s",
    "origin_m",
    "stribeck_speed_m_per_s",
    "rest_fade_per_s",
    "rest_unwind_per_s",
    "drag_distance_m",
    "rest_step_m",
)
_TURN = (  # as ``_by_turn`` has them
    "turn_m",
    "turn_friction_Nm",
    "turn_order",
    "turn_phase_rad",
    "ripple_Nm",
    "ripple_order",
    "ripple_phase_rad",
)
_RIPPLE = (
    "turn_share",
    "torque_loop_Nm_s2_per_m",
    "torque_loop_Nm_s_per_m",
    "torque_wobble_Nm_s3_per_m3",
)
_GAP = ("gap_half_m", "gap_width_m", "gap_lag_s", "gap_torque_Nm", "gap_load_m")
_BED = (  # the first three as ``_swung`` has them
    "bed_share",
    "bed_damping_per_s",
    "bed_stiffness_per_s2",
    "torque_bed_Nm_s2_per_m",
)
_EVALUATED = (_ELASTIC, _TORQUE, _BOTH, _TURN, _RIPPLE, _GAP, _BED)


@njit(cache=True, nogil=True)
def _evaluate(
    elastic: FloatArray,
    torques: FloatArray,
    both: FloatArray,
    turn: FloatArray,
    rippling: FloatArray,
    gap: FloatArray,
    bed_swings: FloatArray,
    r: FloatArray,
    output: FloatArray,
    period: float,
    limit: float,
    every: float,
    late: float,
) -> tuple[FloatArray, FloatArray]:
    """Correction in m and torque in N m of each pass, unclamped, shape (n,) each.

    The letters are those of the equations of ``law``; ``j1`` and ``j2`` the jerks of the last
    passes, ``dt`` and ``dt1`` by how much friction turned over in this pass and the last.

    Parameters
    ----------
    elastic, torques, both, turn, rippling, gap, bed_swings : ndarray
        Coefficients, in the groups of ``_EVALUATED``.
    r : ndarray, shape (n,)
        Commanded position in m at each pass.
    output : ndarray, shape (n,) or (0,)
        The controller's output in N m at each pass; empty where it is not known.
    period, late : float
        Time from pass to pass, and by which ``r'`` is behind ``r``, s.
    limit : float
        J, m/s3.
    every : float
        Servo cycles from pass to pass.
    """
    inertia, viscous, viscous_uneven, coulomb, stribeck, slope, jerk, breakaway, lag, drag = elastic
    torque_inertia, torque_jerk, impulse, torque_viscous, torque_coulomb, torque_load = torques[:6]
    torque_constant, torque_place, torque_stribeck = torques[6:9]
    torque_uneven, torque_drag, turning, turned, torque_breakaway = torques[9:]
    lookahead, origin, fading, rest_fade, rest_unwind, drag_distance, still = both
    turn_share, loop_a, loop_v, tw = rippling
    bed_share, _, _, torque_bed = bed_swings
    gap_half, gap_width, gap_lag, gap_torque, gap_load = gap
    seen, correction, torque = output.size == r.size, np.empty(r.size), np.empty(r.size)
    v = a = j = j1 = s = z = t = dt = d = rest = hard = 0.0
    beyond = wound = crossing = bed = bed_speed = felt = 0.0
    g = h = held = _flank(gap_load, gap_width) if gap_half > 0.0 else 0.0
    breaks, most = torque_coulomb + torque_stribeck, _over(coulomb + stribeck, inertia)
    goes = (
        rest_unwind * period,
        rest_fade * period,
        WOUND_YIELD * every * breaks,
        breaks if gap_half > 0.0 else 0.0,
    )
    for k in range(r.size):
        v1, v, j2, j1 = v, _speed(r[k] - r[max(k - 1, 0)], still, period), j1, j
        v1, a = _before(v, v1, a, _SOFT_STEPS * still / period, period)
        j, answered = _jerks(((v - v1) / period - a) / period, limit)
        a += j * period
        step = (v + lookahead * (a + 0.5 * (lookahead + period) * j)) * period
        if v == 0.0:
            rest += every
            if seen and k > 0:
                beyond += OUTPUT_SMOOTHING * (output[k] - torque[k - 1] - beyond)
            s, t, wound = _faded((s, t, wound), rest, goes, hard / (hard + _soft(bed_share, most)))
        else:
            if seen and rest >= REST_CYCLES and breaks > 0.0:
                t, wound = _taken_over(t, wound, beyond, breaks)
            rest, wound, hard = 0.0, wound * WOUND_FADE, _hardened(hard, a - j * period)
        s, z = _lagging(s, z, step / breakaway, period / (lag + period))
        (t, dt, dt1), d = (
            _turned(t, dt, step / torque_breakaway),
            _followed(d, step / drag_distance),
        )
        wave, cogging, more = _by_turn(turn, turn_share, r[k] + lookahead * v)
        sent = (
            (torque_inertia * a + torque_jerk * answered + impulse * (j1 - j2))
            + (turning * dt + turned * dt1) / period
            + (torque_viscous * v + torque_drag * d)
        )
        slow = _slow_share(step / period / fading)
        level = torque_coulomb + torque_stribeck * slow + torque_load * abs(a) + wave
        sent += level * t + torque_constant + torque_place * (r[k] - origin) + wound
        if bed_share > 0.0:
            way = abs(v) * period / breakaway
            swing, bed_speed, bed = _swung(bed_swings, a, bed_speed, bed, period)
            felt = _held_between(_followed_share(felt, swing, way), swing, s, most)
            sent += torque_bed * felt
        e = (
            inertia * (a + felt)
            + (viscous * v + viscous_uneven * abs(v))
            + ((coulomb + stribeck * slow) * z + drag * d)
        )
        correction[k] = (1.0 + slope * (r[k] - origin)) * e + jerk * j
        if gap_half > 0.0:
            g = g if v == 0.0 else _flank(gap_load + e + lookahead * inertia * j, gap_width)
            h, behind = _crossed(g, h, period / (gap_lag + period))
            correction[k] += gap_half * (h - held)
            crossing = gap_torque * behind
        sent += (sent - wound + loop_a * a + loop_v * v) * more + cogging + crossing
        torque[k] = sent + torque_uneven * abs(v) + _following(turn, tw * v**3, r[k] - late * v, t)
    return correction, torque
