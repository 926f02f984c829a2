"""The report of a verification says which axis it is about, and when it was measured."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.report import run as report_run
from pmac_comp.workflow.verification.result import Verification
from tests.unit.report.test_improvement import verification


@pytest.fixture(autouse=True)
def _without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_run, "verification_sections", lambda _: [])
    monkeypatch.setattr(report_run, "headline", lambda _: [])


def run(**attributes: str) -> Capture:
    time_s = np.arange(3) * 1e-3
    return Capture(time_s, time_s, time_s, attributes=attributes)


def text_of(folder: Path, shown: Verification) -> str:
    return report_run.write_verification_report(shown, folder / "verify.html").read_text(
        encoding="utf-8"
    )


def test_axis_controller_and_time_are_named(tmp_path: Path) -> None:
    bench = load_bench("paper")
    first = run(bench_text=bench.text, controller="card-7", start_utc="2026-03-01T10:00:00+00:00")
    last = first.with_attributes(start_utc="2026-03-01T10:20:00+00:00")
    text = text_of(tmp_path, replace(verification(1.0, 2.0), before=(last,), after=(first,)))
    for said in (bench.name, bench.digest, "card-7", "2026-03-01 10:00:00 and 2026-03-01 10:20:00"):
        assert said in text


def test_runs_that_do_not_say_it_make_a_page_all_the_same(tmp_path: Path) -> None:
    old = run(bench_text="config_version = 0")
    text = text_of(tmp_path, replace(verification(1.0, 2.0), before=(run(),), after=(old,)))
    assert "last run begun" not in text
