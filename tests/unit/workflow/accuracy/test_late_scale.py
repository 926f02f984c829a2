"""A scale that is read late: taken out of captures, kept with the law, and said."""

import json
from dataclasses import asdict

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.identify.scale_age import ScaleAge
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.workflow.accuracy.late_scale import (
    in_time,
    noted_age,
    read_together,
    scale_age_s,
    scale_remarks,
)
from pmac_comp.workflow.accuracy.outcome import error_signals, outcome_of
from pmac_comp.workflow.law.beyond_model import made_with

BENCH = load_bench("paper_x4")
MODEL = DriveModel.base(BENCH)
FOUND = ScaleAge(4.7e-6, 0.1e-6, {"viscous.guide_Ns_per_m": 211.0, "gone.x": 1.0}, 0.125, 0.039)
NOTE = json.loads(json.dumps({"scale_age": asdict(FOUND)}))


def late_run(age_s: float) -> Capture:
    """Table exactly with the motor, scale read late, on a 4 Hz sinusoid."""
    time_s = np.linspace(0.0, 1999 * BENCH.servo_period_s, 2000)
    position_m = 0.02 * np.sin(8.0 * np.pi * time_s)
    table_m = 0.02 * np.sin(8.0 * np.pi * (time_s - age_s))
    return Capture(time_s, position_m, position_m, table_position_m=table_m)


@pytest.mark.parametrize("age_s", [5e-6, -3e-6])
def test_both_readings_of_a_capture_belong_together(age_s: float) -> None:
    run = late_run(age_s)
    middle = slice(2, -2)
    apart = error_signals(run).mechanical_m[middle]
    together = error_signals(run, scale_age_s=age_s).mechanical_m[middle]
    assert np.std(apart) == pytest.approx(abs(age_s) * 0.02 * 8.0 * np.pi / np.sqrt(2.0), rel=0.01)
    assert np.std(together) < 0.01 * np.std(apart)
    raw = run.table_position_m
    assert run.table_position_m is raw  # what was captured stays as it is
    assert read_together(run, 0.0) is run


def test_figures_before_and_after_leave_the_lag_out() -> None:
    run = late_run(5e-6)
    plain, timed = (outcome_of("a", [run], [run], scale_age_s=age) for age in (0.0, 5e-6))
    for name in ("e_before", "e_r_after", "total_before", "total_after"):
        assert getattr(timed, name).value < 0.05 * getattr(plain, name).value


def test_a_run_without_a_scale_is_left_as_it_is() -> None:
    run = Capture(np.linspace(0.0, 8e-3, 9), np.zeros(9), np.zeros(9))
    assert read_together(run, 5e-6) is run


def test_promise_is_made_by_the_drive_behind_the_scale_also_from_a_file() -> None:
    law = CompensationLaw(provenance=NOTE)
    model = made_with(MODEL.with_effect("channel_skew", {"time_s": 2e-6}), law)
    assert model.effects == MODEL.effects
    assert model.parameters["viscous.guide_Ns_per_m"] == 211.0
    assert set(model.parameters) == set(MODEL.parameters)
    assert scale_age_s(law.provenance) == 4.7e-6
    assert scale_age_s({}) == 0.0
    assert in_time(MODEL, {}) == MODEL


def test_a_model_that_holds_the_lag_is_taken_at_its_word() -> None:
    model = MODEL.with_effect("channel_skew", {"time_s": 3e-6})
    noted = json.loads(json.dumps(noted_age(BENCH, model, [late_run(5e-6)])))
    assert scale_age_s(noted) == 3e-6
    (text,) = scale_remarks(CompensationLaw(provenance=noted))
    assert "3.0 us after the encoder" in text
    assert "+-" not in text


def test_person_reads_what_was_found_and_what_becomes_of_it() -> None:
    (text,) = scale_remarks(CompensationLaw(provenance=NOTE))
    assert "4.7 us after the encoder (+- 0.2;" in text
    assert "0.13 um rms" in text or "0.12 um rms" in text
    assert "no error of the table" in text
    early = {"scale_age": {**NOTE["scale_age"], "time_s": -1e-6}}
    assert "1.0 us before" in scale_remarks(CompensationLaw(provenance=early))[0]
    assert scale_remarks(CompensationLaw()) == []
    assert noted_age(BENCH, MODEL, []) == {}
