"""The model against the simulated drive: the same equations written twice, by different methods."""

import numpy as np
import pytest

from pmac_comp.files.bench import SiControl, load_bench
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.model.expected import expected_response
from pmac_comp.physics.signals import trajectory as tr
from pmac_comp.simulator.plant import kernel_ballscrew
from pmac_comp.simulator.plant.ballscrew import make_plant
from pmac_comp.simulator.servo.closed_loop import run_closed_loop
from tests.generators.true_values import friction_of
from tools.acceptance.identify_coverage import truth_si

PAPER = load_bench("paper")
TS = PAPER.servo_period_s

MOTIONS = {
    "sinusoid 10 mm 5 Hz": tr.sinusoid(period_s=TS, amplitude_m=0.01, frequency_Hz=5.0, cycles=2.0),
    "sinusoid 50 mm 1 Hz": tr.sinusoid(
        period_s=TS, amplitude_m=0.05, frequency_Hz=1.0, cycles=1.0, centre_m=0.2
    ),
    "trapezoid, jerk unlimited": tr.trapezoid(
        period_s=TS, distance_m=0.1, speed_m_per_s=0.3, acceleration_m_per_s2=3.0
    ),
    "trapezoid, jerk limited": tr.trapezoid(
        period_s=TS, distance_m=0.1, speed_m_per_s=0.3, acceleration_m_per_s2=3.0, s_curve_s=0.03,
        start_m=-0.25,
    ),
    "triangle 5 mm/s": tr.triangle(period_s=TS, amplitude_m=0.005, speed_m_per_s=0.005, cycles=1),
    "multisine": tr.multisine(
        period_s=TS, amplitude_m=0.03, frequencies_Hz=[0.6, 1.1, 2.3, 4.7], duration_s=3.0
    ),
}  # fmt: skip


def fine_bench():
    """The paper's bench with sensors of 1 nm, so that only the mechanics are compared."""
    law = SiControl(
        Kp_Nm_per_mm=14.891, Ki_Nm_per_mm_s=187.24, Kd_Nm_s_per_mm=0.14263,
        Kvff_Nm_s_per_mm=0.1442, Kaff_Nm_s2_per_mm=6.987e-4,
    )  # fmt: skip
    return PAPER.model_copy(
        update={
            "controller": PAPER.controller.model_copy(update={"kind": "si", "si": law}),
            "encoder": PAPER.encoder.model_copy(update={"counts_per_rev": 1e7}),
            "scale": PAPER.scale.model_copy(update={"resolution_um": 1e-3}),
        }
    )


def model_of(plant, bench):
    truth = plant.truth
    same = [
        "motor_inertia_kgm2",
        "screw_inertia_kgm2",
        "table_mass_kg",
        "torsional_stiffness_Nm_per_rad",
        "screw_rigidity_N",
        "efficiency",
        "current_bandwidth_Hz",
    ]
    values = {f"chain.{name}": getattr(truth, name) for name in same}
    values |= {
        "chain.axial_stiffness_N_per_m": truth.axial_stiffness_N_per_um * 1e6,
        "chain.actuator_delay_s": truth.actuator_delay_us * 1e-6,
        "chain.damping_time_s": truth.damping_time_us * 1e-6,
        **friction_of(truth),
        "viscous.nut_Nms_per_rad": truth.nut_viscous_Nms_per_rad,
        "viscous.motor_Nms_per_rad": truth.motor_viscous_Nms_per_rad,
    }
    return DriveModel.base(bench, values)


def mechanical_miss_m(bench, plant, model, motion):
    run = run_closed_loop(bench, plant, motion.position_m)
    truth = run["true_table_position_m"] - run["true_motor_position_m"]
    response = simulate(model, motion)
    table = run["true_table_position_m"] - response.table_position_m
    return truth - response.mechanical_error_m, table


@pytest.mark.parametrize("name", MOTIONS)
def test_two_codes_agree_on_the_paper_bench_within_its_quantisation(name):
    # Issue figure: dynamic mechanical error within 0.2 um rms on unquantised positions; the plant's
    # loop closes over 1 um counts, the model's over none.
    plant = make_plant(PAPER, effects={}, seed=5)
    miss, _ = mechanical_miss_m(PAPER, plant, model_of(plant, PAPER), MOTIONS[name])
    assert np.std(miss) < 0.2e-6


@pytest.mark.parametrize("name", MOTIONS)
def test_two_codes_agree_closely_with_fine_sensors(name):
    bench = fine_bench()
    plant = make_plant(bench, effects={}, seed=6)
    miss, table = mechanical_miss_m(bench, plant, model_of(plant, bench), MOTIONS[name])
    # The plant's stick zone is 0.2 um wide, the model's has no width.
    assert np.std(miss) < 90e-9
    assert np.std(table) < 250e-9


EFFECTS = [
    ("backlash", {"gap_um": 5.0}, {"gap_m": 5e-6}),
    ("preload_loss", {"half_width_um": 2.0, "stiffness_ratio": 0.4},
     {"half_width_m": 2e-6, "stiffness_ratio": 0.4}),
    ("stribeck", {"excess_N": 30.0, "speed_m_per_s": 0.01},
     {"excess_N": 30.0, "speed_m_per_s": 0.01}),
    ("presliding", {"distance_um": 30.0}, {"distance_m": 30e-6}),
    ("friction_asymmetry", {"fraction": 0.3}, {"fraction": 0.3}),
    ("friction_asymmetry@sliding", {"fraction": -0.5, "place": "sliding"}, {"fraction": -0.5}),
    ("friction_asymmetry@rotary", {"fraction": -0.5, "place": "rotary"}, {"fraction": -0.5}),
    ("friction_per_rev", {"amplitude_Nm": 0.08, "order_per_rev": 2.0, "phase_rad": 0.5},
     {"amplitude_Nm": 0.08, "order_per_rev": 2.0, "phase_rad": 0.5}),
    ("post_reversal_dip", {"fraction": 0.5, "length_mm": 1.5},
     {"fraction": 0.5, "length_m": 1.5e-3}),
    ("friction_warmup", {"fraction": 0.4, "time_constant_s": 1.0},
     {"fraction": 0.4, "time_constant_s": 1.0}),
    ("cogging", {"amplitude_Nm": 0.08, "order_per_rev": 10.0, "phase_rad": 0.5},
     {"amplitude_Nm": 0.08, "order_per_rev": 10.0, "phase_rad": 0.5}),
    ("torque_ripple", {"amplitude_Nm": 0.3, "order_per_rev": 10.0, "rated_Nm": 6.37},
     {"amplitude_Nm": 0.3, "order_per_rev": 10.0}),
    ("bias_force", {"force_N": 60.0}, {"force_N": 60.0}),
    ("cable_drag", {"stiffness_N_per_m": 800.0, "centre_mm": 20.0},
     {"stiffness_N_per_m": 800.0, "centre_m": 0.02}),
    ("payload", {"mass_kg": 25.0}, {"mass_kg": 25.0}),
    ("nut_efficiency", {"loss_fraction": 0.15}, {"loss_fraction": 0.15}),
    ("axial_stiffness_position", {"rigidity_factor": 0.7}, {"rigidity_factor": 0.7}),
    ("axial_stiffness_nonlinear", {"preload_N": 1000.0}, {"preload_N": 1000.0}),
    ("axial_stiffness_nonlinear", {"preload_N": 200.0}, {"preload_N": 200.0}),
    ("viscous_nonlinear", {"coefficient_N": 60.0, "exponent": 0.5},
     {"coefficient_N": 60.0, "exponent": 0.5}),
    ("viscous_nonlinear@", {"coefficient_N": -60.0, "exponent": 0.5},
     {"coefficient_N": -60.0, "exponent": 0.5}),
    ("coupling_windup", {"stiffness_Nm_per_rad": 3000.0}, {"compliance_rad_per_Nm": 1 / 3000.0}),
    ("chain_damping", {"time_us": 200.0}, {"time_s": 127e-6}),
    ("base_mode", {"frequency_Hz": 30.0, "mass_ratio": 0.1, "damping_ratio": 0.05},
     {"frequency_Hz": 30.0, "mass_ratio": 0.1, "damping_ratio": 0.05}),
    ("lead_linear", {"slope_um_per_m": 80.0}, {"slope": 80e-6}),
    ("lead_cyclic", {"amplitude_um": 2.0, "order_per_rev": 1.0, "phase_rad": 0.5},
     {"amplitude_m": 2e-6, "order_per_rev": 1.0, "phase_rad": 0.5}),
    ("thermal_growth", {"final_um_per_m": 60.0, "time_constant_s": 2.0},
     {"final": 60e-6, "time_constant_s": 2.0}),
    ("encoder_eccentricity", {"amplitude_um": 2.0, "order_per_rev": 1.0, "phase_rad": 0.5},
     {"amplitude_m": 2e-6, "order_per_rev": 1.0, "phase_rad": 0.5}),
    ("scale_subdivision", {"amplitude_um": 0.4, "period_um": 2000.0, "phase_rad": 0.5},
     {"amplitude_m": 0.4e-6, "period_m": 2e-3, "phase_rad": 0.5}),
    ("scale_slope", {"slope_um_per_m": 80.0}, {"slope": 80e-6}),
    ("channel_skew", {"time_us": 10.0}, {"time_s": 10e-6}),
    ("actuator_delay", {"time_us": 900.0}, {"time_s": 900e-6}),
    ("current_bandwidth", {"bandwidth_Hz": 120.0}, {"bandwidth_Hz": 120.0}),
    ("torque_saturation", {"limit_Nm": 2.0}, {"limit_Nm": 2.0}),
    ("external_force", {"amplitude_N": 80.0, "frequency_Hz": 7.0, "phase_rad": 0.5},
     {"amplitude_N": 80.0, "frequency_Hz": 7.0, "phase_rad": 0.5}),
]  # fmt: skip


@pytest.mark.parametrize(("name", "hidden", "ours"), EFFECTS, ids=[item[0] for item in EFFECTS])
def test_each_effect_means_the_same_in_both_codes(name, hidden, ours):
    # What the effect changes in the plant's readings is what it changes in the model's.
    bench = fine_bench()
    motion = MOTIONS["sinusoid 10 mm 5 Hz"]
    plain = make_plant(bench, effects={}, spread=0.0)
    base = model_of(plain, bench)
    grown = base.with_effect(name.removesuffix("@"), ours)
    hiding = make_plant(bench, effects={name.partition("@")[0]: hidden}, spread=0.0)
    there = run_closed_loop(bench, hiding, motion.position_m)
    before = run_closed_loop(bench, plain, motion.position_m)
    here, old = simulate(grown, motion), simulate(base, motion)
    for key in ("motor_position_m", "table_position_m"):
        change = there[key] - before[key]
        change -= change[0]
        same = getattr(here, key) - getattr(old, key)
        same = same - same[0]
        size = max(float(np.std(change)), 0.05e-6)
        assert np.std(change - same) < 0.15 * size + 0.03e-6


@pytest.mark.parametrize(
    "variables",
    [
        {"I168": 800.0},  # friction feedforward by the sign of the commanded velocity
        {"I129": 100.0},
        {"I136": -0.5, "I137": 0.1, "I138": -0.4},  # notch
        {"I134": 1.0},  # integration at standstill only
        {"I133": 400000.0},
    ],
)
def test_every_term_of_the_pmac_law_is_read_alike(variables):
    control = PAPER.controller
    update = {"ivariables": {**control.ivariables, **variables}}
    bench = PAPER.model_copy(update={"controller": control.model_copy(update=update)})
    plant = make_plant(bench, effects={}, spread=0.0)
    motion = MOTIONS["trapezoid, jerk unlimited"]
    _, table = mechanical_miss_m(bench, plant, model_of(plant, bench), motion)
    # The plant's loop closes over counts of 1 um.
    assert np.std(table) < 0.6e-6


def test_a_drive_at_its_limit_is_foreseen_though_the_card_does_not_know_it() -> None:
    # A third of the time at 6.5 N m, 0.24 mm rms of following error: the integrator winds on.
    limit = 6.5
    drive = PAPER.drive.model_copy(update={"torque_limit_Nm": limit})
    bench = PAPER.model_copy(update={"drive": drive})
    plant = make_plant(PAPER, effects={}, seed=3)
    plant.par[kernel_ballscrew.P_LIMIT] = limit
    model = DriveModel.base(bench, truth_si(plant.truth))
    motion = tr.sinusoid(period_s=TS, amplitude_m=0.01, frequency_Hz=5.0, cycles=8)
    run = run_closed_loop(bench, plant, motion.position_m)
    assert np.mean(np.abs(run["torque_command_Nm"]) > limit) > 0.25
    expected = expected_response(model, motion.position_m)
    control_m = run["true_motor_position_m"] - motion.position_m
    missed_m = run["true_motor_position_m"] - expected.motor_position_m
    assert np.std(missed_m) < 0.03 * np.std(control_m)
    error_m = run["true_table_position_m"] - run["true_motor_position_m"]
    assert np.std(error_m - expected.mechanical_error_m) < 0.3e-6
