"""Inverse of information matrices that hardly part two parameters."""

import numpy as np
import pytest

from pmac_comp.physics.identify.covariance import root_of_inverse

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
