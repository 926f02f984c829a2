"""Laps of a repeated command, and friction models of a one-mass drive judged on the later ones."""

from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.base.errors import ModelError
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.compare_rigid import (
    compare_rigid,
    lap_samples,
    repeatability_um,
)
from pmac_comp.physics.model.drive import DriveModel, simulate

BENCH: Bench = load_bench("emps")
LAP = 3000


def repeated(n_laps: float) -> Capture:
    """Record of the model itself with asymmetric viscous friction and a little noise."""
    t = np.arange(LAP) * BENCH.servo_period_s
    turn = 2.0 * np.pi / (LAP * BENCH.servo_period_s)
    lap = 0.05 * (1.0 - np.cos(turn * t)) + 0.01 * np.sin(3.0 * turn * t)
    command = np.tile(lap, 5)[: round(n_laps * LAP)]
    drive = DriveModel.base(
        BENCH,
        {"chain.mass_kg": 95.0, "coulomb.guide_N": 20.0, "viscous.guide_Ns_per_m": 200.0},
    ).with_effect("friction_asymmetry", {"fraction": -0.2})
    run = simulate(drive, command)
    rng = np.random.default_rng(5)
    return Capture(
        time_s=run.time_s,
        commanded_position_m=command,
        motor_position_m=run.motor_position_m + rng.normal(0.0, 2e-7, command.size),
        torque_command_Nm=run.torque_command_Nm,
    )


def test_the_lap_is_found_to_the_sample() -> None:
    record = repeated(3.5)
    assert lap_samples(record) == LAP
    assert repeatability_um(record, LAP) == pytest.approx(0.2 * np.sqrt(2.0), rel=0.1)


def test_a_command_that_does_not_repeat_is_one_lap() -> None:
    record = repeated(1.0)
    assert lap_samples(record) == record.n


def test_the_true_effect_comes_close_to_the_floor_on_laps_it_never_saw() -> None:
    growth = (("bias_force",), ("bias_force", "friction_asymmetry"))
    found = compare_rigid(repeated(4.0), BENCH, growth=growth)
    plain, true = found.rows
    assert found.fitted_laps == 2
    assert found.floor_um is not None
    assert true.left_rms_um < 1.5 * found.floor_um
    assert plain.left_rms_um > 3.0 * true.left_rms_um
    assert len(true.laps_um) == 4


def test_without_torque_there_is_nothing_to_compare() -> None:
    with pytest.raises(ModelError, match="torque"):
        compare_rigid(replace(repeated(2.0), torque_command_Nm=None), BENCH)
