"""What friction held as a run began is the model's start, not something that the model lacks."""

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import model_loop
from pmac_comp.physics.compensate.starts import held_at_start_Nm, state_at_start, with_starts
from pmac_comp.physics.compensate.unmodelled import unmodelled
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.trajectory import sinusoid
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture
from pmac_comp.workflow.motion.approach import approach
from tests.generators.true_values import friction_of

BENCH = load_bench("paper")
FORCE_N = 60.0


def run_after_an_approach() -> tuple[Capture, DriveModel]:
    """A run as cards make it, from its last moment of rest on, and the model at the true values."""
    plant = make_plant(BENCH, effects={"bias_force": {"force_N": FORCE_N}}, spread=0.0)
    motion = sinusoid(period_s=BENCH.servo_period_s, amplitude_m=0.01, frequency_Hz=2.0, cycles=3.0)
    head = approach(BENCH, float(motion.position_m[0]))
    whole = closed_loop_capture(BENCH, plant, np.concatenate([head, motion.position_m]))
    run = whole.slice(head.size - 60, whole.n)
    axial = {"chain.axial_stiffness_N_per_m": plant.truth.axial_stiffness_N_per_um * 1e6}
    return run, DriveModel.base(BENCH, {**friction_of(plant.truth), **axial})


def test_what_friction_held_is_parted_from_the_load_and_not_counted_against_the_model() -> None:
    run, model = run_after_an_approach()
    loop = model_loop(model)
    (begun,) = with_starts(model, [run])
    held = held_at_start_Nm(begun)
    # The integrator wound against friction, and against the load beside it.
    assert run.torque_command_Nm is not None
    load_Nm = FORCE_N * BENCH.lead_m_per_rad
    assert abs(held) > 0.1
    assert held + load_Nm == pytest.approx(np.median(run.torque_command_Nm[:40]), abs=0.05)

    def left_um(capture: Capture) -> float:
        steps = {"motor_step_m": BENCH.motor_resolution_m, "table_step_m": 0.0}
        found = unmodelled(CompensationLaw(), loop, [capture], None, **steps)
        assert found is not None
        return found.total_um[1]

    assert left_um(begun) < 0.5 * left_um(run)


def test_a_load_that_the_model_holds_is_no_friction_either() -> None:
    run, model = run_after_an_approach()
    (without,) = with_starts(model, [run])
    (own,) = with_starts(model.with_effect("bias_force", {"force_N": FORCE_N}), [run])
    assert held_at_start_Nm(own) == pytest.approx(held_at_start_Nm(without), abs=0.01)


def test_a_run_that_nobody_looked_at_begins_relaxed() -> None:
    run, _ = run_after_an_approach()
    assert held_at_start_Nm(run) == 0.0
    assert state_at_start(run, 0.5) == 0.0
    strained = run.with_attributes(resting_torque_Nm=-0.8)
    assert state_at_start(strained, 0.5) == -1.0
    assert state_at_start(strained, 1.6) == pytest.approx(-0.5)
    assert state_at_start(strained, 0.0) == 0.0


def test_a_run_cut_out_of_a_motion_holds_nothing_by_friction() -> None:
    run, model = run_after_an_approach()
    cut = run.slice(run.n // 3, run.n)
    (begun,) = with_starts(model, [cut])
    assert held_at_start_Nm(begun) == 0.0
