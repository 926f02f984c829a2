"""Page of an improvement: both models side by side, in micrometres, and what was kept."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from pmac_comp.report import improvement
from pmac_comp.report.page import Section
from pmac_comp.workflow.improve import Improvement
from pmac_comp.workflow.verification.result import Verification


def verification(mechanical: float, total: float) -> Verification:
    motion = SimpleNamespace(
        name="sine",
        e_before=SimpleNamespace(value=5.0),
        total_before=SimpleNamespace(value=30.0),
        e_r_after=SimpleNamespace(value=mechanical),
        total_after=SimpleNamespace(value=total),
        promise_kept=lambda floor_um: True,
        truth=None,
    )
    return Verification((motion,), 0.05, simulated=True)


@pytest.fixture(autouse=True)
def _without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(improvement, "verification_sections", lambda v: [Section("Details")])


def page(tmp_path: Path, grown: Verification | None, kept: str) -> str:
    diagnosis = SimpleNamespace(lines=lambda: ["verdict: named - backlash"])
    result = Improvement(diagnosis, verification(1.25, 2.5), grown, kept)
    return improvement.write_improvement_report(result, tmp_path / "i.html").read_text("utf-8")


def test_both_models_stand_side_by_side(tmp_path: Path) -> None:
    text = page(tmp_path, verification(0.375, 1.125), "grown")
    for figure in ("1.25 → 0.38 um", "2.50 → 1.12 um", ">0.38<", ">1.12<", ">30.00<"):
        assert figure in text
    assert "Details, with the compensation of the grown model" in text
    assert "The compensation of the grown model is on the controller." in text
    assert "simulated" in text


def test_nothing_named_leaves_the_grown_column_empty(tmp_path: Path) -> None:
    text = page(tmp_path, None, "first")
    assert "The diagnosis added nothing" in text
    assert "grown model</h2>" not in text
