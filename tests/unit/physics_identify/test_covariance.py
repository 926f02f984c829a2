"""Inverse of information matrices that hardly part two parameters; scatter of blocks and runs."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from pmac_comp.physics.identify.covariance import root_of_inverse, uncertainty_of
from pmac_comp.physics.identify.normal_equations import Normal
from pmac_comp.physics.identify.problem import Problem

_ROOT = np.diag([1e6, 1.0, 1e-6])  # parameters of very different size


def _information(apart: float) -> np.ndarray:
    alike = np.array([[1.0, 1.0, 0.2], [1.0 - apart, 1.0, 0.2], [0.0, 0.0, 1.0]])
    return np.asarray(_ROOT @ (alike.T @ alike) @ _ROOT)


def test_root_is_that_of_the_inverse() -> None:
    information = _information(0.1)
    root, unroot = root_of_inverse(information)
    np.testing.assert_allclose(_ROOT @ root @ root.T @ information @ np.linalg.inv(_ROOT),
                               np.eye(3), atol=1e-9)  # fmt: skip
    np.testing.assert_allclose(unroot @ unroot.T, information, rtol=1e-9)
    np.testing.assert_allclose(unroot.T @ root, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("apart", [1e-7, 1e-8, 1e-9, 0.0])
def test_what_hardly_parts_has_a_finite_positive_variance(apart: float) -> None:
    information = _information(apart)
    information[0, 1] *= 1.0 + 1e-13  # as after scaling a matrix from both sides
    root, _ = root_of_inverse(information)
    covariance = root @ root.T
    assert np.all(np.isfinite(covariance))
    assert np.all(np.diag(covariance) > 0.0)
    np.testing.assert_array_equal(covariance, covariance.T)
    assert covariance[0, 0] * information[0, 0] > 1e12  # not determined, and told so


def _problem(kinds: list[str]) -> Problem:
    """Parameters of a prior of standard deviation 10 around 0, steady rows unknown."""
    specs = [SimpleNamespace(name=f"coulomb.p{i}", kind=kind) for i, kind in enumerate(kinds)]
    count = len(kinds)
    return cast(
        Problem,
        SimpleNamespace(specs=specs, weight=np.full(count, 1e-2), centre=np.zeros(count)),
    )


def _normal(scores: np.ndarray, runs: np.ndarray) -> Normal:
    """Blocks of equal information, 1 in all, with their scores."""
    count, p = scores.shape
    hessians = np.broadcast_to(np.eye(p) / count, (count, p, p)).copy()
    none = np.empty(0)
    return Normal(np.eye(p), none, 0.0, scores, hessians, np.zeros((p, p)), runs, none)


def test_what_blocks_of_a_run_get_wrong_alike_widens_the_interval() -> None:
    runs = np.repeat(np.arange(8), 20)
    rng = np.random.default_rng(1)
    white = rng.standard_normal((runs.size, 1)) / np.sqrt(runs.size)
    alike = white + 0.15 * rng.standard_normal(8)[runs][:, None]
    problem, theta = _problem(["free"]), np.zeros(1)
    assert uncertainty_of(problem, theta, _normal(white, runs)).std[0] < 1.6
    wide = uncertainty_of(problem, theta, _normal(alike, runs))
    assert wide.std[0] > 0.15 * 20 * np.sqrt(8) * 0.5
    assert wide.freedom[0] == pytest.approx(7.0, abs=0.5)


def test_stretches_of_one_run_stand_for_runs() -> None:
    runs = np.zeros(160, dtype=np.int64)
    alike = 0.15 * np.repeat(np.random.default_rng(1).standard_normal(8), 20)[:, None]
    wide = uncertainty_of(_problem(["free"]), np.zeros(1), _normal(alike, runs))
    assert wide.std[0] > 0.15 * 20 * np.sqrt(8) * 0.5


def test_scatter_that_came_out_small_is_not_believed() -> None:
    runs = np.repeat(np.arange(8), 20)
    quiet = uncertainty_of(_problem(["free"]), np.zeros(1), _normal(np.zeros((160, 1)), runs))
    assert quiet.std[0] == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize(("off", "most"), [(0.0, 10.0), (30.0, np.hypot(10.0, 30.0))])
def test_a_stated_value_errs_by_its_tolerance_and_its_distance_at_most(
    off: float, most: float
) -> None:
    runs = np.repeat(np.arange(8), 20)
    wild = 30.0 * np.random.default_rng(1).standard_normal(8)[runs][:, None]
    theta = np.array([off, off])
    normal = _normal(np.hstack([wild, wild]), runs)
    found = uncertainty_of(_problem(["known", "free"]), theta, normal)
    assert found.std[0] == pytest.approx(most, rel=1e-6)
    assert found.std[1] > 2.0 * most


def test_what_few_blocks_decide_has_few_degrees_of_freedom() -> None:
    runs = np.repeat(np.arange(8), 20)
    normal = _normal(np.random.default_rng(1).standard_normal((160, 1)) / np.sqrt(160.0), runs)
    shares = np.zeros(160)
    shares[[3, 4, 70]] = 1.0 / 3.0
    few = replace(normal, block_hessians=shares[:, None, None] * np.eye(1))
    problem, theta = _problem(["free"]), np.zeros(1)
    assert uncertainty_of(problem, theta, normal).freedom[0] > 50.0
    assert uncertainty_of(problem, theta, few).freedom[0] == pytest.approx(2.0, abs=0.1)
