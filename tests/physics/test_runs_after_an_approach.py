"""Runs that begin where an earlier move ended: friction strained, the integrator holding it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture, read_capture, write_capture
from pmac_comp.physics.diagnose.records import Record, prepare
from pmac_comp.physics.identify import identify
from pmac_comp.physics.identify import records as rec
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.model.start import Start
from pmac_comp.physics.signals import trajectory as tr
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture
from pmac_comp.workflow.model.prediction import predict_files

BENCH = load_bench("paper_x4")
TS = BENCH.servo_period_s
DISTANCE_m = 40e-6
REST_s = 0.8


def _after(capture: Capture, first: int) -> Capture:
    """The capture from a sample on, its time beginning there."""
    part = slice(first, None)
    assert capture.table_position_m is not None
    assert capture.torque_command_Nm is not None
    return Capture(
        time_s=capture.time_s[part] - capture.time_s[first],
        commanded_position_m=capture.commanded_position_m[part],
        motor_position_m=capture.motor_position_m[part],
        table_position_m=capture.table_position_m[part],
        torque_command_Nm=capture.torque_command_Nm[part],
        attributes=dict(capture.attributes),
    )


@pytest.fixture(scope="module")
def runs() -> list[Capture]:
    plant = make_plant(
        BENCH, effects={"presliding": {"distance_um": 1e6 * DISTANCE_m}}, seed=3, spread=0.0
    )
    made = []
    for way, frequency in ((1.0, 3.0), (-1.0, 1.5)):
        approach = tr.trapezoid(
            period_s=TS, distance_m=4e-3, speed_m_per_s=0.05, acceleration_m_per_s2=1.0,
            start_m=-4e-3, both_ways=False, s_curve_s=0.02,
        ).position_m  # fmt: skip
        wave = tr.sinusoid(
            period_s=TS, amplitude_m=8e-3, frequency_Hz=frequency, cycles=5.0, centre_m=0.0
        ).position_m
        wave = wave - wave[0]
        rest = np.full(round(REST_s / TS), approach[-1])
        command = np.concatenate([approach, rest, approach[-1] + wave])
        whole = closed_loop_capture(BENCH, plant, way * command)
        made.append(_after(whole, approach.size + rest.size // 2))
    return made


def test_an_axis_that_rests_strained_stays_where_it_is() -> None:
    lengths = {"distance_m": DISTANCE_m, "rotary_m": DISTANCE_m}
    model = DriveModel.base(BENCH).with_effect("presliding@all", lengths)
    command = np.zeros(1000)
    for torque_Nm in (0.3, -0.3):
        held = simulate(model, command, start=Start(torque_Nm))
        assert np.abs(held.motor_position_m).max() < 1e-9
        assert np.ptp(held.table_position_m) < 1e-9
        assert held.torque_command_Nm[0] == pytest.approx(torque_Nm)
        # The same torque on relaxed bristles carries the axis away until the loop answers.
        pushed = simulate(model, command, torque_feedforward_Nm=np.full(1000, torque_Nm))
        assert np.abs(pushed.motor_position_m).max() > 2e-6


def test_friction_is_found_in_runs_that_follow_an_approach(runs: list[Capture]) -> None:
    start = DriveModel.base(BENCH).with_effect("presliding", {"distance_m": 20e-6})
    found = identify(runs, BENCH, model=start)
    assert found.model is not None
    distance = found.parameters["presliding.distance_m"]
    assert distance.value == pytest.approx(DISTANCE_m, rel=0.08)
    assert distance.std < 0.05 * DISTANCE_m
    for run in runs:
        record = rec.prepare(run, BENCH, leave_out="rest")
        assert abs(record.start.torque_Nm) > 0.1
        before = slice(0, int(np.flatnonzero(record.valid)[0]))
        left = (record.measured - rec.simulated(record, found.model))[before]
        relaxed = replace(record, start=Start())
        without = (record.measured - rec.simulated(relaxed, found.model))[before]
        assert np.all(np.std(left, axis=0) < 0.3 * np.std(without, axis=0))


def test_diagnosis_and_identification_see_the_same_start(runs: list[Capture]) -> None:
    for record, run in zip(prepare(runs, BENCH, prefix="run"), runs, strict=True):
        same = rec.prepare(run, BENCH).start
        assert record.start.torque_Nm == pytest.approx(same.torque_Nm, abs=1e-6)
        assert record.start.error_m == pytest.approx(same.error_m, abs=1e-9)
        # Where in its friction a run begins is no evidence until it is left behind.
        first = int(np.flatnonzero(record.valid)[0])
        assert abs(run.commanded_position_m[first] - run.commanded_position_m[0]) > 0.19e-3


def test_a_prediction_begins_as_its_capture_did(runs: list[Capture], tmp_path: Path) -> None:
    model = tmp_path / "model.json"
    effects = ["coulomb", "viscous", "presliding"]
    stored = {"model_version": 1, "parameters": {}, "effects": effects}
    model.write_text(json.dumps({**stored, "bench_digest": BENCH.digest}))

    def early_m(run: Capture) -> float:
        """Rms by which the motor is missed until well after the first motion."""
        given, out = tmp_path / "run.h5", tmp_path / "predicted.h5"
        write_capture(given, run)
        predict_files("paper_x4", model, given, out, rounding="none")
        missed = read_capture(out).motor_position_m - run.motor_position_m
        return float(np.std(missed[: round((0.5 * REST_s + 0.2) / TS)]))

    for run in runs:
        assert early_m(run) < 0.5 * early_m(replace(run, torque_command_Nm=None))


@pytest.fixture(scope="module")
def held_off() -> list[Capture]:
    """Runs of a drive that rests 1.5 um short of its command, with rest before them and without."""
    plant = make_plant(BENCH, effects={}, seed=3, spread=0.0)
    time = TS * np.arange(round(1.5 / TS))
    wave = 8e-3 * np.clip(time / 0.3, 0.0, 1.0) ** 3 * np.sin(4.0 * np.pi * time)
    approach = tr.trapezoid(
        period_s=TS, distance_m=30e-3, speed_m_per_s=0.1, acceleration_m_per_s2=3.0,
        start_m=-30e-3, both_ways=False, s_curve_s=0.03,
    ).position_m  # fmt: skip
    rest = np.full(round(0.4 / TS), approach[-1])
    command = np.concatenate([approach, rest, approach[-1] + wave])
    made = []
    for way, kept_s in ((1.0, 0.2), (-1.0, 0.0)):
        whole = closed_loop_capture(BENCH, plant, way * command)
        made.append(_after(whole, approach.size + rest.size - round(kept_s / TS)))
    return made


def test_an_error_that_friction_holds_is_where_a_run_begins(held_off: list[Capture]) -> None:
    found = identify(held_off, BENCH)
    assert found.model is not None
    for run in held_off:
        record = prepare([run], BENCH, prefix="run")[0]
        assert abs(record.start.error_m) > 1.2e-6
        early = slice(0, round(0.5 / TS))

        def missed_m(start: Start, record: Record = record, early: slice = early) -> float:
            begun = replace(record, start=start)
            motor_m = begun.response(found.model).motor_position_m
            return float(np.std((record.measured_m[:, 0] - motor_m)[early]))

        assert missed_m(record.start) < 0.15e-6
        for wrong in (Start(), Start(record.start.torque_Nm), Start(0.0, record.start.error_m)):
            assert missed_m(wrong) > 2.0 * missed_m(record.start)


def test_a_prediction_begins_with_the_error_that_its_capture_held(
    held_off: list[Capture], tmp_path: Path
) -> None:
    model, given, out = (tmp_path / name for name in ("model.json", "run.h5", "predicted.h5"))
    stored = {"model_version": 1, "parameters": {}, "effects": ["coulomb", "viscous"]}
    model.write_text(json.dumps({**stored, "bench_digest": BENCH.digest}))
    for run in held_off:
        write_capture(given, run)
        for rounding in ("none", "expected"):
            predict_files("paper_x4", model, given, out, rounding=rounding)
            begun = read_capture(out).motor_position_m - run.motor_position_m
            assert abs(begun[0]) < 0.5 * BENCH.motor_resolution_m
