"""Learning says why it ended: little was gained, the error grew, or the passes were used up."""

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.compensate.exact import learn, rests_of
from pmac_comp.physics.signals.trajectory import dwell, sinusoid

N, PERIOD_s = 4000, 442e-6
DISTURBANCE_m = 3e-6 * np.sin(2.0 * np.pi * 2.0 * PERIOD_s * np.arange(N))


def answering(gain: float) -> "list[str | bool]":
    """How learning ends on an axis that answers an offset with a gain."""

    def total(offset: FloatArray) -> FloatArray:
        return np.asarray(DISTURBANCE_m + gain * offset)

    found = learn(total, N, PERIOD_s, passes=6, cutoff_Hz=40.0, limit_m=60e-6)
    return [found.converged, found.ended]


def test_little_gained_ends_it() -> None:
    converged, reason = answering(1.0)
    assert converged
    assert "changed the error by less than" in str(reason)


def test_growth_ends_it() -> None:
    converged, reason = answering(-1.0)
    assert not converged
    assert "grew 3 times" in str(reason)


def test_retreats_to_slower_bands_are_no_convergence() -> None:
    """Less of one error lies below a lower cutoff: that was told as 'it converges'."""
    swings_m = 3e-6 * np.sin(2.0 * np.pi * 18.0 * PERIOD_s * np.arange(N))
    found = learn(lambda offset: swings_m - offset, N, PERIOD_s, passes=6, cutoff_Hz=40.0)
    assert "grew 3 times" in found.ended
    assert min(found.history_um) == found.history_um[0]
    assert found.contraction == 1.0
    assert found.cutoff_Hz == pytest.approx(40.0 * 0.6**2)  # the last that was tried
    assert len(found.learnable_um) == len(found.history_um)
    assert min(found.learnable_um) == found.learnable_um[0]  # all in one band


def test_passes_end_it() -> None:
    converged, reason = answering(0.2)
    assert not converged
    assert "the 6 passes allowed" in str(reason)


def test_over_a_rest_the_offset_stays_as_the_motion_before_it_left_it() -> None:
    # There and back with a rest between; at rest the axis creeps anew in every run.
    time = np.arange(N) * PERIOD_s
    there = np.clip((time - 0.3) / 0.4, 0.0, 1.0) - np.clip((time - 1.1) / 0.4, 0.0, 1.0)
    position = 0.05 * there * there * (3.0 - 2.0 * there)
    rests = rests_of(position, PERIOD_s)
    assert [round(r.start * PERIOD_s, 1) for r in rests] == [0.0, 0.7, 1.5]
    rng = np.random.default_rng(1)
    tried: list[FloatArray] = []

    def total(offset: FloatArray) -> FloatArray:
        tried.append(offset)
        creep = np.zeros(N)
        for rest in rests:
            creep[rest] = rng.normal(0.0, 5e-6)
        return np.asarray(DISTURBANCE_m + offset + creep)

    found = learn(total, N, PERIOD_s, passes=6, cutoff_Hz=20.0, rests=rests, confirm=2)
    for offset in tried:
        assert all(np.ptp(offset[rest]) == 0.0 for rest in rests)
    assert found.history_um[0] > 1.8
    assert min(found.history_um) < 0.35 * found.history_um[0]
    assert found.scatter_um == 0.0  # what creeps at rest is no scatter of the motion
    assert found.converged


def test_a_sinusoid_has_no_rests_and_a_dwell_is_one() -> None:
    moving = sinusoid(period_s=PERIOD_s, amplitude_m=0.01, frequency_Hz=1.0, cycles=2.0)
    inner = [r for r in rests_of(moving.position_m, PERIOD_s) if 0 < r.start < moving.n // 2]
    assert inner == []
    assert len(rests_of(dwell(period_s=PERIOD_s, duration_s=0.1).position_m, PERIOD_s)) == 1
