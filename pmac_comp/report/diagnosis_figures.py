"""Figures of a diagnosis: where the residual lives before and after, candidates, growth path."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.diagnose.localise import COORDINATE_UNITS, TURNED
from pmac_comp.physics.diagnose.result import Evidence, Growth, Trace
from pmac_comp.report.figures import AFTER, BEFORE, PROMISE, svg, thin_pair

_BINS = 40
_LEAST_PER_BIN = 8
_VOID = 0.2  # of the range: a line across would show what nobody measured
_SHOWN = (0.5, 99.5)  # percentiles: a start transient must not set the scale of the rest
_LONGEST = 5.0  # times the middle one, or the longest upwards
_COLOURS = {"chosen": AFTER, "tied": PROMISE, "lost": "#b9b9b2"}


def coordinate_figure(traces: Sequence[Trace], coordinate: str) -> str | None:
    """Residual on judging captures against a coordinate, base and grown model side by side.

    Dots are samples, the line is the mean in bins of equal count; None where no capture has the
    coordinate. What turns over with the direction is drawn as it is on the way up.
    """
    along = "position" if coordinate == TURNED else coordinate
    parts = [t for t in traces if along in t.coordinates]
    if not parts:
        return None
    x = np.concatenate([t.coordinates[along] for t in parts])
    before = np.concatenate([t.before_um for t in parts])
    after = np.concatenate([t.after_um for t in parts])
    if coordinate == TURNED:
        way = np.concatenate([t.coordinates["direction"] for t in parts])
        x, before, after = (values[way != 0.0] for values in (x, before * way, after * way))
    good = np.isfinite(x) & np.isfinite(before) & np.isfinite(after)
    if np.count_nonzero(good) < 2 * _LEAST_PER_BIN or np.ptp(x[good]) == 0.0:
        return None
    x, before, after = x[good], before[good], after[good]
    label = _axis_label(coordinate)

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, 2, sharey=True)
        for axis, values, colour, title in (
            (panels[0], before, BEFORE, "base model"),
            (panels[1], after, AFTER, "grown model"),
        ):
            step = max(1, x.size // 4000)
            axis.plot(x[::step], values[::step], ".", color="#c4cad2", ms=1.6, rasterized=True)
            axis.plot(*_binned(x, values), "-", color=colour, lw=1.5)
            axis.axhline(0.0, color="#77776f", lw=0.6)
            axis.set_title(title, fontsize=8.5, loc="left")
            axis.set_xlabel(label)
        panels[0].set_ylabel("measured - simulated, um")
        _limit(panels[0], [before, after])

    return svg(draw, 7.2, 2.6)


def _axis_label(coordinate: str) -> str:
    unit = COORDINATE_UNITS.get(coordinate, "")
    words = coordinate.replace("_", " ")
    if coordinate == TURNED:
        words = "position (the way down turned over)"
    return f"{words}, {unit}" if unit else words


def _binned(x: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means in bins of equal count, so that reversals are as well resolved as long strokes."""
    distinct = np.unique(x)
    if distinct.size <= _BINS:
        return distinct, np.array([values[x == at].mean() for at in distinct])
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, _BINS + 1)))
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, edges.size - 2)
    count = np.bincount(index, minlength=edges.size - 1)
    full = count >= _LEAST_PER_BIN
    safe = np.maximum(count, 1)
    centres = np.bincount(index, x, edges.size - 1) / safe
    means = np.bincount(index, values, edges.size - 1) / safe
    return _broken(centres[full], means[full])


def _broken(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The curve with a break wherever no sample lies for a good part of the range."""
    wide = np.flatnonzero(np.diff(x) > _VOID * np.ptp(x)) + 1
    return np.insert(x, wide, np.nan), np.insert(y, wide, np.nan)


def _limit(axis: Axes, curves: Sequence[FloatArray]) -> None:
    """Limits that hold all but a few samples, and say so where some lie outside."""
    values = np.concatenate(curves)
    low, high = np.percentile(values, _SHOWN)
    room = 0.25 * max(high - low, 1e-3)
    axis.set_ylim(low - room, high + room)
    outside = int(np.count_nonzero((values < low - room) | (values > high + room)))
    if outside:
        largest = float(np.max(np.abs(values)))
        axis.text(
            0.995,
            0.02,
            f"{outside} samples outside, up to {largest:.3g} um",
            transform=axis.transAxes,
            ha="right",
            va="bottom",
            fontsize=7,
            color="#77776f",
        )


def trace_figure(trace: Trace) -> str:
    """Residual of one capture over time with the base and with the grown model."""

    def draw(figure: Figure) -> None:
        axis = figure.subplots()
        for values, colour, word in (
            (trace.before_um, BEFORE, "base model"),
            (trace.after_um, AFTER, "grown model"),
        ):
            axis.plot(
                *thin_pair(trace.time_s, np.nan_to_num(values)), color=colour, lw=0.7, label=word
            )
        _limit(axis, [trace.before_um, trace.after_um])
        axis.set_xlabel("time, s")
        axis.set_ylabel("measured -\nsimulated, um")
        figure.legend(loc="outside upper right", ncols=2)

    return svg(draw, 7.2, 2.3)


def spectrum_figure(traces: Sequence[Trace]) -> str | None:
    """Amplitude spectral density of the residual, base and grown model."""
    from scipy.signal import welch

    usable = [t for t in traces if t.time_s.size > 64]
    if not usable:
        return None
    period = float(np.median(np.diff(usable[0].time_s)))
    size = min(1024, *(t.time_s.size for t in usable))

    def density(name: str) -> tuple[FloatArray, FloatArray]:
        found = [welch(np.nan_to_num(getattr(t, name)), 1.0 / period, nperseg=size) for t in usable]
        return found[0][0], np.sqrt(np.mean([f[1] for f in found], axis=0))

    def draw(figure: Figure) -> None:
        axis = figure.subplots()
        for name, colour, word in (
            ("before_um", BEFORE, "base model"),
            ("after_um", AFTER, "grown model"),
        ):
            frequency, values = density(name)
            axis.loglog(frequency[1:], values[1:], color=colour, lw=1.0, label=word)
        axis.set_xlabel("frequency, Hz")
        axis.set_ylabel("um / sqrt(Hz)")
        axis.legend()

    return svg(draw, 7.2, 2.3)


def candidates_figure(evidence: Sequence[Evidence]) -> str | None:
    """Held-out gain of every candidate that was refitted, round by round."""
    rounds = sorted({e.round for e in evidence if e.status != "screened"})
    groups = [[e for e in evidence if e.round == n and e.status != "screened"] for n in rounds]
    if not groups:
        return None

    def draw(figure: Figure) -> None:
        heights = [len(group) for group in groups]
        panels = np.atleast_1d(figure.subplots(len(groups), 1, height_ratios=heights))
        for axis, number, group in zip(panels, rounds, groups, strict=True):
            _candidate_bars(axis, group, f"round {number}")
        panels[-1].set_xlabel("held-out gain: drop of the whitened sum of squares per 1000 samples")

    return svg(draw, 7.2, 0.6 + sum(0.45 + 0.24 * len(group) for group in groups))


def _candidate_bars(axis: Axes, group: Sequence[Evidence], title: str) -> None:
    place = np.arange(len(group))
    gains = [e.heldout_gain if np.isfinite(e.heldout_gain) else 0.0 for e in group]
    colours = [_COLOURS[e.status] for e in group]
    lowest = _lowest_shown(gains)
    bars = axis.barh(place, [max(gain, lowest) for gain in gains], 0.62, color=colours)
    words = [
        f"{e.status}, p {_p_text(e.p_value)}" + f", gain {gain:.2g}" * (gain < lowest)
        for e, gain in zip(group, gains, strict=True)
    ]
    axis.bar_label(bars, words, padding=4, fontsize=7.5)
    axis.axvline(0.0, color="#77776f", lw=0.6)
    axis.set_yticks(place, [e.name for e in group])
    axis.invert_yaxis()
    axis.margins(x=0.28)
    axis.set_title(title, fontsize=8.5, loc="left")
    axis.grid(visible=False, axis="y")
    axis.set_axisbelow(True)


def _lowest_shown(gains: Sequence[float]) -> float:
    """Where bars end downwards: a refit that ran away would leave nothing of the others."""
    sizes = sorted(abs(gain) for gain in gains)
    return -_LONGEST * max(sizes[(len(sizes) - 1) // 2], *gains, 0.0)


def _p_text(p_value: float) -> str:
    return "< 1e-6" if p_value < 1e-6 else f"{p_value:.2g}"


def growth_figure(path: Sequence[Growth], noise_floor_um: float) -> str:
    """Gap on judging captures as effects are added, with the noise floor."""
    names = ["base", *(f"+ {' + '.join(step.added)}" for step in path[1:])]

    def draw(figure: Figure) -> None:
        axis = figure.subplots()
        place = np.arange(len(path))
        colours = [BEFORE, *([AFTER] * (len(path) - 1))]
        bars = axis.barh(place, [step.gap_um for step in path], 0.55, color=colours)
        axis.bar_label(bars, fmt="%.3g um", padding=4, fontsize=7.5)
        axis.axvline(noise_floor_um, color=PROMISE, ls="--", lw=1.2, label="noise floor")
        axis.set_yticks(place, names)
        axis.invert_yaxis()
        axis.margins(x=0.15)
        axis.set_xlabel("gap on captures not used for fitting, um rms")
        axis.grid(visible=False, axis="y")
        axis.set_axisbelow(True)
        figure.legend(loc="outside upper right")

    return svg(draw, 7.2, 1.0 + 0.36 * len(path))
