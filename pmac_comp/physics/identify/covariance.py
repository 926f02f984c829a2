"""How sure a refinement is: the covariance of its parameters from blocks of time and from runs.

What lives here: the sandwich over blocks and over runs, with what steady rows alone would say. What
may not: simulation, steps. Imports ``problem`` and ``normal_equations``.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.stats import t as student

from pmac_comp.base.arrays import BoolArray, FloatArray, IntArray
from pmac_comp.physics.identify.normal_equations import Normal
from pmac_comp.physics.identify.problem import Problem

# A block that decides a direction alone says nothing about its own scatter: beyond this share of
# the information its score is not enlarged further.
_MAX_LEVERAGE = 0.7
_LEAST_OF_PRIOR = 1e-2  # counted as information, so that the equations can be solved
# Scatter over information from which on blocks disagree, over the most that so few show by chance.
_DISAGREE = 3.0
_LEAST_STRETCHES = 8  # a campaign of fewer runs is cut into about so many stretches
_NO_PRIOR = 1e-12
_TINY, _KNOWN = 1e-300, 1e3
_FEWEST, _MANY = 2.0, 1e6  # degrees of freedom; with fewer than two there is no variance
_LEVEL = 0.975
_ROUNDING = float(np.finfo(np.float64).eps)
_BASE = ("chain", "coulomb", "viscous")


@dataclass(frozen=True)
class Uncertainty:
    """Covariance of scaled parameters, and how well it is known itself.

    Parameters
    ----------
    covariance : ndarray, shape (p, p)
        Of the scaled parameters, prior included.
    freedom : ndarray, shape (p,)
        Degrees of freedom of each variance, for Student's factor.
    """

    covariance: FloatArray
    freedom: FloatArray

    @property
    def std(self) -> FloatArray:
        """Standard deviations of the scaled parameters, shape (p,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def uncertainty_of(problem: Problem, theta: FloatArray, final: Normal) -> Uncertainty:
    """How sure the scaled parameters ``theta``, shape (p,), are, prior included.

    A parameter that no maker's tolerance holds keeps at least the interval that it has without
    tempering: weights that follow the scatter of blocks promise more than the usual ones, and what
    blocks get wrong alike is no scatter. Every parameter keeps at least what the scatter of whole
    runs gives: what a model, the numerics of a simulation or the rounding of a repeated motion gets
    wrong is the same in all blocks of a run and another in the next run, which moves otherwise.
    Fine encoders let short blocks promise hundredths of a nanometre, which no model keeps.

    No parameter gets less than the information of its whitened residuals leaves: scatter of a fit
    that has nearly as many parameters as clusters comes out too small by chance. No stated value
    gets more than the error of who asks the bench file alone. A variance that few blocks decide is
    itself hardly known, which is Student's factor.

    Source: the larger of the usual and the robust standard error (Angrist and Pischke 2009, 8.1);
    cluster-robust inference with runs as clusters (Cameron and Miller 2015, VI: as many
    degrees of freedom as clusters less one); effective number of blocks (Carter, Schnepel and
    Steigerwald 2017).
    """
    covariance = _sandwich(problem, theta, final)
    usual = final.untempered or final
    least = np.diag(covariance)
    if final.untempered is not None:
        least = np.maximum(least, np.diag(_sandwich(problem, theta, final.untempered)))
    least = np.where(_is_free(problem), least, np.diag(covariance))
    root, unroot = root_of_inverse(usual.hessian + np.diag(problem.weight))
    inverse = root @ root.T
    # Variances that independent residuals of the whitened size would leave.
    least = np.maximum(least, np.sum(root**2, axis=1))
    by_captures = np.diag(inverse @ usual.hessian @ inverse)
    joined = _joined(usual)
    among, scattered = _among_runs(problem, joined, root, unroot)
    clusters = np.full(theta.size, float(joined.runs.size))
    variance, freedom = _widest(
        problem,
        theta,
        (least, _beside_prior(least, _effective_blocks(usual, inverse) - 1.0, by_captures)),
        (among, _beside_prior(among, clusters - 1.0, scattered)),
    )
    wider = np.sqrt(variance / np.diag(covariance))
    return Uncertainty(np.asarray(covariance * np.outer(wider, wider)), freedom)


def _widest(
    problem: Problem, theta: FloatArray, *found: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Of variances and their degrees of freedom those with the widest interval, shape (p,) each.

    For stated values at most the interval that the bench file gives by itself.
    """
    half = np.stack([student.ppf(_LEVEL, freedom) * np.sqrt(size) for size, freedom in found])
    first = np.argmax(half, axis=0)[np.newaxis]
    variance, freedom = (
        np.take_along_axis(np.stack(column), first, axis=0)[0]
        for column in zip(*found, strict=True)
    )
    most = _most_of_known(problem, theta)
    beyond = half.max(axis=0) > student.ppf(_LEVEL, _MANY) * np.sqrt(most)
    return np.where(beyond, most, variance), np.where(beyond, _MANY, freedom)


def _beside_prior(variance: FloatArray, freedom: FloatArray, part: FloatArray) -> FloatArray:
    """Degrees of freedom of variances of which only a part is estimated, shape (p,).

    A prior is known (Satterthwaite 1946).
    """
    known = np.clip(variance / np.maximum(part, _TINY), 1.0, _KNOWN)
    return np.asarray(np.minimum(np.maximum(freedom, _FEWEST) * known**2, _MANY))


def _effective_blocks(final: Normal, inverse: FloatArray) -> FloatArray:
    """By how many blocks each parameter is determined, were they all to count alike, shape (p,).

    Delay and current loop show where an acceleration begins: some tenths of a second of a campaign
    decide, and as many independent residuals, not as all of its blocks, say how well.
    """
    share = np.einsum("ij,bjk,ik->bi", inverse, final.block_hessians, inverse)
    return np.asarray(share.sum(axis=0) ** 2 / np.maximum(np.sum(share**2, axis=0), _TINY))


def _is_free(problem: Problem) -> BoolArray:
    return np.array([spec.kind != "known" for spec in problem.specs], dtype=np.bool_)


def _most_of_known(problem: Problem, theta: FloatArray) -> FloatArray:
    """Mean square distance of the truth from the estimate by the bench file alone, shape (p,).

    That is a tolerance around the stated value, which may be far from the estimate.
    """
    stated = 1.0 / np.maximum(problem.weight, _NO_PRIOR) + (theta - problem.centre) ** 2
    return np.where(_is_free(problem), np.inf, stated)


def _among_runs(
    problem: Problem, joined: Normal, root: FloatArray, unroot: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Variances with runs as clusters, and the part of them that is scatter, shape (p,) each."""
    inverse = root @ root.T
    pulls = _jackknifed(joined, root, unroot) @ inverse
    scattered = np.sum(pulls**2, axis=0)
    known = np.diag(problem.weight) + joined.prior_scores
    return scattered + np.diag(inverse @ known @ inverse), scattered


def _joined(final: Normal) -> Normal:
    """The same equations with runs, or long stretches of few runs, for blocks."""
    stretch = _stretches(final.runs)
    labels = np.unique(stretch)
    return replace(
        final,
        scores=np.stack([final.scores[stretch == n].sum(axis=0) for n in labels]),
        block_hessians=np.stack([final.block_hessians[stretch == n].sum(axis=0) for n in labels]),
        runs=labels,
    )


def _stretches(runs: IntArray) -> IntArray:
    """Numbers of the runs of blocks, shape (b,), where they are few those of parts of runs."""
    names = np.unique(runs)
    parts = -(-_LEAST_STRETCHES // names.size)
    found = np.zeros_like(runs)
    for i, name in enumerate(names):
        where = np.flatnonzero(runs == name)
        found[where] = i * parts + np.arange(where.size) * parts // where.size
    return found


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
