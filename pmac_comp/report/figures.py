"""Figures as SVG text or files, one look for all; what they show is computed elsewhere."""

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

import numpy as np  # isort: skip

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import MM_PER_M, UM_PER_M
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.workflow.accuracy.outcome import ErrorSignals
from pmac_comp.workflow.accuracy.ringing import ringing_signal
from pmac_comp.workflow.accuracy.static_check import StaticOutcome
from pmac_comp.workflow.controller.difference import Curve
from pmac_comp.workflow.motion.motions import short_motion

BEFORE, AFTER, PROMISE = "#b3452c", "#1f6f5c", "#3b5b92"
_MOST_POINTS = 3000
_STYLE: Mapping[str, Any] = {
    "font.size": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e3e3e0",
    "grid.linewidth": 0.6,
    "axes.edgecolor": "#77776f",
    "svg.fonttype": "none",
    "legend.frameon": False,
}


def svg(draw: Callable[[Figure], None], width_in: float, height_in: float) -> str:
    """SVG element of a figure, ready to stand in a page."""
    with mpl.rc_context(dict(_STYLE)):
        figure = plt.figure(figsize=(width_in, height_in), layout="constrained")
        try:
            draw(figure)
            buffer = io.StringIO()
            figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": "pmac-comp"})
        finally:
            plt.close(figure)
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def thin(values: FloatArray) -> FloatArray:
    """Fewer points for a curve: minimum and maximum of each stretch, so that no peak is lost."""
    if values.size <= _MOST_POINTS:
        return values
    parts = np.array_split(values, _MOST_POINTS // 2)
    return np.concatenate([[part.min(), part.max()] for part in parts])


def thin_pair(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Curve with fewer points that keeps every peak."""
    if y.size <= _MOST_POINTS:
        return x, y
    parts = np.array_split(np.arange(y.size), _MOST_POINTS // 2)
    keep = np.concatenate([sorted((p[np.argmin(y[p])], p[np.argmax(y[p])])) for p in parts])
    return x[keep], y[keep]


def error_traces(before: ErrorSignals, after: ErrorSignals, position_m: FloatArray) -> str:
    """Mechanical, control and total error of one motion, before and after."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots(4, 1, sharex=True, height_ratios=[0.7, 1.0, 1.0, 1.0])
        axes[0].plot(*thin_pair(after.time_s, position_m * MM_PER_M), color="#55554f", lw=0.9)
        axes[0].set_ylabel("command\n(mm)")
        names = ("mechanical_m", "control_m", "total_m")
        labels = ("mechanical\n(um)", "control\n(um)", "total\n(um)")
        for axis, name, label in zip(axes[1:], names, labels, strict=True):
            for signals, colour, word in ((before, BEFORE, "before"), (after, AFTER, "after")):
                curve = thin_pair(signals.time_s, getattr(signals, name) * UM_PER_M)
                axis.plot(*curve, color=colour, lw=0.8, label=word)
            axis.set_ylabel(label)
        figure.legend(*axes[1].get_legend_handles_labels(), loc="outside upper right", ncols=2)
        axes[-1].set_xlabel("time (s)")

    return svg(draw, 7.2, 5.0)


def spectra(before: ErrorSignals, after: ErrorSignals) -> str:
    """Amplitude spectral density of mechanical and total error, before and after."""
    from scipy.signal import welch

    def draw(figure: Figure) -> None:
        axes = figure.subplots(1, 2, sharey=True)
        for axis, name, title in zip(
            axes, ("mechanical_m", "total_m"), ("mechanical error", "total error"), strict=True
        ):
            for signals, colour, word in ((before, BEFORE, "before"), (after, AFTER, "after")):
                values = getattr(signals, name) * UM_PER_M
                rate = 1.0 / (signals.time_s[1] - signals.time_s[0])
                size = min(values.size, 2048)
                frequency, density = welch(values, rate, nperseg=size)
                axis.loglog(frequency[1:], np.sqrt(density[1:]), color=colour, lw=0.9, label=word)
            axis.set_title(title, fontsize=8.5)
            axis.set_xlabel("frequency (Hz)")
        axes[0].set_ylabel("um / sqrt(Hz)")
        axes[0].legend()

    return svg(draw, 7.2, 2.4)


def lead_figure(lead: LeadMap, table: Callable[[FloatArray], FloatArray] | None) -> str:
    """Lead-error map in both directions, what the table leaves of its mean, and their difference.

    ``table`` gives what the table adds at positions in m, None without one.
    """
    up = (lead.error_m + 0.5 * lead.reversal_m) * UM_PER_M
    down = (lead.error_m - 0.5 * lead.reversal_m) * UM_PER_M

    def draw(figure: Figure) -> None:
        heights = [1.3, 1.0] if table is None else [1.3, 0.8, 0.8]
        top, *others = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
        x = lead.position_m * MM_PER_M
        top.plot(x, up, color=BEFORE, lw=0.9, label="upwards")
        top.plot(x, down, color=PROMISE, lw=0.9, ls="--", label="downwards")
        top.set_ylabel("lead error (um)")
        if table is not None:
            left = (lead.error_m + table(lead.position_m)) * UM_PER_M
            others[0].plot(x, left, color=AFTER, lw=0.8)
            others[0].set_ylabel("mean, with\nthe table (um)")
        others[-1].plot(x, up - down, color="#55554f", lw=0.8)
        others[-1].set_ylabel("upwards -\ndownwards (um)")
        others[-1].set_xlabel("table position (mm)")
        figure.legend(*top.get_legend_handles_labels(), loc="outside upper right", ncols=2)

    return svg(draw, 7.2, 4.4)


def learning_figure(left_um: Sequence[float], learnable_um: Sequence[float]) -> str:
    """Error that is left pass by pass, all of it and the part that can be learned, um rms."""

    def draw(figure: Figure) -> None:
        axis = figure.subplots()
        passes = np.arange(len(left_um))
        axis.semilogy(passes, left_um, "o-", color=AFTER, lw=1.0, ms=4, label="total error")
        axis.semilogy(passes, learnable_um, "s--", color=PROMISE, lw=1.0, ms=4,
                      label="its part that can be learned")  # fmt: skip
        axis.set_xticks(passes)
        axis.set_xlabel("pass (0: what learning began from)")
        axis.set_ylabel("um rms")
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("{x:g}")
        axis.legend()

    return svg(draw, 7.2, 2.8)


def summary_marks(
    rows: Sequence[tuple[str, float, float, float | None]], floor_um: float, what: str
) -> str:
    """Error before and after per motion with the promise as a mark.

    ``floor_um`` is what the sensors' own steps make of every one of them; ``what``: which error.
    """

    def draw(figure: Figure) -> None:
        axis: Axes = figure.subplots()
        place = np.arange(len(rows))
        before, after = (np.array([row[k] for row in rows]) for k in (1, 2))
        axis.hlines(place, after, before, color=BEFORE, lw=1.0, alpha=0.4)
        axis.plot(before, place, "o", color=BEFORE, ms=6, label="before")
        axis.plot(after, place, "o", color=AFTER, ms=6, label="after")
        marked = [(p, r[3]) for p, r in zip(place, rows, strict=True) if r[3] is not None]
        if marked:
            axis.plot(
                [m[1] for m in marked],
                [m[0] for m in marked],
                "|",
                color=PROMISE,
                ms=18,
                mew=2,
                label="promised by the model",
            )
        if floor_um > 0.0:
            axis.axvline(floor_um, color="#23231f", ls=":", lw=1.2, label="sensors' steps alone")
        axis.set_xscale("log")  # what is left is a hundredth of what was there
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.set_yticks(place, [fill(short_motion(r[0]), 30) for r in rows])
        axis.set_ylim(len(rows) - 0.5, -0.5)
        axis.set_xlabel(f"{what} error (um rms)")
        figure.legend(loc="outside upper right", ncols=4, markerscale=0.6)

    return svg(draw, 7.2, 1.1 + 0.42 * len(rows))


def ranking(groups: Sequence[tuple[str, Sequence[tuple[str, float]]]]) -> str:
    """Bars of what is left in um rms, one panel per group (title, rows of name and value)."""

    def draw(figure: Figure) -> None:
        heights = [max(len(rows), 1) for _, rows in groups]
        panels = np.atleast_1d(figure.subplots(len(groups), 1, height_ratios=heights))
        for axis, (title, rows) in zip(panels, groups, strict=True):
            place = np.arange(len(rows))
            bars = axis.barh(place, [row[1] for row in rows], 0.6, color=PROMISE)
            axis.bar_label(bars, fmt="%.3g", padding=3)
            axis.set_yticks(place, [row[0] for row in rows])
            axis.invert_yaxis()
            axis.margins(x=0.12)
            axis.set_title(title, fontsize=8.5, loc="left")
            axis.set_xlabel("um rms")
            axis.grid(visible=False, axis="y")

    return svg(draw, 7.6, 1.0 + sum(0.6 + 0.28 * len(rows) for _, rows in groups))


def residual_figure(
    time_s: FloatArray, channels: Sequence[tuple[str, FloatArray, str]], title: str
) -> str:
    """Residuals of one capture over time, channel by channel (name, values, unit)."""

    def draw(figure: Figure) -> None:
        axes = np.atleast_1d(figure.subplots(len(channels), 1, sharex=True))
        for axis, (name, values, unit) in zip(axes, channels, strict=True):
            axis.plot(*thin_pair(time_s, np.nan_to_num(values)), color=PROMISE, lw=0.7)
            axis.set_ylabel(f"{name}\n({unit})")
        axes[0].set_title(title, fontsize=8.5, loc="left")
        axes[-1].set_xlabel("time (s)")

    return svg(draw, 7.2, 0.7 + 1.1 * len(channels))


def overlay_figure(time_s: FloatArray, measured: FloatArray, simulated: FloatArray) -> str:
    """Table minus motor in um, measured and simulated by the model, means taken out."""

    def draw(figure: Figure) -> None:
        axis = figure.subplots()
        for values, colour, word in (
            (measured, BEFORE, "measured"),
            (simulated, AFTER, "simulated"),
        ):
            centred = np.nan_to_num(values - np.nanmean(values))
            axis.plot(*thin_pair(time_s, centred), color=colour, lw=0.8, label=word)
        axis.set_ylabel("table - motor (um)")
        axis.set_xlabel("time (s)")
        figure.legend(*axis.get_legend_handles_labels(), loc="outside upper right", ncols=2)

    return svg(draw, 7.2, 2.4)


def scatter_figure(x: FloatArray, y: FloatArray, xlabel: str, ylabel: str, title: str = "") -> str:
    """Where a residual lives: values against a coordinate with their running mean."""

    def draw(figure: Figure) -> None:
        axis = figure.subplots()
        step = max(1, x.size // 4000)
        axis.plot(x[::step], y[::step], ".", color="#9aa7b8", ms=1.5, rasterized=True)
        edges = np.linspace(x.min(), x.max(), 61)
        index = np.clip(np.digitize(x, edges) - 1, 0, 59)
        count = np.bincount(index, minlength=60)
        mean = np.bincount(index, y, 60) / np.maximum(count, 1)
        centre = 0.5 * (edges[1:] + edges[:-1])
        good = count > 5
        axis.plot(centre[good], mean[good], color=BEFORE, lw=1.4, label="mean")
        axis.set_xlabel(xlabel)
        axis.set_ylabel(ylabel)
        axis.set_title(title, fontsize=8.5, loc="left")

    return svg(draw, 7.2, 2.4)


def save_difference_plot(curves: Sequence[Curve], path: Path) -> None:
    """Old against new, one panel per curve, as SVG or PNG by the suffix."""
    with mpl.rc_context(dict(_STYLE)):
        size = (7.2, 0.8 + 2.0 * max(1, len(curves)))
        figure = plt.figure(figsize=size, layout="constrained")
        panels = np.atleast_1d(figure.subplots(max(1, len(curves)), 1))
        for axis, curve in zip(panels, curves, strict=False):
            axis.plot(*thin_pair(curve.along, curve.old), color=BEFORE, label="on the controller")
            axis.plot(*thin_pair(curve.along, curve.new), color=AFTER, label="new")
            what = "table position" if curve.along_unit == "mm" else "time"
            axis.set_xlabel(f"{what} ({curve.along_unit})")
            axis.set_ylabel(f"({curve.unit})")
            axis.set_title(curve.name, fontsize=8.5, loc="left")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
        figure.savefig(path)
        plt.close(figure)


def static_figure(static: StaticOutcome) -> str:
    """Deviations at the targets, before and after, from both directions, each on its own scale."""

    def draw(figure: Figure) -> None:
        panels = np.atleast_1d(figure.subplots(1, len(static.sides)))
        for axis, (name, side) in zip(panels, static.sides, strict=True):
            middle = float(np.mean([side.up_m, side.down_m]))
            x = side.target_m * MM_PER_M
            ways = (
                (side.up_m, "^", BEFORE, "-", "upwards"),
                (side.down_m, "v", PROMISE, "--", "downwards"),
            )
            for values, mark, colour, line, word in ways:
                runs = (values - middle) * UM_PER_M
                mean, double = runs.mean(axis=0), 2.0 * runs.std(axis=0, ddof=1)
                axis.errorbar(x, mean, double, color=colour, ls=line, lw=1.0, capsize=2.5,
                              label=word)  # fmt: skip
                for run in runs:
                    axis.plot(x, run, mark, color=colour, ms=2.6, alpha=0.5)
            axis.set_title(name, fontsize=8.5, loc="left")
            axis.set_xlabel("target (mm)")
        panels[0].set_ylabel("deviation (um)")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)

    return svg(draw, 7.2, 3.0)


def ringing_figure(before: Capture, after: Capture, lowest_Hz: float) -> str:
    """What rings of the total error, before and after, over the command."""

    def draw(figure: Figure) -> None:
        top, low = figure.subplots(2, 1, sharex=True, height_ratios=[0.6, 1.0])
        speed = np.gradient(before.commanded_position_m, before.sample_period_s) * MM_PER_M
        top.plot(*thin_pair(before.time_s, speed), color="#55554f", lw=0.9)
        top.set_ylabel("speed\n(mm/s)")
        for capture, colour, word in ((before, BEFORE, "before"), (after, AFTER, "after")):
            signal = ringing_signal(capture, lowest_Hz) * UM_PER_M
            low.plot(*thin_pair(capture.time_s, signal), color=colour, lw=0.7, label=word)
        low.set_ylabel("ringing (um)")
        low.set_xlabel("time (s)")
        figure.legend(*low.get_legend_handles_labels(), loc="outside upper right", ncols=2)

    return svg(draw, 7.2, 3.2)
