"""Patterns faster than the coarse grid: what its block means average away.

What lives here: waves of position and of time in the residual within coarse samples. No decisions.
May import ``records``, ``localise`` and ``workbench``.

A scale's signal period is crossed within one coarse sample at speed, and a chatter swings within
it: neither the candidates' ranking nor flexible rivals see them. White noise puts the same power
at every wave; a pattern puts its own at one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.physics.diagnose.localise import Region
from pmac_comp.physics.diagnose.records import Record
from pmac_comp.physics.diagnose.workbench import Workbench
from pmac_comp.physics.model.drive import DriveModel

# Positions are known to the model's error: no wave shorter than a few of these steps is resolved.
_STEP_m = 0.5e-6
_SHORTEST_m, _LONGEST_m = 2e-6, 2e-3
_MOST_STEPS = 1 << 21
_BINS = 24
_LEAST = 500


@dataclass(frozen=True)
class FinePattern:
    """The strongest wave within coarse samples.

    Parameters
    ----------
    region : Region
        Its coordinate, period or frequency, size and shape.
    rms_um : float
        Rms of what of it lies within coarse samples.
    p_value : float
        That white noise shows such a wave, corrected for the waves tried.
    """

    region: Region
    rms_um: float
    p_value: float


@dataclass(frozen=True)
class _Fast:
    """Residual less its mean within each coarse sample, where it was taken, and in which."""

    position_m: FloatArray
    index: IntArray
    block: IntArray
    left_m: FloatArray


@dataclass(frozen=True)
class _Wave:
    """A wave of the residual: per unit of its coordinate, mean square, chance, samples' phases."""

    per_unit: float
    mean_square_m2: float
    p_value: float
    phase_rev: FloatArray
    fast: _Fast


def fine_pattern(workbench: Workbench, model: DriveModel) -> FinePattern | None:
    """The strongest wave of the judging runs within coarse samples.

    Parameters
    ----------
    workbench : Workbench
        Records; those that judge are looked at.
    model : DriveModel
        What is subtracted, and where the axis is.

    Returns
    -------
    FinePattern or None
        None where the samples are as coarse as the coarse grid, or too few.
    """
    records = [r for r in workbench.judging_records if r.factor > 1]
    parts = list(workbench.executor.map(lambda r: _fast(r, model), records))
    count = sum(part.left_m.size for part in parts)
    power = sum(float(part.left_m @ part.left_m) for part in parts)
    if count < _LEAST or power <= 0.0:
        return None
    tones = [_tone(record, part) for record, part in zip(records, parts, strict=True)]
    waves = [_position_wave(_joined(parts)), *tones]
    powers = [wave.mean_square_m2 * wave.fast.left_m.size / count for wave in waves]
    best = int(np.argmax(powers))
    channel = "table" if workbench.channels > 1 else "motor"
    region = _region(waves[best], channel, "frequency" if best else "position")
    return FinePattern(region, UM_PER_M * float(np.sqrt(powers[best])), waves[best].p_value)


def _fast(record: Record, model: DriveModel) -> _Fast:
    simulated = record.channels_of(record.response(model))[:, -1]
    left = record.measured_m[:, -1] - simulated
    index: IntArray = np.flatnonzero(np.repeat(record.usable, record.factor))
    block = np.repeat(np.arange(index.size // record.factor), record.factor)
    return _Fast(simulated[index], index, block, _within(left[index], block))


def _within(values: FloatArray, block: IntArray) -> FloatArray:
    """Values less their mean within each block."""
    means = np.bincount(block, weights=values) / np.maximum(np.bincount(block), 1)
    return np.asarray(values - means[block])


def _joined(parts: Sequence[_Fast]) -> _Fast:
    """All runs as one, blocks kept apart."""
    starts = np.cumsum([0, *(int(part.block.max(initial=-1)) + 1 for part in parts)])
    return _Fast(
        np.concatenate([part.position_m for part in parts]),
        np.concatenate([part.index for part in parts]),
        np.concatenate([p.block + s for p, s in zip(parts, starts[:-1], strict=True)]),
        np.concatenate([part.left_m for part in parts]),
    )


def _position_wave(fast: _Fast) -> _Wave:
    """Strongest wave along the axis, the same over all runs, phase included."""
    origin = float(fast.position_m.min())
    span = float(fast.position_m.max()) - origin
    step_m = max(_STEP_m, span / _MOST_STEPS)
    place = np.round((fast.position_m - origin) / step_m).astype(np.int64)
    # Four times the travel keeps the transform's grid finer than a wave is wide.
    length = 1 << (4 * int(place.max()) + 1).bit_length()
    spectrum = np.fft.rfft(np.bincount(place, weights=fast.left_m, minlength=length))
    per_m = np.arange(spectrum.size) / (length * step_m)
    tried = np.flatnonzero((per_m >= 1.0 / _LONGEST_m) & (per_m <= 1.0 / _SHORTEST_m))
    top = int(tried[np.argmax(np.abs(spectrum[tried]))]) if tried.size else 0
    return _wave(float(per_m[top]), complex(spectrum[top]), tried.size, fast.position_m, fast)


def _tone(record: Record, fast: _Fast) -> _Wave:
    """Strongest wave over the time of one run."""
    series = np.zeros(4 * record.valid.size)
    series[fast.index] = fast.left_m
    spectrum = np.fft.rfft(series)
    per_s = np.fft.rfftfreq(series.size, record.period_s)
    top = int(np.argmax(np.abs(spectrum)))
    time_s = (record.period_s * fast.index).astype(np.float64)
    return _wave(float(per_s[top]), complex(spectrum[top]), per_s.size, time_s, fast)


def _wave(per_unit: float, amplitude: complex, tried: int, along: FloatArray, fast: _Fast) -> _Wave:
    square = abs(amplitude) ** 2
    relative = square / max(float(fast.left_m @ fast.left_m), 1e-300)
    # Over white noise, the relative power is distributed as exp(-x).
    p_value = min(1.0, tried * float(np.exp(-min(relative, 700.0))))
    mean_square = 2.0 * square / max(fast.left_m.size, 1) ** 2
    return _Wave(per_unit, mean_square, p_value, np.mod(along * per_unit, 1.0), fast)


def _region(wave: _Wave, channel: str, coordinate: str) -> Region:
    """The wave at its own size, which is more than what is left of it within coarse samples."""
    fast = wave.fast
    turns = 2.0 * np.pi * wave.phase_rev
    both = [_within(np.cos(turns), fast.block), _within(np.sin(turns), fast.block)]
    size_m, *_ = np.linalg.lstsq(np.column_stack(both), fast.left_m, rcond=None)
    explained = float(np.sum((both[0] * size_m[0] + both[1] * size_m[1]) ** 2))
    of_position = coordinate == "position"
    period = (UM_PER_M if of_position else 1.0) / max(wave.per_unit, 1e-300)
    shown = period if of_position else wave.per_unit
    along = (np.arange(_BINS) + 0.5) / _BINS
    shape = UM_PER_M * (
        size_m[0] * np.cos(2.0 * np.pi * along) + size_m[1] * np.sin(2.0 * np.pi * along)
    )
    return Region(
        channel=channel,
        coordinate=coordinate,
        unit="um" if of_position else "Hz",
        low=shown,
        high=shown,
        share=min(1.0, explained / float(fast.left_m @ fast.left_m)),
        size_um=UM_PER_M * float(np.hypot(*size_m)),
        p_value=wave.p_value,
        centres=tuple((period * along).tolist()),
        means_um=tuple(shape.tolist()),
        repeats=True,
    )
