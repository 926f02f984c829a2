"""Exact pre-compensation of one known motion: the model, or the machine, is inverted by learning.

What lives here: the learning step (the total error, filtered without phase and fed back into the
command offset) and its stop rule, for a simulated loop as for measured repeats. What may not:
controllers. Imports ``base`` and this package.

A closed loop passes slow offsets unchanged, so subtracting the error that is left converges up to
where the loop's phase reaches 60 degrees; above that the filter stops the learning.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

from pmac_comp.base.arrays import FloatArray, finite_array
from pmac_comp.base.units import UM_PER_M
from pmac_comp.physics.compensate.design import LoopRunner

LEARNING_CUTOFF_Hz = 20.0
_GAIN = 0.8
_MOST_PASSES = 12
_LEAST_GAIN_FRAC = 0.03  # of the error: a pass that gains less ends the learning
_PAD_s = 0.2


@dataclass(frozen=True)
class Learning:
    """A learned offset and how the error fell.

    Parameters
    ----------
    correction_m : ndarray, shape (n,)
        Best offset found, added to the command.
    history_um : tuple of float
        Rms of the total error before each pass and after the last, um.
    converged : bool
        Whether learning ended by its stop rule rather than by the number of passes.
    """

    correction_m: FloatArray
    history_um: tuple[float, ...]
    converged: bool


def learn(
    total_error_of: Callable[[FloatArray], FloatArray],
    n: int,
    period_s: float,
    *,
    start_m: FloatArray | None = None,
    passes: int = _MOST_PASSES,
    cutoff_Hz: float = LEARNING_CUTOFF_Hz,
    limit_m: float = math.inf,
) -> Learning:
    """Offset that makes a repeated motion's total error small.

    Parameters
    ----------
    total_error_of : callable
        Runs the motion with an offset (m, shape (n,)) and gives table minus command in m.
    n : int
        Samples of the motion.
    period_s : float
        Servo period.
    start_m : ndarray, shape (n,), or None
        Offset to start from (the model's); None means none.
    passes : int
        Most passes.
    cutoff_Hz : float
        Where learning ends.
    limit_m : float
        Amplitude that the offset never passes.

    Returns
    -------
    Learning
        The best offset met, never a worse one than the start.
    """
    offset = np.zeros(n) if start_m is None else finite_array("start_m", start_m).copy()
    best, best_um = offset.copy(), math.inf
    history: list[float] = []
    converged = False
    for number in range(passes + 1):
        error = total_error_of(offset)
        error = error - np.mean(error)
        left_um = float(np.sqrt(np.mean(error**2)) * UM_PER_M)
        history.append(left_um)
        gained = best_um - left_um
        if gained > 0.0:
            best, best_um = offset.copy(), left_um
        if number > 0 and gained < _LEAST_GAIN_FRAC * best_um:
            converged = True
            break
        offset = np.clip(offset - _GAIN * zero_phase(error, period_s, cutoff_Hz), -limit_m, limit_m)
    return Learning(best, tuple(history), converged)


def zero_phase(values: FloatArray, period_s: float, cutoff_Hz: float) -> FloatArray:
    """Values low-passed forward and backward, so that nothing is shifted in time."""
    sos = butter(2, min(cutoff_Hz, 0.45 / period_s), fs=1.0 / period_s, output="sos")
    pad = min(values.size - 1, round(_PAD_s / period_s))
    return np.asarray(sosfiltfilt(sos, values, padlen=pad))


def exact_correction(
    loop: LoopRunner, position_m: FloatArray, period_s: float, *, limit_m: float = math.inf
) -> Learning:
    """Offset for one known motion by learning on the model; shape (n,) in m."""

    def run(offset: FloatArray) -> FloatArray:
        signals = loop(position_m, position_m + offset, None)
        return signals.table_position_m - position_m

    return learn(run, position_m.size, period_s, limit_m=limit_m)
