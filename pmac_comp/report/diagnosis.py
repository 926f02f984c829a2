"""Report of a diagnosis: verdict, evidence, where the residual lives, growth path."""

from pathlib import Path

import numpy as np

from pmac_comp import __version__
from pmac_comp.report import figures
from pmac_comp.report.page import Page, Section, Table, write_page
from pmac_comp.workflow.diagnosis import DiagnosisOutcome


def write_diagnosis_report(outcome: DiagnosisOutcome, path: Path) -> Path:
    """Report of a diagnosis as one page."""
    d = outcome.diagnosis
    title = {"named": "Missing physics named", "none": "Nothing is missing",
             "unknown": "Something is missing that has no name here",
             "tie": "Look-alikes that these runs cannot separate"}[d.verdict]  # fmt: skip
    page = Page(
        title=title,
        subtitle=", ".join(d.named) or "no effect named",
        notice="Gaps are measured minus simulated on captures that were not used for fitting; the "
        "simulation runs closed loop from the commanded trajectory alone.",
        headline=[
            (f"{d.gap_before_um:.3f} → {d.gap_after_um:.3f} um", f"gap, {d.gap_channel}, rms"),
            (f"{d.noise_floor_um:.3f} um", "noise floor"),
            (d.verdict, "verdict"),
        ],
        sections=[
            _words(outcome),
            _evidence(outcome),
            _where(outcome),
            _traces(outcome),
        ],
        facts={"pmac-comp": __version__, "bench digest": outcome.bench.digest},
    )
    return write_page(page, path)


def _words(outcome: DiagnosisOutcome) -> Section:
    d = outcome.diagnosis
    rows = [(e.name, e.value, e.unit, e.std, e.lower95, e.upper95) for e in d.estimates]
    tables = []
    if rows:
        tables.append(
            Table(("parameter", "value", "unit", "std", "lower 95 %", "upper 95 %"), rows)
        )
    if d.path:
        path = [(" + ".join(g.added) or "base", g.gap_um, g.torque_gap_Nm) for g in d.path]
        tables.append(Table(("added", "gap um", "torque gap N m"), path, "Growth path"))
    text = [*d.statements, *(f.text for f in d.findings)]
    if d.separating_experiment is not None:
        text.append(f"To separate look-alikes: {d.separating_experiment.text}")
    return Section("What was found", text=text, tables=tables)


def _evidence(outcome: DiagnosisOutcome) -> Section:
    rows = [
        (e.round, e.name, e.status, e.heldout_gain, e.bic_gain, e.p_value, e.gap_um)
        for e in outcome.diagnosis.evidence
    ]
    columns = ("round", "candidate", "status", "held-out gain", "BIC gain", "p", "gap um")
    return Section(
        "Candidates and their evidence",
        text=["Held-out gain: drop of the whitened sum of squares per thousand samples."],
        tables=[Table(columns, [tuple(_finite(v) for v in row) for row in rows])],
    )


def _finite(value: object) -> object:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _where(outcome: DiagnosisOutcome) -> Section:
    d = outcome.diagnosis
    shapes = [
        (
            figures.region_figure(
                np.array(r.centres), np.array(r.means_um), f"{r.coordinate} {r.unit}"
            ),
            r.describe(),
        )
        for r in d.where[:4]
        if r.centres
    ]
    left = [f"Left after growth: {r.describe()}" for r in d.residual] or [
        "What is left after growth is noise."
    ]
    return Section("Where the base model disagrees", text=left, figures=shapes)


def _traces(outcome: DiagnosisOutcome) -> Section:
    images = [
        (
            figures.pair_figure(t.time_s, t.before_um, t.after_um),
            f"{t.name}: measured minus simulated, base and grown model.",
        )
        for t in outcome.diagnosis.traces[:6]
    ]
    return Section("Residuals on captures not used for fitting", figures=images)
