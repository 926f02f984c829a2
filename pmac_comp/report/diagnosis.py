"""Report of a diagnosis: verdict, where the residual lives, evidence, growth path."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pmac_comp import __version__
from pmac_comp.physics.diagnose import Diagnosis
from pmac_comp.physics.diagnose.result import Evidence
from pmac_comp.physics.diagnose.words import names_in_words
from pmac_comp.report import diagnosis_figures as figures
from pmac_comp.report.page import Page, Section, Table, write_page
from pmac_comp.workflow.model.diagnosis import DiagnosisOutcome

_TITLES = {
    "named": "Missing physics named",
    "none": "Nothing is missing",
    "unknown": "Something is missing that has no name here",
    "tie": "Look-alikes that these runs cannot separate",
}
_PARTLY = "A part of what is missing has a name, a part has none"
_MOST_COORDINATES = 4
_MOST_TRACES = 6
_LEAST_SHARE = 0.02
_LEAST_P = 1e-12


def write_diagnosis_report(outcome: DiagnosisOutcome, path: Path) -> Path:
    """Report of a diagnosis as one page."""
    d = outcome.diagnosis
    sections = [
        _words(outcome),
        *_separation(outcome),
        _where(d),
        _evidence(d),
        _growth(d),
        _traces(d),
    ]
    page = Page(
        title=_PARTLY if d.verdict == "unknown" and d.named else _TITLES[d.verdict],
        subtitle=names_in_words(d.named, d.tied) or "no effect named",
        notice=f"{outcome.provenance} Gaps are measured minus simulated on captures that were not "
        "used for fitting; the simulation runs closed loop from the commanded trajectory alone.",
        headline=_headline(d),
        sections=sections,
        facts={
            "pmac-comp": __version__,
            "bench": outcome.bench.name,
            "bench digest": outcome.bench.digest,
        },
    )
    return write_page(page, path)


def _headline(d: Diagnosis) -> list[tuple[str, str]]:
    shown = [
        (d.verdict, "verdict"),
        (f"{d.gap_before_um:.3g} → {d.gap_after_um:.3g} um", f"gap, {d.gap_channel}, rms"),
        (f"{d.noise_floor_um:.3g} um", "noise floor"),
    ]
    if d.torque_gap_before_Nm is not None and d.torque_gap_after_Nm is not None:
        text = f"{d.torque_gap_before_Nm:.3g} → {d.torque_gap_after_Nm:.3g} N m"
        shown.append((text, "torque gap, rms"))
    return shown


def _words(outcome: DiagnosisOutcome) -> Section:
    d = outcome.diagnosis
    rows = [(e.name, e.value, e.unit, e.std, e.lower95, e.upper95) for e in d.estimates]
    columns = ("parameter", "value", "unit", "std", "lower 95 %", "upper 95 %")
    tables = [Table(columns, rows)] if rows else []
    return Section("What was found", points=[*d.statements, *outcome.findings()], tables=tables)


def _separation(outcome: DiagnosisOutcome) -> list[Section]:
    """What would tell look-alikes apart, with commands that can be pasted."""
    d = outcome.diagnosis
    experiment = d.separating_experiment
    if experiment is None:
        return []
    title = "The run that would separate " + " and ".join(experiment.effects)
    if d.verdict != "tie":
        title = "The run that would tell most"
    return [Section(title, text=[experiment.text, *outcome.commands()])]


def _where(d: Diagnosis) -> Section:
    """Residual against the coordinates in which it lives, base and grown model."""
    chosen = [r for r in d.where if r.channel == d.gap_channel and r.share >= _LEAST_SHARE]
    shapes = []
    for region in chosen[:_MOST_COORDINATES]:
        image = figures.coordinate_figure(d.traces, region.coordinate)
        if image is not None:
            shapes.append((image, f"Base model, all captures: {region.describe()}."))
    spectrum = figures.spectrum_figure(d.traces)
    if spectrum is not None:
        shapes.append((spectrum, "Residual over frequency, captures not used for fitting."))
    left = [f"Left after growth: {r.describe()}." for r in d.residual] or [
        "What is left after growth follows no coordinate of the motion."
    ]
    return Section("Where simulation and measurement disagree", text=left, figures=shapes)


def _evidence(d: Diagnosis) -> Section:
    refitted = [e for e in d.evidence if e.status != "screened"]
    rows = [
        (
            e.name,
            e.round,
            e.status,
            *map(_finite, (e.heldout_gain, e.bic_gain)),
            _p_value(e.p_value),
            e.gap_um,
        )
        for e in refitted
    ]
    columns = ("candidate", "round", "status", "held-out gain", "BIC gain", "p", "gap um")
    image = figures.candidates_figure(d.evidence)
    tables = [Table(columns, rows, "Candidates that got a full refit")] if rows else []
    return Section(
        "Candidates and their evidence",
        text=[
            "Every candidate is refitted jointly with the parameters it could hide behind. The "
            "p-value is that of a block sign-flip test, corrected for the number of candidates; "
            "half the BIC gain is the logarithm of the Bayes factor, near enough."
        ],
        tables=[*tables, *_screened(d.evidence)],
        figures=[] if image is None else [(image, "Candidates that got a full refit.")],
    )


def _screened(evidence: Sequence[Evidence]) -> list[Table]:
    """Candidates that a linearised refit ruled out, one row per round."""
    rows = []
    for number in sorted({e.round for e in evidence}):
        names = [e.name for e in evidence if e.round == number and e.status == "screened"]
        if names:
            rows.append((f"round {number}", ", ".join(names)))
    caption = "To these a linearised joint refit gave too little to be refitted in full"
    return [Table(("round", "candidates"), rows, caption, in_words=True)] if rows else []


def _p_value(value: float) -> float | str | None:
    """A p-value; below what the test's blocks can tell, only that."""
    return f"< {_LEAST_P:g}" if value < _LEAST_P else _finite(value)


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _growth(d: Diagnosis) -> Section:
    path = [(" + ".join(g.added) or "base", g.gap_um, g.torque_gap_Nm) for g in d.path]
    image = figures.growth_figure(d.path, d.noise_floor_um)
    return Section(
        "Growth path",
        tables=[Table(("added", "gap um", "torque gap N m"), path)],
        figures=[(image, "Gap after every step, each model refitted.")],
    )


def _traces(d: Diagnosis) -> Section:
    images = [
        (figures.trace_figure(t), f"{t.name}: residual over time.") for t in d.traces[:_MOST_TRACES]
    ]
    return Section("Residuals on captures not used for fitting", figures=images)
