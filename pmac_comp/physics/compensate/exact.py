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
from enum import Enum

import numpy as np
from scipy.signal import butter, sosfiltfilt

from pmac_comp.base.arrays import FloatArray, finite_array
from pmac_comp.base.units import UM_PER_M
from pmac_comp.physics.compensate.design import LoopRunner
from pmac_comp.physics.signals.metrics import rms_um

LEARNING_CUTOFF_Hz = 20.0
MEASURED_CUTOFF_Hz = 40.0  # with velocity and acceleration feedforward the loop lags little there
_GAIN = 0.8
_MOST_PASSES = 12
_LEAST_GAIN_FRAC = 0.03  # of the error: a pass that gains less ends the learning
_LEAST_GAIN_OF_FIRST_FRAC = 0.01  # of the error before the first pass: neither is that worth a run
_GROWTH_FRAC = 0.05  # an error that grows by more is taken back
_RETREAT = 0.6  # cutoff after a pass that was taken back
_MOST_RETREATS = 2
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
    cutoff_Hz : float
        Up to where the error was learned from at the end.
    learnable_um : tuple of float
        Rms of the part below the cutoff, which is all that learning can take away: its fall from
        pass to pass is the proof of convergence.
    confirmed_um : tuple of float
        Rms of the total error of fresh runs with the best offset.
    scatter_um : float
        Rms by which such runs differ from their mean: what no repetition can learn.
    ended : str
        Why learning ended, for people.
    """

    correction_m: FloatArray
    history_um: tuple[float, ...]
    converged: bool
    cutoff_Hz: float = LEARNING_CUTOFF_Hz
    learnable_um: tuple[float, ...] = ()
    confirmed_um: tuple[float, ...] = ()
    scatter_um: float = 0.0
    ended: str = ""

    @property
    def contraction(self) -> float:
        """Mean factor per pass by which the learnable error fell; below 1 it converges."""
        kept = self.learnable_um[: 1 + int(np.argmin(self.learnable_um or (1.0,)))]
        if len(kept) < 2 or kept[0] <= 0.0:
            return 1.0
        return float((kept[-1] / kept[0]) ** (1.0 / (len(kept) - 1)))


def learn(
    total_error_of: Callable[[FloatArray], FloatArray],
    n: int,
    period_s: float,
    *,
    start_m: FloatArray | None = None,
    passes: int = _MOST_PASSES,
    cutoff_Hz: float = LEARNING_CUTOFF_Hz,
    limit_m: float = math.inf,
    confirm: int = 0,
) -> Learning:
    """Offset that makes a repeated motion's total error small.

    A pass after which the error grew is taken back, and learning goes on below a lower cutoff.

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
    confirm : int
        Fresh runs with the best offset at the end: the least of noisy runs flatters.

    Returns
    -------
    Learning
        The best offset met, never a worse one than the start.
    """
    offset = np.zeros(n) if start_m is None else finite_array("start_m", start_m).copy()
    best, best_error, best_um = offset, np.zeros(n), math.inf
    history: list[float] = []
    learnable: list[float] = []
    retreats = 0
    converged, ended = False, f"the {passes} passes allowed were made"
    for number in range(passes + 1):
        error = total_error_of(offset)
        error = error - np.mean(error)
        left_um = rms_um(error)
        history.append(left_um)
        learnable.append(rms_um(zero_phase(error, period_s, cutoff_Hz)))
        gained = best_um - left_um
        if gained > 0.0:
            best, best_error, best_um = offset.copy(), error, left_um
        least_um = max(_LEAST_GAIN_FRAC * best_um, _LEAST_GAIN_OF_FIRST_FRAC * history[0])
        if number > 0 and abs(gained) < least_um:
            converged, ended = (
                True,
                f"the last pass changed the error by less than {least_um:.2f} um",
            )
            break
        if left_um > (1.0 + _GROWTH_FRAC) * best_um:
            retreats += 1
            cutoff_Hz *= _RETREAT
            if retreats > _MOST_RETREATS:
                converged, ended = True, f"the error grew {retreats} times and was taken back"
                break
        step = zero_phase(best_error, period_s, cutoff_Hz)
        offset = np.clip(best - _GAIN * step, -limit_m, limit_m)
    fresh = [total_error_of(best) for _ in range(confirm)]
    fresh = [run - np.mean(run) for run in fresh]
    mean = np.mean(fresh, axis=0) if fresh else np.zeros(n)
    return Learning(
        best,
        tuple(history),
        converged,
        cutoff_Hz,
        tuple(learnable),
        tuple(rms_um(run) for run in fresh),
        float(np.sqrt(np.mean([np.mean((run - mean) ** 2) for run in fresh])) * UM_PER_M)
        if len(fresh) > 1
        else 0.0,
        ended,
    )


def zero_phase(values: FloatArray, period_s: float, cutoff_Hz: float) -> FloatArray:
    """Values low-passed forward and backward, so that nothing is shifted in time."""
    sos = butter(2, min(cutoff_Hz, 0.45 / period_s), fs=1.0 / period_s, output="sos")
    pad = min(values.size - 1, round(_PAD_s / period_s))
    return np.asarray(sosfiltfilt(sos, values, padlen=pad))


class Aim(Enum):
    """Which error an exact correction takes away."""

    TOTAL = "total"  # table minus command: the offset also cancels the lag of the loop
    MECHANICAL = "mechanical"  # e_r: the offset undoes table minus motor, the loop's lag stays


def exact_correction(
    loop: LoopRunner,
    position_m: FloatArray,
    period_s: float,
    *,
    limit_m: float = math.inf,
    aim: Aim = Aim.TOTAL,
) -> Learning:
    """Offset for one known motion by learning on the model; shape (n,) in m."""

    def run(offset: FloatArray) -> FloatArray:
        signals = loop(position_m, position_m + offset, None)
        if aim is Aim.MECHANICAL:
            return signals.table_position_m - signals.motor_position_m + offset
        return signals.table_position_m - position_m

    return learn(run, position_m.size, period_s, limit_m=limit_m)
