"""The page of a diagnosis: what it shows, what it says, and what a start transient cannot do."""

import re
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.model_file import ModelFile
from pmac_comp.physics.diagnose.localise import TURNED, Region
from pmac_comp.physics.diagnose.result import (
    Diagnosis,
    Estimate,
    Evidence,
    Growth,
    SeparatingExperiment,
    Trace,
)
from pmac_comp.physics.diagnose.words import names_in_words
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.report import diagnosis_figures as figures
from pmac_comp.report.diagnosis import write_diagnosis_report
from pmac_comp.workflow.model.diagnosis import DiagnosisOutcome

BENCH = load_bench("paper")
EXPERIMENT = SeparatingExperiment(
    ("lead_linear", "scale_slope"), "Measure with a laser.", ("sine:amplitude_mm=5,frequency_Hz=1",)
)


def trace(first_um: float = 0.0) -> Trace:
    time = 0.004 * np.arange(1500)
    position = 100.0 * np.sin(2.0 * time)
    after = 0.05 * np.sin(40.0 * time)
    before = after + 0.03 * position
    before[:5] += first_um
    values = {"position": position, "time": time}
    return Trace("capture 7", time, MappingProxyType(values), before, after)


def diagnosis(**changes: object) -> Diagnosis:
    region = Region("table", "position", "mm", -100.0, -80.0, 0.9, 3.0, 1e-9, (0.0,), (0.0,))
    found = Diagnosis(
        verdict="tie",
        named=("lead_linear", "scale_slope"),
        tied=(("lead_linear", "scale_slope"),),
        evidence=(
            Evidence("lead_linear", 1, 268.0, 900.0, 1443.0, 1e-17, 0.16, "chosen"),
            Evidence("scale_slope", 1, 268.0, 900.0, 1443.0, 1e-17, 0.16, "tied"),
            Evidence("presliding", 1, -286.0, 40.0, -1304.0, 1.0, 1.4, "lost"),
            Evidence("cogging", 1, *([float("nan")] * 5), "screened"),
        ),
        where=(region,),
        gap_before_um=1.411,
        gap_after_um=0.162,
        torque_gap_before_Nm=0.137,
        torque_gap_after_Nm=0.137,
        noise_floor_um=0.126,
        gap_channel="table",
        residual=(),
        separating_experiment=EXPERIMENT,
        findings=(),
        statements=("Found: lead_linear, scale_slope <script>.",),
        model=DriveModel.base(BENCH),
        estimates=(Estimate("lead_linear.slope_um_per_m", -25.0, "um/m", 0.2, -25.4, -24.6),),
        path=(Growth((), 1.411, 0.137), Growth(("lead_linear",), 0.162, 0.137)),
        traces=(trace(),),
    )
    return replace(found, **changes)


def page(tmp_path: Path, found: Diagnosis) -> str:
    model = ModelFile(bench_digest="", effects=[], parameters={}, created_utc="")
    outcome = DiagnosisOutcome(
        BENCH, found, model, None, "paper", sources=("simulated closed loop",)
    )
    return write_diagnosis_report(outcome, tmp_path / "page.html").read_text(encoding="utf-8")


def test_a_tie_shows_both_names_and_a_command_that_can_be_pasted(tmp_path: Path) -> None:
    html = page(tmp_path, diagnosis())
    assert "Look-alikes that these runs cannot separate" in html
    assert "Source of the captures: simulated closed loop." in html
    assert "pmac-comp capture URL --bench paper" in html
    assert "--motion &#34;sine:amplitude_mm=5,frequency_Hz=1&#34;" in html
    assert "<script" not in html
    assert "1.41 → 0.162 um" in html


def test_a_compensation_that_stands_is_taken_off_before_the_runs_that_would_tell_more() -> None:
    model = ModelFile(bench_digest="", effects=[], parameters={}, created_utc="")
    outcome = DiagnosisOutcome(BENCH, diagnosis(), model, None, "paper")
    (capture,) = outcome.commands()
    assert replace(outcome, removal="pmac-comp remove URL").commands() == [
        "  pmac-comp remove URL", capture
    ]  # fmt: skip
    lines = replace(outcome, removal="pmac-comp remove URL").lines()
    assert lines.index("  pmac-comp remove URL") + 1 == lines.index(capture)


def test_candidates_are_drawn_and_those_only_screened_are_one_row(tmp_path: Path) -> None:
    html = page(tmp_path, diagnosis())
    assert "<tr><td>round 1</td><td>cogging</td></tr>" in html
    assert len(re.findall(r"<td>cogging</td>", html)) == 1
    assert len(re.findall(r"<td>presliding</td>", html)) == 1
    assert "lost, p 1<" in html
    assert "chosen, p &lt; 1e-6" in html


def test_the_residual_is_drawn_before_and_after_in_its_coordinate(tmp_path: Path) -> None:
    html = page(tmp_path, diagnosis())
    assert "position, mm" in html
    assert html.count("base model") >= 3
    assert html.count("grown model") >= 3
    assert "noise floor" in html


@pytest.mark.parametrize("verdict", ["none", "unknown", "named"])
def test_every_verdict_has_a_page_without_figures_that_it_cannot_have(
    tmp_path: Path, verdict: str
) -> None:
    bare = diagnosis(
        verdict=verdict, named=(), tied=(), evidence=(), where=(), estimates=(),
        separating_experiment=None, traces=(), path=(Growth((), 0.2, None),),
        torque_gap_before_Nm=None, torque_gap_after_Nm=None,
    )  # fmt: skip
    html = page(tmp_path, bare)
    assert "no effect named" in html
    assert html.count("<svg") == 1  # the growth path


def test_a_start_transient_does_not_set_the_scale_but_is_told() -> None:
    plain, spiked = figures.trace_figure(trace()), figures.trace_figure(trace(500.0))
    assert "samples outside" not in plain
    assert "5 samples outside, up to 500 um" in spiked


def test_no_capture_with_the_coordinate_gives_no_figure() -> None:
    assert figures.coordinate_figure([trace()], "force") is None
    assert figures.coordinate_figure([], "position") is None
    assert figures.candidates_figure([]) is None
    assert figures.spectrum_figure([]) is None


def test_what_turns_over_with_the_direction_is_drawn_as_it_is_on_the_way_up() -> None:
    """Over position as it is, both ways together cancel."""
    time = 0.004 * np.arange(1500)
    position = 100.0 * np.sin(2.0 * time)
    way = np.sign(np.cos(2.0 * time))
    values = {"position": position, "direction": way}
    turning = Trace("capture 7", time, MappingProxyType(values), 0.03 * position * way, 0.0 * time)
    upwards = Trace("capture 7", time, MappingProxyType(values), 0.03 * position, 0.0 * time)
    drawn = figures.coordinate_figure([turning], TURNED)
    plain = figures.coordinate_figure([upwards], "position")
    assert drawn is not None
    assert plain is not None
    assert "turned over" in drawn
    assert len(_lines(plain)) > 2
    assert _lines(drawn) == _lines(plain)


def _lines(svg: str) -> list[str]:
    """Paths of the curves in a figure."""
    return re.findall(r'<g id="line2d_\d+">\s*<path d="([^"]+)" clip-path', svg)


def test_look_alikes_beside_something_unknown_are_one_name_and_not_two(tmp_path: Path) -> None:
    html = page(tmp_path, diagnosis(verdict="unknown"))
    assert "lead_linear or scale_slope" in html
    assert "A part of what is missing has a name, a part has none" in html
    assert "left after growth is noise" not in html


def test_names_are_joined_by_or_within_a_group_only() -> None:
    tied = (("lead_linear", "scale_slope"),)
    named = ("lead_linear", "scale_slope", "cogging")
    assert names_in_words(named, tied) == "lead_linear or scale_slope, cogging"
    assert names_in_words(("cogging", "backlash"), ()) == "cogging, backlash"
    assert names_in_words((), ()) == ""


def test_a_refit_that_ran_away_does_not_hide_the_other_bars() -> None:
    assert figures._lowest_shown([-9.7, -8.8, 0.67, -2.85e8]) == pytest.approx(-44.0)
    assert figures._lowest_shown([80.0, -30.0]) == pytest.approx(-400.0)
    assert figures._lowest_shown([-3.0]) == pytest.approx(-15.0)


def test_a_p_value_that_no_test_can_tell_is_a_bound() -> None:
    from pmac_comp.report.diagnosis import _p_value

    assert [_p_value(v) for v in (0.0, 1e-256, 0.03)] == ["< 1e-12", "< 1e-12", 0.03]
    assert _p_value(float("nan")) is None
