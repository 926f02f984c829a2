"""What a run begins with."""

from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.diagnose.records import prepare
from pmac_comp.physics.model import slots
from pmac_comp.physics.model.drive import DriveModel

BENCH = load_bench("paper_x4")
HELD_Nm = 0.315


@pytest.fixture
def flickering() -> Capture:
    """A run that begins at rest, its encoder between two counts and its command not quite exact."""
    gains = DriveModel.base(BENCH).kernel_vector()
    period_s = BENCH.servo_period_s
    time = period_s * np.arange(2000)
    command = 0.05 * np.maximum(0.0, time - 0.03) + 1e-14 * np.sin(900.0 * time)
    motor = command + BENCH.motor_resolution_m * (np.arange(2000) % 4 == 0)
    torque = HELD_Nm + gains[slots.KP] * (command - motor)
    torque -= gains[slots.KD] * np.gradient(motor - command, period_s)
    return Capture(
        time_s=time,
        commanded_position_m=command,
        motor_position_m=motor,
        torque_command_Nm=torque,
    )


def test_a_flickering_encoder_does_not_hide_what_the_integrator_holds(flickering):
    (record,) = prepare([flickering], BENCH, prefix="run")
    assert record.rest_torque_Nm == pytest.approx(HELD_Nm, abs=2e-3)


def test_a_run_that_begins_in_motion_does_not_tell_it(flickering):
    moving = flickering.commanded_position_m + 0.01 * flickering.time_s
    (record,) = prepare([replace(flickering, commanded_position_m=moving)], BENCH, prefix="run")
    assert record.rest_torque_Nm == 0.0
