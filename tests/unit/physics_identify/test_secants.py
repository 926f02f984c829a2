"""Derivatives that hold over an interval, not at its middle alone."""

from dataclasses import dataclass, field
from typing import cast

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import NonFinite
from pmac_comp.physics.identify.normal_equations import Normal
from pmac_comp.physics.identify.problem import Problem
from pmac_comp.physics.identify.secants import Slopes, over_interval

_WAVE, _RIPPLE = 0.02, 0.01  # length and size of what the misfit does beside its trend


@dataclass(frozen=True)
class Wavy:
    """Two parameters and what is left of two samples each; the first has a ripple on its trend."""

    low: float = -10.0
    unstable_beyond: float = np.inf
    weight: FloatArray = field(default_factory=lambda: np.array([1e-2, 1e-2]))
    slope_substeps: int = 1

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        return np.array([self.low, -10.0]), np.array([10.0, 10.0])

    def many(self, thetas: list[FloatArray], _substeps: int) -> list[list[FloatArray]]:
        if any(abs(theta[0]) > self.unstable_beyond for theta in thetas):
            raise NonFinite("unstable", code="PC-MOD-010")
        return [[self._left(theta)] for theta in thetas]

    def _left(self, theta: FloatArray) -> FloatArray:
        ripple = _RIPPLE * np.sin(2.0 * np.pi * theta[0] / _WAVE)
        return np.array([[-theta[0] - ripple], [-5.0 * theta[1]]])


def equations(slopes: Slopes) -> Normal:
    columns = np.column_stack([record[0][:, 0] for record in slopes])
    none = np.empty(0)
    return Normal(columns.T @ columns, none, 0.0, none, none, none, none.astype(np.int64), none)


def slopes_at_zero() -> Slopes:
    """The ripple multiplies the derivative at the point by more than four."""
    steep = 1.0 + _RIPPLE * 2.0 * np.pi / _WAVE
    return [[np.array([[-steep], [0.0]])], [np.array([[0.0], [-5.0]])]]


def found(problem: Wavy, theta: FloatArray) -> FloatArray:
    slopes = over_interval(cast(Problem, problem), theta, slopes_at_zero(), equations)
    return equations(slopes).hessian


def test_a_ripple_of_the_misfit_is_no_information() -> None:
    assert equations(slopes_at_zero()).hessian[0, 0] > 16.0
    np.testing.assert_allclose(found(Wavy(), np.zeros(2)), np.diag([1.0, 25.0]), rtol=0.05)


def test_at_a_bound_the_interval_is_crossed_from_there_on() -> None:
    np.testing.assert_allclose(found(Wavy(low=0.0), np.zeros(2)), np.diag([1.0, 25.0]), rtol=0.05)


def test_between_near_bounds_the_point_decides() -> None:
    class Narrow(Wavy):
        @property
        def bounds(self) -> tuple[FloatArray, FloatArray]:
            return np.array([-1e-3, -10.0]), np.array([1e-3, 10.0])

    assert found(Narrow(), np.zeros(2))[0, 0] > 16.0


def test_a_loop_unstable_within_the_interval_keeps_the_point() -> None:
    assert found(Wavy(unstable_beyond=0.01), np.zeros(2))[0, 0] > 16.0
