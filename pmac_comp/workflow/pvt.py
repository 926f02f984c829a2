"""Sampled trajectories as motion programs: PVT segments, as long as the cubic stays close.

Each segment is the cubic through its end values (Software Reference Manual p. 463); how far it is
from the trajectory is stated, not assumed.
"""

from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.workflow.motions import Motion
from pmac_comp.workflow.scales import Scales

PROGRAM_NUMBER = 703  # of runs that are only measured
_LISTED_DIGITS = 9  # one fewer than the ten that a listing shows
_SHORTEST_CYCLES = 11  # 4.9 ms at 442 us: well above the card's calculation time of a block
_LONGEST_DOUBLINGS = 6
_PVT_ERROR_m = 0.02e-6


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
    rounding_ct : float
        Largest rounding of a position in the text, counts.
    duration_s : float
        Time the program takes.
    """

    lines: tuple[str, ...]
    n_segments: int
    start_ct: float
    shape_error_m: float
    rounding_ct: float
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
    at, last, worst, rounding, segments = 0, 0, 0.0, 0.0, 0
    tolerance = _PVT_ERROR_m / scales.motor_m_per_ct
    while at < n - 1:
        length, error = _segment(position, speed, at, period, tolerance)
        if length != last:
            lines.append(f"PVT{length * period * 1e3:.6f}")
            last = length
        at += length
        worst, segments = max(worst, error), segments + 1
        velocity = speed[at] if at < n - 1 else 0.0
        place = _listed(position[at], 4)
        rounding = max(rounding, abs(float(place) - float(position[at])))
        lines.append(f"X{place}:{_listed(velocity, 3)}")
    return PvtProgram(
        tuple(_tidy(line) for line in lines),
        segments,
        float(position[0]),
        worst * scales.motor_m_per_ct,
        rounding,
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
