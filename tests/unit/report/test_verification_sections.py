"""Sections of a verification: what is measured, in which units, and what nobody measured."""

from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.exact import Learning
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.report import figures
from pmac_comp.report.page import Section
from pmac_comp.report.verification import headline, verification_sections
from pmac_comp.workflow.accuracy.outcome import MotionOutcome, Ratio, outcome_of
from pmac_comp.workflow.verification.learning import Refinement
from pmac_comp.workflow.verification.result import Verification

N, PERIOD_s = 3000, 1e-3


@pytest.fixture(autouse=True)
def _without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("summary_marks", "error_traces", "spectra", "lead_figure", "learning_figure"):
        monkeypatch.setattr(figures, name, lambda *_: "<svg></svg>")


def run(error_um: float) -> Capture:
    time_s = PERIOD_s * np.arange(N)
    r = 0.01 * np.sin(2 * np.pi * time_s)
    swing = 1e-6 * np.sqrt(2.0) * error_um * np.sin(2 * np.pi * 3.0 * time_s)
    return Capture(time_s, r, r, table_position_m=r + swing)


def outcome(promise: dict[str, float] | None = None) -> MotionOutcome:
    return outcome_of("sine", [run(5.0)] * 2, [run(0.5)] * 2, promise=promise)


PROMISE = {
    "e_before_um": 5.0, "e_r_after_um": 0.4, "e_r_after_lower_um": 0.3, "e_r_after_upper_um": 0.45,
    "e_c_before_um": 0.0, "e_c_after_um": 0.0, "total_before_um": 5.0, "total_after_um": 0.4,
    "total_after_lower_um": 0.3, "total_after_upper_um": 0.6,
}  # fmt: skip


def shown(**parts: object) -> dict[str, Section]:
    ratio = Ratio(0.1, 0.09, 0.11)
    found = Verification((outcome(),), 0.05, simulated=True, mechanical=ratio, total=ratio)
    return {s.title: s for s in verification_sections(replace(found, **parts))}  # type: ignore[arg-type]


def test_each_error_has_rms_interval_ratio_and_peak() -> None:
    tables = shown()["Errors, motion by motion"].tables
    assert [t.caption.split(",")[0] for t in tables] == [
        "Mechanical error", "Control tracking error", "Total error at the table"
    ]  # fmt: skip
    name, before, after, share, peak_before, peak_after = tables[0].rows[0]
    assert (name, peak_before, peak_after) == ("sine", "7.1", "0.71")
    assert before.startswith("5.00 (")
    assert after.startswith("0.50 (")
    assert share.startswith("0.100 (")


def test_the_lead_error_is_said_to_be_taken_out_only_where_it_is() -> None:
    grid = np.linspace(-0.1, 0.1, 11)
    lead = LeadMap(grid, 0.0 * grid, 0.0 * grid, 0.0)
    without, with_map = shown(), shown(lead=lead)
    assert "still in it" in without["Errors, motion by motion"].text[0]
    assert "is taken out of both" in with_map["Errors, motion by motion"].text[0]
    assert "Lead-error map" in with_map
    assert "Lead-error map" not in without


def test_promised_and_measured_stand_in_one_row() -> None:
    (table,) = shown(motions=(outcome(PROMISE),))["What the model promised"].tables
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows["sine: mechanical"] == (
        "5.00", "5.00", "0.40", "0.30 – 0.45", "0.45", "0.50", "MISSED"
    )  # fmt: skip
    assert rows["sine: total"][-1] == "kept"
    assert rows["sine: control"][3] is None
    assert "No promise" in shown()["What the model promised"].text[0]


def test_the_headline_has_what_is_left_with_its_interval() -> None:
    ratio = Ratio(0.1, 0.09, 0.11)
    found = Verification((outcome(),), 0.05, simulated=True, mechanical=ratio, total=ratio)
    cards = dict(headline(found))
    assert "after/before 0.100 (0.090 – 0.110)" in cards["5.00 → 0.50 um"]


def test_learning_is_a_section_with_its_passes() -> None:
    learning = Learning(
        np.zeros(3), (1.7, 0.6, 0.5), converged=True, learnable_um=(1.6, 0.4, 0.2),
        confirmed_um=(0.5, 0.52), scatter_um=0.07, ended="the last pass changed little",
    )  # fmt: skip
    section = shown(learning=Refinement("sine", 28.5, 1.7, learning))[
        "Learning on top of the model"
    ]
    model, passes = section.tables
    assert [row[1] for row in model.rows] == ["28.50", "1.70", "0.51"]
    assert [row[2] for row in model.rows] == ["–", "94.0 %", "98.2 %"]
    assert passes.rows[-1] == ("2", "0.500", "0.200")
