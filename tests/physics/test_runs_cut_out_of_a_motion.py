"""Captures that begin in the middle of a motion: the model begins with the speed of the axis."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture, read_capture, write_capture
from pmac_comp.physics.diagnose.records import Record, prepare
from pmac_comp.physics.identify import records as rec
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.resting import start_of
from pmac_comp.physics.model.start import Start
from pmac_comp.physics.signals import trajectory as tr
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture
from pmac_comp.workflow.model.prediction import predict_files

BENCH = load_bench("paper_x4")
TS = BENCH.servo_period_s
AMPLITUDE_m, FREQUENCY_Hz = 12e-3, 2.0
MODEL = DriveModel.base(BENCH)


@pytest.fixture(scope="module")
def run() -> Capture:
    wave = tr.sinusoid(
        period_s=TS, amplitude_m=AMPLITUDE_m, frequency_Hz=FREQUENCY_Hz, cycles=6.0
    ).position_m
    return closed_loop_capture(BENCH, make_plant(BENCH, effects={}, seed=3, spread=0.0), wave)


def _every(capture: Capture, stride: int) -> Capture:
    """The capture as a gather with this period would have it."""

    def thin(column: FloatArray | None) -> FloatArray | None:
        return None if column is None else np.ascontiguousarray(column[::stride])

    return replace(
        capture,
        time_s=capture.time_s[::stride],
        commanded_position_m=capture.commanded_position_m[::stride],
        motor_position_m=capture.motor_position_m[::stride],
        desired_position_m=thin(capture.desired_position_m),
        table_position_m=thin(capture.table_position_m),
        torque_command_Nm=thin(capture.torque_command_Nm),
        valid=None,
        extra={},
    )


def _start_of(capture: Capture) -> Start:
    return start_of(
        BENCH,
        capture.desired_m,
        capture.motor_position_m,
        capture.torque_command_Nm,
        capture.sample_period_s,
    )


def _missed_um(record: Record) -> FloatArray:
    """Difference of reading and model in each channel, shape (n, channels), um."""
    return 1e6 * (record.measured_m - record.channels_of(record.response(MODEL)))


@pytest.mark.parametrize("cut_s", [0.7, 1.31, 1.62])
@pytest.mark.parametrize("stride", [1, 2])
def test_a_run_cut_out_of_a_motion_is_simulated_from_its_speed_on(
    run: Capture, cut_s: float, stride: int
) -> None:
    first = round(cut_s / TS)
    cut = _every(run.slice(first, run.n), stride)
    speed = float(np.diff(cut.desired_m[:2])[0] / cut.sample_period_s)
    assert _start_of(cut).speed_m_per_s == pytest.approx(speed)
    (record,) = prepare([cut], BENCH, prefix="run")
    (whole,) = prepare([run], BENCH, prefix="run")
    missed = _missed_um(record)[record.valid]
    # As well as the run that began at rest.
    reference = _missed_um(whole)[first:][: record.valid.size][record.valid]
    assert missed.std(axis=0) == pytest.approx(reference.std(axis=0), abs=0.02)
    # Begun at rest, the model would have to catch up with a motion of 0.1 m/s.
    halted = replace(record, start=replace(record.start, speed_m_per_s=0.0))
    begins = slice(0, round(0.02 / TS))
    assert np.abs(_missed_um(halted)[begins]).max() > 5 * np.abs(_missed_um(record)[begins]).max()


def test_without_torque_the_speed_is_known_all_the_same(run: Capture) -> None:
    cut = replace(run.slice(round(0.7 / TS), run.n), torque_command_Nm=None)
    start = _start_of(cut)
    assert start.speed_m_per_s != 0.0
    assert start.torque_Nm == 0.0
    (record,) = prepare([cut], BENCH, prefix="run")
    assert _missed_um(record)[record.valid].std(axis=0).max() < 0.3


def test_a_column_left_empty_tells_nothing_of_the_start(run: Capture) -> None:
    first, empty = round(0.7 / TS), np.zeros(run.n)
    unmeasured = replace(run, motor_position_m=empty)
    for blind in (unmeasured, replace(run, torque_command_Nm=empty)):
        assert _start_of(blind) == Start()
        assert _start_of(blind.slice(first, run.n)).torque_Nm == 0.0


def test_a_torque_that_was_added_and_captured_is_none_of_the_integrators(tmp_path: Path) -> None:
    wave = tr.sinusoid(period_s=TS, amplitude_m=AMPLITUDE_m, frequency_Hz=FREQUENCY_Hz, cycles=3.0)
    added_Nm = 0.5 * np.cos(9.0 * wave.time_s)
    plant = make_plant(BENCH, effects={}, seed=3, spread=0.0)
    pushed = closed_loop_capture(BENCH, plant, wave.position_m, torque_feedforward_Nm=added_Nm)
    cut = replace(pushed, extra={rec.TORQUE_FEEDFORWARD: added_Nm}).slice(round(0.7 / TS), pushed.n)
    (record,) = prepare([cut], BENCH, prefix="run")
    assert rec.prepare(cut, BENCH).start.torque_Nm == pytest.approx(record.start.torque_Nm)
    assert _missed_um(record)[record.valid].std(axis=0).max() < 0.3
    model, given, out = (tmp_path / name for name in ("model.json", "run.h5", "predicted.h5"))
    stored = {"model_version": 1, "parameters": {}, "effects": ["coulomb", "viscous"]}
    model.write_text(json.dumps({**stored, "bench_digest": BENCH.digest}))
    write_capture(given, cut)
    predict_files("paper_x4", model, given, out, rounding="none")
    missed = 1e6 * (read_capture(out).motor_position_m - cut.motor_position_m)
    assert np.std(missed) < 1.0


def test_a_few_samples_and_a_way_back_to_where_it_began_are_judged_too() -> None:
    short = 1e-6 * np.arange(4, dtype=np.float64)
    back = 1e-7 * np.array([0.0, 1.0, 2.0, 2.0, 1.0, 1.0, 0.0])
    for command_m, follows in ((short, True), (back, False)):
        start = start_of(BENCH, command_m, 0.9 * command_m, None, TS)
        assert (start.speed_m_per_s != 0.0) == follows


def test_identification_leaves_out_what_a_cut_made_unknown(run: Capture) -> None:
    cut = run.slice(round(0.7 / TS), run.n)
    for leave_out in ("nothing", "rest", "reversals"):
        record = rec.prepare(cut, BENCH, leave_out=leave_out)
        period_s = record.factor * cut.sample_period_s
        assert np.flatnonzero(record.valid)[0] * period_s >= 0.3
    assert cut.mask.all()


def test_a_run_that_sets_out_is_no_run_under_way(run: Capture) -> None:
    assert _start_of(run).speed_m_per_s == 0.0
    # Setting out at once, without a sample of rest; and with a jump in speed.
    time_s = TS * np.arange(3000, dtype=np.float64)
    ramp = time_s**2
    jump = 0.01 * time_s
    plant = make_plant(BENCH, effects={}, seed=3, spread=0.0)
    for command in (ramp, jump):
        assert _start_of(closed_loop_capture(BENCH, plant, command)).speed_m_per_s == 0.0


@pytest.mark.parametrize("speed_m_per_s", [0.003, -0.01, 0.05])
def test_what_the_integrator_holds_is_known_where_a_command_jumps(speed_m_per_s: float) -> None:
    approach = tr.trapezoid(
        period_s=TS, distance_m=30e-3, speed_m_per_s=0.1, acceleration_m_per_s2=3.0,
        start_m=-30e-3, both_ways=False, s_curve_s=0.03,
    ).position_m  # fmt: skip
    rest = np.full(round(0.4 / TS), approach[-1])
    away = speed_m_per_s * TS * np.arange(1, 4000, dtype=np.float64)
    plant = make_plant(BENCH, effects={}, seed=3, spread=0.0)
    whole = closed_loop_capture(BENCH, plant, np.concatenate([approach, rest, rest[-1] + away]))
    leaves = approach.size + rest.size
    rested = _start_of(whole.slice(leaves - 100, whole.n)).torque_Nm
    assert abs(rested) > 0.3
    for first in (leaves - 1, leaves):
        assert _start_of(whole.slice(first, whole.n)).torque_Nm == pytest.approx(rested, abs=0.02)
