"""Jog profiles and the segment queue."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmac_comp.simulator.servo import trajectory as traj

UNIT = 3072.0
LIMITS = traj.JogLimits(
    acceleration_ct_per_ms2=2.0,
    time_ms=0.0,
    s_curve_ms=25.0,
    speed_ct_per_ms=100.0,
    calculation_ms=10.0,
    unit_per_count=UNIT,
    cycle_ms=0.442,
)


def played(segments, *, step=1.0, start=0.0, limit=200_000):
    queue = traj.MotionQueue()
    queue.place(1, start)
    queue.replace(1, segments)
    positions = [start]
    while queue.pending(1) and len(positions) < limit:
        traj.advance(queue.segments, queue.cursor, queue.index, 1, step)
        positions.append(queue.state(1)[0])
    return np.array(positions)


def check_limits(positions, *, slack=1.001):
    velocity = np.diff(positions) / UNIT / 0.442
    assert np.max(np.abs(velocity)) <= 100.0 * slack
    # The average over the S-curve is limited; a pure S peaks at twice the average (p. 100).
    acceleration = np.diff(velocity) / 0.442
    assert np.max(np.abs(acceleration)) <= 2.0 * 2.0 * slack


def test_long_jog_has_the_times_of_its_variables():
    segments = traj.jog_to(0.0, 0.0, LIMITS, 50_000 * UNIT)
    total_ms = sum(s.duration_cycles for s in segments) * 0.442
    # Ixx92, then distance over speed plus one acceleration time: 100/2 = 50 ms = 2 Ixx21.
    assert total_ms == pytest.approx(10.0 + 500.0 + 50.0, abs=1.0)
    positions = played(segments)
    assert positions[-1] == 50_000 * UNIT
    check_limits(positions)


def test_acceleration_stretches_the_times_alike():
    slow = traj.JogLimits(0.5, 0.0, 25.0, 100.0, 10.0, UNIT, 0.442)
    total, part = slow.times(slow.speed)
    assert total * 0.442 == pytest.approx(200.0)
    assert part == pytest.approx(total / 2)


def test_continuous_jog_reaches_its_speed_and_stops_smoothly():
    up = traj.jog_continuous(0.0, 0.0, LIMITS, -1)
    assert math.isinf(up[-1].duration_cycles)
    velocity = up[-1].coefficients[1]
    assert velocity / UNIT / 0.442 == pytest.approx(-100.0)
    down = traj.stop(up[-1].coefficients[0], velocity, LIMITS)
    assert down[-1].end()[1] == pytest.approx(0.0, abs=1e-9)
    assert sum(s.duration_cycles for s in down) * 0.442 == pytest.approx(50.0)


def test_abort_uses_ixx15_and_zero_never_stops():
    segments = traj.abort(0.0, 100.0 * UNIT * 0.442, 5.0, UNIT, 0.442)
    assert sum(s.duration_cycles for s in segments) * 0.442 == pytest.approx(20.0)
    assert segments[0].flags == traj.ABORTING
    assert math.isinf(traj.abort(0.0, 1.0, 0.0, UNIT, 0.442)[0].duration_cycles)


@given(
    st.floats(-2e5, 2e5),
    st.floats(-100.0, 100.0),
    st.floats(0.05, 5.0),
    st.floats(0.0, 60.0),
)
def test_any_jog_from_any_velocity_ends_at_rest_on_its_target(target, speed, rate, s_curve):
    limits = traj.JogLimits(rate, 0.0, s_curve, 100.0, 10.0, UNIT, 0.442)
    goal = float(round(target * UNIT))
    segments = traj.jog_to(0.0, speed * UNIT * 0.442, limits, goal)
    end, velocity = segments[-1].end()
    assert end == pytest.approx(goal, abs=1e-3)
    assert velocity == pytest.approx(0.0, abs=1e-5)
    for first, second in itertools.pairwise(segments):
        position, rate_of_change = first.end()
        # The last piece may take up rounding of the whole plan.
        assert second.coefficients[0] == pytest.approx(position, abs=2e-2 + 1e-9 * abs(goal))
        slope = second.coefficients[1] if len(second.coefficients) > 1 else 0.0
        assert slope == pytest.approx(rate_of_change, abs=1e-4)


def test_time_base_scales_moves_and_not_dwells():
    move = traj.Segment(100.0, (0.0, 10.0))
    dwell = traj.Segment(50.0, (1000.0,), traj.REAL_TIME | traj.DWELL)
    assert len(played([move])) == 101
    assert len(played([move], step=0.5)) == 201
    assert len(played([move, dwell], step=0.5)) in {250, 251}
    queue = traj.MotionQueue()
    queue.push(1, [move])
    for _ in range(10):
        flags = traj.advance(queue.segments, queue.cursor, queue.index, 1, 0.0)
    assert queue.state(1)[0] == 0.0
    assert flags & traj.TIMED


def test_motors_change_segment_in_the_same_cycle():
    queue = traj.MotionQueue()
    for motor in (1, 2):
        queue.push(motor, [traj.Segment(7.3, (0.0, motor)), traj.Segment(9.1, (7.3 * motor, 0.5))])
    counts = []
    for _ in range(40):
        for motor in (1, 2):
            traj.advance(queue.segments, queue.cursor, queue.index, motor, 0.37)
        counts.append((queue.pending(1), queue.pending(2)))
    assert all(a == b for a, b in counts)
    assert {a for a, _ in counts} == {2, 1}


def test_tags_and_low_water_are_reported_once():
    queue = traj.MotionQueue()
    queue.watch(1, 1)
    queue.push(1, [traj.Segment(3.0, (0.0, 1.0), tag=7), traj.Segment(3.0, (3.0, 1.0), tag=8)])
    events = []
    for _ in range(8):
        flags = traj.advance(queue.segments, queue.cursor, queue.index, 1, 1.0)
        events.append((flags >> 16, queue.executing_tag(1)))
    assert [e for e in events if e[0]] == [(1, 7), (1, 8), (2, 0)]


def test_shift_moves_everything_and_full_queue_refuses():
    queue = traj.MotionQueue()
    queue.push(1, [traj.Segment(5.0, (10.0, 1.0))])
    queue.shift(1, -10.0)
    assert queue.last_position(1) == (5.0, 1.0)
    with pytest.raises(OverflowError):
        queue.push(1, [traj.Segment(1.0, (0.0,))] * traj.DEPTH)
