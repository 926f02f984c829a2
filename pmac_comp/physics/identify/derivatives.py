"""Speed and acceleration from a measured position without delay.

What lives here: zero-phase filtering, differentiation and decimation of captures. What may not: any
model. Imports ``base``; scipy does the filtering.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, decimate, sosfiltfilt

from pmac_comp.base.arrays import BoolArray, FloatArray

FILTER_ORDER = 4
CUTOFF_Hz = 100.0
BORDER_SAMPLES = 50


@dataclass(frozen=True)
class Motion:
    """Filtered position with its derivatives, shape (n,) each; ``usable`` marks good rows."""

    position_m: FloatArray
    velocity_m_per_s: FloatArray
    acceleration_m_per_s2: FloatArray
    usable: BoolArray


def motion_of(
    position_m: FloatArray, period_s: float, valid: BoolArray, *, cutoff_Hz: float = CUTOFF_Hz
) -> Motion:
    """Position, speed and acceleration of a measured position, filtered without delay.

    Parameters
    ----------
    position_m : ndarray, shape (n,)
        Measured position.
    period_s : float
        Sample period.
    valid : ndarray of bool, shape (n,)
        Samples to trust; others are bridged by a line, and rows near them are not usable.
    cutoff_Hz : float
        Corner of the 4th-order Butterworth filter, run forwards and backwards.

    Source
    ------
    EMPS reference processing: Janot, Gautier, Brunot 2019 (4th order, zero phase, 100 Hz, central
    differences, 50 border samples left out).
    """
    corner_Hz = min(cutoff_Hz, 0.2 / period_s)
    sections = butter(FILTER_ORDER, corner_Hz, fs=1.0 / period_s, output="sos")
    smooth = np.asarray(sosfiltfilt(sections, bridged(position_m, valid)), dtype=np.float64)
    velocity = central_difference(smooth, period_s)
    return Motion(smooth, velocity, central_difference(velocity, period_s), usable_rows(valid))


def bridged(values: FloatArray, valid: BoolArray) -> FloatArray:
    """Values with invalid samples replaced by a line between their neighbours, shape (n,)."""
    if bool(valid.all()):
        return values
    index = np.arange(values.size)
    return np.interp(index, index[valid], values[valid])


def central_difference(values: FloatArray, period_s: float) -> FloatArray:
    """First derivative by central differences, ends repeated, shape (n,)."""
    slope = np.empty_like(values)
    slope[1:-1] = (values[2:] - values[:-2]) / (2.0 * period_s)
    slope[0], slope[-1] = slope[1], slope[-2]
    return slope


def usable_rows(valid: BoolArray, border: int = BORDER_SAMPLES) -> BoolArray:
    """Rows at least ``border`` samples away from either end and any invalid sample, shape (n,)."""
    bad = np.concatenate(([0], np.cumsum(~valid)))
    index = np.arange(valid.size)
    low = np.clip(index - border, 0, valid.size)
    high = np.clip(index + border + 1, 0, valid.size)
    near = bad[high] - bad[low] > 0
    return (index >= border) & (index < valid.size - border) & ~near


def decimated(columns: FloatArray, usable: BoolArray, factor: int) -> tuple[FloatArray, BoolArray]:
    """Columns decimated by a zero-phase FIR filter, shape (m, k), and which rows are usable."""
    if factor <= 1:
        return columns, usable
    thin = decimate(columns, factor, ftype="fir", axis=0, zero_phase=True)
    return np.asarray(thin, dtype=np.float64), usable[::factor]
