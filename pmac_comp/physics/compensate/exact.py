"""Exact pre-compensation of one known motion: the model, or the machine, is inverted by learning.

What lives here: the learning step (the total error, filtered without phase and fed back into the
command offset) and its stop rule, for a simulated loop as for measured repeats. What may not:
controllers. Imports ``base`` and this package.

A closed loop passes slow offsets unchanged, so subtracting the error that is left converges up to
where the loop's phase reaches 60 degrees; above that the filter stops the learning.

Rests are learned like all else: the lag with which an axis stops goes within some hundredths of a
second, as the integrator takes it away, and an offset that stayed would hold the axis off its
target by that much for as long as it rests.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial

import numpy as np

from pmac_comp.base.arrays import FloatArray, finite_array
from pmac_comp.physics.compensate.loop import LoopRunner
from pmac_comp.physics.signals.metrics import rms_um
from pmac_comp.physics.signals.rests import rests_of

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
_EDGE_FRAC = 0.02  # of a motion at both ends, over which its offset fades
_NOISE_MARGIN = 1.5  # times the scatter of repeats: nothing is left to learn below


@dataclass(frozen=True)
class Learning:
    """A learned offset and how the error fell.

    Parameters
    ----------
    correction_m : ndarray, shape (n,)
        Best offset found, added to the command.
    history_um : tuple of float
        Rms of the total error before each pass and after the last, rests included, um.
    converged : bool
        Whether the last pass changed next to nothing, or what is left is the scatter of repeats.
    cutoff_Hz : float
        Up to where the error was learned from at the end.
    learnable_um : tuple of float
        Rms of the part below that cutoff, which is all that learning can take away, in the errors
        of ``history_um``: its fall up to the best of them is the proof of convergence.
    confirmed_um : tuple of float
        Rms of the total error of fresh runs with the best offset.
    scatter_um : float
        Rms by which such runs differ from their mean: what no repetition can learn.
    ended : str
        Why learning ended, for people.
    interrupted : bool
        Whether somebody stopped it: passes or fresh runs are missing.
    """

    correction_m: FloatArray
    history_um: tuple[float, ...]
    converged: bool
    cutoff_Hz: float = LEARNING_CUTOFF_Hz
    learnable_um: tuple[float, ...] = ()
    confirmed_um: tuple[float, ...] = ()
    scatter_um: float = 0.0
    ended: str = ""
    interrupted: bool = False

    @property
    def contraction(self) -> float:
        """Mean factor per pass, up to the best, by which the learnable error fell; 1 for none."""
        kept = self.learnable_um[: 1 + int(np.argmin(self.history_um or (1.0,)))]
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
    rests: Sequence[slice] = (),
    keeps_interrupted: bool = False,
) -> Learning:
    """Offset that makes a repeated motion's total error small.

    A pass after which the error grew is taken back. Where the motion has rests, learning then
    leaves them out: what moves a resting axis by micrometres may turn its friction over, so that
    the next start finds it on the wrong side. If that is not enough, it goes on below a lower
    cutoff. The error that is judged is that of the whole motion, rests included.

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
    rests : sequence of slice
        Where the command stands (``rests_of``).
    keeps_interrupted : bool
        Whether Ctrl-C ends learning with what was learned up to the last complete pass, and no
        fresh run follows. Before a pass is complete it is raised all the same.

    Returns
    -------
    Learning
        The best offset met, never a worse one than the start.
    """
    tried_m = [np.zeros(n) if start_m is None else finite_array("start_m", start_m).copy()]
    errors_m: list[FloatArray] = []
    history_um: list[float] = []
    best = retreats = 0
    left_out: Sequence[slice] = ()
    converged, ended = False, f"the {passes} passes allowed were made"
    interrupted = False

    def measured(offset_m: FloatArray) -> FloatArray:
        error_m = total_error_of(offset_m)
        return error_m - np.mean(error_m)

    for number in range(passes + 1):
        best_before_um = min(history_um, default=math.inf)
        try:
            errors_m.append(measured(tried_m[-1]))
        except KeyboardInterrupt:
            complete = number - 1  # the first run is that before learning
            if not keeps_interrupted or complete < 1:
                raise
            interrupted = True
            ended = f"it was interrupted after {complete} pass{'es' if complete > 1 else ''}"
            break
        left_um = rms_um(errors_m[-1])
        history_um.append(left_um)
        best = int(np.argmin(history_um))
        least_um = max(
            _LEAST_GAIN_FRAC * history_um[best], _LEAST_GAIN_OF_FIRST_FRAC * history_um[0]
        )
        if number > 0 and abs(best_before_um - left_um) < least_um:
            converged, ended = (
                True,
                f"the last pass changed the error by less than {least_um:.2f} um",
            )
            break
        if left_um > (1.0 + _GROWTH_FRAC) * history_um[best]:
            retreats += 1
            if retreats > _MOST_RETREATS:
                ended = f"the error grew {retreats} times and was taken back"
                break
            if rests and not left_out:
                left_out = rests
            else:
                cutoff_Hz *= _RETREAT
        step_m = _step(errors_m[best], period_s, cutoff_Hz, left_out)
        tried_m.append(np.clip(tried_m[best] - _GAIN * step_m, -limit_m, limit_m))
    confirm = 0 if interrupted else confirm
    again = partial(measured, tried_m[best])
    fresh_m = _fresh_runs(again, confirm, keeps_interrupted=keeps_interrupted)
    if len(fresh_m) < confirm:
        interrupted, ended = True, f"{ended}; the fresh runs after it were interrupted"
    scatter_um = rms_um(np.array(fresh_m) - np.mean(fresh_m, axis=0)) if len(fresh_m) > 1 else 0.0
    # In one band: after a retreat less of the same error lies below the cutoff.
    learnable_um = [rms_um(_step(error, period_s, cutoff_Hz, left_out)) for error in errors_m]
    return Learning(
        correction_m=tried_m[best],
        history_um=tuple(history_um),
        converged=converged or learnable_um[best] <= _NOISE_MARGIN * scatter_um,
        cutoff_Hz=cutoff_Hz,
        learnable_um=tuple(learnable_um),
        confirmed_um=tuple(rms_um(run) for run in fresh_m),
        scatter_um=scatter_um,
        ended=ended,
        interrupted=interrupted,
    )


def _fresh_runs(
    run: Callable[[], FloatArray], n: int, *, keeps_interrupted: bool
) -> list[FloatArray]:
    """Errors of ``n`` runs, or of those before Ctrl-C where that is kept."""
    errors: list[FloatArray] = []
    try:
        while len(errors) < n:
            errors.append(run())
    except KeyboardInterrupt:
        if not keeps_interrupted:
            raise
    return errors


def _step(
    error: FloatArray, period_s: float, cutoff_Hz: float, left_out: Sequence[slice]
) -> FloatArray:
    """What is learned from an error: its slow part, and over rests that are left out nothing.

    What is learned of the motion that ends in such a rest fades, as the lag of the loop does;
    before the first motion there is nothing. The way to it and from it lies in the motion beside.
    """
    if not left_out:
        return zero_phase(error, period_s, cutoff_Hz)
    blend = round(1.0 / (cutoff_Hz * period_s))
    rise = np.arange(1, blend + 1) / (blend + 1)
    rise = rise**2 * (3.0 - 2.0 * rise)
    filled = error.copy()
    for rest in left_out:
        held = np.mean(error[max(0, rest.start - blend) : rest.start]) if rest.start else 0.0
        filled[rest] = held * _padded(rise[::-1], rest.stop - rest.start)
    step = zero_phase(filled, period_s, cutoff_Hz)
    for rest in left_out:
        before = slice(max(0, rest.start - blend), rest.start)
        after = slice(rest.stop, min(rest.stop + blend, error.size))
        first, last = filled[rest.start], filled[rest.stop - 1]
        step[rest] = filled[rest]
        step[before] += rise[blend - (before.stop - before.start) :] * (first - step[before])
        step[after] += rise[::-1][: after.stop - after.start] * (last - step[after])
    return step


def _padded(values: FloatArray, n: int) -> FloatArray:
    """The first ``n`` of values, zeros after their end."""
    out = np.zeros(n)
    out[: values.size] = values[:n]
    return out


def zero_phase(values: FloatArray, period_s: float, cutoff_Hz: float) -> FloatArray:
    """Values low-passed forward and backward, so that nothing is shifted in time; shapes (n,).

    The filter is a Butterworth's of second order; where the sampling does not carry the cutoff it
    lies at 0.45 of the rate.
    """
    from scipy.signal import butter, sosfiltfilt

    sos = butter(2, min(cutoff_Hz, 0.45 / period_s), fs=1.0 / period_s, output="sos")
    pad = min(values.size - 1, round(_PAD_s / period_s))
    return np.asarray(sosfiltfilt(sos, values, padlen=pad))


def faded(offset_m: FloatArray) -> FloatArray:
    """An offset in m, shape (n,), as every route sends it: at both ends it fades to zero."""
    n = offset_m.size
    inside = np.minimum(np.arange(n), np.arange(n)[::-1]) / max(1.0, _EDGE_FRAC * n)
    edge = np.clip(inside, 0.0, 1.0)
    return np.asarray(offset_m * edge * edge * (3.0 - 2.0 * edge))


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
    lead_in_m: FloatArray | None = None,
    may_run: Callable[[FloatArray], bool] | None = None,
) -> Learning:
    """Offset for one known motion by learning on the model; shape (n,) in m.

    The model runs it as a route does, ``faded`` at both ends. A model has no noise: once the slow
    part is learned, learning goes on in the band of measured runs. That is kept where the error
    falls by it. A still wider band gains nothing: with 80 Hz the same was left on the simulated
    card.

    Parameters
    ----------
    loop : callable
        Closed loop of the model.
    position_m : ndarray, shape (n,)
        The motion in m.
    period_s : float
        Servo period.
    limit_m : float
        Amplitude that the offset never passes.
    aim : Aim
        Which error is to be small.
    lead_in_m : ndarray or None
        Command before the motion, which carries no offset: friction and integrator begin the motion
        as it leaves them. None: relaxed, on the spot.
    may_run : callable or None
        Whether the machine may run the motion with an offset: cut off at ``limit_m``, one of the
        wider band has sharper bends. It is left where the machine may run that of the slow one.
    """
    head = np.zeros(0) if lead_in_m is None else lead_in_m
    commanded = np.concatenate([head, position_m])

    def run(offset: FloatArray) -> FloatArray:
        added = np.concatenate([np.zeros(head.size), faded(offset)])
        signals = loop(commanded, commanded + added, None)
        if aim is Aim.MECHANICAL:
            error = signals.table_position_m - signals.motor_position_m + added
        else:
            error = signals.table_position_m - commanded
        return np.asarray(error[head.size :])

    learned = partial(
        learn,
        run,
        position_m.size,
        period_s,
        limit_m=limit_m,
        rests=rests_of(position_m, period_s),
    )
    found = learned()
    if found.cutoff_Hz < LEARNING_CUTOFF_Hz:  # that band was too wide for this loop already
        return found
    wider = learned(start_m=found.correction_m, cutoff_Hz=MEASURED_CUTOFF_Hz)
    if min(wider.history_um) > (1.0 - _LEAST_GAIN_FRAC) * min(found.history_um):
        return found
    if may_run is not None and may_run(found.correction_m) and not may_run(wider.correction_m):
        return found
    return replace(wider, history_um=found.history_um + wider.history_um[1:])
