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

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import lsq_linear

from pmac_comp.base.arrays import BoolArray, FloatArray, IntArray
from pmac_comp.physics.diagnose.statistics import Whitener, rows_with_past

_RIDGE = 1e-10


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
        """Products summed over the fitting blocks."""
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
        scaled = matrix * np.outer(unit, unit) + _RIDGE * np.eye(chosen.size)
        factor = cholesky(scaled, lower=False)
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
    everything = np.empty((*residual.shape, columns.shape[2] + 1))
    everything[:, :, :-1] = columns
    everything[:, :, -1] = residual
    keep = rows_with_past(usable, whitener.order)
    white = whitener.apply(everything)
    del everything
    weights = (keep[:, None] * (1.0 if robust is None else robust))[:, :, None]
    white *= weights
    white = _without_offsets(white, whitener, keep, offset_channels, robust)
    if doubtful is not None and doubtful.shape[2] > 0:
        white = _discounted(white, whitener.apply(doubtful) * weights)
    count = max(1, white.shape[0] // block)
    blocks = np.empty((count, white.shape[2], white.shape[2]))
    rows = np.empty(count)
    for b in range(count):
        stop = white.shape[0] if b == count - 1 else (b + 1) * block
        part = white[b * block : stop].reshape(-1, white.shape[2])
        blocks[b] = part.T @ part
        rows[b] = float(keep[b * block : stop].sum() * white.shape[1])
    return blocks, rows


def _without_offsets(
    white: FloatArray,
    whitener: Whitener,
    keep: BoolArray,
    offset_channels: Sequence[int],
    robust: FloatArray | None,
) -> FloatArray:
    """Everything projected orthogonally to a free constant in the given channels."""
    for channel in offset_channels:
        constant = np.zeros((white.shape[0], white.shape[1]))
        constant[:, channel] = 1.0
        image = whitener.apply(constant) * keep[:, None]
        if robust is not None:
            image = image * robust
        power = float(np.sum(image**2))
        if power > 0.0:
            share = np.einsum("tc,tck->k", image, white) / power
            for c in range(white.shape[1]):  # in place: these arrays are the largest there are
                white[:, c] -= np.outer(image[:, c], share)
    return white


def _discounted(white: FloatArray, shapes: FloatArray) -> FloatArray:
    """Everything weighed by the inverse root of the covariance 1 + shapes shapes'."""
    flat = white.reshape(-1, white.shape[2])
    basis, size, _ = np.linalg.svd(shapes.reshape(-1, shapes.shape[2]), full_matrices=False)
    share = 1.0 - 1.0 / np.sqrt(1.0 + size**2)
    flat -= basis @ (share[:, None] * (basis.T @ flat))
    return flat.reshape(white.shape)
