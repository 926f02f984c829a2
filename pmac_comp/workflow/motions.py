"""Motions as text, as trajectories and as motion programs in PVT form.

What lives here: the motion specifications of the command line, the campaigns, and the rendering
of any sampled trajectory as PVT segments (each the cubic through its end values; Software
Reference Manual p. 463). What may not: conversations.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import AmplitudeExceeded, ConfigError, MotorNotSafe, SafetyRefusal
from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.signals import trajectory as tr
from pmac_comp.physics.signals.trajectory import Trajectory
from pmac_comp.workflow.scales import Scales

PROGRAM_NUMBER = 703
_LISTED_DIGITS = 9  # one fewer than the ten that a listing shows
_SHORTEST_CYCLES = 11  # 4.9 ms at 442 us: well above the card's calculation time of a block
_LONGEST_DOUBLINGS = 6
_PVT_ERROR_m = 0.02e-6
_WIGGLE_m = 150e-6
_WIGGLE_Hz = 6.0
_WIGGLE_s = 1.5
_WIGGLE_DECADES = 4.5  # natural ones: from 150 um to below 2 um
_REST_s = 0.1


@dataclass(frozen=True)
class Motion:
    """A named trajectory on one bench."""

    name: str
    trajectory: Trajectory

    @property
    def position_m(self) -> FloatArray:
        """Commanded table position in m, shape (n,)."""
        return self.trajectory.position_m

    @property
    def duration_s(self) -> float:
        """Length in s."""
        return float(self.trajectory.time_s[-1])

    def row(self) -> tuple[str, float, float, float, float, float]:
        """Name, duration, range, peak speed and acceleration for people."""
        t = self.trajectory
        return (
            self.name,
            round(self.duration_s, 2),
            round(float(t.position_m.min()) * MM_PER_M, 3),
            round(float(t.position_m.max()) * MM_PER_M, 3),
            round(float(np.max(np.abs(t.velocity_m_per_s))) * MM_PER_M, 1),
            round(float(np.max(np.abs(t.acceleration_m_per_s2))), 3),
        )


def check_motion(motion: Motion, bench: Bench) -> None:
    """Refuse a motion that leaves the travel or passes the safety limits, all reasons at once."""
    t = motion.trajectory
    low, high = bench.travel.min_mm / MM_PER_M, bench.travel.max_mm / MM_PER_M
    speed = float(np.max(np.abs(t.velocity_m_per_s)))
    acceleration = float(np.max(np.abs(t.acceleration_m_per_s2)))
    refusals: list[SafetyRefusal] = []
    if t.position_m.min() < low - 1e-9 or t.position_m.max() > high + 1e-9:
        refusals.append(
            MotorNotSafe(
                f"{motion.name} runs from {t.position_m.min() * 1e3:.1f} to "
                f"{t.position_m.max() * 1e3:.1f} mm, the travel is {low * 1e3:g} to "
                f"{high * 1e3:g} mm.",
                code="PC-MOV-001",
            )
        )
    for value, limit, what, unit in (
        (speed * 1e3, bench.safety.max_speed_mm_per_s, "speed", "mm/s"),
        (acceleration, bench.safety.max_acceleration_m_per_s2, "acceleration", "m/s2"),
    ):
        if value > limit * (1.0 + 1e-6):
            refusals.append(
                AmplitudeExceeded(
                    f"{motion.name}: {what} {value:.4g} {unit}, the limit is {limit:g} {unit}.",
                    code="PC-MOV-002",
                )
            )
    if refusals:
        raise SafetyRefusal(
            f"The motion {motion.name} is refused.",
            code="PC-MOV-000",
            hint="Choose a smaller motion or correct [travel] and [safety] in the bench file.",
            refusals=tuple(refusals),
        )


# Specifications -----------------------------------------------------------------------------------

_Maker = Callable[[float, dict[str, float]], Trajectory]


def _sine(period: float, v: dict[str, float]) -> Trajectory:
    return tr.sinusoid(
        period_s=period,
        amplitude_m=v.pop("amplitude_mm", 10.0) / MM_PER_M,
        frequency_Hz=v.pop("frequency_Hz", 1.0),
        cycles=v.pop("cycles", 4.0),
        centre_m=v.pop("centre_mm", 0.0) / MM_PER_M,
    )


def _trapezoid(period: float, v: dict[str, float]) -> Trajectory:
    return tr.trapezoid(
        period_s=period,
        distance_m=v.pop("distance_mm", 100.0) / MM_PER_M,
        speed_m_per_s=v.pop("speed_mm_per_s", 200.0) / MM_PER_M,
        acceleration_m_per_s2=v.pop("acceleration_m_per_s2", 2.0),
        s_curve_s=v.pop("s_curve_ms", 15.0) / 1e3,
        start_m=v.pop("start_mm", 0.0) / MM_PER_M,
        repeats=int(v.pop("repeats", 1.0)),
    )


def _triangle(period: float, v: dict[str, float]) -> Trajectory:
    return tr.triangle(
        period_s=period,
        amplitude_m=v.pop("amplitude_mm", 10.0) / MM_PER_M,
        speed_m_per_s=v.pop("speed_mm_per_s", 5.0) / MM_PER_M,
        cycles=int(v.pop("cycles", 2.0)),
        centre_m=v.pop("centre_mm", 0.0) / MM_PER_M,
        acceleration_m_per_s2=v.pop("acceleration_m_per_s2", 1.0),
    )


_MAKERS: Mapping[str, _Maker] = {"sine": _sine, "trapezoid": _trapezoid, "triangle": _triangle}


def parse_motion(text: str, bench: Bench) -> Motion:
    """Motion of ``kind:key=value,...`` or of a CSV file with a command.

    Raises
    ------
    ConfigError
        Unknown kind or key, or a value that is no number.
    """
    if text.lower().endswith((".csv", ".h5", ".hdf5")):
        return _motion_from_file(Path(text), bench)
    kind, _, rest = text.partition(":")
    maker = _MAKERS.get(kind.strip().lower())
    if maker is None:
        raise ConfigError(
            f"'{kind}' is not a kind of motion.",
            code="PC-MOV-003",
            hint="Use " + ", ".join(_MAKERS) + " or the name of a CSV file.",
        )
    values = _key_values(rest, text)
    motion = Motion(text, maker(bench.servo_period_s, values))
    if values:
        raise ConfigError(
            f"'{text}': unknown key(s) {', '.join(values)}.",
            code="PC-MOV-004",
            hint="See `pmac-comp capture --help`.",
        )
    check_motion(motion, bench)
    return motion


def _key_values(text: str, whole: str) -> dict[str, float]:
    values: dict[str, float] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        key, _, value = item.partition("=")
        try:
            values[key.strip()] = float(value)
        except ValueError as error:
            raise ConfigError(
                f"'{whole}': '{item}' is not key=number.", code="PC-MOV-005"
            ) from error
    return values


def _motion_from_file(path: Path, bench: Bench) -> Motion:
    from pmac_comp.workflow.commands import read_command

    time_s, position = read_command(path)
    period = bench.servo_period_s
    n = math.floor((time_s[-1] - time_s[0]) / period) + 1
    grid = period * np.arange(n)
    from scipy.interpolate import CubicSpline

    motion = Motion(path.stem, Trajectory(grid, CubicSpline(time_s - time_s[0], position)(grid)))
    check_motion(motion, bench)
    return motion


# Campaigns ----------------------------------------------------------------------------------------


def calibration_motions(bench: Bench) -> list[Motion]:
    """Proposed campaign: several amplitudes and frequencies at three places of the travel.

    Fits the travel, the safety limits and the rated speed of the bench (ballscrew facts 2.9,
    excitation rules).
    """
    low, high = bench.travel.min_mm / 1e3, bench.travel.max_mm / 1e3
    middle, span = 0.5 * (low + high), high - low
    period = bench.servo_period_s
    speed = usable_speed(bench)
    acceleration = min(bench.safety.max_acceleration_m_per_s2, 8.0)

    def sine(name: str, amplitude: float, frequency: float, place: float, n: float) -> Motion:
        omega = 2.0 * math.pi * frequency
        amplitude = min(amplitude, 0.15 * span, 0.9 * speed / omega, 0.85 * acceleration / omega**2)
        shape = tr.sinusoid(
            period_s=period,
            amplitude_m=amplitude,
            frequency_Hz=frequency,
            cycles=n,
            centre_m=middle + place * span,
        )
        return Motion(name, shape)

    def move(name: str, distance: float, fraction: float, start: float) -> Motion:
        shape = tr.trapezoid(
            period_s=period,
            distance_m=distance * span,
            speed_m_per_s=fraction * speed,
            acceleration_m_per_s2=min(3.0, acceleration),
            s_curve_s=0.02,
            start_m=middle + start * span,
        )
        return Motion(name, shape)

    slow = tr.triangle(
        period_s=period,
        amplitude_m=min(2e-3, 0.05 * span),
        speed_m_per_s=2e-3,
        cycles=2,
        centre_m=middle,
        acceleration_m_per_s2=0.5,
    )
    return [
        sine("sine_low_end", 0.010, 4.0, -0.40, 8.0),
        sine("sine_middle", 0.012, 3.5, 0.0, 8.0),
        sine("sine_high_end", 0.010, 4.0, 0.40, 8.0),
        sine("sine_long", 0.050, 0.7, 0.0, 3.0),
        sine("sine_small", 0.004, 1.0, 0.1, 4.0),
        move("move_long", 0.75, 0.7, -0.38),
        move("move_slow", 0.15, 0.1, -0.1),
        Motion("triangle_slow", slow),
    ]


def lead_motions(bench: Bench) -> list[Motion]:
    """One slow run over the travel and back."""
    low, high = bench.travel.min_mm / 1e3, bench.travel.max_mm / 1e3
    margin = 0.005 * (high - low)
    shape = tr.trapezoid(
        period_s=bench.servo_period_s,
        distance_m=high - low - 2.0 * margin,
        speed_m_per_s=min(0.06, 0.3 * usable_speed(bench)),
        acceleration_m_per_s2=0.5,
        s_curve_s=0.05,
        start_m=low + margin,
    )
    return [Motion("lead_run", shape)]


def verification_motions(
    bench: Bench, seed: int, *, n_sine: int = 3, n_move: int = 3
) -> list[Motion]:
    """Motions drawn by a seed: sinusoids within the rated speed and jerk-limited trapezoids."""
    rng = np.random.default_rng(seed)
    low, high = bench.travel.min_mm / 1e3, bench.travel.max_mm / 1e3
    span, speed = high - low, usable_speed(bench)
    acceleration = min(bench.safety.max_acceleration_m_per_s2, 10.0)
    period = bench.servo_period_s
    motions: list[Motion] = []
    for _ in range(n_sine):
        frequency = float(np.exp(rng.uniform(np.log(0.7), np.log(5.0))))
        omega = 2.0 * math.pi * frequency
        most = min(0.05, 0.1 * span, 0.95 * speed / omega, 0.98 * acceleration / omega**2)
        amplitude = float(rng.uniform(0.7, 1.0)) * most
        centre = float(rng.uniform(low + 1.2 * amplitude, high - 1.2 * amplitude))
        name = f"sine {amplitude * 1e3:.1f} mm {frequency:.2f} Hz at {centre * 1e3:.0f} mm"
        cycles = max(3.0, min(6.0, math.ceil(1.5 * frequency)))
        shape = tr.sinusoid(
            period_s=period,
            amplitude_m=amplitude,
            frequency_Hz=frequency,
            cycles=cycles,
            centre_m=centre,
        )
        motions.append(Motion(name, shape))
    for _ in range(n_move):
        distance = float(rng.uniform(0.05, 0.3)) * span
        v = float(rng.uniform(0.3, 0.95)) * speed
        a = float(rng.uniform(0.3, 1.0)) * min(5.0, acceleration)
        start = float(rng.uniform(low, high - distance))
        name = f"move {distance * 1e3:.0f} mm {v * 1e3:.0f} mm/s {a:.1f} m/s2"
        shape = tr.trapezoid(
            period_s=period,
            distance_m=distance,
            speed_m_per_s=v,
            acceleration_m_per_s2=a,
            s_curve_s=0.015,
            start_m=start,
        )
        motions.append(Motion(name, shape))
    return motions


def usable_speed(bench: Bench) -> float:
    """Highest speed in m/s: the safety limit or the rated speed of the motor."""
    limit = bench.safety.max_speed_mm_per_s / MM_PER_M
    rpm = bench.known.rated_speed_rpm
    return limit if rpm is None else min(limit, rpm / 60.0 * bench.pitch_m)


# PVT form -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PvtProgram:
    """A sampled trajectory as a motion program.

    Parameters
    ----------
    lines : tuple of str
        Lines between OPEN and CLOSE.
    n_segments : int
        PVT segments.
    start_ct : float
        Where the motor must stand, counts.
    shape_error_m : float
        Largest departure of the cubic segments from the trajectory.
    duration_s : float
        Time the program takes.
    """

    lines: tuple[str, ...]
    n_segments: int
    start_ct: float
    shape_error_m: float
    duration_s: float


def _listed(value: float, decimals: int) -> str:
    """Decimal text with no more digits than the card lists back: ten (fact sheet, 2.4)."""
    whole = len(str(int(abs(value))))
    return f"{value:.{max(0, min(decimals, _LISTED_DIGITS - whole))}f}"


def pvt_program(motion: Motion, bench: Bench) -> PvtProgram:
    """PVT segments through a trajectory, as long as the cubic stays within 0.02 um.

    The axis is in counts (``#1->X``) and the velocity in counts/s (I5190 = 1000).
    """
    scales = Scales.of(bench)
    period = bench.servo_period_s
    position = motion.position_m / scales.motor_m_per_ct
    speed = np.gradient(position, period)
    n = position.size
    lines: list[str] = ["ABS"]
    at, last, worst, segments = 0, 0, 0.0, 0
    tolerance = _PVT_ERROR_m / scales.motor_m_per_ct
    while at < n - 1:
        length, error = _segment(position, speed, at, period, tolerance)
        if length != last:
            lines.append(f"PVT{length * period * 1e3:.6f}")
            last = length
        at += length
        worst, segments = max(worst, error), segments + 1
        velocity = speed[at] if at < n - 1 else 0.0
        lines.append(f"X{_listed(position[at], 4)}:{_listed(velocity, 3)}")
    return PvtProgram(
        tuple(_tidy(line) for line in lines),
        segments,
        float(position[0]),
        worst * scales.motor_m_per_ct,
        (n - 1) * period,
    )


def _segment(
    position: FloatArray, speed: FloatArray, at: int, period: float, tolerance: float
) -> tuple[int, float]:
    """Cycles of the longest admissible segment from a sample and its largest error in counts."""
    left = position.size - 1 - at
    for doubling in range(_LONGEST_DOUBLINGS, -1, -1):
        length = _SHORTEST_CYCLES << doubling
        if length > left:
            continue
        rest = left - length
        if 0 < rest < _SHORTEST_CYCLES and doubling == 0:
            length = left
        error = _cubic_error(position, speed, at, length, period)
        if error <= tolerance or doubling == 0:
            return length, error
    return left, _cubic_error(position, speed, at, left, period)


def _cubic_error(
    position: FloatArray, speed: FloatArray, at: int, length: int, period: float
) -> float:
    u = np.arange(length + 1) / length
    h = length * period
    p0, p1 = position[at], position[at + length]
    m0, m1 = speed[at] * h, speed[at + length] * h
    cubic = (
        (2 * u**3 - 3 * u**2 + 1) * p0
        + (u**3 - 2 * u**2 + u) * m0
        + (3 * u**2 - 2 * u**3) * p1
        + (u**3 - u**2) * m1
    )
    return float(np.max(np.abs(cubic - position[at : at + length + 1])))


def _tidy(line: str) -> str:
    """Line without useless zeros and minus zeros."""
    parts = line.split(":")
    return ":".join(_tidy_number(part) for part in parts)


def _tidy_number(text: str) -> str:
    head = text.rstrip("-0123456789.")
    number = text[len(head) :]
    if "." not in number:
        return text
    short = number.rstrip("0").rstrip(".")
    return head + ("0" if short in {"", "-", "-0"} else short)


def relaxing(motion: Motion) -> tuple[Motion, int]:
    """The motion with a fading wiggle and a short rest before it, and the sample it starts at.

    Friction remembers the approach: the drive stands wound up, and the integrator pushes against
    it. A wiggle that fades through the presliding distance leaves it relaxed, which is how a
    simulation starts.
    """
    period = motion.trajectory.sample_period_s
    t = np.arange(1, round(_WIGGLE_s / period)) * period
    rise = np.clip(t * _WIGGLE_Hz, 0.0, 1.0)
    fade = np.exp(-_WIGGLE_DECADES * t / _WIGGLE_s) * (1.0 - (t / _WIGGLE_s) ** 8)
    shape = _WIGGLE_m * rise**2 * (3.0 - 2.0 * rise) * fade * np.sin(2 * np.pi * _WIGGLE_Hz * t)
    start = motion.position_m[0]
    inward = 1.0 if np.mean(motion.position_m) >= start else -1.0
    rest = np.full(round(_REST_s / period), start)
    position = np.concatenate([[start], start + inward * shape, rest, motion.position_m])
    first = 1 + shape.size + rest.size
    grid = period * np.arange(position.size, dtype=np.float64)
    return Motion(motion.name, Trajectory(grid, position)), first


def motion_rows(motions: Sequence[Motion]) -> list[tuple[Any, ...]]:
    """Rows of a table of motions."""
    return [motion.row() for motion in motions]
