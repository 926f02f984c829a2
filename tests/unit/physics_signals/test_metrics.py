"""Figures of merit against hand-made numbers."""

import numpy as np
import pytest

from pmac_comp.base.errors import ModelError
from pmac_comp.physics.signals import metrics


def test_rms_with_and_without_the_mean():
    values_m = np.array([3e-6, 4e-6, 5e-6])
    assert metrics.rms_um(values_m) == pytest.approx(np.sqrt(50.0 / 3.0))
    assert metrics.centred_rms_um(values_m) == pytest.approx(np.sqrt(2.0 / 3.0))


def test_positioning_after_iso_230_2_by_hand():
    # Two targets, two runs: spreads of sqrt(2)/2 times the difference of the two runs.
    up = np.array([[1.0, 4.0], [3.0, 4.0]])
    down = np.array([[-1.0, 2.0], [-1.0, 4.0]])
    found = metrics.positioning(up, down)
    np.testing.assert_allclose(found.reversal_m, [3.0, 1.0])
    assert found.reversal_value_m == 3.0
    assert found.mean_reversal_m == 2.0
    deviation = np.sqrt(2.0)
    # Target 1: up 2 +- 2 s, down -1; target 2: up 4, down 3 +- 2 s.
    assert found.repeatability_m == pytest.approx(max(4 * deviation, 2 * deviation + 3.0))
    assert found.systematic_m == pytest.approx(5.0)
    assert found.mean_bidirectional_m == pytest.approx(3.0)
    assert found.accuracy_m == pytest.approx(3.0 + 2 * deviation - min(-1.0, 2 - 2 * deviation))


@pytest.mark.parametrize("shape", [(1, 3), (3,), (2, 0)])
def test_positioning_needs_repeated_runs(shape):
    with pytest.raises(ModelError):
        metrics.positioning(np.zeros(shape), np.zeros(shape))


def test_positioning_refuses_unequal_and_non_finite_runs():
    with pytest.raises(ModelError):
        metrics.positioning(np.zeros((2, 2)), np.zeros((2, 3)))
    with pytest.raises(ModelError):
        metrics.positioning(np.array([[np.nan], [0.0]]), np.zeros((2, 1)))
