"""Report of an identification: parameters with intervals, what the model leaves and where."""

from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp import __version__
from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import MM_PER_M, UM_PER_M
from pmac_comp.files.capture import Capture
from pmac_comp.report import figures
from pmac_comp.report.page import Page, Section, Table, write_page
from pmac_comp.workflow.model.identification import IdentificationOutcome

_MOST_CAPTURES = 8
_FIGURES = {
    "rounds": "rounds of refinement",
    "last_step_std": "last step, in standard deviations of the parameters",
    "held_out_coulomb_um": "left on held-out stretches with Coulomb friction, um rms",
    "held_out_lugre_um": "left on held-out stretches with LuGre friction, um rms",
    "held_out_gms_um": "left on held-out stretches with GMS friction, um rms",
    "held_out_turning_stribeck_um": "left on held-out stretches with Stribeck friction at nut and "
    "motor, um rms",
    "held_out_onset_um": "left on held-out stretches with a fitted onset of friction, um rms",
    "relative_force_error_percent": "relative error of the force, %",
    "closed_loop_position_rms_um": "motor position from the command alone, um rms",
    "closed_loop_position_peak_um": "motor position from the command alone, um at most",
    "closed_loop_force_error_percent": "force from the command alone, relative error %",
}


def write_identification_report(outcome: IdentificationOutcome, path: Path) -> Path:
    """Report of an identification as one page."""
    found = outcome.identification
    headline = [
        (f"{value:.3g} {unit}", f"left in {what}, rms") for what, value, unit in outcome.left()
    ]
    sections = [
        Section(
            "Parameters",
            text=[f"Method: {found.method}", *found.statements],
            tables=[
                Table(
                    ("parameter", "value", "unit", "std", "lower 95 %", "upper 95 %", "bench file"),
                    outcome.rows(),
                ),
                Table(
                    ("of the fit", "value"),
                    [(_FIGURES.get(key, key), value) for key, value in found.figures.items()],
                ),
            ],
        ),
        _correlations(outcome),
        *_residual_sections(outcome),
    ]
    page = Page(
        title="Identification",
        subtitle=f"{outcome.bench.name} – {len(outcome.captures)} capture(s), effects "
        f"{', '.join(outcome.model_file.effects) or 'base'}",
        notice=_notice(outcome.captures),
        headline=headline,
        sections=sections,
        facts={
            "pmac-comp": __version__,
            "bench digest": outcome.bench.digest,
            **{d.name: d.sha256 or "in memory" for d in outcome.model_file.data},
        },
    )
    return write_page(page, path)


def _notice(captures: tuple[Capture, ...]) -> str:
    sources = sorted({str(c.attributes.get("source", "not stated")) for c in captures})
    return "Source of the captures: " + "; ".join(sources) + "."


def _correlations(outcome: IdentificationOutcome) -> Section:
    stored = outcome.model_file.correlation
    pairs = [
        (a, b, stored.matrix[i][j])
        for i, a in enumerate(stored.names)
        for j, b in enumerate(stored.names[:i])
    ]
    strongest = sorted(pairs, key=lambda pair: -abs(pair[2]))[:12]
    return Section(
        "Strongest correlations",
        tables=[Table(("parameter", "with", "correlation"), strongest)],
        open=False,
    )


def _residual_sections(outcome: IdentificationOutcome) -> list[Section]:
    sections = []
    pairs = list(zip(outcome.captures, outcome.identification.residuals, strict=False))
    for i, (capture, left) in enumerate(pairs[:_MOST_CAPTURES]):
        channels = [
            (name, np.asarray(values) * factor, unit)
            for name, values, factor, unit in (
                ("motor", left.motor_m, UM_PER_M, "um"),
                ("table - motor", left.table_m, UM_PER_M, "um"),
                ("torque", left.torque_Nm, 1.0, "N m"),
            )
            if values is not None
        ]
        name = str(capture.attributes.get("motion", f"capture {i + 1}"))
        time_s = capture.time_s[: channels[0][1].size] if channels else capture.time_s
        images = _overlay(capture, left.table_m)
        images += [
            (figures.residual_figure(time_s, channels, name), "Measured minus simulated over time.")
        ]
        images += _where(capture, channels)
        sections.append(Section(f"What the model leaves: {name}", figures=images, open=i < 3))
    return sections


def _overlay(capture: Capture, left_m: FloatArray | None) -> list[tuple[str, str]]:
    """What the drive did and what the model makes of the same command; nothing without a scale."""
    table = capture.table_position_m
    if table is None or left_m is None or np.size(left_m) != capture.n:
        return []
    measured = (table - capture.motor_position_m) * UM_PER_M
    image = figures.overlay_figure(
        capture.time_s, measured, measured - np.asarray(left_m) * UM_PER_M
    )
    return [(image, "Table minus motor, measured and simulated, means taken out.")]


def _where(capture: Capture, channels: list[tuple[str, FloatArray, str]]) -> list[tuple[str, str]]:
    """Residual of the last channel against speed and position: where it lives."""
    name, values, unit = channels[-1] if channels else ("", np.zeros(0), "")
    if values.size != capture.n:
        return []
    good = np.isfinite(values)
    speed = np.gradient(capture.commanded_position_m, capture.time_s) * MM_PER_M
    coordinates: list[tuple[FloatArray, str]] = [
        (speed, "commanded speed (mm/s)"),
        (capture.commanded_position_m * MM_PER_M, "commanded position (mm)"),
    ]
    out: list[tuple[str, Any]] = []
    for coordinate, label in coordinates:
        if np.ptp(coordinate[good]) > 0.0:
            image = figures.scatter_figure(
                coordinate[good], values[good], label, f"{name} residual ({unit})"
            )
            out.append(
                (image, f"Where the {name} residual lives along the {label.split(' (')[0]}.")
            )
    return out
