"""Inverse dynamics of a rigid drive on made data, and on data that cannot tell."""

from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import NotIdentifiable
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.rigid import rigid_regression, rigid_start
from pmac_comp.physics.model.drive import DriveModel

BENCH = load_bench("emps")
TIME_S = np.arange(8000) * 1e-3
TRUE = np.array([95.0, 203.0, 20.0, -3.0])


def capture_of(position_m: FloatArray, seed: int = 1) -> Capture:
    v = np.gradient(position_m, 1e-3)
    a = np.gradient(v, 1e-3)
    force_N = TRUE[0] * a + TRUE[1] * v + TRUE[2] * np.sign(v) + TRUE[3]
    noise = np.random.default_rng(seed).normal(0.0, 1.0, TIME_S.size)
    torque = (force_N + noise) * BENCH.lead_m_per_rad
    measured = np.round(position_m / 5e-8) * 5e-8
    return Capture(TIME_S, position_m, measured, torque_command_Nm=torque)


def two_tones() -> FloatArray:
    return np.asarray(
        0.1 + 0.03 * np.sin(2 * np.pi * 0.5 * TIME_S) + 0.005 * np.sin(2 * np.pi * 2.2 * TIME_S)
    )


def test_recovers_what_made_the_data() -> None:
    fit = rigid_regression([capture_of(two_tones())], BENCH)
    std = np.sqrt(np.diag(fit.covariance))
    assert np.all(np.abs(fit.coefficients - TRUE) < 4.0 * std + 0.004 * np.abs(TRUE))
    assert np.all(std < 0.05 * np.abs(TRUE))


def test_invalid_samples_do_not_matter() -> None:
    clean = capture_of(two_tones())
    valid = np.ones(TIME_S.size, dtype=np.bool_)
    valid[3000:3030] = False
    motor = clean.motor_position_m.copy()
    motor[3000:3030] = np.nan
    fit = rigid_regression([replace(clean, motor_position_m=motor, valid=valid)], BENCH)
    assert fit.coefficients == pytest.approx(TRUE, rel=0.02)


def test_the_force_held_at_rest_is_no_bias() -> None:
    # There and back with long rests, in all of which the controller holds most of the friction.
    there_and_back = 0.1 - 0.03 * np.cos(2 * np.pi * 0.5 * np.clip(TIME_S % 4.0, 1.0, 3.0))
    capture = capture_of(np.asarray(there_and_back))
    resting = np.gradient(there_and_back) == 0.0
    assert capture.torque_command_Nm is not None
    held = np.where(resting, -17.0 * BENCH.lead_m_per_rad, capture.torque_command_Nm)
    fit = rigid_regression([replace(capture, torque_command_Nm=held)], BENCH)
    assert fit.value("bias_force_N") == pytest.approx(TRUE[3], abs=0.5)
    assert fit.value("coulomb_N") == pytest.approx(TRUE[2], abs=0.5)


def test_a_mass_that_nobody_stated_begins_where_the_captures_put_it() -> None:
    guess, captures = DriveModel.base(BENCH), [capture_of(two_tones())]
    begun = rigid_start(captures, BENCH, guess).parameters
    assert begun["chain.mass_kg"] == pytest.approx(TRUE[0], rel=0.02)
    assert begun["coulomb.guide_N"] == pytest.approx(TRUE[2], rel=0.05)
    found = guess.with_parameters({"chain.mass_kg": 70.0})
    assert rigid_start(captures, BENCH, found) is found
    blind = [replace(captures[0], torque_command_Nm=None)]
    assert rigid_start(blind, BENCH, guess) is guess
    assert rigid_start([capture_of(np.full(TIME_S.size, 0.1))], BENCH, guess) is guess


@pytest.mark.faults
@pytest.mark.parametrize(
    ("name", "position_m", "parameter"),
    [
        ("standstill", np.full(TIME_S.size, 0.1), "mass_kg"),
        (
            "encoder dither only",
            0.1 + 1e-7 * np.random.default_rng(3).standard_normal(8000),
            "mass",
        ),
        ("one speed, one direction", 0.01 + 0.01 * TIME_S, "coulomb_N"),
        ("one direction", 0.01 + 0.002 * TIME_S**2, "coulomb_N"),
        ("too short", two_tones(), "samples"),
    ],
)
def test_f40_poor_data_is_refused(name: str, position_m: FloatArray, parameter: str) -> None:
    capture = capture_of(position_m)
    if name == "too short":
        capture = capture.slice(0, 210)
    with pytest.raises(NotIdentifiable) as caught:
        rigid_regression([capture], BENCH)
    assert parameter in caught.value.message
    assert caught.value.hint.startswith("Capture")


@pytest.mark.faults
def test_f40_no_torque_is_refused() -> None:
    with pytest.raises(NotIdentifiable, match="torque command"):
        rigid_regression([replace(capture_of(two_tones()), torque_command_Nm=None)], BENCH)
