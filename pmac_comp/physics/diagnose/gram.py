"""Joint linearised refits of many candidates from one set of scalar products.

What lives here: weighted least squares on Gram matrices kept per block of time. No drive. May
import ``statistics`` only.

All sensitivities are simulated once. Whatever is asked later (this candidate with these base
parameters, that pair, on the fitting captures, on each block of the validation captures) is
answered from the scalar products of the columns, in microseconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky, solve_triangular
from scipy.optimize import lsq_linear

from pmac_comp.base.arrays import BoolArray, FloatArray, IntArray
from pmac_comp.base.errors import NotIdentifiable
from pmac_comp.physics.diagnose.statistics import Whitener, rows_with_past

# Of columns of unit length; larger ones where rounding leaves columns dependent even so.
_RIDGES = (1e-10, 1e-8, 1e-6, 1e-4)
_PIECE = 512


@dataclass(frozen=True)
class Prior:
    """Bounds and priors of the columns, all in the columns' own units, about the present point.

    Parameters
    ----------
    lower, upper : ndarray, shape (k,)
        Bounds of the step.
    centre, sigma : ndarray, shape (k,)
        Gaussian prior of the step; infinite sigma means none.
    """

    lower: FloatArray
    upper: FloatArray
    centre: FloatArray
    sigma: FloatArray


@dataclass(frozen=True)
class Solution:
    """A refit on some of the columns.

    Parameters
    ----------
    indices : ndarray of int, shape (s,)
        Columns that were free.
    step : ndarray, shape (s,)
        Step of each.
    covariance : ndarray, shape (s, s)
        Of the step, from the weighted data and the priors.
    chi2 : float
        Weighted sum of squares plus prior terms after the step.
    """

    indices: IntArray
    step: FloatArray
    covariance: FloatArray
    chi2: float


@dataclass(frozen=True)
class Gram:
    """Scalar products of whitened columns and residual, per block of time.

    Parameters
    ----------
    blocks : ndarray, shape (b, k + 1, k + 1)
        Products in each block; the last row and column belong to the residual.
    fitting : ndarray of bool, shape (b,)
        Blocks of the fitting captures; the others judge.
    rows : ndarray, shape (b,)
        Number of whitened samples in each block.
    prior : Prior
        Of the k columns.
    record : ndarray of int, shape (b,), or None
        Which record each block belongs to.
    """

    blocks: FloatArray
    fitting: BoolArray
    rows: FloatArray
    prior: Prior
    record: IntArray | None = None

    @property
    def n_columns(self) -> int:
        """Number of columns."""
        return int(self.blocks.shape[1]) - 1

    @cached_property
    def total(self) -> FloatArray:
        """Products summed over the fitting blocks, shape (k + 1, k + 1)."""
        return np.asarray(self.blocks[self.fitting].sum(axis=0))

    def with_bounds(self, prior: Prior) -> "Gram":
        """The same data under other bounds."""
        return Gram(self.blocks, self.fitting, self.rows, prior, self.record)

    def solve(
        self, indices: Sequence[int] | IntArray, *, weights: FloatArray | None = None
    ) -> Solution:
        """Bounded, prior-weighted least squares over the chosen columns on fitting blocks.

        Parameters
        ----------
        indices : sequence of int
            Columns that are free; the others stay at zero.
        weights : ndarray, shape (b,) or None
            Weight of each block instead of the fitting set (bootstrap).

        Returns
        -------
        Solution
        """
        chosen = np.asarray(indices, dtype=np.int64)
        total = self.total if weights is None else np.tensordot(weights, self.blocks, axes=1)
        return self._solve_total(total, chosen)

    def _solve_total(self, total: FloatArray, chosen: IntArray) -> Solution:
        precision = 1.0 / self.prior.sigma[chosen] ** 2
        matrix = total[np.ix_(chosen, chosen)] + np.diag(precision)
        # A column that does nothing (an effect out of reach of the data) must not blow up.
        matrix += np.diag((np.diag(matrix) <= 0.0).astype(np.float64))
        right = total[chosen, -1] + precision * self.prior.centre[chosen]
        unit = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        factor = _factor(matrix * np.outer(unit, unit))
        target = solve_triangular(factor, right * unit, trans="T")
        step = solve_triangular(factor, target) * unit
        lower, upper = self.prior.lower[chosen], self.prior.upper[chosen]
        if np.any(step < lower) or np.any(step > upper):
            step = _bounded(factor, target, lower / unit, upper / unit) * unit
        inverse = solve_triangular(factor, np.eye(chosen.size))
        covariance = (inverse @ inverse.T) * np.outer(unit, unit)
        return Solution(chosen, step, covariance, self._chi2(total, chosen, step))

    def _chi2(self, total: FloatArray, chosen: IntArray, step: FloatArray) -> float:
        data = total[-1, -1] - 2.0 * step @ total[chosen, -1]
        data += step @ total[np.ix_(chosen, chosen)] @ step
        off = (step - self.prior.centre[chosen]) / self.prior.sigma[chosen]
        return float(data + off @ off)

    def block_chi2(self, solution: Solution) -> FloatArray:
        """Weighted sum of squares that a refit leaves in every block, shape (b,)."""
        chosen, step = solution.indices, solution.step
        part = self.blocks[:, chosen][:, :, chosen]
        return np.asarray(
            self.blocks[:, -1, -1]
            - 2.0 * self.blocks[:, chosen, -1] @ step
            + np.einsum("i,bij,j->b", step, part, step)
        )

    def moved(self, solution: Solution) -> "Gram":
        """Gram matrices about the point that a solution reaches (linearised)."""
        k = self.n_columns
        shift = np.eye(k + 1)
        shift[solution.indices, -1] = -solution.step
        blocks = np.einsum("ji,bjk,kl->bil", shift, self.blocks, shift)
        whole = np.zeros(k)
        whole[solution.indices] = solution.step
        prior = Prior(
            self.prior.lower - whole,
            self.prior.upper - whole,
            self.prior.centre - whole,
            self.prior.sigma,
        )
        return Gram(blocks, self.fitting, self.rows, prior)


def _factor(scaled: FloatArray) -> FloatArray:
    """Upper triangle whose square a matrix of unit diagonal is, but for a ridge."""
    for ridge in _RIDGES:
        try:
            return np.asarray(cholesky(scaled + ridge * np.eye(scaled.shape[0]), lower=False))
        except LinAlgError:
            continue
    raise NotIdentifiable(
        "No parameter can be told from any other on these captures.",
        code="PC-DIA-016",
        hint="Capture motions of some millimetres in both directions; `pmac-comp capture` "
        "proposes a campaign.",
    )


def _bounded(
    factor: FloatArray, target: FloatArray, lower: FloatArray, upper: FloatArray
) -> FloatArray:
    """Least squares in a box; the box is widened by a hair where it is empty."""
    room = np.where(upper > lower, upper, lower + 1e-12 * (1.0 + np.nan_to_num(np.abs(lower))))
    return np.asarray(lsq_linear(factor, target, bounds=(lower, room), method="bvls").x)


def gram_of_record(
    residual: FloatArray,
    columns: FloatArray | NDArray[np.float32],
    usable: BoolArray,
    whitener: Whitener,
    *,
    block: int,
    offset_channels: Sequence[int],
    robust: FloatArray | None = None,
    doubtful: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Block Gram matrices of one record.

    Parameters
    ----------
    residual : ndarray, shape (m, channels)
        Measured minus simulated.
    columns : ndarray, shape (m, channels, k)
        Sensitivities.
    usable : ndarray of bool, shape (m,)
        Samples that count.
    whitener : Whitener
        Noise model.
    block : int
        Samples per block.
    offset_channels : sequence of int
        Channels with a free constant in this record; it is projected out of everything.
    robust : ndarray, shape (m, channels) or None
        Square-root weights of single whitened samples.
    doubtful : ndarray, shape (m, channels, q) or None
        Shapes of what the model is known not to get right, at one standard deviation each; they
        count as noise of this record.

    Returns
    -------
    tuple of ndarray
        Blocks of shape (b, k + 1, k + 1), and the number of samples in each.
    """
    keep = rows_with_past(usable, whitener.order)
    weights = keep[:, None] * (np.ones(residual.shape) if robust is None else robust)
    images, basis, share = _nuisances(whitener, weights, offset_channels, doubtful)
    count = max(1, residual.shape[0] // block)
    ends = [*(b * block for b in range(count)), residual.shape[0]]
    wide = np.stack(
        [
            _products(residual, columns, whitener, weights, (images, basis), first, last)
            for first, last in pairwise(ends)
        ]
    )
    projection = _projection(wide.sum(axis=0), columns.shape[2] + 1, images.shape[2], share)
    rows = [float(keep[a:b].sum() * residual.shape[1]) for a, b in pairwise(ends)]
    return projection.T @ wide @ projection, np.array(rows)


def _nuisances(
    whitener: Whitener,
    weights: FloatArray,
    offset_channels: Sequence[int],
    doubtful: FloatArray | None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weighted images of free constants, and a basis of doubtful shapes with their discounts."""
    constants = np.zeros((*weights.shape, len(offset_channels)))
    for i, channel in enumerate(offset_channels):
        constants[:, channel, i] = 1.0
    images = whitener.apply(constants) * weights[:, :, None]
    if doubtful is None or doubtful.shape[2] == 0:
        return images, np.zeros((*weights.shape, 0)), np.zeros(0)
    shapes = whitener.apply(doubtful) * weights[:, :, None]
    flat = shapes.reshape(-1, shapes.shape[2])
    basis, size, _ = np.linalg.svd(flat, full_matrices=False)
    share = 1.0 - 1.0 / np.sqrt(1.0 + size**2)
    return images, basis.reshape(*weights.shape, -1), share


def _products(
    residual: FloatArray,
    columns: FloatArray | NDArray[np.float32],
    whitener: Whitener,
    weights: FloatArray,
    nuisances: tuple[FloatArray, FloatArray],
    first: int,
    last: int,
) -> FloatArray:
    """Scalar products of whitened columns, residual and nuisances over samples first to last.

    A short piece at a time: whitened columns in double precision are never all in memory.
    """
    k = columns.shape[2]
    width = k + 1 + sum(n.shape[2] for n in nuisances)
    total = np.zeros((width, width))
    for start in range(first, last, _PIECE):
        stop, past = min(last, start + _PIECE), max(0, start - whitener.order)
        raw = np.empty((stop - past, residual.shape[1], k + 1))
        raw[:, :, :k] = columns[past:stop]
        raw[:, :, k] = residual[past:stop]
        white = whitener.apply(raw)[start - past :] * weights[start:stop, :, None]
        part = np.concatenate([white, *(n[start:stop] for n in nuisances)], axis=2)
        flat = part.reshape(-1, width)
        total += flat.T @ flat
    return total


def _projection(total: FloatArray, kept: int, n_images: int, share: FloatArray) -> FloatArray:
    """Map from products with nuisances to those of columns free of them.

    Free constants are projected out; then everything is weighed by the inverse root of the
    covariance 1 + shapes shapes' of the doubtful shapes.
    """
    projection = np.eye(total.shape[0])[:, :kept]
    for i in range(kept, kept + n_images):
        if total[i, i] > 0.0:
            projection[i] = -(total[i] @ projection) / total[i, i]
    of_shapes = slice(kept + n_images, total.shape[0])
    projection[of_shapes] = -share[:, None] * (total[of_shapes] @ projection)
    return projection
