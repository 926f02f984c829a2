"""Sampled trajectories as motion programs: PVT segments, as long as the cubic stays close.

Each segment is the cubic through its end values (Software Reference Manual p. 463); how far it is
from the trajectory is stated, not assumed. The jerk of a segment is constant: where that of the
trajectory steps, as at the corners of an S-curve, a segment ends, also between two samples. One
that ran across would overshoot the acceleration, and end a move with a reversed one.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pmac_comp.base.arrays import FloatArray, stretches
from pmac_comp.base.units import MS_PER_S
from pmac_comp.files.bench import Bench
from pmac_comp.workflow.bench.scales import Scales
from pmac_comp.workflow.motion.motions import Motion

PROGRAM_NUMBER = 703  # of runs that are only measured
_LISTED_DIGITS = 9  # one fewer than the ten that a listing shows
_SHORTEST_CYCLES = 11  # 4.9 ms at 442 us: well above the card's calculation time of a block
_SHORTEST_ALONE_CYCLES = 7  # 3.1 ms: of one between longer ones, which the card calculates ahead
_LONGEST_DOUBLINGS = 6
_PVT_ERROR_m = 0.02e-6
_BETWEEN_CORNERS, _BETWEEN_CORNERS_CYCLES = 25.0, 60.0  # times that, of a segment so short
_SAME_CYCLES = 1e-6
_REACH = 4  # samples of a cubic; fourth differences across a corner
_TWO_CORNERS = 2 * _REACH  # fourth differences across two that are close
_LEAST_BEND_ct = 1e-6  # fourth difference: positions are not rounded more coarsely
_SHARP, _SMOOTH_FRAC = 30.0, 0.85  # times what so many of the fourth differences stay below
_JERK_FRAC = 0.03  # of a step of the acceleration: a cubic does not bend so little by a jerk


class PvtSegment(NamedTuple):
    """One segment: when it ends, in servo cycles from the start, and its text.

    ``time`` is empty where the segment before took as long.
    """

    end_cycle: float
    time: str
    end: str


@dataclass(frozen=True)
class PvtProgram:
    """A sampled trajectory as a motion program.

    Parameters
    ----------
    segments : tuple of PvtSegment
        In their order.
    start_ct : float
        Where the motor must stand, counts.
    shape_error_m : float
        Largest departure of the cubic segments from the trajectory.
    rounding_ct : float
        Largest rounding of a position in the text, counts.
    duration_s : float
        Time the program takes.
    """

    segments: tuple[PvtSegment, ...]
    start_ct: float
    shape_error_m: float
    rounding_ct: float
    duration_s: float

    @property
    def lines(self) -> tuple[str, ...]:
        """Lines between OPEN and CLOSE."""
        texts = (text for segment in self.segments for text in (segment.time, segment.end))
        return ("ABS", *filter(None, texts))


def number_text(value: float, decimals: int) -> str:
    """Decimal text as the card lists it: without useless zeros and minus zero."""
    text = f"{value:.{decimals}f}"
    short = text.rstrip("0").rstrip(".") if "." in text else text
    return "0" if short == "-0" else short


def _listed(value: float, decimals: int) -> str:
    """The same with no more digits than the card lists back: ten (fact sheet, 2.4)."""
    whole = len(str(int(abs(value))))
    return number_text(value, max(0, min(decimals, _LISTED_DIGITS - whole)))


def pvt_program(motion: Motion, bench: Bench) -> PvtProgram:
    """PVT segments through a trajectory, as long as the cubic stays within 0.02 um.

    The axis is in counts (``#1->X``) and the velocity in counts/s (I5190 = 1000).
    """
    scales = Scales.of(bench)
    period = bench.servo_period_s
    position = motion.position_m / scales.motor_m_per_ct
    tolerance = _PVT_ERROR_m / scales.motor_m_per_ct
    nodes, worst = _nodes(position, tolerance)
    segments: list[PvtSegment] = []
    last, rounding = 0.0, 0.0
    for before, node in pairwise(nodes):
        cycles, time = node.cycle - before.cycle, ""
        if abs(cycles - last) > _SAME_CYCLES:
            time = f"PVT{number_text(cycles * period * MS_PER_S, 6)}"
            last = cycles
        place = _listed(node.place, 4)
        rounding = max(rounding, abs(float(place) - node.place))
        end = f"X{place}:{_listed(node.speed / period, 3)}"
        segments.append(PvtSegment(node.cycle, time, end))
    return PvtProgram(
        tuple(segments),
        float(position[0]),
        worst * scales.motor_m_per_ct,
        rounding,
        (position.size - 1) * period,
    )


class _Node(NamedTuple):
    """Place in counts and speed in counts per cycle at a time in cycles."""

    cycle: float
    place: float
    speed: float


def _at_sample(k: int, position: FloatArray, speed: FloatArray) -> _Node:
    return _Node(float(k), float(position[k]), float(speed[k]))


def _nodes(position: FloatArray, tolerance: float) -> tuple[list[_Node], float]:
    """Ends of the segments through a trajectory, and the largest error of the cubics in counts."""
    speed = _speed(position)
    nodes, worst = [_at_sample(0, position, speed)], 0.0
    off = _BETWEEN_CORNERS * tolerance
    for corner in _with_room(_corners(position, speed), position, speed):
        # Between corners a cubic that is off a little beats two where the acceleration steps.
        if corner.cycle - nodes[-1].cycle <= _BETWEEN_CORNERS_CYCLES:
            error = _cubic_error(position, nodes[-1], corner)
            if error <= off:
                nodes.append(corner)
                worst = max(worst, error)
        while nodes[-1] is not corner:
            node, error = _next_node(position, speed, nodes[-1], corner, tolerance)
            nodes.append(node)
            worst = max(worst, error)
    return nodes, worst


def _with_room(corners: list[_Node], position: FloatArray, speed: FloatArray) -> list[_Node]:
    """Corners with room for a segment on both sides, and the end, where the axis stands.

    Two that are close, as around a short plateau of the acceleration, are one in their middle: the
    cubics to both sides of it have nearly one acceleration there, one that ran across both steps.
    """
    kept = [_Node(float(position.size - 1), float(position[-1]), 0.0)]
    for corner in reversed(_merged(corners, position, speed)):
        room = kept[0].cycle - corner.cycle
        before_long = len(kept) > 1 and kept[1].cycle - kept[0].cycle >= _SHORTEST_CYCLES
        shortest = _SHORTEST_ALONE_CYCLES if before_long else _SHORTEST_CYCLES
        if corner.cycle > _SHORTEST_CYCLES and room > shortest:
            kept.insert(0, corner)
    return kept


def _merged(corners: list[_Node], position: FloatArray, speed: FloatArray) -> list[_Node]:
    merged: list[_Node] = []
    for corner in corners:
        if merged and corner.cycle - merged[-1].cycle <= _SHORTEST_ALONE_CYCLES:
            k = round(0.5 * (merged[-1].cycle + corner.cycle))
            merged[-1] = _at_sample(k, position, speed)
        else:
            merged.append(corner)
    return merged


def _next_node(
    position: FloatArray, speed: FloatArray, begin: _Node, corner: _Node, tolerance: float
) -> tuple[_Node, float]:
    """End of the longest admissible segment up to a corner, and its largest error in counts."""
    end, error = corner, math.inf
    for doubling in range(_LONGEST_DOUBLINGS, -1, -1):
        length = _SHORTEST_CYCLES << doubling
        end = corner
        if corner.cycle - begin.cycle >= length + _SHORTEST_CYCLES + 1:
            k = math.ceil(begin.cycle) + length
            end = _at_sample(k, position, speed)
        error = _cubic_error(position, begin, end)
        if error <= tolerance:
            break
    return end, error


def _speed(position: FloatArray) -> FloatArray:
    """Speed in counts per cycle at each sample, exact for constant jerk."""
    speed = np.gradient(position, edge_order=2 if position.size > 2 else 1)
    inner = 8.0 * (position[3:-1] - position[1:-3]) - (position[4:] - position[:-4])
    speed[2:-2] = inner / 12.0
    return np.asarray(speed)


def _corners(position: FloatArray, speed: FloatArray) -> list[_Node]:
    """Where the jerk or the acceleration of a trajectory steps, between its samples.

    Fourth differences of cubics are zero but for the four across a corner. The difference of the
    cubics on both sides has a triple root there, or a double one where the acceleration steps.
    """
    bends = np.abs(np.diff(position, 4))
    if bends.size < _REACH:
        return []
    across = bends > max(_LEAST_BEND_ct, _SHARP * float(np.quantile(bends, _SMOOTH_FRAC)))
    corners = []
    for run in stretches(across):
        k = run.start + _REACH - 1  # last sample before the corner
        if k + _REACH >= position.size or run.stop - run.start > _TWO_CORNERS:
            continue
        if run.stop - run.start > _REACH:  # two that are too close to be told apart
            k = run.start + (run.stop - run.start + _REACH - 1) // 2
            corners.append(_at_sample(k, position, speed))
            continue
        at = np.arange(float(_REACH))
        left = np.polyfit(at - 3.0, position[k - 3 : k + 1] - position[k], 3)
        right = np.polyfit(at + 1.0, position[k + 1 : k + 5] - position[k], 3)
        cubic, square, line, _ = (right - left).tolist()
        has_step = abs(square) > _LEAST_BEND_ct and abs(cubic) < _JERK_FRAC * abs(square)
        root = -0.5 * line / square if has_step else -square / (3.0 * cubic)
        s = min(max(root, -1.0), 2.0)
        place = float(position[k] + np.polyval(left, s))
        corners.append(_Node(k + s, place, float(np.polyval(np.polyder(left), s))))
    return corners


def _cubic_error(position: FloatArray, begin: _Node, end: _Node) -> float:
    """Largest departure in counts, at the samples, of the cubic between two nodes."""
    h = end.cycle - begin.cycle
    at = np.arange(math.ceil(begin.cycle), math.floor(end.cycle) + 1)
    u = (at - begin.cycle) / h
    cubic = (
        (2 * u**3 - 3 * u**2 + 1) * begin.place
        + (u**3 - 2 * u**2 + u) * begin.speed * h
        + (3 * u**2 - 2 * u**3) * end.place
        + (u**3 - u**2) * end.speed * h
    )
    return float(np.max(np.abs(cubic - position[at]), initial=0.0))
