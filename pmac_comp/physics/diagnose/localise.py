"""Where the disagreement lives: the residual against the coordinates in which causes act.

What lives here: machine coordinates of a capture, binned means of a residual and their tests.
No model and no refit. May import ``files`` and ``statistics``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.base.units import MM_PER_M, UM_PER_M
from pmac_comp.physics.diagnose.statistics import corrected_p, effective_size

# Position, of a residual that changes its sign with the direction: what friction by place leaves.
TURNED = "position_by_direction"
COORDINATE_UNITS: Mapping[str, str] = MappingProxyType(
    {
        "position": "mm",
        TURNED: "mm",
        "screw_angle": "rev",
        "speed": "mm/s",
        "distance_since_reversal": "mm",
        "acceleration": "m/s2",
        "force": "N m",
        "time": "s",
        "direction": "",
        "frequency": "Hz",
    }
)
_BINS = 24
_MIN_PER_BIN = 12
# Ringing: bands of a sixth of an octave, two of them together, from a frequency that motions leave
# alone up to a share of the sampling rate; how much of a residual, and how many times its
# surroundings, in the median run.
_LOWEST_Hz, _HIGHEST_FRAC = 15.0, 0.4
_PER_OCTAVE, _WIDTH = 6, 2
_RINGS, _STANDS_OUT = 0.15, 5.0
_FEW_RUNS, _LEAST = 2, 256


@dataclass(frozen=True)
class Coordinates:
    """Machine coordinates of the samples of one capture.

    Parameters
    ----------
    values : Mapping[str, ndarray, shape (n,)]
        Coordinates by name in the units of ``COORDINATE_UNITS``.
    """

    values: Mapping[str, FloatArray]


@dataclass(frozen=True)
class Region:
    """A coordinate and the part of it in which the residual is largest.

    Parameters
    ----------
    channel : str
        ``table`` or ``motor``.
    coordinate, unit : str
        Name from ``COORDINATE_UNITS`` and its unit.
    low, high : float
        Edges of the region, in the unit.
    share : float
        Share of the residual's variance that the coordinate alone explains beyond chance.
    size_um : float
        Largest absolute bin mean, in um.
    p_value : float
        That such bin means come from correlated noise alone, corrected for the coordinates tried.
    centres, means_um : tuple of float
        The residual's shape along the coordinate.
    repeats : bool
        Whether ``low`` and ``high`` are the period of a pattern of position in um, or its
        frequency, and the shape is that over one period.
    rings : bool
        Whether the residual rings in a narrow band of frequency whatever the motion.
    """

    channel: str
    coordinate: str
    unit: str
    low: float
    high: float
    share: float
    size_um: float
    p_value: float
    centres: tuple[float, ...] = ()
    means_um: tuple[float, ...] = ()
    repeats: bool = False
    rings: bool = False

    def describe(self) -> str:
        """One phrase for a person."""
        unit = f" {self.unit}" if self.unit else ""
        if self.rings:
            return (
                f"{self.channel} residual rings between {self.low:.3g} and {self.high:.3g} Hz "
                f"in every run ({100 * self.share:.0f} % of its variance, amplitude "
                f"{self.size_um:.2f} um), as a spring and a mass do that the model lacks"
            )
        if self.repeats:
            where = "every" if self.coordinate == "position" else "at"
            what = " of position" if self.coordinate == "position" else ""
            return (
                f"{self.channel} residual repeats {where} {self.low:.4g}{unit}{what} "
                f"with an amplitude of {self.size_um:.2f} um ({100 * self.share:.0f} % of the "
                "variance that is faster than 2 ms)"
            )
        if self.coordinate == TURNED:
            return (
                f"{self.channel} residual turns over with the direction and differs by place "
                f"({100 * self.share:.0f} % of its variance), largest {self.size_um:.2f} um "
                f"between {self.low:.4g} and {self.high:.4g}{unit}, as where friction is not the "
                "same along the travel, or not in the runs that were made there"
            )
        return (
            f"{self.channel} residual follows {self.coordinate.replace('_', ' ')} "
            f"({100 * self.share:.0f} % of its variance), largest {self.size_um:.2f} um "
            f"between {self.low:.4g} and {self.high:.4g}{unit}"
        )


def machine_coordinates(
    time_s: FloatArray,
    position_m: FloatArray,
    torque_Nm: FloatArray | None,
    lead_m_per_rev: float,
) -> Coordinates:
    """Coordinates of a motion from its simulated (noise-free) motor position.

    Parameters
    ----------
    time_s, position_m : ndarray, shape (n,)
        Time and smooth motor position.
    torque_Nm : ndarray, shape (n,) or None
        Torque along the motion.
    lead_m_per_rev : float
        Travel per revolution.

    Returns
    -------
    Coordinates
        Everything of ``COORDINATE_UNITS`` but ``frequency`` and what is made of two of them.
    """
    velocity = np.gradient(position_m, time_s)
    acceleration = np.gradient(velocity, time_s)
    values = {
        "position": MM_PER_M * position_m,
        "screw_angle": np.mod(position_m / lead_m_per_rev, 1.0),
        "speed": MM_PER_M * velocity,
        "distance_since_reversal": MM_PER_M * distance_since_reversal_m(position_m),
        "acceleration": acceleration,
        "time": time_s - time_s[0],
        "direction": np.sign(np.where(np.abs(velocity) > 1e-5, velocity, 0.0)),
    }
    if torque_Nm is not None:
        values["force"] = torque_Nm
    return Coordinates(MappingProxyType(values))


def distance_since_reversal_m(position_m: FloatArray, *, dead_m: float = 2e-6) -> FloatArray:
    """Signed travel since the last reversal; positive when moving up, negative when down.

    Parameters
    ----------
    position_m : ndarray, shape (n,)
        Motor position.
    dead_m : float
        A turn smaller than this (encoder lattice, hunting) is not a reversal.

    Returns
    -------
    ndarray, shape (n,)
        Distance in m, zero until the first motion.
    """
    turns = reversal_indices(position_m, dead_m=dead_m)
    starts = np.concatenate(([0], turns))
    which = np.searchsorted(starts, np.arange(position_m.size), side="right") - 1
    return np.asarray(position_m - position_m[starts[which]])


def reversal_indices(position_m: FloatArray, *, dead_m: float = 2e-6) -> IntArray:
    """Sample numbers of turning points followed by more than ``dead_m`` of travel, shape (turns,).

    ``position_m`` has shape (n,).
    """
    turns: list[int] = []
    extreme, direction = 0, 0
    for i in np.flatnonzero(np.abs(np.diff(position_m, prepend=position_m[0])) > 0.0).tolist():
        travel = position_m[i] - position_m[extreme]
        if direction * travel > 0.0:
            extreme = i
        elif abs(travel) > dead_m:
            if direction != 0:
                turns.append(extreme)
            direction, extreme = (1 if travel > 0.0 else -1), i
    return np.asarray(turns, dtype=np.int64)


def localise(
    residual_m: Sequence[FloatArray],
    coordinates: Sequence[Coordinates],
    *,
    channel: str,
    sample_s: float,
) -> tuple[Region, ...]:
    """Coordinates in which a residual has a shape, strongest first.

    Parameters
    ----------
    residual_m : sequence of ndarray, shape (n_i,)
        Residual of each capture; NaN marks samples that may not be used.
    coordinates : sequence of Coordinates
        Of the same samples.
    channel : str
        Name of the channel for the answer.
    sample_s : float
        Sample period of the residual, for the frequency coordinate.

    Returns
    -------
    tuple of Region
        One per coordinate in which the bin means differ beyond chance.
    """
    joined = np.concatenate([r - np.nanmean(r) for r in residual_m])
    good = np.isfinite(joined)
    if np.count_nonzero(good) < 4 * _BINS:
        return ()
    names = [n for n in COORDINATE_UNITS if all(n in c.values for c in coordinates)]
    regions = []
    for name in names:
        along = np.concatenate([c.values[name] for c in coordinates])
        region = _bin_test(joined[good], along[good], name, channel, len(names) + 1)
        if region is not None:
            regions.append(region)
    turned = _turned_region(joined, coordinates, channel, len(names) + 1)
    if turned is not None:
        regions.append(turned)
    regions.append(_frequency_region(residual_m, channel, sample_s))
    kept = [r for r in regions if r.p_value < 0.01 and r.share > 0.02]
    # A band of frequency says least about a cause: it comes last. A narrow one that every run
    # shows is a cause.
    kept = sorted(kept, key=lambda r: (r.coordinate == "frequency", -r.share))
    ringing = _ringing(residual_m, channel, sample_s)
    return tuple(kept) if ringing is None else (ringing, *kept)


def _turned_region(
    residual_m: FloatArray, coordinates: Sequence[Coordinates], channel: str, tried: int
) -> Region | None:
    """What changes its sign with the direction, by place; what it does everywhere is direction's.

    ``residual_m`` has shape (n,), all captures one after the other.
    """
    if not all({"position", "direction"} <= c.values.keys() for c in coordinates):
        return None
    way, along = (
        np.concatenate([c.values[name] for c in coordinates]) for name in ("direction", "position")
    )
    good = np.isfinite(residual_m) & (way != 0.0)
    if np.count_nonzero(good) < 4 * _BINS:
        return None
    turned = (residual_m * way)[good]
    return _bin_test(turned - turned.mean(), along[good], TURNED, channel, tried)


def _bin_test(
    residual: FloatArray, along: FloatArray, name: str, channel: str, tried: int
) -> Region | None:
    """Variance of bin means against what the effective number of samples allows."""
    edges = np.unique(np.quantile(along, np.linspace(0.0, 1.0, _BINS + 1)))
    if edges.size < 3:
        return None
    index = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, edges.size - 2)
    counts = np.bincount(index, minlength=edges.size - 1)
    keep = counts >= _MIN_PER_BIN
    sums = np.bincount(index, weights=residual, minlength=edges.size - 1)
    means = np.where(keep, sums / np.maximum(counts, 1), 0.0)
    power = float(residual @ residual)
    if power <= 0.0 or np.count_nonzero(keep) < 2:
        return None
    explained = float((counts * means**2)[keep].sum())
    freedom = int(np.count_nonzero(keep)) - 1
    # What the coordinate leaves is the noise it is judged by, with its own memory: a coordinate
    # that explains everything leaves white noise, one that explains nothing leaves the colour.
    remainder = residual - np.where(keep, means, 0.0)[index]
    inflation = residual.size / effective_size(remainder)
    noise = max(float(remainder @ remainder) / residual.size, 1e-6 * power / residual.size)
    statistic = explained / noise / inflation
    p_value = corrected_p(float(chi2_distribution.sf(statistic, freedom)), tried)
    worst = int(np.argmax(np.abs(means)))
    chance = freedom * inflation * noise / power
    return Region(
        channel=channel,
        coordinate=name,
        unit=COORDINATE_UNITS[name],
        low=float(edges[worst]),
        high=float(edges[worst + 1]),
        share=float(np.clip(explained / power - chance, 0.0, 1.0)),
        size_um=UM_PER_M * float(abs(means[worst])),
        p_value=p_value,
        centres=tuple(float(c) for c in 0.5 * (edges[:-1] + edges[1:])),
        means_um=tuple(float(UM_PER_M * m) for m in means),
    )


def _frequency_region(residual_m: Sequence[FloatArray], channel: str, sample_s: float) -> Region:
    """The band that holds the most of the residual's power, an octave wide."""
    longest = max(residual_m, key=lambda r: r.size)
    clean = np.nan_to_num(longest - np.nanmean(longest))
    window = np.hanning(clean.size)
    power = np.abs(np.fft.rfft(clean * window)) ** 2
    frequency = np.fft.rfftfreq(clean.size, sample_s)
    total = float(power[1:].sum())
    edges = 0.25 * 2.0 ** np.arange(0, 14)
    sums = np.array(
        [power[(frequency >= a) & (frequency < 2 * a)].sum() for a in edges.tolist()]
    ) / max(total, 1e-300)
    peak = int(np.argmax(sums))
    return Region(
        channel=channel,
        coordinate="frequency",
        unit="Hz",
        low=float(edges[peak]),
        high=float(2 * edges[peak]),
        share=float(sums[peak]),
        size_um=UM_PER_M * float(np.sqrt(2.0 * sums[peak]) * clean.std()),
        p_value=0.0 if sums[peak] > 0.5 else 1.0,
        centres=tuple(float(e) for e in edges),
        means_um=tuple(float(UM_PER_M * np.sqrt(s) * clean.std()) for s in sums),
    )


def _ringing(residual_m: Sequence[FloatArray], channel: str, sample_s: float) -> Region | None:
    """A narrow band that stands out of every run's residual; None where there is none.

    What a motion leaves comes back with its own period, another one in every run.
    """
    count = int(np.log2(_HIGHEST_FRAC / sample_s / _LOWEST_Hz) * _PER_OCTAVE)
    edges = _LOWEST_Hz * 2.0 ** (np.arange(count + 1) / _PER_OCTAVE)
    clean = [np.nan_to_num(r - np.nanmean(r)) for r in residual_m]
    shares = np.array([_band_shares(c, edges, sample_s) for c in clean if c.size > _LEAST])
    if count < _WIDTH or shares.shape[0] < _FEW_RUNS:
        return None
    sums = np.stack([np.convolve(s, np.ones(_WIDTH), "valid") for s in shares])
    peak = int(np.argmax(np.median(sums, axis=0)))
    share = float(np.median(sums[:, peak]))
    near = slice(max(0, peak - _PER_OCTAVE), peak + _WIDTH + _PER_OCTAVE)
    around = np.delete(np.median(shares, axis=0)[near], np.arange(_WIDTH) + peak - near.start)
    stands_out = share > _STANDS_OUT * _WIDTH * float(np.median(around))
    if share < _RINGS or not stands_out or np.quantile(sums[:, peak], 0.25) < 0.5 * share:
        return None
    power = float(np.mean(np.concatenate(clean) ** 2))
    return Region(
        channel=channel,
        coordinate="frequency",
        unit="Hz",
        low=float(edges[peak]),
        high=float(edges[peak + _WIDTH]),
        share=share,
        size_um=UM_PER_M * float(np.sqrt(2.0 * share * power)),
        p_value=0.0,
        rings=True,
    )


def _band_shares(residual_m: FloatArray, edges_Hz: FloatArray, sample_s: float) -> FloatArray:
    """Share of a residual's power in each band."""
    lines = np.abs(np.fft.rfft(residual_m * np.hanning(residual_m.size))) ** 2
    frequency = np.fft.rfftfreq(residual_m.size, sample_s)
    index = np.searchsorted(edges_Hz, frequency, side="right")
    sums = np.bincount(index, weights=lines, minlength=edges_Hz.size + 1)
    return np.asarray(sums[1 : edges_Hz.size] / max(float(lines[1:].sum()), 1e-300))
