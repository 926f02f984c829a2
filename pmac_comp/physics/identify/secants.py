"""Derivatives over the interval of a fit instead of at its point.

What lives here: sigma points along the principal directions of what a fit leaves open, and the
secants between them. What may not: steps, covariances of scatter. Imports ``problem``,
``covariance`` (roots) and ``normal_equations``.

Where friction sticks, and on which side of a count a run rests, changes with friction itself: the
derivative at a point can be many times what the misfit does over the whole interval, and an
interval from it many times too narrow.

Source: statistical linearisation over sigma points (Gelb 1974, 6.2; Julier and Uhlmann 1997).
"""

from collections.abc import Callable

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import NonFinite
from pmac_comp.physics.identify.covariance import root_of_inverse
from pmac_comp.physics.identify.normal_equations import Normal
from pmac_comp.physics.identify.problem import Problem

Slopes = list[list[FloatArray]]

_ROUNDS = 3  # an interval that grows is crossed anew
_GREW = 1.3
_LEAST_SPAN = 0.2  # of two standard deviations that bounds leave of a direction


def over_interval(
    problem: Problem,
    theta: FloatArray,
    slopes: Slopes,
    equations: Callable[[Slopes], Normal],
) -> Slopes:
    """Derivatives whose information agrees with what residuals do over the interval it leaves.

    Parameters
    ----------
    problem : Problem
        What is fitted.
    theta : ndarray, shape (p,)
        Scaled parameters at the estimate.
    slopes : list of list of ndarray
        Derivatives there, per parameter and record, shape (m, c) each.
    equations : callable
        Normal equations of derivatives.

    Returns
    -------
    list of list of ndarray
        As ``slopes``; those themselves where the loop is unstable within the interval.
    """
    root, unroot = _roots(problem, equations(slopes))
    for _ in range(_ROUNDS):
        try:
            crossed = _crossed(problem, theta, slopes, root)
        except NonFinite:
            return slopes
        slopes = _combined(crossed, unroot.T)
        before = _widths(root)
        root, unroot = _roots(problem, equations(slopes))
        if np.all(_widths(root) <= _GREW * before):
            break
    return slopes


def _roots(problem: Problem, normal: Normal) -> tuple[FloatArray, FloatArray]:
    return root_of_inverse(normal.hessian + np.diag(problem.weight))


def _widths(root: FloatArray) -> FloatArray:
    """Standard deviations by information, scaled parameters, shape (p,)."""
    return np.asarray(np.linalg.norm(root, axis=1))


def _crossed(problem: Problem, theta: FloatArray, slopes: Slopes, root: FloatArray) -> Slopes:
    """Change of what is simulated per standard deviation along each column of ``root``."""
    spans = [_span(problem, theta, direction) for direction in root.T]
    ends = [theta + t * direction for direction, span in zip(root.T, spans, strict=True)
            for t in span]  # fmt: skip
    left = problem.many(ends, problem.slope_substeps)
    found = []
    for j, (low, high) in enumerate(spans):
        if high - low < 2.0 * _LEAST_SPAN:
            found += _combined(slopes, root[:, [j]])
            continue
        pairs = zip(left[2 * j], left[2 * j + 1], strict=True)
        found.append([(b - a) / (high - low) for a, b in pairs])
    return found


def _span(problem: Problem, theta: FloatArray, direction: FloatArray) -> tuple[float, float]:
    """Two standard deviations along a direction, around theta where the bounds leave them."""
    lowest, highest = problem.bounds
    moves = direction != 0.0
    ends = np.stack([lowest - theta, highest - theta])[:, moves] / direction[moves]
    least = min(float(ends.min(axis=0).max(initial=-np.inf)), 0.0)
    most = max(float(ends.max(axis=0).min(initial=np.inf)), 0.0)
    high = min(max(1.0, least + 2.0), most)
    return max(high - 2.0, least), high


def _combined(slopes: Slopes, weights: FloatArray) -> Slopes:
    """Derivatives along the columns of ``weights``, shape (p, q)."""
    n_records = len(slopes[0])
    return [
        [
            sum(
                (w * s[i] for w, s in zip(column, slopes, strict=True)), np.zeros_like(slopes[0][i])
            )
            for i in range(n_records)
        ]
        for column in weights.T
    ]
