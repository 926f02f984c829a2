"""Whitened normal equations of residuals and derivatives, nuisances projected out.

What lives here: weights of the channels, Gauss-Newton matrices whole and per block of time, cost.
What may not: simulation, steps. Imports ``problem``, ``whitening`` and ``records``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray, IntArray
from pmac_comp.base.errors import NonFinite
from pmac_comp.physics.identify.problem import Problem
from pmac_comp.physics.identify.records import Record
from pmac_comp.physics.identify.whitening import Whitener, fit_whitener, white

BLOCK_s = 0.4


@dataclass(frozen=True)
class Normal:
    """Whitened normal equations of p parameters, b blocks and q nuisances, these projected out.

    Parameters
    ----------
    hessian, gradient : ndarray, shapes (p, p) and (p,)
        J'J and J'r of the whitened slopes J and residuals r.
    cost : float
        Weighted sum of squares.
    scores, block_hessians : ndarray, shapes (b, p) and (b, p, p)
        What each block of time gives to both.
    prior_scores : ndarray, shape (p, p)
        S'KS of the prior information K of the nuisances and what they take of the slopes, S.
    runs : ndarray of int, shape (b,)
        Number of the record of each block.
    nuisance : ndarray, shape (q,)
        Nuisances that fit best.
    steady : tuple of ndarray, shapes (p, p) and (p,), or None
        Hessian and gradient of the steady rows alone.
    untempered : Normal or None
        The same before ``covariance.tempered``.
    """

    hessian: FloatArray
    gradient: FloatArray
    cost: float
    scores: FloatArray
    block_hessians: FloatArray
    prior_scores: FloatArray
    runs: IntArray  # number of the record of each block
    nuisance: FloatArray
    steady: tuple[FloatArray, FloatArray] | None = None  # Hessian and gradient of steady rows alone
    untempered: "Normal | None" = None  # the same before ``covariance.tempered``


def normal_equations(
    problem: Problem,
    filters: list[list[Whitener]],
    residuals: Sequence[FloatArray],
    slopes: Sequence[Sequence[FloatArray]],
    *,
    scatter: bool = True,
) -> Normal:
    """Weighted equations of residuals and derivatives at one place.

    ``residuals`` has shape (m, c) per record, ``slopes`` the same per parameter and record.
    Without ``scatter`` only what a step needs: nothing of blocks of time and steady rows.
    """
    parts = []
    for i, record in enumerate(problem.records):
        columns = [-slope[i] for slope in slopes]
        for c, whitener in enumerate(filters[i]):
            nuisance = _nuisance_of(problem, i, record, c)
            stack = np.column_stack(
                [residuals[i][:, c], *[column[:, c] for column in columns], nuisance]
            )
            rows = whitener.rows(record.valid)
            parts.append((i, c, np.where(rows[:, None], whitener.apply(stack), 0.0)))
    p = len(slopes)
    whole, on_slopes = _assembled(problem, [part for _, _, part in parts], p)
    if not scatter:
        return whole
    scores, hessians, runs = _block_scores(problem, parts, on_slopes, whole.nuisance, p)
    whole = replace(whole, scores=scores, block_hessians=hessians, runs=runs)
    if problem.steady is None:
        return whole
    kept = [part * filters[i][c].rows(problem.steady[i])[:, None] for i, c, part in parts]
    some, _ = _assembled(problem, kept, p)
    return replace(whole, steady=(some.hessian, some.gradient))


def _nuisance_of(problem: Problem, i: int, record: Record, c: int) -> FloatArray:
    columns = problem.nuisance[i]
    return columns if record.channels[c] == "difference" else np.zeros_like(columns)


def _assembled(problem: Problem, parts: Sequence[FloatArray], p: int) -> tuple[Normal, FloatArray]:
    """Equations of whitened rows without their blocks, and what nuisances take of each slope."""
    gram = _gram(parts)
    inner = slice(1, 1 + p)
    rest = slice(1 + p, None)
    known = problem.nuisance_information
    solve = np.linalg.pinv(gram[rest, rest] + np.diag(known), hermitian=True)
    on_slopes = solve @ gram[rest, inner]
    on_residual = solve @ gram[rest, 0]
    hessian = gram[inner, inner] - gram[inner, rest] @ on_slopes
    gradient = gram[inner, 0] - gram[inner, rest] @ on_residual
    cost = float(gram[0, 0] - gram[0, rest] @ on_residual)
    return Normal(
        hessian=hessian,
        gradient=gradient,
        cost=cost,
        scores=np.empty((0, p)),
        block_hessians=np.empty((0, p, p)),
        prior_scores=on_slopes.T @ (known[:, None] * on_slopes),
        runs=np.empty(0, dtype=np.int64),
        nuisance=np.asarray(on_residual),
    ), on_slopes


def _gram(parts: Sequence[FloatArray]) -> FloatArray:
    total = np.zeros((parts[0].shape[1], parts[0].shape[1]))
    for part in parts:
        total += part.T @ part
    return total


def _block_scores(
    problem: Problem,
    parts: list[tuple[int, int, FloatArray]],
    on_slopes: FloatArray,
    on_residual: FloatArray,
    p: int,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Score, Gauss-Newton matrix and record of each block of time, all channels together."""
    scores: dict[tuple[int, int], FloatArray] = {}
    hessians: dict[tuple[int, int], FloatArray] = {}
    for i, _, part in parts:
        slopes = part[:, 1 : 1 + p] - part[:, 1 + p :] @ on_slopes
        left = part[:, 0] - part[:, 1 + p :] @ on_residual
        block = max(round(BLOCK_s / problem.records[i].period_s), 1)
        for b, start in enumerate(range(0, left.size, block)):
            rows = slice(start, start + block)
            scores[i, b] = scores.get((i, b), 0.0) + slopes[rows].T @ left[rows]
            hessians[i, b] = hessians.get((i, b), 0.0) + slopes[rows].T @ slopes[rows]
    runs = np.array([i for i, _ in scores], dtype=np.int64)
    return np.stack(list(scores.values())), np.stack(list(hessians.values())), runs


def white_filters(problem: Problem, residuals: list[FloatArray]) -> list[list[Whitener]]:
    """Weights per record and channel; residuals, shape (m, c) each, are taken for white noise."""
    return [
        [
            white(max(_robust_std(residual[record.valid, c]), problem.floors[name]))
            for c, name in enumerate(record.channels)
        ]
        for record, residual in zip(problem.records, residuals, strict=True)
    ]


def coloured_filters(problem: Problem, residuals: list[FloatArray]) -> list[list[Whitener]]:
    """Weights per record and channel that whiten residuals, shape (m, c) per record."""
    return [
        [
            fit_whitener(residual[:, c], record.valid, problem.floors[name])
            for c, name in enumerate(record.channels)
        ]
        for record, residual in zip(problem.records, residuals, strict=True)
    ]


def _robust_std(values: FloatArray) -> float:
    if values.size == 0:
        return 0.0
    centred = values - np.median(values)
    return float(np.sqrt(np.mean(np.clip(centred, *np.quantile(centred, [0.02, 0.98])) ** 2)))


def prior_cost(problem: Problem, theta: FloatArray) -> float:
    """Squared distance of ``theta``, shape (p,), from the prior, in its standard deviations."""
    return float(problem.weight @ (theta - problem.centre) ** 2)


def cost_at(problem: Problem, theta: FloatArray, filters: list[list[Whitener]]) -> float:
    """Misfit with prior at ``theta``, shape (p,); infinite where the loop is unstable."""
    try:
        residuals = problem.residuals(theta)
    except NonFinite:
        return np.inf
    parts = _whitened_residuals(problem, residuals, filters)
    gram = _gram(parts)
    rest = _nuisance_solution(problem, gram)
    return float(gram[0, 0] - gram[0, 1:] @ rest) + prior_cost(problem, theta)


def channel_costs(
    problem: Problem, residuals: list[FloatArray], filters: list[list[Whitener]]
) -> list[FloatArray]:
    """Misfit of each channel of each record, shape (c,), nuisances taken out."""
    cleaned = without_nuisances(problem, residuals, linear_part(problem, residuals, filters))
    parts = iter(_whitened_residuals(problem, cleaned, filters))
    return [
        np.array([float(np.sum(next(parts)[:, 0] ** 2)) for _ in record.channels])
        for record in problem.records
    ]


def linear_part(
    problem: Problem, residuals: list[FloatArray], filters: list[list[Whitener]]
) -> FloatArray:
    """Nuisances that fit residuals best, shape (q,)."""
    parts = _whitened_residuals(problem, residuals, filters)
    gram = _gram(parts)
    return _nuisance_solution(problem, gram)


def _nuisance_solution(problem: Problem, gram: FloatArray) -> FloatArray:
    matrix = gram[1:, 1:] + np.diag(problem.nuisance_information)
    return np.asarray(np.linalg.pinv(matrix, hermitian=True) @ gram[1:, 0])


def _whitened_residuals(
    problem: Problem, residuals: list[FloatArray], filters: list[list[Whitener]]
) -> list[FloatArray]:
    parts = []
    for i, record in enumerate(problem.records):
        for c, whitener in enumerate(filters[i]):
            nuisance = _nuisance_of(problem, i, record, c)
            stack = np.column_stack([residuals[i][:, c], nuisance])
            rows: BoolArray = whitener.rows(record.valid)
            parts.append(np.where(rows[:, None], whitener.apply(stack), 0.0))
    return parts


def without_nuisances(
    problem: Problem, residuals: Sequence[FloatArray], eta: FloatArray
) -> list[FloatArray]:
    """Residuals less the nuisances ``eta``, shape (q,); shape (m, c) per record."""
    cleaned = []
    for i, record in enumerate(problem.records):
        left = residuals[i].copy()
        for c, name in enumerate(record.channels):
            if name == "difference":
                left[:, c] -= problem.nuisance[i] @ eta
        cleaned.append(left)
    return cleaned
