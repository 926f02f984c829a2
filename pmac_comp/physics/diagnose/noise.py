"""The noise floor: what the gap would be with a perfect model.

What lives here: the effect of the sensors' steps in the simulated loop, and repeats in the data.
May import ``records`` and ``workbench``.
"""

import numpy as np

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.physics.diagnose.records import Record
from pmac_comp.physics.diagnose.workbench import Workbench
from pmac_comp.physics.model.drive import DriveModel

_LARGEST_PERIOD_FRAC = 0.5


def noise_floor_um(bench: Workbench, model: DriveModel) -> float:
    """Rms of the last channel on judging samples that a perfect model would leave.

    The larger of two. One is what the sensors' steps do in the simulated loop, together with what
    the data shows beyond them at frequencies at which no drive moves. The other is how far the
    data itself differs between repeats of the same command. Neither can exceed what the model
    leaves, which contains it.
    """
    judging = bench.judging_records
    parts = list(bench.executor.map(lambda r: _noise_parts_m(r, model), judging))
    whole = [r for r, m in zip(bench.records, bench.fitting, strict=True) if not m.all()]
    total, count = 0.0, 0
    for record, complete, (steps, left) in zip(judging, whole, parts, strict=True):
        n = int(np.count_nonzero(record.valid))
        total += n * min(max(steps, repeatability_m(complete)), left) ** 2
        count += n
    return 1e6 * float(np.sqrt(total / max(count, 1)))


def _noise_parts_m(record: Record, model: DriveModel) -> tuple[float, float]:
    """Noise by sensors, and rms of all that the model leaves."""
    smooth = record.channels_of(record.response(model))[:, -1]
    stepped = record.channels_of(record.response(model, quantise=True))[:, -1]
    left = record.measured_m[:, -1] - smooth
    steps = float(np.std((stepped - smooth)[record.valid]))
    extra = _white_power(record, left) - _white_power(record, stepped - smooth)
    return float(np.sqrt(steps**2 + max(0.0, extra))), float(np.std(left[record.valid]))


def _white_power(record: Record, values: FloatArray) -> float:
    """Power in m2 of white noise that has the same power within blocks."""
    if record.factor < 2:
        return 0.0
    count = values.size // record.factor
    good = record.usable
    blocks = values[: count * record.factor].reshape(count, record.factor)[good]
    return float(blocks.var(axis=1, ddof=1).mean()) if blocks.size else 0.0


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
