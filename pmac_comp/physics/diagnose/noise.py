"""The noise floor: what the gap would be with a perfect model.

What lives here: the effect of the sensors' steps in the simulated loop, and repeats in the data.
May import ``records`` and ``workbench``.
"""

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray, IntArray
from pmac_comp.physics.diagnose.records import Record
from pmac_comp.physics.diagnose.workbench import Workbench
from pmac_comp.physics.model.drive import DriveModel

_LARGEST_PERIOD_FRAC = 0.5
# Where the axis travels less than this in a block it is still; so many blocks tell its noise.
_STILL_m = 1e-6
_LEAST_STILL = 20
_FAR_MORE = 9.0


def noise_floor_um(bench: Workbench, model: DriveModel, *, calm: bool = False) -> float:
    """Rms of the last channel on judging samples that a perfect model would leave.

    The larger of two. One is what the sensors' steps do in the simulated loop, together with what
    the data shows beyond them at frequencies at which no drive moves. The other is how far the
    data itself differs between repeats of the same command. Neither can exceed what the model
    leaves, which contains it. ``calm`` leaves out where the sensors' rounding decides the motion.
    """
    judging = bench.calm_records if calm else bench.judging_records
    still_m2 = _still_power_m2(bench, model)
    parts = list(bench.executor.map(lambda r: _noise_parts_m(r, model, still_m2), judging))
    whole = bench.whole_records(calm=calm)
    total, count = 0.0, 0
    for record, complete, (steps, left) in zip(judging, whole, parts, strict=True):
        n = int(np.count_nonzero(record.valid))
        total += n * min(max(steps, repeatability_m(complete)), left) ** 2
        count += n
    return 1e6 * float(np.sqrt(total / max(count, 1)))


def _noise_parts_m(
    record: Record, model: DriveModel, still_m2: float | None
) -> tuple[float, float]:
    """Noise by sensors, and rms of all that the model leaves.

    Noise of a sensor is there at rest too; a pattern of the scale finer than what the axis travels
    in a block is not, and must not pass for noise because it is fast.
    """
    smooth = record.channels_of(record.response(model))[:, -1]
    stepped = record.channels_of(record.response(model, quantise=True))[:, -1]
    left = record.measured_m[:, -1] - smooth
    steps = float(np.std((stepped - smooth)[record.valid]))
    seen = _white_power(record, left, record.usable)
    if still_m2 is not None and seen > _FAR_MORE * still_m2:
        seen = still_m2
    extra = seen - _white_power(record, stepped - smooth, record.usable)
    return float(np.sqrt(steps**2 + max(0.0, extra))), float(np.std(left[record.valid]))


def _still_power_m2(bench: Workbench, model: DriveModel) -> float | None:
    """White power where the axis hardly moves, at least that of the scale's step; None if never."""
    powers, count = 0.0, 0
    for record in bench.records:
        blocks = record.usable.size
        shape = (blocks, record.factor)
        travel = np.ptp(record.desired_m[: blocks * record.factor].reshape(shape), axis=1)
        still = record.usable & (travel < _STILL_m)
        if record.factor < 2 or not still.any():
            continue
        smooth = record.channels_of(record.response(model))[:, -1]
        here = int(np.count_nonzero(still))
        powers += here * _white_power(record, record.measured_m[:, -1] - smooth, still)
        count += here
    if count < _LEAST_STILL:
        return None
    description = model.bench
    step_m = description.scale_resolution_m if bench.channels > 1 else None
    return powers / count + (step_m or description.motor_resolution_m) ** 2 / 12.0


def _white_power(record: Record, values: FloatArray, chosen: BoolArray) -> float:
    """Power in m2 of white noise that has the same power within the chosen blocks."""
    if record.factor < 2 or not chosen.any():
        return 0.0
    blocks = values[: chosen.size * record.factor].reshape(chosen.size, record.factor)
    return float(blocks[chosen].var(axis=1, ddof=1).mean())


def repeatability_m(record: Record) -> float:
    """Rms difference between repeats of the command over root two; 0 where nothing repeats."""
    lag = period_samples(record.desired_m)
    if lag == 0:
        return 0.0
    error = record.measured_m[:, -1] - record.desired_m
    same = np.abs(record.desired_m[lag:] - record.desired_m[:-lag]) < 1e-8
    good = same & record.valid[lag:] & record.valid[:-lag]
    if np.count_nonzero(good) < lag // 2:
        return 0.0
    return float(np.std((error[lag:] - error[:-lag])[good]) / np.sqrt(2.0))


def period_samples(command_m: FloatArray) -> int:
    """Samples after which a command repeats to 10 nm over half its motion, 0 if it does not.

    Source
    ------
    Difference function of de Cheveigne and Kawahara (2002), by FFT; each minimum is verified.
    """
    n = command_m.size
    centred = command_m - command_m.mean()
    length = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(centred, length)
    product = np.fft.irfft(spectrum * spectrum.conj(), length)[:n]
    energy = np.concatenate(([0.0], np.cumsum(centred**2)))
    lags = np.arange(n)
    squares = energy[n - lags] + energy[n] - energy[lags] - 2.0 * product
    difference = squares / np.arange(n, 0, -1)
    inner = difference[1:-1]
    minima: IntArray = 1 + np.flatnonzero((inner < difference[:-2]) & (inner <= difference[2:]))
    small = minima[difference[minima] < 0.2 * float(centred.var())]
    for lag in small[small <= _LARGEST_PERIOD_FRAC * n].tolist():
        moving = np.abs(np.diff(command_m))[: n - lag] > 0.0
        same = np.abs(command_m[lag:] - command_m[:-lag])[: moving.size] < 1e-8
        if np.count_nonzero(same & moving) > 0.5 * np.count_nonzero(moving):
            return int(lag)
    return 0
