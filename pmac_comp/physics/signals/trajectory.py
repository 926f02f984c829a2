"""Trajectories sampled at the servo period: what an axis is asked to do.

What lives here: the ``Trajectory`` value and generators of the motions used for identification,
prediction and verification. All start and end at rest. What may not: limits of a bench or anything
of a controller. Imports ``base`` and ``moves``.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray, finite_array
from pmac_comp.base.errors import ModelError
from pmac_comp.physics.signals.moves import move_pieces

MAX_SAMPLES = 50_000_000
_TINY = 1e-12


@dataclass(frozen=True)
class Trajectory:
    """Position command on a uniform grid.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        Uniform grid from 0 in s.
    position_m : ndarray, shape (n,)
        Commanded table position in m.

    Raises
    ------
    ModelError
        Lengths differ or time does not run on a uniform grid.
    NonFinite
        NaN or infinity in either column.
    """

    time_s: FloatArray
    position_m: FloatArray

    def __post_init__(self) -> None:
        time = finite_array("time_s", self.time_s, min_size=2)
        position = finite_array("position_m", self.position_m, min_size=2)
        if time.size != position.size:
            raise ModelError(
                f"time_s has {time.size} samples and position_m {position.size}.",
                code="PC-TRJ-001",
                hint="Give both on the same grid.",
            )
        steps = np.diff(time)
        mean = (time[-1] - time[0]) / (time.size - 1)
        if not mean > 0.0 or float(np.max(np.abs(steps - mean))) > 0.5 * mean:
            raise ModelError(
                "time_s does not run forward on a uniform grid.",
                code="PC-TRJ-002",
                hint="Sample the command once per servo period.",
            )
        object.__setattr__(self, "time_s", time)
        object.__setattr__(self, "position_m", position)

    @property
    def n(self) -> int:
        """Number of samples."""
        return int(self.time_s.size)

    @property
    def sample_period_s(self) -> float:
        """Sample period in s."""
        return float((self.time_s[-1] - self.time_s[0]) / (self.n - 1))

    @property
    def velocity_m_per_s(self) -> FloatArray:
        """Central-difference velocity in m/s, shape (n,)."""
        return np.asarray(np.gradient(self.position_m, self.sample_period_s))

    @property
    def acceleration_m_per_s2(self) -> FloatArray:
        """Second-difference acceleration in m/s2, shape (n,); zero at both ends."""
        out = np.zeros(self.n)
        out[1:-1] = np.diff(self.position_m, 2) / self.sample_period_s**2
        return out

    def then(self, other: "Trajectory") -> "Trajectory":
        """Both trajectories one after the other, shifted so that the path stays connected."""
        shifted = other.position_m + (self.position_m[-1] - other.position_m[0])
        position = np.concatenate([self.position_m, shifted[1:]])
        return _on_grid(position, self.sample_period_s)

    def moved(self, offset_m: float) -> "Trajectory":
        """The same motion at another place."""
        return Trajectory(self.time_s, self.position_m + _real("offset_m", offset_m))


def dwell(*, period_s: float, position_m: float = 0.0, duration_s: float = 1.0) -> Trajectory:
    """Standstill at a position in m for a duration in s."""
    n = _samples(period_s, duration_s)
    return _on_grid(np.full(n, _real("position_m", position_m)), period_s)


def sinusoid(
    *,
    period_s: float,
    amplitude_m: float,
    frequency_Hz: float,
    cycles: float = 5.0,
    centre_m: float = 0.0,
    ramp_cycles: float = 1.0,
    dwell_s: float = 0.1,
) -> Trajectory:
    """Sinusoid of half stroke ``amplitude_m`` that grows and fades smoothly at both ends.

    Parameters
    ----------
    period_s : float
        Sample period in s.
    amplitude_m, frequency_Hz : float
        Half stroke in m and frequency in Hz.
    cycles : float
        Cycles at full amplitude between the two ramps.
    centre_m : float
        Centre of the motion in m.
    ramp_cycles : float
        Cycles of each ramp (quintic, so that acceleration starts at zero).
    dwell_s : float
        Standstill before and after in s.

    Raises
    ------
    ModelError
        An argument is not positive, or the trajectory would be longer than ``MAX_SAMPLES``.
    """
    frequency = _positive("frequency_Hz", frequency_Hz)
    ramp = _positive("ramp_cycles", ramp_cycles) / frequency
    total = _positive("cycles", cycles) / frequency + 2.0 * ramp
    amplitude = _real("amplitude_m", amplitude_m)

    def shape(t: FloatArray) -> FloatArray:
        return amplitude * np.sin(2.0 * math.pi * frequency * t) * _window(t, total, ramp)

    return _sampled(shape, total, period_s, centre_m, dwell_s)


def multisine(
    *,
    period_s: float,
    amplitude_m: float,
    frequencies_Hz: Sequence[float],
    duration_s: float = 10.0,
    centre_m: float = 0.0,
    ramp_s: float = 0.5,
    dwell_s: float = 0.1,
    seed: int = 0,
    roll_off: float = 2.0,
) -> Trajectory:
    """Sum of sinusoids with random phases, scaled to a peak of ``amplitude_m``.

    The amplitude of each line falls with frequency to the power ``roll_off``, so that 2 gives
    equal accelerations. See ``sinusoid`` for the other parameters.
    """
    lines = finite_array("frequencies_Hz", frequencies_Hz)
    if np.any(lines <= 0.0):
        raise _out_of_range("frequencies_Hz", float(lines.min()), "every line must be positive")
    total = _positive("duration_s", duration_s)
    ramp = min(_positive("ramp_s", ramp_s), 0.5 * total)
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi, lines.size)
    weights = (lines.min() / lines) ** roll_off
    amplitude = _real("amplitude_m", amplitude_m)

    def shape(t: FloatArray) -> FloatArray:
        angles = 2.0 * math.pi * lines[:, None] * t[None, :] + phases[:, None]
        raw = weights @ np.sin(angles) * _window(t, total, ramp)
        peak = float(np.max(np.abs(raw), initial=0.0))
        return np.asarray(raw * (amplitude / peak if peak > 0.0 else 0.0))

    return _sampled(shape, total, period_s, centre_m, dwell_s)


def trapezoid(
    *,
    period_s: float,
    distance_m: float,
    speed_m_per_s: float,
    acceleration_m_per_s2: float,
    s_curve_s: float = 0.0,
    start_m: float = 0.0,
    dwell_s: float = 0.2,
    repeats: int = 1,
    both_ways: bool = True,
) -> Trajectory:
    """Moves of ``distance_m`` with trapezoidal speed, there and back.

    Parameters
    ----------
    period_s : float
        Sample period in s.
    distance_m, speed_m_per_s, acceleration_m_per_s2 : float
        Signed distance in m, speed limit in m/s and acceleration limit in m/s2.
    s_curve_s : float
        Rise time of the acceleration in s; 0 means steps in acceleration (jerk unlimited).
    start_m : float
        First position in m.
    dwell_s : float
        Standstill before, between and after the moves in s.
    repeats : int
        Times that the motion is repeated.
    both_ways : bool
        Return after each move; False continues in the same direction.
    """
    distance = _real("distance_m", distance_m)
    sides = (1.0, -1.0) if both_ways else (1.0,)
    moves = [side * distance for _ in range(_count("repeats", repeats)) for side in sides]
    return path(
        moves,
        period_s=period_s,
        speed_m_per_s=speed_m_per_s,
        acceleration_m_per_s2=acceleration_m_per_s2,
        s_curve_s=s_curve_s,
        start_m=start_m,
        dwell_s=dwell_s,
    )


def triangle(
    *,
    period_s: float,
    amplitude_m: float,
    speed_m_per_s: float,
    cycles: int = 2,
    centre_m: float = 0.0,
    acceleration_m_per_s2: float = 1.0,
    dwell_s: float = 0.1,
) -> Trajectory:
    """Constant speed between ``centre_m - amplitude_m`` and ``+``, reversing without dwell."""
    stroke = 2.0 * _real("amplitude_m", amplitude_m)
    moves = [side * stroke for _ in range(_count("cycles", cycles)) for side in (1.0, -1.0)]
    body = path(
        moves,
        period_s=period_s,
        speed_m_per_s=speed_m_per_s,
        acceleration_m_per_s2=acceleration_m_per_s2,
        start_m=centre_m - 0.5 * stroke,
        dwell_s=0.0,
    )
    rest = dwell(period_s=period_s, position_m=body.position_m[0], duration_s=dwell_s)
    return rest.then(body).then(rest)


def staircase(
    *,
    period_s: float,
    positions_m: Sequence[float],
    speed_m_per_s: float,
    acceleration_m_per_s2: float,
    s_curve_s: float = 0.0,
    dwell_s: float = 1.0,
) -> Trajectory:
    """Stops at each of ``positions_m`` for ``dwell_s``; the axis starts at the first one."""
    stops = finite_array("positions_m", positions_m, min_size=2)
    return path(
        [float(step) for step in np.diff(stops)],
        period_s=period_s,
        speed_m_per_s=speed_m_per_s,
        acceleration_m_per_s2=acceleration_m_per_s2,
        s_curve_s=s_curve_s,
        start_m=float(stops[0]),
        dwell_s=dwell_s,
    )


def path(
    moves_m: Sequence[float],
    *,
    period_s: float,
    speed_m_per_s: float,
    acceleration_m_per_s2: float,
    s_curve_s: float = 0.0,
    start_m: float = 0.0,
    dwell_s: float = 0.2,
) -> Trajectory:
    """Moves with trapezoidal speed one after the other, with a dwell around each.

    Acceleration pulses that are trapezoids (steps for ``s_curve_s`` = 0), integrated exactly as
    piecewise polynomials and sampled. See ``trapezoid`` for the other parameters.

    Parameters
    ----------
    moves_m : sequence of float, shape (n,)
        Signed distances in m.
    """
    moves = finite_array("moves_m", moves_m)
    speed = _positive("speed_m_per_s", speed_m_per_s)
    acceleration = _positive("acceleration_m_per_s2", acceleration_m_per_s2)
    rise = _not_negative("s_curve_s", s_curve_s)
    rest = _not_negative("dwell_s", dwell_s)
    knots: list[float] = [0.0, rest]
    slopes: list[tuple[float, float]] = [(0.0, 0.0)]
    for move in moves:
        for duration, jerk, level in move_pieces(float(move), speed, acceleration, rise):
            knots.append(knots[-1] + duration)
            slopes.append((jerk, level))
        knots.append(knots[-1] + rest)
        slopes.append((0.0, 0.0))
    return _integrated(knots, slopes, period_s, start_m)


def _integrated(
    knots: list[float], slopes: list[tuple[float, float]], period_s: float, start_m: float
) -> Trajectory:
    """Second integral of a piecewise linear acceleration, sampled."""
    from scipy.interpolate import PPoly

    times = np.asarray(knots)
    durations = np.diff(times)
    keep = durations > _TINY
    if not np.any(keep):
        return dwell(period_s=period_s, position_m=start_m, duration_s=period_s)
    table = np.asarray(slopes).T[:, keep]
    edges = np.concatenate([[0.0], np.cumsum(durations[keep])])
    position = PPoly(table, edges).antiderivative(2)
    n = _samples(period_s, float(edges[-1]))
    t = np.minimum(np.arange(n) * period_s, edges[-1])
    return _on_grid(_real("start_m", start_m) + np.asarray(position(t)), period_s)


def _sampled(
    shape: Callable[[FloatArray], FloatArray],
    total_s: float,
    period_s: float,
    centre_m: float,
    dwell_s: float,
) -> Trajectory:
    rest = _samples(period_s, _not_negative("dwell_s", dwell_s)) - 1
    n = _samples(period_s, total_s)
    body = shape(np.minimum(np.arange(n) * period_s, total_s))
    still = np.zeros(rest)
    centre = _real("centre_m", centre_m)
    position: FloatArray = np.concatenate([still, body, still]) + centre
    return _on_grid(position, period_s)


def _window(t: FloatArray, total: float, ramp: float) -> FloatArray:
    """Quintic rise from 0 to 1, flat, quintic fall: first and second derivative vanish at ends."""
    inside = np.clip(np.minimum(t, total - t) / ramp, 0.0, 1.0)
    return np.asarray(inside**3 * (10.0 - 15.0 * inside + 6.0 * inside**2), dtype=np.float64)


def _on_grid(position_m: FloatArray, period_s: float) -> Trajectory:
    time: FloatArray = np.arange(position_m.size, dtype=np.float64) * period_s
    return Trajectory(time, position_m)


def _samples(period_s: float, duration_s: float) -> int:
    period = _positive("period_s", period_s)
    ratio = duration_s / period
    if not ratio < MAX_SAMPLES:
        raise ModelError(
            f"A trajectory of {duration_s:g} s at {period:g} s per sample is too long.",
            code="PC-TRJ-004",
            hint=f"At most {MAX_SAMPLES} samples are possible.",
        )
    return max(2, math.ceil(ratio - 1e-9) + 1)


def _real(name: str, value: float) -> float:
    return float(finite_array(name, [value])[0])


def _positive(name: str, value: float) -> float:
    number = _real(name, value)
    if number <= 0.0:
        raise _out_of_range(name, number, "it must be positive")
    return number


def _not_negative(name: str, value: float) -> float:
    number = _real(name, value)
    if number < 0.0:
        raise _out_of_range(name, number, "it must not be negative")
    return number


def _count(name: str, value: int) -> int:
    if not 1 <= value <= 100_000:
        raise _out_of_range(name, value, "1 to 100000 are possible")
    return int(value)


def _out_of_range(name: str, value: float, rule: str) -> ModelError:
    return ModelError(
        f"{name} of the motion is {value:g}; {rule}.",
        code="PC-TRJ-003",
        hint="Correct the motion that was asked for.",
    )
