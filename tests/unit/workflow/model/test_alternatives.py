"""What a user would do otherwise, on a drive whose answers are known."""

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.signals.trajectory import sinusoid, trapezoid
from pmac_comp.workflow.model.alternatives import compare_alternatives
from pmac_comp.workflow.model.other_ways import (
    Way,
    dual_positions_m,
    positions_m,
    scaled_bench,
    settles,
)

BENCH = load_bench("paper")
MODEL = DriveModel.base(BENCH)
PERIOD_S = BENCH.servo_period_s
SINE_m = sinusoid(
    period_s=PERIOD_S, amplitude_m=0.01, frequency_Hz=2.0, cycles=2.0, centre_m=0.05, dwell_s=0.05
).position_m
MOVE_m = trapezoid(
    period_s=PERIOD_S, distance_m=0.03, speed_m_per_s=0.1, acceleration_m_per_s2=2.0,
    s_curve_s=0.015, start_m=-0.1, dwell_s=1.2,
).position_m  # fmt: skip


def slow(scaling: float) -> DriveModel:
    return DriveModel(scaled_bench(BENCH, scaling), MODEL.effects, MODEL.parameters)


def test_a_vanishing_weight_of_the_scale_is_the_loop_on_the_motor() -> None:
    plain = simulate(MODEL, SINE_m)
    motor, table = positions_m(MODEL, SINE_m, weight=1e-4)
    np.testing.assert_allclose(motor, plain.motor_position_m, rtol=0.0, atol=5e-9)
    np.testing.assert_allclose(table, plain.table_position_m, rtol=0.0, atol=5e-9)


def test_the_loop_on_the_scale_brings_the_table_to_rest_on_the_command() -> None:
    """A loop on the motor leaves the wind-up of friction at the table, one on the table does not.

    The integrator runs until the reading that it sees is right; a bias force bends the chain.
    """
    bent = slow(0.25).with_effect("bias_force", {"force_N": 60.0})
    motor_on_motor, table_on_motor = positions_m(bent, MOVE_m)
    motor_on_table, table_on_table = positions_m(bent, MOVE_m, weight=1.0)
    goal = MOVE_m[-1]
    bend_m = table_on_motor[-1] - motor_on_motor[-1]
    assert abs(bend_m) > 0.4e-6
    assert abs(motor_on_motor[-1] - goal) < 0.2 * abs(bend_m)
    assert abs(table_on_table[-1] - goal) < 0.2 * abs(bend_m)
    assert motor_on_table[-1] - goal == pytest.approx(-bend_m, rel=0.4)


def test_position_from_the_scale_and_velocity_from_the_motor_rests_on_the_command() -> None:
    """Without sliding friction, so that the integrator has nothing to wait for."""
    bent = MODEL.without_effect("coulomb").with_effect("bias_force", {"force_N": 60.0})
    motor, table = dual_positions_m(bent, MOVE_m)
    assert abs(table[-1] - motor[-1]) > 0.4e-6
    assert abs(table[-1] - MOVE_m[-1]) < 0.02 * abs(table[-1] - motor[-1])
    assert not settles(Way(slow(16.0), dual=True))


def test_stability_is_seen_without_the_help_of_friction() -> None:
    assert settles(Way(MODEL))
    assert not settles(Way(MODEL, weight=1.0))
    assert settles(Way(slow(0.25), weight=1.0))
    assert not settles(Way(slow(16.0)))


def test_scaled_gains_leave_the_acceleration_feedforward_and_the_gain_at_rest() -> None:
    plain, scaled = MODEL.kernel_vector(), slow(2.0).kernel_vector()
    notched = DriveModel(scaled_bench(BENCH, 2.0, notch_Hz=130.0)).kernel_vector()
    for slot in (s.KP, s.KI, s.KD, s.KVFF):
        assert scaled[slot] == pytest.approx(2.0 * plain[slot])
    assert scaled[s.KAFF] == pytest.approx(plain[s.KAFF])
    n1, n2, d1, d2 = notched[s.NOTCH : s.NOTCH + 4]
    at_rest = (1.0 + n1 + n2) / (1.0 + d1 + d2)
    assert notched[s.KP] * at_rest == pytest.approx(scaled[s.KP])
    z = np.exp(2j * np.pi * 130.0 * PERIOD_S)
    assert abs(1.0 + n1 / z + n2 / z**2) < 1e-9


def test_a_notch_in_place_of_the_benchs_own_leaves_the_gain_at_rest() -> None:
    """Its Ixx30 has the gain at rest of the notch that it states."""
    stated = dict(zip(("I136", "I137", "I138", "I139"), (-1.6, 0.9, -1.0, 0.4), strict=True))
    ivariables = {**BENCH.controller.ivariables, **stated}
    controller = BENCH.controller.model_copy(update={"ivariables": ivariables})
    bench = BENCH.model_copy(update={"controller": controller})

    def slow_gain(scaling: float, notch_Hz: float | None, slot: int) -> float:
        changed = scaled_bench(bench, scaling, notch_Hz=notch_Hz)
        vector = DriveModel.base(changed).kernel_vector()
        n1, n2, d1, d2 = vector[s.NOTCH : s.NOTCH + 4]
        return float(vector[slot] * (1.0 + n1 + n2) / (1.0 + d1 + d2))

    for slot, factor in ((s.KP, 2.0), (s.KVFF, 2.0), (s.KAFF, 1.0)):
        own = slow_gain(1.0, None, slot)
        assert slow_gain(2.0, None, slot) == pytest.approx(factor * own)
        assert slow_gain(2.0, 130.0, slot) == pytest.approx(factor * own)


def test_what_is_known_of_the_ways_comes_out() -> None:
    rows = compare_alternatives(MODEL, [SINE_m])
    total = {row.name: row.total_rms_um for row in rows}
    base = total["velocity and acceleration feedforward only (baseline)"]
    learned = total["iterative learning on the repeated motion"]
    friction = total["torque compensation (friction feedforward)"]
    law = total["this project's law"]
    assert base is not None
    assert learned is not None
    assert friction is not None
    assert law is not None
    # Friction is what the baseline lags behind; learning and the law take the bend away as well.
    assert friction < 0.5 * base
    assert learned < 0.3 * base
    assert law < 0.2 * base
    bare = next(row for row in rows if row.name == "linear-scale feedback alone")
    assert bare.total_rms_um is None
    assert "unstable" in bare.how


def test_a_rigid_drive_has_no_table_of_its_own() -> None:
    assert compare_alternatives(DriveModel.base(load_bench("emps")), [SINE_m]) == ()
