"""Closed forms beside hand figures and the simulated loop."""

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.model import quasi_static as qs
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.signals import trajectory as tr
from pmac_comp.physics.signals.metrics import rms_um

BENCH = load_bench("paper")
TS = BENCH.servo_period_s
MODEL = DriveModel.base(BENCH)


def test_error_at_mid_travel_has_the_published_terms():
    # By hand, x = 0.45 m: 2.20 um per m/s2, 3.83 um per m/s, 0.93 um Coulomb.
    model = MODEL.with_parameters({"chain.efficiency": 1.0})
    one, none = np.ones(1), np.zeros(1)
    inertial = qs.mechanical_error_m(model, none, none, one, none)
    coulomb = qs.mechanical_error_m(model, none, none, none, one)
    viscous = qs.mechanical_error_m(model, none, one, none, none)
    figures = -1e6 * np.concatenate([inertial, viscous, coulomb])
    np.testing.assert_allclose(figures, [2.20, 3.83, 0.93], rtol=6e-3)


@pytest.mark.parametrize("name", ["bias_force", "backlash", "friction_asymmetry", "cable_drag"])
def test_effects_change_the_closed_form_as_they_change_the_loop(name):
    values = {"bias_force": {"force_N": 200.0}, "backlash": {"gap_m": 4e-6},
              "friction_asymmetry": {"fraction": 0.8},
              "cable_drag": {"stiffness_N_per_m": 3000.0}}[name]  # fmt: skip
    grown = MODEL.with_effect(name, values)
    motion = tr.trapezoid(
        period_s=TS, distance_m=0.06, speed_m_per_s=0.2, acceleration_m_per_s2=2.0, s_curve_s=0.03
    )
    there, plain = simulate(grown, motion), simulate(MODEL, motion)
    found = []
    for model, run in ((grown, there), (MODEL, plain)):
        v = np.gradient(run.table_position_m, TS)
        found.append(qs.mechanical_error_m(model, run.table_position_m, v, np.gradient(v, TS)))
    moving = np.abs(motion.velocity_m_per_s) > 0.19
    simulated = (there.mechanical_error_m - plain.mechanical_error_m)[moving]
    formula = (found[0] - found[1])[moving]
    assert rms_um(simulated) > 0.1
    assert rms_um(simulated - formula) < 0.3 * rms_um(simulated)


def test_static_errors_are_those_of_a_slow_run():
    model = MODEL.with_effect("lead_linear", {"slope": 50e-6}).with_effect(
        "lead_cyclic", {"amplitude_m": 3e-6, "phase_rad": 1.0}
    )
    motion = tr.trapezoid(
        period_s=TS, distance_m=0.03, speed_m_per_s=0.03, acceleration_m_per_s2=0.5, both_ways=False
    )
    run, plain = simulate(model, motion), simulate(MODEL, motion)
    change = run.mechanical_error_m - plain.mechanical_error_m
    assert np.std(change - qs.static_error_m(model, run.motor_position_m)) < 0.03e-6


def test_thermal_growth_starts_at_the_bearing():
    model = MODEL.with_effect("thermal_growth", {"final": 1e-4, "time_constant_s": 10.0})
    ends = qs.static_error_m(model, np.array([-0.45, 0.0]), 1e6)
    np.testing.assert_allclose(ends, [0.0, 45e-6], atol=1e-9)
    assert qs.static_error_m(model, np.array([0.3]), 0.0)[0] == 0.0


def test_motor_torque_is_that_of_the_loop_in_steady_motion():
    motion = tr.sinusoid(period_s=TS, amplitude_m=0.02, frequency_Hz=2.0, cycles=4.0)
    run = simulate(MODEL, motion)
    x = run.table_position_m
    v = np.gradient(x, TS)
    a = np.gradient(v, TS)
    formula = qs.motor_torque_Nm(MODEL, x, v, a)
    steady = (np.abs(v) > 0.1) & (np.arange(x.size) > 1000) & (np.arange(x.size) < x.size - 1000)
    assert np.std(run.motor_torque_Nm[steady]) > 0.5
    assert np.std((run.motor_torque_Nm - formula)[steady]) < 0.06


def test_a_sparse_bench_file_is_enough():
    nominal = BENCH.nominal.model_copy(
        update={
            "motor_inertia_kgm2": None, "screw_inertia_kgm2": None, "efficiency": None,
            "torsional_stiffness_Nm_per_rad": None, "screw_rigidity_N": None,
            "current_bandwidth_Hz": None, "actuator_delay_us": None,
        }
    )  # fmt: skip
    model = DriveModel.base(BENCH.model_copy(update={"nominal": nominal, "scale": None}))
    motion = tr.sinusoid(period_s=TS, amplitude_m=1e-3, frequency_Hz=3.0, cycles=2.0)
    run = simulate(model, motion)
    assert np.std(run.control_error_m) < 0.1 * np.std(motion.position_m)
    assert 50.0 < qs.modes_Hz(model, 0.0)[0] < 400.0
