"""How sure a refinement is: the covariance of its parameters from blocks of time.

What lives here: the sandwich over blocks with what steady rows alone would say. What may not:
simulation, steps. Imports ``problem`` and ``normal_equations``.
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import solve_triangular

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.identify.normal_equations import Normal
from pmac_comp.physics.identify.problem import Problem

# A block that decides a direction alone says nothing about its own scatter: beyond this share of
# the information its score is not enlarged further.
_MAX_LEVERAGE = 0.7
_LEAST_OF_PRIOR = 1e-2  # counted as information, so that the equations can be solved
# Scatter over information from which on blocks disagree, over the most that so few show by chance.
_DISAGREE = 3.0
_FEW_RUNS = 4
_NO_PRIOR = 1e-12
_ROUNDING = float(np.finfo(np.float64).eps)
_BASE = ("chain", "coulomb", "viscous")


def covariance_of(problem: Problem, theta: FloatArray, final: Normal) -> FloatArray:
    """Covariance of the scaled parameters, prior included, shape (p, p).

    A parameter that no maker's tolerance holds keeps at least the interval that it has without
    tempering: weights that follow the scatter of blocks promise more than the usual ones, and what
    blocks get wrong alike is no scatter. With friction in detail every parameter keeps at least
    what whole runs give, up to its tolerance: a run that repeats its motion meets the same
    fractions of a count at each reversal, so that its blocks err alike.
    """
    covariance = _sandwich(problem, theta, final)
    least = np.diag(covariance)
    if final.untempered is not None:
        least = np.maximum(least, np.diag(_sandwich(problem, theta, final.untempered)))
    free = np.array([spec.kind != "known" for spec in problem.specs])
    least = np.where(free, least, np.diag(covariance))
    if final.steady is not None:
        tolerance = np.where(free, np.inf, 1.0 / np.maximum(problem.weight, _NO_PRIOR))
        between = np.minimum(_between_runs(problem, final), tolerance)
        least = np.maximum(least, between)
    wider = np.sqrt(least / np.diag(covariance))
    return np.asarray(covariance * np.outer(wider, wider))


def _between_runs(problem: Problem, final: Normal) -> FloatArray:
    """Variances of the parameters from the scatter of whole runs, shape (p,); few runs: none."""
    runs = np.unique(final.runs)
    if runs.size < _FEW_RUNS:
        return np.zeros(problem.weight.size)
    root, _ = root_of_inverse(final.hessian + np.diag(problem.weight))
    pulls = np.stack([root @ root.T @ final.scores[final.runs == run].sum(axis=0) for run in runs])
    pulls = pulls - pulls.mean(axis=0)
    return np.asarray(runs.size / (runs.size - 1) * np.sum(pulls**2, axis=0))


def _sandwich(problem: Problem, theta: FloatArray, final: Normal) -> FloatArray:
    prior = np.diag(problem.weight)
    root, unroot = root_of_inverse(final.hessian + prior)
    inverse = root @ root.T
    scores = _jackknifed(final, root, unroot)
    meat = scores.T @ scores + final.prior_scores
    covariance = inverse @ (meat + prior) @ inverse
    if final.steady is not None:
        shift = _shift_on_steady_rows(problem, theta, *final.steady)
        covariance = covariance + np.outer(shift, shift)
    return np.asarray(covariance)


def tempered(problem: Problem, final: Normal) -> Normal:
    """The same equations, weaker in directions in which blocks of time disagree.

    What a model or rounding gets wrong at low frequency counts in whitened residuals as if it were
    known to their noise: against the prior it would win by what it claims, not by what it knows.
    In the directions in which the scores of blocks scatter more than the Hessian says (and more
    than so few blocks can by chance), Hessian and scores are scaled to that scatter.

    Source: curvature adjustment of composite likelihoods (Ribatet, Cooley and Davison 2012).
    """
    p = final.gradient.size
    prior = np.diag(problem.weight)
    scores = _jackknifed(final, *root_of_inverse(final.hessian + prior))
    least = _LEAST_OF_PRIOR * prior + 1e-9 * np.diag(np.diag(final.hessian))
    root = np.linalg.cholesky(final.hessian + least)
    seen = solve_triangular(root, scores.T, lower=True)
    scatter, turn = np.linalg.eigh(seen @ seen.T)
    by_chance = (1.0 + np.sqrt(p / max(scores.shape[0], 1))) ** 2
    share = 1.0 / np.maximum(scatter / (_DISAGREE * by_chance), 1.0)
    left = root @ turn
    right = turn.T @ solve_triangular(root, np.eye(p), lower=True)
    whole, half = (left * share) @ right, (left * np.sqrt(share)) @ right
    steady = final.steady
    if steady is not None:
        steady = (half @ steady[0] @ half.T, whole @ steady[1])
    return replace(
        final,
        hessian=half @ final.hessian @ half.T,
        gradient=whole @ final.gradient,
        scores=scores @ whole.T,
        block_hessians=np.zeros_like(final.block_hessians),  # the scores are enlarged already
        prior_scores=whole @ final.prior_scores @ whole.T,
        steady=steady,
        untempered=final,
    )


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


def root_of_inverse(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """R with R R' the inverse of a symmetric matrix, and R^-T; shape (p, p) each.

    An inverse by elimination of two parameters that hardly part is not positive definite in the
    last digits. Here it is by construction: directions below the matrix's own rounding count as
    that.
    """
    size = np.sqrt(np.diag(information))
    scaled = information / np.outer(size, size)
    known, turn = np.linalg.eigh(0.5 * (scaled + scaled.T))
    width = np.sqrt(np.maximum(known, _ROUNDING * known.size * known[-1]))
    return turn / np.outer(size, width), np.outer(size, width) * turn


def _jackknifed(final: Normal, root: FloatArray, unroot: FloatArray) -> FloatArray:
    """Block scores enlarged by what each block pulls the estimate to itself, shape (b, p).

    Source: cluster-robust covariance CR3 (Bell and McCaffrey 2002), the jackknife over blocks.
    """
    enlarged = []
    for hessian, score in zip(final.block_hessians, final.scores, strict=True):
        share, turn = np.linalg.eigh(root.T @ hessian @ root)
        factor = 1.0 / (1.0 - np.clip(share, 0.0, _MAX_LEVERAGE))
        enlarged.append(unroot @ (turn * factor) @ (turn.T @ (root.T @ score)))
    return np.stack(enlarged)
