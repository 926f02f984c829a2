"""A drive quicker or later than its bench file says: found where that is held too tightly."""

import json
import math

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.delay import drive_delay_s
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.identify.drive_lag import DriveLag, measured_drive_lag
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture
from pmac_comp.workflow.law import beyond_model
from pmac_comp.workflow.law.beyond_model import made_with, shown_by_runs
from pmac_comp.workflow.law.drive_lag import lag_note, lag_remarks
from pmac_comp.workflow.motion.campaigns import calibration_motions
from tests.physics.identified import SLOW, identified

BENCH = load_bench("paper_x4")
TIME_us = 800.0
_HELD = BENCH.tolerance.model_copy(
    update={"current_bandwidth_Hz": 0.002, "actuator_delay_us": 0.002}
)
SURE = BENCH.model_copy(update={"tolerance": _HELD})
LATE = {"actuator_delay": {"time_us": TIME_us}}
MODEL = DriveModel.base(BENCH)


def test_a_late_drive_is_found_behind_a_bench_file_that_is_too_sure() -> None:
    runs, model = identified(SURE, LATE, seed=3, without=SLOW)
    found = measured_drive_lag(runs, SURE, model)
    assert found is not None
    bandwidth_Hz = make_plant(BENCH, effects=LATE, seed=3).truth.current_bandwidth_Hz
    true_s = 1e-6 * TIME_us + 1.0 / (2.0 * math.pi * bandwidth_Hz)
    assert found.lag_s == pytest.approx(true_s, abs=60e-6)
    assert found.held_s == pytest.approx(973e-6, abs=20e-6)
    assert found.with_um < 0.9 * found.without_um
    assert drive_delay_s(found.model) == pytest.approx(found.lag_s + 0.5 * BENCH.servo_period_s)


@pytest.mark.slow
def test_nothing_is_found_where_the_samples_outweigh_the_bench_file() -> None:
    runs, model = identified(BENCH, {}, seed=3, without=SLOW)
    assert measured_drive_lag(runs, BENCH, model) is None


def test_a_model_with_a_lag_of_its_own_is_taken_at_its_word() -> None:
    motion = calibration_motions(SURE)[0]
    runs = [closed_loop_capture(SURE, make_plant(BENCH, effects=LATE), motion.position_m)]
    model = MODEL.with_effect("actuator_delay", {"time_s": 5e-4})
    assert measured_drive_lag(runs, SURE, model) is None
    assert measured_drive_lag([], BENCH, MODEL) is None


def test_the_law_keeps_the_drive_that_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    own = {"time_s": 3e-4}
    quick = MODEL.with_effect("actuator_delay", own).with_parameters({"chain.efficiency": 0.9})
    found = DriveLag(quick, 400e-6, 40e-6, 920e-6, 1.21, 0.83)
    monkeypatch.setattr(beyond_model, "found_drive_lag", lambda *_: found)
    shown = shown_by_runs(BENCH, MODEL, (), (), with_gap=False)
    assert shown.model == quick
    law = CompensationLaw(provenance=json.loads(json.dumps(shown.noted)))
    again = made_with(MODEL, law)
    assert again.effects == quick.effects
    assert again.parameters == quick.parameters


@pytest.mark.parametrize(("lag_s", "words"), [(400e-6, "520 us earlier"), (1000e-6, "80 us later")])
def test_person_reads_what_was_found(lag_s: float, words: str) -> None:
    note = lag_note(DriveLag(MODEL, lag_s, 40e-6, 920e-6, 1.21, 0.83))
    (text,) = lag_remarks(CompensationLaw(provenance=json.loads(json.dumps(note))))
    assert words in text
    assert "+- 80 us, and not 920" in text
    assert "0.83 um rms" in text
    assert "actuator_delay_us" in text
    assert lag_remarks(CompensationLaw()) == []
