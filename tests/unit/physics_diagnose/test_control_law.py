"""A wrong gain in the bench file is seen without any plant, and a right one is not doubted."""

from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import TORQUE_FEEDFORWARD, Capture
from pmac_comp.physics.diagnose.control_law import told_of_law
from pmac_comp.physics.diagnose.records import prepare
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals import trajectory as tr
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture

BENCH = load_bench("paper_x4")
TS = BENCH.servo_period_s
MOVE = tr.trapezoid(
    period_s=TS, distance_m=0.03, speed_m_per_s=0.1, acceleration_m_per_s2=3.0, s_curve_s=0.02
)


def _said(bench: Bench, *runs: Capture) -> tuple[str, ...]:
    return told_of_law(prepare(runs, bench, prefix="run"), bench)


@pytest.fixture(scope="module")
def run() -> Capture:
    return closed_loop_capture(BENCH, make_plant(BENCH, effects={}, seed=2), MOVE.position_m)


def _with(variable: str, factor: float) -> Bench:
    law = BENCH.controller
    changed = {**law.ivariables, variable: factor * law.ivariables[variable]}
    ivariables = law.model_copy(update={"ivariables": changed})
    return BENCH.model_copy(update={"controller": ivariables})


WITHOUT_FEEDFORWARD = _with("I132", 0.0)


def test_the_law_of_the_bench_file_is_not_doubted(run: Capture) -> None:
    assert _said(BENCH, run) == ()


def test_nothing_is_told_of_what_a_capture_does_not_hold(run: Capture) -> None:
    wrong = _with("I130", 1.2)
    assert _said(wrong, replace(run, torque_command_Nm=None)) == ()
    lost = np.ones(run.n, dtype=np.bool_)
    lost[run.n // 2] = False
    assert _said(wrong, replace(run, valid=lost)) == ()


def test_a_gain_that_the_capture_was_not_made_with_is_named(run: Capture) -> None:
    (line,) = _said(_with("I131", 1.0 / 1.15), run)
    assert "that of derivative gain 1.15 times the stated one." in line


def test_little_of_a_gain_that_makes_much_of_the_torque_is_told(run: Capture) -> None:
    # Far behind its command the axis is driven by a difference of large terms: an integrator that
    # takes the error in before its output is used is half a per cent of the proportional gain.
    vector = DriveModel.base(WITHOUT_FEEDFORWARD).kernel_vector()
    command = np.asarray(0.03 * (1.0 - np.cos(4.0 * np.pi * np.arange(6000) * TS)))
    plant = make_plant(WITHOUT_FEEDFORWARD, effects={}, seed=2)
    lagging = closed_loop_capture(WITHOUT_FEEDFORWARD, plant, command)
    assert lagging.torque_command_Nm is not None
    sooner = vector[s.KI] * TS * (lagging.desired_m - lagging.motor_position_m)
    said = _said(
        WITHOUT_FEEDFORWARD,
        replace(lagging, torque_command_Nm=lagging.torque_command_Nm + sooner),
    )
    assert _said(WITHOUT_FEEDFORWARD, lagging) == ()
    assert len(said) == 1
    assert "proportional gain 1.006 times the stated one" in said[0]


def test_a_factor_of_all_gains_is_told_once(run: Capture) -> None:
    (line,) = _said(_with("I130", 1.0 / 1.15), run)
    assert "all gains 1.15 times the stated ones" in line


@pytest.mark.parametrize(("push_Nm", "told"), [(0.05, 0), (0.5, 1)])
def test_a_torque_that_no_gains_give_is_told_as_something_else(
    run: Capture, push_Nm: float, told: int
) -> None:
    assert run.torque_command_Nm is not None
    push = push_Nm * np.sin(2.0 * np.pi * 7.0 * run.time_s)
    said = _said(BENCH, replace(run, torque_command_Nm=run.torque_command_Nm + push))
    assert len(said) == told
    assert all("something else acts" in line for line in said)


def test_a_torque_that_was_added_and_captured_belongs_neither_to_law_nor_drive() -> None:
    added_Nm = 0.4 * np.sin(40.0 * MOVE.time_s)
    run = closed_loop_capture(
        BENCH,
        make_plant(BENCH, effects={}, seed=2),
        MOVE.position_m,
        torque_feedforward_Nm=added_Nm,
    )
    known = replace(run, extra={**run.extra, TORQUE_FEEDFORWARD: added_Nm})
    assert "something else acts" in _said(BENCH, run)[0]
    assert _said(BENCH, known) == ()
    model = DriveModel.base(BENCH)
    missed = []
    for each in (known, run):
        (record,) = prepare([each], BENCH, prefix="run")
        motor_m = record.response(model).motor_position_m
        missed.append(float(np.std((record.measured_m[:, 0] - motor_m)[record.valid])))
    assert missed[0] < 0.3 * missed[1]
