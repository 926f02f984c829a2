"""Figures of merit: rms of an error, and accuracy of positioning after ISO 230-2.

What lives here: pure functions of arrays. What may not: plots and verdicts. Imports ``base`` only.
"""

from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray, finite_array
from pmac_comp.base.errors import ModelError
from pmac_comp.base.units import UM_PER_M

_COVERAGE = 2.0  # ISO 230-2: expanded range with coverage factor 2


def rms_um(values_m: FloatArray) -> float:
    """Root mean square in um of values in m, shape (n,)."""
    return UM_PER_M * float(np.sqrt(np.mean(values_m**2)))


def centred_rms_um(values_m: FloatArray) -> float:
    """Root mean square about the mean, in um, of values in m, shape (n,).

    For errors between scale and encoder: the offset between them is unknown.
    """
    return float(np.std(values_m) * UM_PER_M)


@dataclass(frozen=True)
class Positioning:
    """Results after ISO 230-2:2014, all in m; deviations are actual minus target.

    Parameters
    ----------
    mean_up_m, mean_down_m : ndarray, shape (p,)
        Mean deviation at each target, approached upwards and downwards.
    reversal_m : ndarray, shape (p,)
        Reversal value of each target (upwards minus downwards).
    reversal_value_m, mean_reversal_m : float
        B, the largest magnitude of the reversal values, and their mean.
    repeatability_m : float
        R, bidirectional.
    systematic_m, mean_bidirectional_m : float
        E, bidirectional systematic deviation, and M, range of the mean bidirectional deviation.
    accuracy_m : float
        A, bidirectional accuracy of positioning.
    """

    mean_up_m: FloatArray
    mean_down_m: FloatArray
    reversal_m: FloatArray
    reversal_value_m: float
    mean_reversal_m: float
    repeatability_m: float
    systematic_m: float
    mean_bidirectional_m: float
    accuracy_m: float


def positioning(up_m: FloatArray, down_m: FloatArray) -> Positioning:
    """Accuracy and repeatability of positioning from repeated approaches.

    Parameters
    ----------
    up_m, down_m : ndarray, shape (runs, targets)
        Deviation (actual minus target) in m per run and target, approached upwards and downwards.

    Raises
    ------
    ModelError
        Fewer than two runs, different shapes or not two-dimensional.
    NonFinite
        A deviation is not finite.

    Source
    ------
    ISO 230-2:2014, clauses 3 and 8: estimators of the mean and standard deviation, B, R, E, M, A.
    """
    up, down = _runs("up_m", up_m), _runs("down_m", down_m)
    if up.shape != down.shape:
        raise ModelError(
            f"up_m has shape {up.shape}, down_m {down.shape}.",
            code="PC-MET-002",
            hint="Approach each target as often from below as from above.",
        )
    mean_up, mean_down = up.mean(axis=0), down.mean(axis=0)
    spread_up = _COVERAGE * up.std(axis=0, ddof=1)
    spread_down = _COVERAGE * down.std(axis=0, ddof=1)
    reversal = mean_up - mean_down
    middle = 0.5 * (mean_up + mean_down)
    means = np.stack([mean_up, mean_down])
    spreads = np.stack([spread_up, spread_down])
    # R at a target: the larger of both expanded ranges, and their overlap with the reversal.
    each = np.stack([2.0 * spread_up, 2.0 * spread_down, spread_up + spread_down + abs(reversal)])
    return Positioning(
        mean_up_m=mean_up,
        mean_down_m=mean_down,
        reversal_m=reversal,
        reversal_value_m=float(np.max(np.abs(reversal))),
        mean_reversal_m=float(np.mean(reversal)),
        repeatability_m=float(np.max(each)),
        systematic_m=float(np.max(means) - np.min(means)),
        mean_bidirectional_m=float(np.max(middle) - np.min(middle)),
        accuracy_m=float(np.max(means + spreads) - np.min(means - spreads)),
    )


def _runs(name: str, value: FloatArray) -> FloatArray:
    array = np.asarray(value)
    if array.ndim != 2 or array.shape[0] < 2 or array.shape[1] < 1:
        raise ModelError(
            f"{name} has shape {array.shape}; at least two runs of one target are needed.",
            code="PC-MET-001",
            hint="Give one row per run and one column per target.",
        )
    return finite_array(name, array.ravel()).reshape(array.shape)
