"""What is left after growth: noise, or something without a name.

What lives here: the noise floor and the test of the remainder against flexible rivals. May import
the rest of this package below ``diagnose``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.diagnose.growth import Grown
from pmac_comp.physics.diagnose.localise import Region, localise
from pmac_comp.physics.diagnose.records import Record, gap
from pmac_comp.physics.diagnose.statistics import corrected_p, sign_flip_p
from pmac_comp.physics.model.drive import DriveModel, simulate

_UNEXPLAINED = 0.10  # of the noise variance per sample, earned by flexible rivals on both parts
_TOLD = 0.05  # of the variance that the grown model removed: the form is right to this
_EXCESS = 0.8  # of the noise floor: what the flexible rivals may have missed
_LARGEST_PERIOD_FRAC = 0.5


@dataclass(frozen=True)
class Remainder:
    """What the grown model leaves.

    Parameters
    ----------
    unexplained : bool
        Whether something material is left.
    fit_share, judged_share : float
        Drop of chi-square per sample that flexible rivals earn.
    p_value : float
        That the judged share comes from chance.
    noise_floor_um : float
        Rms that a perfect model would leave on the judging samples.
    excess_um : float
        Gap beyond the noise floor, root of the difference of squares.
    regions : tuple of Region
        Where the remainder lives.
    """

    unexplained: bool
    fit_share: float
    judged_share: float
    p_value: float
    noise_floor_um: float
    excess_um: float
    regions: tuple[Region, ...]

    @property
    def visible(self) -> bool:
        """Whether the remainder is worth describing."""
        return self.unexplained or self.excess_um > 0.5 * self.noise_floor_um


def remainder_of(grown: Grown, bench: Bench) -> Remainder:
    """Judge what the last round left against flexible rivals and against the noise floor."""
    last = grown.rounds[-1]
    rivals = last.screening
    fit_gain, _ = rivals.flexible_gains()
    fit_share = fit_gain / max(last.rows_fit, 1.0)
    floor_um = noise_floor_um(grown)
    gap_um = _rms_um(grown, grown.final.model)
    excess_um = float(np.sqrt(max(0.0, gap_um**2 - floor_um**2)))
    drop = rivals.gram.block_chi2(rivals.base) - rivals.gram.block_chi2(rivals.flexible)
    p_value = corrected_p(sign_flip_p(drop, seed=1), 1)
    removed = float((grown.base.blocks - grown.final.blocks).sum()) / float(
        last.rows_fit + last.rows_judge
    )
    material = max(_UNEXPLAINED, _TOLD * removed)
    by_rivals = fit_share > material and p_value < 0.01
    base_um = _rms_um(grown, grown.base.model)
    worth = max(_EXCESS * floor_um, 0.25 * float(np.sqrt(max(0.0, base_um**2 - floor_um**2))))
    return Remainder(
        unexplained=bool(by_rivals or excess_um > worth),
        fit_share=fit_share,
        judged_share=excess_um / max(floor_um, 1e-12),
        p_value=p_value,
        noise_floor_um=floor_um,
        excess_um=excess_um,
        regions=_regions(grown, bench),
    )


def noise_floor_um(grown: Grown) -> float:
    """Rms of the last channel on judging samples that a perfect model would leave.

    The larger of two: what the sensors' steps do in the simulated loop, and how far the data
    itself differs between repeats of the same command.
    """
    judging = grown.bench.judging_records
    model = grown.final.model
    simulated = list(grown.bench.executor.map(lambda r: _sensor_noise_m(r, model), judging))
    whole = [
        r for r, m in zip(grown.bench.records, grown.bench.fitting, strict=True) if not m.all()
    ]
    total, count = 0.0, 0
    for record, complete, sensor in zip(judging, whole, simulated, strict=True):
        n = int(np.count_nonzero(record.valid))
        repeat = repeatability_m(complete)
        total += n * max(sensor, repeat) ** 2
        count += n
    return 1e6 * float(np.sqrt(total / max(count, 1)))


def _sensor_noise_m(record: Record, model: DriveModel) -> float:
    smooth = record.channels_of(record.response(model))[:, -1]
    stepped = record.channels_of(
        simulate(model, record.commanded_m, desired_position_m=record.desired_m, quantise=True)
    )[:, -1]
    return float(np.std((stepped - smooth)[record.valid]))


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


def _rms_um(grown: Grown, model: DriveModel) -> float:
    return gap(grown.bench.judging_records, model, grown.bench.executor).position_um


def _regions(grown: Grown, bench: Bench) -> tuple[Region, ...]:
    workbench = grown.bench
    residuals: Sequence[FloatArray] = workbench.residuals(grown.final.simulated)
    coordinates = [
        r.coordinates(r.response(grown.final.model), bench.pitch_m) for r in workbench.records
    ]
    marked = [
        np.where(r.usable, d[:, -1], np.nan)
        for r, d in zip(workbench.records, residuals, strict=True)
    ]
    channel = "table" if workbench.channels > 1 else "motor"
    period = workbench.records[0].coarse_period_s
    return localise(marked, coordinates, channel=channel, sample_s=period)
