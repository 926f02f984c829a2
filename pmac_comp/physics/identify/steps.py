"""Steps of a refinement: Gauss-Newton within the bounds, damped where the misfit allows it.

What lives here: one step from one place. What may not: rounds, weights, verdicts. Imports
``problem``, ``covariance`` (roots) and ``normal_equations``.
"""

import numpy as np
from scipy.optimize import lsq_linear

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.identify.covariance import root_of_inverse
from pmac_comp.physics.identify.normal_equations import Normal, cost_at, prior_cost
from pmac_comp.physics.identify.problem import Problem
from pmac_comp.physics.identify.whitening import Whitener

_DAMPING_TRIES = 6


def damped_step(
    problem: Problem, theta: FloatArray, at: Normal, filters: list[list[Whitener]]
) -> tuple[FloatArray, float, float]:
    """Next point, shape (p,), the step in standard deviations, and its share of the misfit."""
    prior = np.diag(problem.weight)
    gradient = at.gradient - problem.weight * (theta - problem.centre)
    here = at.cost + prior_cost(problem, theta)
    matrix = at.hessian + prior
    damping = 0.0
    for _ in range(_DAMPING_TRIES):
        damped = matrix + damping * np.diag(np.diag(matrix))
        new = problem.bounded(theta + _bounded_step(problem, theta, damped, gradient))
        cost = cost_at(problem, new, filters)
        if cost <= here * (1.0 + 1e-9):
            move = new - theta
            step = float(np.sqrt(max(float(move @ matrix @ move), 0.0) / theta.size))
            return new, step, 1.0 - cost / here
        damping = 10.0 * damping if damping > 0.0 else 1e-2
    return theta, 0.0, 0.0


def plain_step(problem: Problem, theta: FloatArray, at: Normal) -> tuple[FloatArray, float]:
    """Next point, shape (p,), and the undamped step to it in standard deviations.

    The misfit to rounded simulations is too rough for a line search.
    """
    matrix = at.hessian + np.diag(problem.weight)
    gradient = at.gradient - problem.weight * (theta - problem.centre)
    new = problem.bounded(theta + _bounded_step(problem, theta, matrix, gradient))
    move = new - theta
    return new, float(np.sqrt(max(float(move @ matrix @ move), 0.0) / theta.size))


def _bounded_step(
    problem: Problem, theta: FloatArray, matrix: FloatArray, gradient: FloatArray
) -> FloatArray:
    """Gauss-Newton step within the bounds: clipping a free step would break tied sums."""
    low, high = problem.bounds
    root, unroot = root_of_inverse(matrix)
    target = root.T @ gradient
    margin = 1e-12
    found = lsq_linear(
        unroot.T, target, bounds=(low - theta - margin, high - theta + margin), method="bvls"
    )
    return np.asarray(found.x)
