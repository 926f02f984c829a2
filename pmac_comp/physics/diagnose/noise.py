"""The noise floor: what the gap would be with a perfect model.

What lives here: the effect of the sensors' steps in the simulated loop, and repeats in the data.
May import ``records`` and ``workbench``.
"""

from itertools import pairwise

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray, IntArray, stretches
from pmac_comp.base.units import UM_PER_M
from pmac_comp.physics.diagnose.records import Record
from pmac_comp.physics.diagnose.workbench import Workbench
from pmac_comp.physics.model.drive import DriveModel

_LARGEST_PERIOD_FRAC = 0.5
# Where the axis travels less than this in a block it is still; so many blocks tell its noise.
_STILL_m = 1e-6
_LEAST_STILL = 20
_FAR_MORE = 9.0
_SAME_m = 1e-8  # within which a command is the same again
_LEAST_REPEATED = 512
_REFINEMENTS = 5
_MOST_LAGS = 24
_BANDS = 16
_LOWEST_LINE = 3


def noise_floor_um(
    workbench: Workbench, model: DriveModel, *, calm: bool = False, ambient_m2: float = 0.0
) -> float:
    """Rms of the last channel on judging samples that a perfect model would leave.

    The larger of two. One is what the sensors' steps do in the simulated loop, together with what
    the data shows beyond them at frequencies at which no drive moves, and with ``ambient_m2``,
    what pushes the axis in every run. The other is how far the data itself differs between repeats
    of the same command. Neither can exceed what the model leaves, which contains it. ``calm``
    leaves out where the sensors' rounding decides the motion.
    """
    judging = workbench.calm_records if calm else workbench.judging_records
    still_m2 = _still_power_m2(workbench, model)
    parts = list(workbench.executor.map(lambda r: _noise_parts_m(r, model, still_m2), judging))
    whole = workbench.whole_records(calm=calm)
    total, count = 0.0, 0
    for record, complete, (steps, left) in zip(judging, whole, parts, strict=True):
        n = int(np.count_nonzero(record.valid))
        known = float(np.sqrt(steps**2 + ambient_m2))
        total += n * min(max(known, repeatability_m(complete)), left) ** 2
        count += n
    return UM_PER_M * float(np.sqrt(total / max(count, 1)))


def ambient_m2(workbench: Workbench, model: DriveModel) -> float:
    """Power in m2 that repeats of a command differ by beyond what the sensors' steps explain.

    Vibration and uneven friction push the axis whatever it does: runs that repeat tell of those
    that do not. Power of single frequencies, and what drifts, is an effect and no noise: of each
    band the median of its lines counts.
    """
    records = [
        r.masked(r.valid & np.resize(np.repeat(c, r.factor), r.valid.size))
        for r, c in zip(workbench.records, workbench.counted, strict=True)
    ]
    still_m2 = _still_power_m2(workbench, model)

    def work(record: Record) -> tuple[float, int]:
        seen = repeats_m(record, record.measured_m[:, -1])
        if seen.size < _LEAST_REPEATED:
            return 0.0, 0
        smooth, stepped = _both(record, model)
        # Part of what rounding does comes back with the motion: it is foreseen in the same way.
        foreseen = 0.5 * broadband_power(repeats_m(record, stepped))
        foreseen += _beyond_steps_m2(record, smooth, stepped, still_m2)
        return 0.5 * broadband_power(seen) - foreseen, seen.size

    found = list(workbench.executor.map(work, records))
    count = sum(n for _, n in found)
    return max(0.0, sum(power * n for power, n in found) / max(count, 1))


def repeats_m(record: Record, reading_m: FloatArray) -> FloatArray:
    """Differences of reading less command between repeats of the command in m, shape (k,), no gaps.

    A period need not be a whole number of samples: of the lags at which the command comes back, the
    one nearest to a whole number is taken, and what was measured is interpolated there.
    """
    lag = fractional_period(record.desired_m)
    if lag == 0.0:
        return np.zeros(0)
    error = reading_m - record.desired_m
    later = _later(error, lag)
    here, there = slice(1, 1 + later.size), slice(-1 - later.size, -1)
    same = np.abs(_later(record.desired_m, lag) - record.desired_m[here]) < _SAME_m
    same &= record.valid[here] & record.valid[there]
    difference = later - error[here]
    return np.asarray(difference[_longest(same)])


def fractional_period(command_m: FloatArray) -> float:
    """Samples after which a command, shape (n,), repeats; 0 if it does not.

    Of several such lags the one nearest to a whole number.
    """
    best, least = 0.0, np.inf
    small = _minima(_difference(command_m), 0.2 * float(command_m.var()))
    for lag in small[small <= _LARGEST_PERIOD_FRAC * command_m.size][:_MOST_LAGS].tolist():
        exact = _refined(command_m, float(lag))
        away = abs(exact - round(exact))
        if away >= least or abs(exact - lag) > 1.0:
            continue
        again = _later(command_m, exact)
        moving = np.abs(np.diff(command_m))[1 : 1 + again.size] > 0.0
        same = np.abs(again - command_m[1 : 1 + again.size]) < _SAME_m
        if np.count_nonzero(same & moving) > 0.5 * np.count_nonzero(moving):
            best, least = exact, away
    return best


def _refined(command_m: FloatArray, lag: float) -> float:
    """The lag moved to where the better half of the samples comes back most exactly."""
    speed = np.gradient(command_m)
    for _ in range(_REFINEMENTS):
        if not 1.0 <= lag <= command_m.size - 4.0:
            return lag
        again = _later(command_m, lag)
        missed = again - command_m[1 : 1 + again.size]
        better = np.abs(missed) <= np.median(np.abs(missed))
        rate = _later(speed, lag)[better]
        lag -= float(rate @ missed[better] / max(float(rate @ rate), 1e-300))
    return lag


def broadband_power(series: FloatArray) -> float:
    """Power of a series, shape (n,), in the square of its unit.

    Its lowest lines and what stands out of each band are left out.
    """
    window = np.hanning(series.size)
    lines = np.abs(np.fft.rfft((series - series.mean()) * window)) ** 2
    lines *= 2.0 / (series.size * float(np.sum(window**2)))
    edges = np.unique(np.geomspace(_LOWEST_LINE, lines.size, _BANDS + 1).astype(int))
    bands = [lines[a:b] for a, b in pairwise(edges.tolist())]
    return float(sum(np.median(b) / np.log(2.0) * b.size for b in bands))


def _cubic(share: float) -> FloatArray:
    """Weights of four samples for the value between the second and the third (Lagrange)."""
    s = share
    return np.array(
        [
            -s * (s - 1.0) * (s - 2.0) / 6.0,
            (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0,
            -(s + 1.0) * s * (s - 2.0) / 2.0,
            (s + 1.0) * s * (s - 1.0) / 6.0,
        ]
    )


def _later(values: FloatArray, lag: float) -> FloatArray:
    """Values so many samples later, from the second sample on."""
    whole = int(np.floor(lag))
    n = values.size - whole - 3
    weights = _cubic(lag - whole)
    return np.asarray(sum(w * values[whole + k : whole + k + n] for k, w in enumerate(weights)))


def _longest(chosen: BoolArray) -> slice:
    """The longest stretch of chosen samples."""
    return max(stretches(chosen), key=lambda s: s.stop - s.start, default=slice(0, 0))


def _noise_parts_m(
    record: Record, model: DriveModel, still_m2: float | None
) -> tuple[float, float]:
    """Noise by sensors, and rms of all that the model leaves.

    Noise of a sensor is there at rest too; a pattern of the scale finer than what the axis travels
    in a block is not, and must not pass for noise because it is fast.
    """
    smooth, stepped = _both(record, model)
    left = record.measured_m[:, -1] - smooth
    steps = float(np.std((stepped - smooth)[record.valid]))
    extra = _beyond_steps_m2(record, smooth, stepped, still_m2)
    return float(np.sqrt(steps**2 + extra)), float(np.std(left[record.valid]))


def _both(record: Record, model: DriveModel) -> tuple[FloatArray, FloatArray]:
    """Last channel of the simulation without and with the sensors' steps."""
    smooth = record.channels_of(record.response(model))[:, -1]
    return smooth, record.channels_of(record.response(model, quantise=True))[:, -1]


def _beyond_steps_m2(
    record: Record, smooth: FloatArray, stepped: FloatArray, still_m2: float | None
) -> float:
    """White power of a reading beyond that of the steps, no more than it has at rest."""
    seen = _white_power(record, record.measured_m[:, -1] - smooth, record.usable)
    if still_m2 is not None and seen > _FAR_MORE * still_m2:
        seen = still_m2
    return max(0.0, seen - _white_power(record, stepped - smooth, record.usable))


def _still_power_m2(workbench: Workbench, model: DriveModel) -> float | None:
    """White power where the axis hardly moves, at least that of the scale's step; None if never."""
    powers, count = 0.0, 0
    for record in workbench.records:
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
    step_m = description.scale_resolution_m if workbench.channels > 1 else None
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
    """Samples after which a command, shape (n,), repeats to 10 nm over half its motion, else 0.

    Source
    ------
    Difference function of de Cheveigne and Kawahara (2002), by FFT; each minimum is verified.
    """
    n = command_m.size
    small = _minima(_difference(command_m), 0.2 * float(command_m.var()))
    for lag in small[small <= _LARGEST_PERIOD_FRAC * n].tolist():
        moving = np.abs(np.diff(command_m))[: n - lag] > 0.0
        same = np.abs(command_m[lag:] - command_m[:-lag])[: moving.size] < _SAME_m
        if np.count_nonzero(same & moving) > 0.5 * np.count_nonzero(moving):
            return int(lag)
    return 0


def _difference(command_m: FloatArray) -> FloatArray:
    """Mean square difference of a command to itself at every lag."""
    n = command_m.size
    centred = command_m - command_m.mean()
    length = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(centred, length)
    product = np.fft.irfft(spectrum * spectrum.conj(), length)[:n]
    energy = np.concatenate(([0.0], np.cumsum(centred**2)))
    lags = np.arange(n)
    squares = energy[n - lags] + energy[n] - energy[lags] - 2.0 * product
    return np.asarray(squares / np.arange(n, 0, -1))


def _minima(difference: FloatArray, limit: float) -> IntArray:
    """Lags at which the difference is least, and below a limit."""
    inner = difference[1:-1]
    minima: IntArray = 1 + np.flatnonzero((inner < difference[:-2]) & (inner <= difference[2:]))
    return minima[difference[minima] < limit]
