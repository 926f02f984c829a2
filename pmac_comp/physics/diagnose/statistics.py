"""Statistics that know the data is coloured: whitening, effective sample size, tests, intervals.

What lives here: numbers about numbers. No drive, no capture. May import no package of ours but
``base``.

Residuals of a closed loop sampled at 2262 Hz are strongly correlated; a likelihood that counts
every sample as independent makes any nonsense win. Everything here either removes the
correlation (vector autoregressive whitening) or counts it (effective size, blocks).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.stats import beta, norm

from pmac_comp.base.arrays import BoolArray, FloatArray

_RIDGE = 1e-9
_MIN_BLOCKS = 4
# Whitened residuals that hold more than noise are correlated over a few hundredths of a second.
_SAMPLES_PER_INDEPENDENT = 16.0


@dataclass(frozen=True)
class Whitener:
    """Vector autoregressive filter that turns coloured noise into white noise of unit variance.

    Parameters
    ----------
    lags : ndarray, shape (order, channels, channels)
        Prediction of sample t from sample t - k is ``lags[k - 1] @ x[t - k]``.
    scale : ndarray, shape (channels, channels)
        Inverse Cholesky factor of the innovation covariance.
    """

    lags: FloatArray
    scale: FloatArray

    @property
    def order(self) -> int:
        """Number of past samples the filter looks at."""
        return int(self.lags.shape[0])

    def apply(self, columns: FloatArray) -> FloatArray:
        """Whitened copy of residuals or sensitivities.

        Parameters
        ----------
        columns : ndarray, shape (n, channels) or (n, channels, k)
            Samples in time order; several columns are filtered alike.

        Returns
        -------
        ndarray
            Same shape; the first ``order`` samples are zero because their past is unknown.
        """
        wide = columns[..., None] if columns.ndim == 2 else columns
        scaled = np.einsum("ij,kjl->kil", self.scale, self.lags)
        filters = np.concatenate([self.scale[None], -scaled])
        out: FloatArray = _filtered(np.ascontiguousarray(filters), np.ascontiguousarray(wide))
        return np.asarray(out[..., 0] if columns.ndim == 2 else out)


@njit(cache=True, nogil=True, error_model="numpy")
def _filtered(filters: FloatArray, series: FloatArray) -> FloatArray:
    """Sum over lags of filter times past sample; zero where the past is unknown."""
    n, channels, k = series.shape
    order = filters.shape[0] - 1
    out = np.zeros((n, channels, k))
    for t in range(order, n):
        for lag in range(order + 1):
            for i in range(channels):
                for j in range(channels):
                    share = filters[lag, i, j]
                    for c in range(k):
                        out[t, i, c] += share * series[t - lag, j, c]
    return out


def fit_whitener(
    series: Sequence[FloatArray], usable: Sequence[BoolArray], *, order: int, floor: FloatArray
) -> Whitener:
    """Whitener estimated from noise-like series by least squares.

    Parameters
    ----------
    series : sequence of ndarray, shape (n_i, channels)
        One series per capture.
    usable : sequence of ndarray of bool, shape (n_i,)
        Samples that may be used.
    order : int
        Number of lags.
    floor : ndarray, shape (channels,)
        Least standard deviation of an innovation, per channel: sensors are never better than
        their resolution, so a lucky fit cannot claim it.

    Returns
    -------
    Whitener
        The filter; white input gives lags near zero.
    """
    past, future = _lagged(series, usable, order)
    channels = series[0].shape[1]
    if future.shape[0] < 4 * order * channels:
        return Whitener(np.zeros((order, channels, channels)), np.diag(1.0 / floor))
    gram = past.T @ past
    gram += np.eye(gram.shape[0]) * (_RIDGE * np.trace(gram) / gram.shape[0] + 1e-300)
    coefficients = np.linalg.solve(gram, past.T @ future)
    innovation = _robust_covariance(future - past @ coefficients) + np.diag(floor**2)
    scale = np.linalg.inv(np.linalg.cholesky(innovation))
    lags = coefficients.T.reshape(channels, order, channels).transpose(1, 0, 2)
    return Whitener(np.ascontiguousarray(lags), scale)


def _lagged(
    series: Sequence[FloatArray], usable: Sequence[BoolArray], order: int
) -> tuple[FloatArray, FloatArray]:
    """Past and present samples of all series stacked, rows with unusable samples left out."""
    pasts, futures = [], []
    for values, good in zip(series, usable, strict=True):
        n = values.shape[0]
        if n <= order:
            continue
        keep = rows_with_past(good, order)[order:]
        past = np.hstack([values[order - k : n - k] for k in range(1, order + 1)])
        pasts.append(past[keep])
        futures.append(values[order:][keep])
    channels = series[0].shape[1]
    if not pasts:
        return np.zeros((0, order * channels)), np.zeros((0, channels))
    return np.vstack(pasts), np.vstack(futures)


def rows_with_past(usable: BoolArray, order: int) -> BoolArray:
    """Which samples, shape (n,), are usable together with the ``order`` samples before them."""
    bad = np.convolve(~usable, np.ones(order + 1))[: usable.size] > 0.5
    bad[:order] = True
    return ~bad


def _robust_covariance(samples: FloatArray) -> FloatArray:
    """Covariance with rows beyond 4 robust deviations limited (impacts, sticking)."""
    spread = np.maximum(1.4826 * np.median(np.abs(samples), axis=0), 1e-300)
    size = np.max(np.abs(samples) / spread, axis=1)
    limited = samples * np.minimum(1.0, 4.0 / np.maximum(size, 1e-12))[:, None]
    return np.asarray(limited.T @ limited / max(1, samples.shape[0]))


def huber_weights(whitened: FloatArray, *, limit: float = 3.5) -> FloatArray:
    """Square-root weights that bound the influence of single samples.

    Parameters
    ----------
    whitened : ndarray, shape (n, channels)
        Residual in units of its standard deviation.
    limit : float
        Where influence stops growing, in standard deviations.

    Returns
    -------
    ndarray, shape (n, channels)
        1 inside the limit, ``sqrt(limit / size)`` outside.
    """
    return np.sqrt(np.minimum(1.0, limit / np.maximum(np.abs(whitened), 1e-12)))


def effective_size(series: FloatArray, *, max_lag: int | None = None) -> float:
    """Number of independent samples a correlated series is worth.

    Parameters
    ----------
    series : ndarray, shape (n,)
        Residual; its mean is removed.
    max_lag : int or None
        Largest lag summed; a tenth of the series by default.

    Returns
    -------
    float
        Between 1 and n; Geyer's initial positive sequence stops the sum.
    """
    n = series.size
    centred = series - series.mean()
    power = float(centred @ centred)
    if n < 4 or power <= 0.0:
        return float(max(1, n))
    length = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(centred, length)
    rho = np.fft.irfft(spectrum * spectrum.conj(), length)[: (max_lag or n // 10) + 1] / power
    pairs = rho[1:-1:2] + rho[2::2]
    stop = np.flatnonzero(pairs <= 0.0)
    total = float(pairs[: stop[0]].sum()) if stop.size else float(pairs.sum())
    return float(np.clip(n / (1.0 + 2.0 * total), 1.0, n))


def block_means(values: FloatArray, block: int) -> FloatArray:
    """Means of consecutive blocks of a series of shape (n,), shape (n // block,).

    The rest that does not fill a block is left out.
    """
    count = values.size // block
    return np.asarray(values[: count * block].reshape(count, block).mean(axis=1))


def sign_flip_p(differences: FloatArray, *, seed: int, draws: int = 2000) -> float:
    """One-sided p-value that the mean of block differences is positive.

    Parameters
    ----------
    differences : ndarray, shape (blocks,)
        Gain per block; blocks are long against the correlation of the data.
    seed : int
        Seed of the random sign flips.
    draws : int
        Number of random flips.

    Returns
    -------
    float
        The larger of the sign-flip p-value (resolution 1/draws) and, where that resolution is
        exhausted, the Student-like tail of the studentised mean.

    Source
    ------
    Permutation of signs under symmetry (Good, Permutation Tests).
    """
    n = differences.size
    if n < _MIN_BLOCKS:
        return 1.0
    # Symmetry survives any odd function; the root keeps one impact from deciding alone.
    differences = np.sign(differences) * np.sqrt(np.abs(differences))
    observed = float(differences.mean())
    if observed <= 0.0:
        return 1.0
    rng = np.random.default_rng(seed)
    flips = rng.choice(np.array([-1.0, 1.0]), size=(draws, n))
    hits = int(np.count_nonzero(flips @ differences / n >= observed))
    least = math.exp2(-n)
    if hits > 0:
        return max(least, (hits + 1) / (draws + 1))
    tail = float(norm.sf(studentised(differences)))
    return max(least, tail)


def rotation_p(
    before: FloatArray, after: FloatArray, rows: FloatArray, *, parameters: int
) -> float:
    """p-value of a drop of chi-square that may come from a single event.

    Signs of blocks cannot prove what happens once or twice (a torque limit reached at the start of
    a stroke). Given the sum of squares before, a residual without cause points anywhere: the share
    of it that a few parameters take away is Beta distributed in as many dimensions as there are
    independent samples where the sum of squares lives.

    Parameters
    ----------
    before, after : ndarray, shape (blocks,)
        Sum of squares in every block without and with the candidate.
    rows : ndarray, shape (blocks,)
        Samples in every block.
    parameters : int
        Parameters of the candidate.

    Returns
    -------
    float
        One where nothing is gained.

    Source
    ------
    Rotation test (Langsrud 2005); blocks are counted by the participation ratio of their power,
    their samples as one in ``_SAMPLES_PER_INDEPENDENT``.
    """
    whole = float(before.sum())
    share = 1.0 - float(after.sum()) / whole if whole > 0.0 else 0.0
    if share <= 0.0:
        return 1.0
    blocks = whole**2 / float(np.sum(before**2))
    size = blocks * float(rows.mean()) / _SAMPLES_PER_INDEPENDENT
    free = size - parameters
    return float(beta.sf(share, 0.5 * parameters, 0.5 * free)) if free > 1.0 else 1.0


def studentised(differences: FloatArray) -> float:
    """Mean of differences, shape (n,), over its standard error; infinite when all agree."""
    n = differences.size
    if n < 2:
        return 0.0
    deviation = float(differences.std(ddof=1))
    mean = float(differences.mean())
    if deviation <= 0.0:
        return float(np.sign(mean) * np.inf) if mean else 0.0
    return mean * math.sqrt(n) / deviation


def corrected_p(p_value: float, candidates: int) -> float:
    """p-value after trying several candidates (Sidak)."""
    if p_value >= 1.0:
        return 1.0
    return float(-np.expm1(max(1, candidates) * np.log1p(-p_value)))


def wilson_interval(hits: int, cases: int, *, confidence: float = 0.95) -> tuple[float, float]:
    """Interval of a proportion that keeps its promise near 0 and 1.

    Parameters
    ----------
    hits, cases : int
        Successes out of trials.
    confidence : float
        Coverage.

    Returns
    -------
    tuple of float
        Lower and upper bound; (0, 1) without cases.

    Source
    ------
    Wilson (1927), score interval.
    """
    if cases <= 0:
        return (0.0, 1.0)
    z = float(norm.ppf(0.5 + confidence / 2.0))
    share = hits / cases
    centre = (share + z * z / (2 * cases)) / (1.0 + z * z / cases)
    half = z / (1.0 + z * z / cases) * np.sqrt(share * (1 - share) / cases + z * z / (4 * cases**2))
    return (float(max(0.0, centre - half)), float(min(1.0, centre + half)))


def bic_gain(chi2_gain: float, parameters: int, effective: float) -> float:
    """Improvement of the Bayesian information criterion; positive favours the larger model.

    Parameters
    ----------
    chi2_gain : float
        Drop of the whitened sum of squares.
    parameters : int
        Added parameters.
    effective : float
        Effective number of independent samples.

    Returns
    -------
    float
        ``chi2_gain - parameters * ln(effective)``, about twice the log Bayes factor.
    """
    return chi2_gain - parameters * float(np.log(max(effective, 2.0)))
