"""Moves of a motion program: from axis positions and modal settings to segments for each motor.

Source: Turbo PMAC Software Reference Manual p. 405-485 (statements).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.memory import read_float48
from pmac_comp.simulator.programs.motion_planner import LinearMove, Planner, Segments, join
from pmac_comp.simulator.servo import trajectory as traj

if TYPE_CHECKING:
    from pmac_comp.simulator.programs.coordinate_system import CoordinateSystem

_LONGEST_MOVE_ms = 8388608.0


def move_segments(
    system: CoordinateSystem,
    planner: Planner,
    targets: dict[str, float],
    rates: dict[str, float],
    tag: int,
) -> Segments:
    """Segments of the move to ``targets`` (axis units) in the mode that is in force.

    ``rates`` are the end velocities that a PVT move states, in axis units per ms.
    """
    mode = system.modal.mode
    if mode == "pvt":
        return _pvt(system, planner, targets, rates, tag)
    if mode == "spline":
        cycles = system.cycles(_spline_time_ms(system))
        return planner.spline(system.motor_targets(targets), cycles, tag)
    if mode == "rapid":
        return _rapid(system, planner, targets, tag)
    deltas = {a: targets[a] - system.targets.get(a, 0.0) for a in targets}
    time_ms, ramp_ms = _limited(system, deltas, _move_time_ms(system, deltas), _ramp_ms(system))
    return _linear(system, planner, targets, deltas, (time_ms, ramp_ms), tag)


def delay_segments(
    system: CoordinateSystem, planner: Planner, time_ms: float, tag: int
) -> Segments:
    """DELAY: a move of no distance, blended as any other."""
    ramp_ms = _ramp_ms(system)
    targets = dict(system.targets)
    nowhere = dict.fromkeys(targets, 0.0)
    return _linear(system, planner, targets, nowhere, (max(time_ms, ramp_ms), ramp_ms), tag)


def _ramp_ms(system: CoordinateSystem) -> float:
    modal = system.modal
    return max(modal.ta_ms, 2.0 * modal.ts_ms, system.card.servo.cycle_ms)


def _linear(
    system: CoordinateSystem,
    planner: Planner,
    targets: dict[str, float],
    deltas: dict[str, float],
    move_and_ramp_ms: tuple[float, float],
    tag: int,
) -> Segments:
    time_ms, ramp_ms = move_and_ramp_ms
    move = LinearMove(
        end=system.motor_targets(targets),
        velocity=system.motor_rates({a: d / time_ms for a, d in deltas.items()}),
        cycles=system.cycles(time_ms),
        ramp_cycles=system.cycles(ramp_ms),
        s_cycles=system.cycles(system.modal.ts_ms),
        tag=tag,
    )
    segments = planner.linear(move)
    if system.isx(92):
        join(segments, planner.finish())
    return segments


def _move_time_ms(system: CoordinateSystem, deltas: dict[str, float]) -> float:
    modal = system.modal
    if modal.tm_ms is not None:
        time_ms = modal.tm_ms
    else:
        feed = modal.feed or system.isx(89)
        distance = math.sqrt(sum(deltas.get(a, 0.0) ** 2 for a in modal.feed_axes))
        if distance == 0.0:
            distance = max((abs(d) for d in deltas.values()), default=0.0)
        time_ms = distance / feed * system.isx(90) if feed > 0.0 else 0.0
    return min(max(time_ms, 0.5), _LONGEST_MOVE_ms)


def _limited(
    system: CoordinateSystem, deltas: dict[str, float], time_ms: float, ramp_ms: float
) -> tuple[float, float]:
    """Move and ramp time under Ixx16 and Ixx17; a move is never shorter than its ramp."""
    memory = system.card.memory
    for motor, definition in system.axes.items():
        counts = abs(sum(s * deltas.get(a, 0.0) for a, s in definition.terms))
        if counts == 0.0:
            continue
        base = r.motor_base(motor)
        speed = read_float48(memory.x, memory.y, base + r.M_IXX16)
        acceleration = read_float48(memory.x, memory.y, base + r.M_IXX17)
        if speed > 0.0:
            time_ms = max(time_ms, counts / speed)
        if acceleration > 0.0:
            shortest = math.sqrt(counts / acceleration)
            longest_ramp = max(time_ms, ramp_ms)
            ramp_ms = max(ramp_ms, min(counts / longest_ramp / acceleration, shortest))
    return max(time_ms, ramp_ms), ramp_ms


def _pvt(
    system: CoordinateSystem,
    planner: Planner,
    targets: dict[str, float],
    rates: dict[str, float],
    tag: int,
) -> Segments:
    segments = planner.pvt(
        system.motor_targets(targets),
        system.motor_rates(rates),
        system.motor_rates(system.velocities),
        system.cycles(_spline_time_ms(system)),
        tag,
    )
    system.velocities = rates
    return segments


def _spline_time_ms(system: CoordinateSystem) -> float:
    if system.card.variables.int_i(42):
        time_ms = system.modal.ta_ms
    else:
        # Quarter microseconds are what the register resolves (p. 463).
        time_ms = round((system.modal.tm_ms or 0.0) * 4096.0) / 4096.0
    if time_ms <= 0.0:
        raise CardError(3, "segment time is zero")
    return time_ms


def _rapid(
    system: CoordinateSystem, planner: Planner, targets: dict[str, float], tag: int
) -> Segments:
    """Jog-style moves, not blended; only the slowest motor uses its full speed (p. 465)."""
    out = planner.finish()
    ends = system.motor_targets(targets)
    plans: dict[int, list[traj.Segment]] = {}
    for motor, end in ends.items():
        limits = system.card.rapid_limits(motor)
        plans[motor] = traj.jog_to(planner.position[motor], 0.0, limits, end, flags=traj.TIMED)
    longest = max((_total(p) for p in plans.values()), default=0.0)
    if not math.isfinite(longest):  # a speed of zero: all stand until the program is aborted
        plans = {m: [traj.Segment(longest, (planner.position[m],), traj.TIMED)] for m in ends}
    for motor, plan in plans.items():
        stretched = _stretched(plan, longest)
        if not stretched:
            stretched = [traj.Segment(max(longest, 1.0), (ends[motor],), traj.TIMED)]
        first = stretched[0]
        stretched[0] = traj.Segment(first.duration_cycles, first.coefficients, first.flags, tag)
        out.setdefault(motor, []).extend(stretched)
        planner.position[motor] = ends[motor]
    return out


def _total(plan: list[traj.Segment]) -> float:
    return sum(s.duration_cycles for s in plan)


def _stretched(plan: list[traj.Segment], cycles: float) -> list[traj.Segment]:
    """Plan with all times scaled so that it lasts `cycles`."""
    total = _total(plan)
    if total <= 0.0 or cycles <= total:
        return list(plan)
    k = cycles / total
    return [
        traj.Segment(
            s.duration_cycles * k,
            tuple(c / k**i for i, c in enumerate(s.coefficients)),
            s.flags,
            s.tag,
        )
        for s in plan
    ]
