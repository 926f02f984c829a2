"""Autoregressive whitening of residuals and sensitivities.

What lives here: the AR model of one channel and its use as a filter. What may not: any drive.
Imports ``base`` and scipy.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from pmac_comp.base.arrays import BoolArray, FloatArray

AR_ORDER = 6


@dataclass(frozen=True)
class Whitener:
    """Prediction-error filter of one channel, scaled to unit innovations.

    Parameters
    ----------
    taps : ndarray, shape (order + 1,)
        FIR taps; the first is one over the innovation's standard deviation.
    """

    taps: FloatArray

    def apply(self, columns: FloatArray) -> FloatArray:
        """Filtered columns, shape as given; the first ``order`` rows are the filter's start."""
        return np.asarray(lfilter(self.taps, [1.0], columns, axis=0), dtype=np.float64)

    def rows(self, valid: BoolArray) -> BoolArray:
        """Rows whose filter window holds valid samples only, shape (n,)."""
        order = self.taps.size - 1
        bad = np.concatenate(([0], np.cumsum(~valid)))
        index = np.arange(valid.size)
        low = np.maximum(index - order, 0)
        return np.asarray((bad[index + 1] - bad[low] == 0) & (index >= order))


def white(std: float) -> Whitener:
    """Whitener of white noise with a standard deviation."""
    return Whitener(np.array([1.0 / std]))


def fit_whitener(
    residual: FloatArray, valid: BoolArray, floor: float, *, order: int = AR_ORDER
) -> Whitener:
    """AR whitener of a residual by the Yule-Walker equations.

    Parameters
    ----------
    residual : ndarray, shape (n,)
        Residual of one channel; invalid samples are left out of the covariances.
    valid : ndarray of bool, shape (n,)
        Samples to use.
    floor : float
        Least standard deviation of the innovations (the resolution of the sensor).
    order : int
        Order of the model.
    """
    masked = np.where(valid, residual, 0.0)
    n = max(int(valid.sum()), 1)
    order = min(order, max(n // 50, 0))
    lags = range(order + 1)
    covariance = np.array([masked[: masked.size - k] @ masked[k:] for k in lags]) / n
    covariance[0] = covariance[0] * (1.0 + 1e-6) + 1e-2 * floor**2
    if order == 0:
        return white(max(float(np.sqrt(covariance[0])), floor))
    phi = solve_toeplitz(covariance[:-1], covariance[1:])
    variance = float(covariance[0] - phi @ covariance[1:])
    taps = np.concatenate(([1.0], -np.asarray(phi))) / max(np.sqrt(max(variance, 0.0)), floor)
    return Whitener(np.asarray(taps, dtype=np.float64))
