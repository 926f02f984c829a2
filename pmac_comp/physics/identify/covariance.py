"""How sure a refinement is: the covariance of its parameters from blocks of time.

What lives here: the sandwich over blocks with what steady rows alone would say. What may not:
simulation, steps. Imports ``problem`` and ``normal_equations``.
"""

import numpy as np
from scipy.linalg import solve_triangular

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.identify.normal_equations import Normal
from pmac_comp.physics.identify.problem import Problem

# A block that decides a direction alone says nothing about its own scatter: beyond this share of
# the information its score is not enlarged further.
_MAX_LEVERAGE = 0.7
_BASE = ("chain", "coulomb", "viscous")


def covariance_of(problem: Problem, theta: FloatArray, final: Normal) -> FloatArray:
    """Sandwich covariance of the scaled parameters, prior included, shape (p, p)."""
    prior = np.diag(problem.weight)
    inverse = np.asarray(np.linalg.inv(final.hessian + prior), dtype=np.float64)
    scores = _jackknifed(final, inverse)
    meat = scores.T @ scores + final.prior_scores
    covariance = inverse @ (meat + prior) @ inverse
    if final.steady is not None:
        shift = _shift_on_steady_rows(problem, theta, *final.steady)
        covariance = covariance + np.outer(shift, shift)
    return np.asarray(covariance)


def _shift_on_steady_rows(
    problem: Problem, theta: FloatArray, hessian: FloatArray, gradient: FloatArray
) -> FloatArray:
    """Where the base parameters would go on the steady rows alone, less where they are, shape (p,).

    A model that is wrong about the moments after a reversal is pulled by them, and blocks of time
    that all pull the same way do not show it as scatter (a specification test of Hausman's kind).
    """
    base = np.array([spec.name.partition(".")[0] in _BASE for spec in problem.specs])
    gradient = gradient - problem.weight * (theta - problem.centre)
    matrix = hessian + np.diag(problem.weight)
    shift = np.zeros(theta.size)
    shift[base] = np.linalg.solve(matrix[np.ix_(base, base)], gradient[base])
    return shift


def _jackknifed(final: Normal, inverse: FloatArray) -> FloatArray:
    """Block scores enlarged by what each block pulls the estimate to itself, shape (b, p).

    Source: cluster-robust covariance CR3 (Bell and McCaffrey 2002), the jackknife over blocks.
    """
    root = np.linalg.cholesky(inverse)
    enlarged = []
    for hessian, score in zip(final.block_hessians, final.scores, strict=True):
        share, turn = np.linalg.eigh(root.T @ hessian @ root)
        factor = 1.0 / (1.0 - np.clip(share, 0.0, _MAX_LEVERAGE))
        weights = solve_triangular(root, turn * factor, lower=True, trans="T")
        enlarged.append(weights @ (turn.T @ (root.T @ score)))
    return np.stack(enlarged)
