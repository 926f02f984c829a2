"""Joint refits from scalar products agree with ordinary least squares."""

import numpy as np
import pytest

from pmac_comp.base.errors import NotIdentifiable
from pmac_comp.physics.diagnose.gram import Gram, Prior, _factor, gram_of_record
from pmac_comp.physics.diagnose.statistics import Whitener

WHITE = Whitener(np.zeros((1, 2, 2)), np.eye(2))


def free(k: int) -> Prior:
    return Prior(np.full(k, -np.inf), np.full(k, np.inf), np.zeros(k), np.full(k, np.inf))


def make(prior=None, n=400, k=5, seed=0):
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(n, 2, k))
    truth = np.array([1.0, -2.0, 0.0, 0.5, 3.0])[:k]
    residual = columns @ truth + 0.1 * rng.normal(size=(n, 2))
    residual[:, 1] += 7.0
    blocks, rows = gram_of_record(
        residual, columns, np.ones(n, dtype=bool), WHITE, block=50, offset_channels=[1]
    )
    fitting = np.arange(len(rows)) < 6
    return Gram(blocks, fitting, rows, prior or free(k)), columns, residual, truth


def test_solution_is_that_of_least_squares_with_a_free_offset():
    gram, columns, residual, _ = make()
    whole = Gram(gram.blocks, np.ones(len(gram.rows), dtype=bool), gram.rows, gram.prior)
    rows = columns[1:].reshape(-1, 5)
    offset = np.tile([0.0, 1.0], 399)[:, None]
    expected, left, *_ = np.linalg.lstsq(
        np.hstack([rows, offset]), residual[1:].ravel(), rcond=None
    )
    solution = whole.solve(range(5))
    assert solution.step == pytest.approx(expected[:5], abs=1e-8)
    assert solution.chi2 == pytest.approx(left[0], rel=1e-8)


def test_subset_and_blocks_add_up():
    gram, *_ = make()
    solution = gram.solve([0, 1, 4])
    assert gram.block_chi2(solution)[gram.fitting].sum() == pytest.approx(solution.chi2)
    moved = gram.moved(solution)
    assert moved.total[-1, -1] == pytest.approx(solution.chi2)
    again = moved.solve([0, 1, 4])
    assert np.abs(again.step).max() < 1e-9


def test_bounds_hold_and_the_rest_adapts():
    prior = Prior(
        np.array([-0.5, -np.inf, -1, -1, -1.0]),
        np.array([0.5, np.inf, 1, 1, 1.0]),
        np.zeros(5),
        np.full(5, np.inf),
    )
    gram, *_ = make(prior)
    step = gram.solve(range(5)).step
    assert step[0] == pytest.approx(0.5)
    assert step[4] == pytest.approx(1.0)
    assert step[1] < -1.5


def test_a_tight_prior_keeps_a_known_parameter():
    prior = Prior(
        np.full(5, -np.inf),
        np.full(5, np.inf),
        np.array([0.0, 0, 0, 0, 0.25]),
        np.array([np.inf, np.inf, np.inf, np.inf, 1e-6]),
    )
    gram, *_ = make(prior)
    assert gram.solve(range(5)).step[4] == pytest.approx(0.25, abs=1e-5)


def test_covariance_is_the_inverse_of_the_information():
    gram, *_ = make()
    information = gram.total[:5, :5]
    assert np.allclose(gram.solve(range(5)).covariance, np.linalg.inv(information), rtol=1e-6)


def test_unusable_samples_do_not_count():
    rng = np.random.default_rng(3)
    columns, residual = rng.normal(size=(100, 2, 2)), rng.normal(size=(100, 2))
    good = np.ones(100, dtype=bool)
    good[40:60] = False
    spoiled = residual.copy()
    spoiled[40:60] = 1e6
    one, rows = gram_of_record(residual, columns, good, WHITE, block=25, offset_channels=[])
    two, _ = gram_of_record(spoiled, columns, good, WHITE, block=25, offset_channels=[])
    # The sample after the gap leans on its spoiled past and is left out too.
    assert np.allclose(one, two)
    assert rows.sum() == 2 * (100 - 20 - 2)


def test_columns_that_rounding_leaves_dependent_are_solved_and_nonsense_is_refused():
    shaken = np.ones((3, 3)) + np.diag([0.0, -2e-9, -2e-9])
    factor = _factor(shaken)
    assert factor.T @ factor == pytest.approx(shaken, abs=1e-7)
    with pytest.raises(NotIdentifiable) as refused:
        _factor(-np.eye(2))
    assert refused.value.code == "PC-DIA-016"
