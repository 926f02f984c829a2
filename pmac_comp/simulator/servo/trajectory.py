"""Trajectories: per-motor queues of polynomial segments, and the jog profiles that fill them.

What lives here: the queue that the servo kernel evaluates every servo cycle, and the planners of
jog, stop and abort moves. What may not: motion programs (they plan blended moves and push the
segments here), memory addresses. Imports numba and ``base``.

One segment is a polynomial ``c0 + c1 t + ... + c5 t^5`` in units of 1/(32 Ixx08) count, with
``t`` in servo cycles from its start at 100 % time base. A motor whose queue is empty stands at its
last position. All motors of a coordinate system get segments of the same durations, so they change
segment in the same servo cycle whatever the time base does.

Source: Turbo PMAC Software Reference Manual p. 97-108, 152 (Ixx15, Ixx19-23, Ixx92), 332-340.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from pmac_comp.base.arrays import FloatArray, IntArray

N_MOTORS = 32
DEPTH = 512
INDEFINITE = math.inf

# Columns of a stored segment.
(Q_DURATION, Q_C0, Q_C1, Q_C2, Q_C3, Q_C4, Q_C5, Q_FLAGS, Q_TAG, N_COLUMNS) = range(10)
# Columns of the cursor of a motor.
(C_TIME, C_POSITION, C_VELOCITY, C_ACCELERATION, C_JERK, N_CURSOR) = range(6)
# Columns of the integer state of a motor.
(I_HEAD, I_COUNT, I_TAG, I_WATCH, I_STARTED, N_INDEX) = range(6)

# Segment flags.
TIMED = 1  # move timer active (status word 1 bit 17)
REAL_TIME = 2  # not scaled by the time base (DWELL)
DWELL = 4  # status word 1 bit 15
ABORTING = 8  # status word 1 bit 12
HOMING = 16  # status word 1 bit 10
JOGGING = 32  # a jog, as opposed to a programmed move


@dataclass(frozen=True)
class Segment:
    """One polynomial piece of a motor's trajectory.

    Parameters
    ----------
    duration_cycles : float
        Servo cycles at 100 %; ``INDEFINITE`` runs until replaced.
    coefficients : tuple of float
        Up to six, ascending powers of the time in cycles, position units.
    flags : int
        Segment flags of this module.
    tag : int
        Non-zero: the start of this segment is reported as an event with this number.
    """

    duration_cycles: float
    coefficients: tuple[float, ...]
    flags: int = TIMED
    tag: int = 0

    def end(self) -> tuple[float, float]:
        """Position and velocity at the end of the segment, in units and units per cycle."""
        t = self.duration_cycles
        position = sum(c * t**i for i, c in enumerate(self.coefficients))
        velocity = sum(i * c * t ** (i - 1) for i, c in enumerate(self.coefficients) if i)
        return position, velocity


class MotionQueue:
    """Segment queues of all motors, shared with the servo kernel.

    ``push`` and ``replace`` act from the next servo cycle on. ``watch`` asks for an event when
    fewer than ``least`` segments remain, so that a program is planned ahead without polling.
    """

    def __init__(self) -> None:
        self.segments: FloatArray = np.zeros((N_MOTORS + 1, DEPTH, N_COLUMNS))
        self.cursor: FloatArray = np.zeros((N_MOTORS + 1, N_CURSOR))
        self.index: IntArray = np.zeros((N_MOTORS + 1, N_INDEX), dtype=np.int64)

    def push(self, motor: int, segments: Iterable[Segment]) -> None:
        """Append segments; raises OverflowError when the queue is full."""
        for segment in segments:
            count = int(self.index[motor, I_COUNT])
            if count >= DEPTH:
                raise OverflowError(f"The trajectory queue of motor {motor} is full.")
            row = self.segments[motor, (int(self.index[motor, I_HEAD]) + count) % DEPTH]
            row[:] = 0.0
            row[Q_DURATION] = segment.duration_cycles
            row[Q_C0 : Q_C0 + len(segment.coefficients)] = segment.coefficients
            row[Q_FLAGS] = segment.flags
            row[Q_TAG] = segment.tag
            self.index[motor, I_COUNT] = count + 1

    def replace(self, motor: int, segments: Iterable[Segment]) -> None:
        """Drop what is queued and start with these segments in the next servo cycle."""
        self.clear(motor)
        self.push(motor, segments)

    def drop_last(self, motor: int, count: int) -> None:
        """Take back the segments that were appended last and have not started."""
        self.index[motor, I_COUNT] -= count

    def clear(self, motor: int) -> None:
        """Drop all segments: the motor stands where it is now commanded."""
        self.index[motor, I_HEAD] = 0
        self.index[motor, I_COUNT] = 0
        self.index[motor, I_STARTED] = 0
        self.index[motor, I_TAG] = 0
        self.cursor[motor, C_TIME] = 0.0
        self.cursor[motor, C_VELOCITY:] = 0.0

    def place(self, motor: int, position: float) -> None:
        """Stand at a position in units (loop closed, re-zeroed)."""
        self.clear(motor)
        self.cursor[motor, C_POSITION] = position

    def shift(self, motor: int, offset: float) -> None:
        """Move the origin of a motor: all queued positions change by ``offset`` units."""
        self.cursor[motor, C_POSITION] += offset
        for i in range(int(self.index[motor, I_COUNT])):
            row = (int(self.index[motor, I_HEAD]) + i) % DEPTH
            self.segments[motor, row, Q_C0] += offset

    def ignore_time_base(self, motor: int) -> None:
        """Let what is queued run at 100 % whatever the time base does (jogs in feed hold)."""
        for i in range(int(self.index[motor, I_COUNT])):
            row = self.segments[motor, (int(self.index[motor, I_HEAD]) + i) % DEPTH]
            row[Q_FLAGS] = int(row[Q_FLAGS]) | REAL_TIME

    def ignores_time_base(self, motor: int) -> bool:
        """Whether what executes now runs at 100 % in feed hold too."""
        if not self.pending(motor):
            return False
        row = self.segments[motor, int(self.index[motor, I_HEAD])]
        return bool(int(row[Q_FLAGS]) & REAL_TIME)

    def pending(self, motor: int) -> int:
        """Number of segments that are executing or waiting."""
        return int(self.index[motor, I_COUNT])

    def watch(self, motor: int, least: int) -> None:
        """Report when fewer than ``least`` segments remain; 0 reports nothing."""
        self.index[motor, I_WATCH] = least

    def executing_tag(self, motor: int) -> int:
        """Tag of the latest tagged segment while anything executes, 0 if there was none."""
        return int(self.index[motor, I_TAG]) if self.index[motor, I_COUNT] else 0

    def state(self, motor: int) -> tuple[float, float]:
        """Commanded position and velocity now, in units and units per cycle at 100 %."""
        return float(self.cursor[motor, C_POSITION]), float(self.cursor[motor, C_VELOCITY])

    def time_left_cycles(self, motor: int) -> float:
        """Servo cycles left in the executing segment at 100 %; 0 if it stands or is unending."""
        if not self.index[motor, I_COUNT]:
            return 0.0
        row = self.segments[motor, int(self.index[motor, I_HEAD])]
        left = float(row[Q_DURATION] - self.cursor[motor, C_TIME])
        return left if math.isfinite(left) else 0.0

    def last_position(self, motor: int) -> tuple[float, float]:
        """Position and velocity at the end of everything queued (for planning ahead).

        What has no end counts as where the motor is now commanded.
        """
        count = int(self.index[motor, I_COUNT])
        if not count:
            return self.state(motor)
        row = self.segments[motor, (int(self.index[motor, I_HEAD]) + count - 1) % DEPTH]
        if not math.isfinite(row[Q_DURATION]):
            return self.state(motor)
        return Segment(float(row[Q_DURATION]), tuple(row[Q_C0 : Q_C5 + 1])).end()


@njit(cache=True)
def advance(
    segments: FloatArray, cursor: FloatArray, index: IntArray, motor: int, step: float
) -> int:
    """Advance one motor by ``step`` cycles of scaled time; the flags of what it executes.

    Leaves position, velocity and acceleration in the cursor. Bits 16 and up of the result:
    65536 a tagged segment has started, 131072 fewer segments remain than watched for.
    """
    if index[motor, I_COUNT] == 0:
        cursor[motor, C_VELOCITY] = 0.0
        cursor[motor, C_ACCELERATION] = 0.0
        cursor[motor, C_JERK] = 0.0
        return 0
    events = 0
    time = cursor[motor, C_TIME]
    row = segments[motor, index[motor, I_HEAD]]
    if index[motor, I_STARTED] == 0:
        index[motor, I_STARTED] = 1
        index[motor, I_TAG] = int(row[Q_TAG])
        if index[motor, I_TAG] != 0:
            events |= 65536
    if int(row[Q_FLAGS]) & REAL_TIME:
        time += 1.0
    else:
        time += step
    while time >= row[Q_DURATION]:
        duration = row[Q_DURATION]
        spare = time - duration
        end = _position(row, duration)
        index[motor, I_HEAD] = (index[motor, I_HEAD] + 1) % DEPTH
        index[motor, I_COUNT] -= 1
        if index[motor, I_COUNT] < index[motor, I_WATCH]:
            events |= 131072
        if index[motor, I_COUNT] == 0:
            cursor[motor, C_TIME] = 0.0
            cursor[motor, C_POSITION] = end
            cursor[motor, C_VELOCITY] = 0.0
            cursor[motor, C_ACCELERATION] = 0.0
            cursor[motor, C_JERK] = 0.0
            index[motor, I_STARTED] = 0
            index[motor, I_TAG] = 0
            return events
        time = spare
        row = segments[motor, index[motor, I_HEAD]]
        if int(row[Q_TAG]) != 0:
            # Untagged pieces keep it: a first one may be over in the step in which it started.
            index[motor, I_TAG] = int(row[Q_TAG])
            events |= 65536
    cursor[motor, C_TIME] = time
    cursor[motor, C_POSITION] = _position(row, time)
    t = time
    c2, c3, c4, c5 = row[Q_C2], row[Q_C3], row[Q_C4], row[Q_C5]
    cursor[motor, C_VELOCITY] = row[Q_C1] + t * (
        2.0 * c2 + t * (3.0 * c3 + t * (4.0 * c4 + t * 5.0 * c5))
    )
    cursor[motor, C_ACCELERATION] = 2.0 * c2 + t * (6.0 * c3 + t * (12.0 * c4 + t * 20.0 * c5))
    cursor[motor, C_JERK] = 6.0 * c3 + t * (24.0 * c4 + t * 60.0 * c5)
    return events | int(row[Q_FLAGS])


@njit(cache=True)
def _position(row: FloatArray, t: float) -> float:
    return float(
        row[Q_C0]
        + t * (row[Q_C1] + t * (row[Q_C2] + t * (row[Q_C3] + t * (row[Q_C4] + t * row[Q_C5]))))
    )


@dataclass(frozen=True)
class JogLimits:
    """Jog settings of a motor, in counts and ms as its I-variables have them.

    Parameters
    ----------
    acceleration_ct_per_ms2 : float
        Ixx19.
    time_ms, s_curve_ms : float
        Ixx20 and Ixx21.
    speed_ct_per_ms : float
        Ixx22 (Ixx23 for homing); its magnitude counts.
    calculation_ms : float
        Ixx92.
    unit_per_count : float
        32 Ixx08.
    cycle_ms : float
        Servo period.
    """

    acceleration_ct_per_ms2: float
    time_ms: float
    s_curve_ms: float
    speed_ct_per_ms: float
    calculation_ms: float
    unit_per_count: float
    cycle_ms: float

    @property
    def speed(self) -> float:
        """Speed in units per cycle."""
        return abs(self.speed_ct_per_ms) * self.unit_per_count * self.cycle_ms

    @property
    def delay_cycles(self) -> float:
        """Calculation time in whole servo cycles, at least one."""
        return max(1.0, math.ceil(self.calculation_ms / self.cycle_ms))

    def times(self, change: float) -> tuple[float, float]:
        """Acceleration time and S-part in cycles for a velocity change in units per cycle.

        Both are stretched alike until the average acceleration is within Ixx19 (p. 100).
        """
        total = max(self.time_ms, 2.0 * self.s_curve_ms, 2.0 * self.cycle_ms) / self.cycle_ms
        part = self.s_curve_ms / self.cycle_ms
        rate = self.acceleration_ct_per_ms2 * self.unit_per_count * self.cycle_ms**2
        needed = abs(change) / rate if rate > 0.0 else total
        stretch = max(1.0, needed / total)
        return total * stretch, part * stretch


def change_of_velocity(
    position: float, v0: float, v1: float, limits: JogLimits, *, flags: int
) -> list[Segment]:
    """Segments that take the velocity from ``v0`` to ``v1`` (units per cycle) in an S-curve."""
    total, part = limits.times(v1 - v0)
    return _s_curve(position, v0, v1, total, part, flags)


def _s_curve(
    position: float, v0: float, v1: float, total: float, part: float, flags: int
) -> list[Segment]:
    part = min(part, 0.5 * total)
    if v0 == v1 or total <= 0.0:
        return []
    acceleration = (v1 - v0) / (total - part)
    pieces: list[Segment] = []
    jerk = acceleration / part if part > 0.0 else 0.0
    plan = ((part, 0.0, jerk), (total - 2.0 * part, acceleration, 0.0), (part, acceleration, -jerk))
    velocity = v0
    for duration, a0, j0 in plan:
        if duration <= 1e-9:
            continue
        piece = Segment(duration, (position, velocity, 0.5 * a0, j0 / 6.0), flags)
        pieces.append(piece)
        position, velocity = piece.end()
    return pieces


def _hold(position: float, velocity: float, duration: float, flags: int) -> list[Segment]:
    return [Segment(duration, (position, velocity), flags)] if duration > 1e-9 else []


def _end(segments: list[Segment], position: float, velocity: float) -> tuple[float, float]:
    return segments[-1].end() if segments else (position, velocity)


def jog_continuous(
    position: float, velocity: float, limits: JogLimits, direction: int, *, flags: int = JOGGING
) -> list[Segment]:
    """J+ and J-: unending jog; ``direction`` is +1 or -1."""
    segments = _hold(position, velocity, limits.delay_cycles, flags)
    where = _end(segments, position, velocity)[0]
    target = limits.speed * direction
    segments += change_of_velocity(where, velocity, target, limits, flags=flags)
    where = _end(segments, position, velocity)[0]
    return [*segments, Segment(INDEFINITE, (where, target), flags)]


def jog_to(
    position: float,
    velocity: float,
    limits: JogLimits,
    target: float,
    *,
    flags: int = JOGGING | TIMED,
) -> list[Segment]:
    """Jog from a present state (units, units per cycle) that ends at rest exactly on ``target``.

    A speed of zero leads nowhere: the motor stops and stands.
    """
    segments = _hold(position, velocity, limits.delay_cycles, flags)
    where = _end(segments, position, velocity)[0]
    if limits.speed == 0.0 and (velocity or where != target):
        # At no speed the target is never reached: the motor stands until another command.
        segments += change_of_velocity(where, velocity, 0.0, limits, flags=flags)
        where = _end(segments, position, velocity)[0]
        return [*segments, Segment(INDEFINITE, (where,), flags)]
    cruise, cruise_cycles = _cruise(velocity, target - where, limits)
    segments += change_of_velocity(where, velocity, cruise, limits, flags=flags)
    where = _end(segments, position, velocity)[0]
    segments += _hold(where, cruise, cruise_cycles, flags)
    where = _end(segments, position, velocity)[0]
    segments += change_of_velocity(where, cruise, 0.0, limits, flags=flags)
    where = _end(segments, position, velocity)[0]
    # The last piece ends on the target to the unit; what is left over is rounding.
    if segments:
        last = segments[-1]
        first, *rest = last.coefficients
        segments[-1] = replace(last, coefficients=(first + (target - where), *rest))
    return segments


def _cruise(v0: float, distance: float, limits: JogLimits) -> tuple[float, float]:
    """Cruise velocity and its duration for a jog over ``distance`` from velocity ``v0``."""

    def ramps(v1: float) -> float:
        first = 0.5 * (v0 + v1) * limits.times(v1 - v0)[0] if v1 != v0 else 0.0
        second = 0.5 * v1 * limits.times(v1)[0] if v1 != 0.0 else 0.0
        return first + second

    top = limits.speed
    if top == 0.0:
        return 0.0, 0.0
    if distance >= ramps(top):
        return top, (distance - ramps(top)) / top
    if distance <= ramps(-top):
        return -top, (ramps(-top) - distance) / top
    low, high = -top, top
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if ramps(middle) < distance else (low, middle)
    return 0.5 * (low + high), 0.0


def stop(
    position: float, velocity: float, limits: JogLimits, *, flags: int = JOGGING
) -> list[Segment]:
    """J/: deceleration by Ixx19-21 from now."""
    return change_of_velocity(position, velocity, 0.0, limits, flags=flags)


def abort(
    position: float,
    velocity: float,
    deceleration_ct_per_ms2: float,
    unit_per_count: float,
    cycle_ms: float,
) -> list[Segment]:
    """Abort or limit deceleration by Ixx15; a rate of 0 never stops (p. 97)."""
    rate = deceleration_ct_per_ms2 * unit_per_count * cycle_ms**2
    if velocity == 0.0:
        return []
    if rate <= 0.0:
        return [Segment(INDEFINITE, (position, velocity), ABORTING)]
    return _s_curve(position, velocity, 0.0, abs(velocity) / rate, 0.0, ABORTING)
