"""Refusals that need no computing: options, motions, captures and amplitudes, before a minute."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import AmplitudeExceeded, ConfigError, NotIdentifiable
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture, write_capture
from pmac_comp.physics.compensate.design import design_law, start_law
from pmac_comp.physics.compensate.exact import Aim
from pmac_comp.physics.compensate.loop import model_loop
from pmac_comp.physics.compensate.motions import design_motions
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.workflow.compensation import compensate, computing
from pmac_comp.workflow.compensation.compensate import compensate_files
from pmac_comp.workflow.compensation.computing import compute_compensation
from pmac_comp.workflow.compensation.file import ROUTES
from pmac_comp.workflow.compensation.foreseen import (
    check_amplitude,
    check_options,
    check_slow_runs,
    check_uncompensated,
)
from pmac_comp.workflow.law import beyond_model
from pmac_comp.workflow.motion.campaigns import lead_motions
from pmac_comp.workflow.motion.motions import parse_motion

BENCH = load_bench("paper")
MODEL = DriveModel.base(BENCH)
SINE = parse_motion("sine:amplitude_mm=12,frequency_Hz=3.5", BENCH)


def limited(most_um: float) -> Bench:
    """Bench that allows corrections of this size."""
    safety = BENCH.safety.model_copy(update={"max_correction_um": most_um})
    return BENCH.model_copy(update={"safety": safety})


def slow_run(reach: float = 1.0) -> Capture:
    """A slow run over a share of the travel and back, of a screw that is a little long."""
    motion = lead_motions(BENCH)[0].trajectory
    r = reach * motion.position_m
    return Capture(motion.time_s, r, r, table_position_m=1.00003 * r)


@pytest.fixture
def nothing_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails a test in which the law is computed."""

    def never(*_args: object, **_more: object) -> None:
        pytest.fail("the law was computed before the refusal")

    monkeypatch.setattr(computing, "dynamic_law", never)
    monkeypatch.setattr(beyond_model, "found_clearance", never)
    monkeypatch.setattr(
        "pmac_comp.workflow.model.identification.load_model", lambda *_args, **_more: MODEL
    )


@pytest.mark.usefixtures("nothing_computed")
@pytest.mark.parametrize("route", ["law", "servo", "table", "cam"])
def test_slow_runs_of_a_part_of_the_travel_are_refused_first(route: str) -> None:
    with pytest.raises(NotIdentifiable, match="guess") as refused:
        compute_compensation(BENCH, MODEL, route=route, slow=(slow_run(0.5),), motion=SINE)
    assert refused.value.code == "PC-LEAD-011"


def test_slow_runs_that_reach_and_those_to_be_limited_pass() -> None:
    for route in ROUTES:
        check_slow_runs(BENCH, route, [slow_run()], whole_travel=True)
        check_slow_runs(BENCH, route, [slow_run(0.5)], whole_travel=False)
        if route != "table":
            check_slow_runs(BENCH, route, [], whole_travel=True)


@pytest.mark.usefixtures("nothing_computed")
def test_a_table_without_slow_runs_is_refused_first(tmp_path: Path) -> None:
    out = tmp_path / "c.json"
    with pytest.raises(ConfigError, match="no table") as refused:
        compensate_files("paper", Path("m.json"), out, route="table")
    assert refused.value.code == "PC-DEP-015"
    assert "--slow" in refused.value.hint
    assert not out.exists()


@pytest.mark.usefixtures("nothing_computed")
@pytest.mark.parametrize("route", ["law", "servo", "cam", "program"])
def test_a_correction_far_beyond_the_limit_is_refused_first(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, route: str
) -> None:
    monkeypatch.setattr(compensate, "load_bench", lambda _: limited(10.0))
    out = tmp_path / "c.json"
    with pytest.raises(AmplitudeExceeded, match="of 10 um") as refused:
        compensate_files(
            "paper", Path("m.json"), out, route=route, command=SINE.name, aim=Aim.TOTAL
        )
    assert refused.value.code == "PC-DEP-010"
    assert ("--aim mechanical" in refused.value.hint) is (route in {"cam", "program"})
    assert not out.exists()


@pytest.mark.parametrize("route", ["law", "servo", "table", "cam", "program"])
def test_what_may_still_fit_is_left_to_the_whole_computation(route: str) -> None:
    check_amplitude(limited(60.0), MODEL, route, SINE, Aim.TOTAL)


@pytest.mark.parametrize("route", ["law", "cam"])
def test_a_scale_that_is_read_late_is_no_error_to_be_corrected(route: str) -> None:
    late = MODEL.with_effect("channel_skew", {"time_s": 220e-6})
    check_amplitude(limited(60.0), late, route, SINE, Aim.MECHANICAL)


def test_the_regression_foretells_the_largest_correction_of_the_law() -> None:
    loop = model_loop(MODEL)
    start = start_law(BENCH, loop, design_motions(BENCH))
    law = design_law(BENCH, loop)
    assert start.largest_correction_m == pytest.approx(law.largest_correction_m, rel=0.05)


@pytest.mark.usefixtures("nothing_computed")
def test_runs_with_a_compensation_on_are_refused_by_name(tmp_path: Path) -> None:
    run = slow_run()
    shifted = replace(run, desired_position_m=run.commanded_position_m + 5e-6)
    write_capture(tmp_path / "after_01.h5", shifted)
    with pytest.raises(ConfigError, match=r"after_01\.h5 .* up to 5\.0 um") as refused:
        compensate_files(
            "paper", Path("m.json"), tmp_path / "c.json", route="law",
            captures=(tmp_path / "after_01.h5",),
        )  # fmt: skip
    assert refused.value.code == "PC-DEP-014"


def test_rounding_of_the_desired_position_is_no_compensation() -> None:
    run = slow_run()
    count = BENCH.motor_resolution_m
    rounded = replace(run, desired_position_m=np.round(run.commanded_position_m / count) * count)
    check_uncompensated(BENCH, [rounded], ["run.h5"])


@pytest.mark.parametrize("route", ["servo", "table", "cam", "program"])
def test_a_rhythm_belongs_to_the_route_law_alone(route: str) -> None:
    check_options(BENCH, "law", None, 2)
    with pytest.raises(ConfigError, match="--every") as refused:
        check_options(BENCH, route, SINE, 2)
    assert refused.value.code == "PC-DEP-013"


@pytest.mark.parametrize("route", ["cam", "program"])
def test_a_route_for_one_motion_needs_it_before_anything_is_read(route: str) -> None:
    with pytest.raises(ConfigError, match="needs the motion") as refused:
        compensate_files("paper", Path("no-such.json"), Path("c.json"), route=route)
    assert refused.value.code == "PC-DEP-011"


def test_a_motion_too_long_for_a_cam_is_refused_first() -> None:
    long = parse_motion("sine:amplitude_mm=10,frequency_Hz=0.5,cycles=40", BENCH)
    with pytest.raises(ConfigError, match="too long") as refused:
        check_options(BENCH, "cam", long)
    assert refused.value.code == "PC-CAM-001"
    check_options(BENCH, "program", long)


def test_a_motion_that_leaves_the_travel_is_refused_before_the_model_is_read() -> None:
    with pytest.raises(Exception, match="refused") as refused:
        compensate_files(
            "paper", Path("no-such.json"), Path("c.json"), route="cam",
            command="sine:amplitude_mm=400,frequency_Hz=0.1",
        )  # fmt: skip
    assert getattr(refused.value, "code", "") == "PC-MOV-000"
