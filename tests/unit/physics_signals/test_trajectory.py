"""Trajectories: rest at both ends, limits kept, the shape that was asked for."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmac_comp.base.errors import ModelError
from pmac_comp.physics.signals import trajectory as tr

TS = 441.996e-6

MOTIONS = {
    "sinusoid": tr.sinusoid(period_s=TS, amplitude_m=0.01, frequency_Hz=3.0, centre_m=0.05),
    "multisine": tr.multisine(period_s=TS, amplitude_m=0.01, frequencies_Hz=[1.0, 2.3, 4.1]),
    "trapezoid": tr.trapezoid(
        period_s=TS, distance_m=0.1, speed_m_per_s=0.3, acceleration_m_per_s2=3.0
    ),
    "s-curve": tr.trapezoid(
        period_s=TS, distance_m=-0.1, speed_m_per_s=0.3, acceleration_m_per_s2=3.0, s_curve_s=0.05
    ),
    "triangle": tr.triangle(period_s=TS, amplitude_m=0.01, speed_m_per_s=0.02),
    "staircase": tr.staircase(
        period_s=TS, positions_m=[0.0, 0.02, 0.05], speed_m_per_s=0.2, acceleration_m_per_s2=2.0
    ),
    "dwell": tr.dwell(period_s=TS, position_m=0.1, duration_s=0.5),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_motions_start_and_end_at_rest(name):
    motion = MOTIONS[name]
    edge = np.concatenate([np.diff(motion.position_m[:3]), np.diff(motion.position_m[-3:])])
    # One sample of the hardest acceleration moves less than this.
    assert np.max(np.abs(edge)) < 1e-6
    assert motion.sample_period_s == pytest.approx(TS, rel=1e-12)


def test_trapezoid_keeps_speed_and_acceleration_and_comes_back():
    motion = MOTIONS["trapezoid"]
    assert np.max(motion.position_m) == pytest.approx(0.1, abs=1e-12)
    assert motion.position_m[-1] == pytest.approx(0.0, abs=1e-12)
    assert np.max(np.abs(motion.velocity_m_per_s)) == pytest.approx(0.3, rel=1e-6)
    assert np.max(np.abs(motion.acceleration_m_per_s2)) == pytest.approx(3.0, rel=1e-6)


def test_s_curve_limits_the_jerk():
    motion = MOTIONS["s-curve"]
    assert np.min(motion.position_m) == pytest.approx(-0.1, abs=1e-12)
    jerk = np.diff(motion.acceleration_m_per_s2[1:-1]) / TS
    assert np.max(np.abs(jerk)) == pytest.approx(3.0 / 0.05, rel=1e-3)
    assert np.max(np.abs(motion.acceleration_m_per_s2)) == pytest.approx(3.0, rel=1e-3)


@settings(max_examples=60, deadline=None)
@given(
    distance=st.floats(1e-5, 0.5),
    speed=st.floats(1e-3, 1.0),
    acceleration=st.floats(0.1, 20.0),
    rise=st.floats(0.0, 0.1),
    sign=st.sampled_from([1.0, -1.0]),
)
def test_any_move_arrives_within_its_limits(distance, speed, acceleration, rise, sign):
    motion = tr.path(
        [sign * distance], period_s=1e-2, speed_m_per_s=speed, acceleration_m_per_s2=acceleration,
        s_curve_s=rise, dwell_s=0.05,
    )  # fmt: skip
    assert motion.position_m[-1] == pytest.approx(sign * distance, rel=1e-9)
    steps = sign * np.diff(motion.position_m)
    assert np.min(steps) > -1e-12
    assert np.max(steps) <= speed * 1e-2 * (1 + 1e-9)
    assert np.max(np.abs(motion.acceleration_m_per_s2)) <= acceleration * (1 + 1e-6)


def test_sinusoid_has_its_amplitude_and_frequency_in_the_middle():
    motion = tr.sinusoid(period_s=TS, amplitude_m=0.01, frequency_Hz=5.0, cycles=10.0)
    middle = slice(int(0.5 / TS), int(2.0 / TS))
    t = motion.time_s[middle] - 0.1
    wave = np.exp(-2j * np.pi * 5.0 * t)
    amplitude = 2.0 * abs(np.mean(motion.position_m[middle] * wave))
    assert amplitude == pytest.approx(0.01, rel=1e-2)


def test_multisine_repeats_with_its_seed_and_reaches_its_peak():
    first = tr.multisine(period_s=TS, amplitude_m=0.01, frequencies_Hz=[1.0, 2.3], seed=3)
    again = tr.multisine(period_s=TS, amplitude_m=0.01, frequencies_Hz=[1.0, 2.3], seed=3)
    other = tr.multisine(period_s=TS, amplitude_m=0.01, frequencies_Hz=[1.0, 2.3], seed=4)
    assert np.array_equal(first.position_m, again.position_m)
    assert not np.array_equal(first.position_m, other.position_m)
    assert np.max(np.abs(first.position_m)) == pytest.approx(0.01)


def test_trajectories_join_without_a_step():
    joined = MOTIONS["trapezoid"].moved(0.2).then(MOTIONS["staircase"])
    assert joined.position_m[0] == pytest.approx(0.2)
    assert np.max(np.abs(np.diff(joined.position_m))) <= 0.3 * TS * (1 + 1e-6)


@pytest.mark.parametrize(
    "time",
    [np.array([0.0, 1.0, 1.0]), np.array([0.0, 2.0, 1.0]), np.array([0.0, 1.0, 5.0]), np.zeros(3)],
)
def test_time_that_is_not_a_grid_is_refused(time):
    with pytest.raises(ModelError):
        tr.Trajectory(time, np.zeros(3))


def test_negative_counts_are_refused():
    with pytest.raises(ModelError):
        tr.trapezoid(
            period_s=TS, distance_m=0.1, speed_m_per_s=0.3, acceleration_m_per_s2=3.0, repeats=0
        )
