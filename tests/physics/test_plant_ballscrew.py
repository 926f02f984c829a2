"""The simulated drive against figures of the bench, a SciPy integrator and its own laws."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pmac_comp.base.errors import ConfigError
from pmac_comp.files.bench import load_bench
from pmac_comp.simulator.plant import kernel_ballscrew as k
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.plant.ballscrew import BallscrewPlant, modal_frequencies_Hz
from pmac_comp.simulator.plant.effects import PLANT_EFFECTS
from pmac_comp.simulator.servo.closed_loop import run_closed_loop

BENCH = load_bench("paper")
TS = BENCH.servo_period_s


def nominal(effects=None) -> BallscrewPlant:
    return make_plant(BENCH, effects=effects or {}, spread=0.0)


def sine(amplitude_m: float, frequency_Hz: float, duration_s: float = 2.0, centre_m: float = 0.0):
    t = np.arange(round(duration_s / TS)) * TS
    ramp = np.clip(t * frequency_Hz, 0.0, 1.0)
    ramp = ramp**2 * (3.0 - 2.0 * ramp)
    return centre_m + amplitude_m * ramp * np.sin(2.0 * math.pi * frequency_Hz * t)


def mechanical_error_um(run) -> np.ndarray:
    return 1e6 * (run["true_table_position_m"] - run["true_motor_position_m"])


# Screw of 60 finite elements: bearing-to-nut distance -> first mode, motor free.
@pytest.mark.parametrize(
    ("x_m", "free_Hz"), [(0.15, 150.5), (0.30, 139.5), (0.45, 130.6), (0.60, 123.2), (0.75, 116.9)]
)
def test_first_resonance_over_the_travel(x_m, free_Hz):
    found = modal_frequencies_Hz(nominal().par, x_m - 0.45)[1]
    assert found == pytest.approx(free_Hz, rel=0.003)


def test_drawn_drives_keep_the_measured_resonance_and_their_tolerances():
    masses = set()
    for seed in range(12):
        plant = make_plant(BENCH, seed=seed)
        assert modal_frequencies_Hz(plant.par, 0.0)[1] == pytest.approx(130.6, rel=1e-6)
        assert abs(plant.truth.table_mass_kg / 122.86 - 1.0) <= 0.05
        assert abs(plant.truth.screw_rigidity_N / 7.83e7 - 1.0) <= 0.03
        masses.add(plant.truth.table_mass_kg)
    assert len(masses) == 12
    again = make_plant(BENCH, seed=3)
    np.testing.assert_array_equal(again.par, make_plant(BENCH, seed=3).par)


@pytest.mark.parametrize("centre_m", [-0.25, 0.0, 0.25])
def test_quasi_static_error_has_the_coefficients_of_the_closed_form(centre_m):
    run = run_closed_loop(BENCH, nominal(), sine(0.01, 5.0, 3.0, centre_m))
    kept = run["time_s"] > 1.0
    v = np.gradient(run["true_table_position_m"], TS)
    a = np.gradient(v, TS)
    moving = kept & (np.abs(v) > 0.02)
    columns = np.column_stack([a, v, np.sign(v), np.ones_like(v)])[moving]
    found = np.linalg.lstsq(columns, mechanical_error_um(run)[moving], rcond=None)[0]
    x = 0.45 + centre_m
    # C, c_J and the nut term of the closed form, um per m/s2, um per m/s, um.
    c_th = 1.0 / 6000.0 + x / 1826.0
    rho = 0.01 / (2.0 * math.pi)
    c = 1.0 / 97.14e6 + x / 7.83e7 + rho**2 * c_th
    c_j = (2.557e-4 + 0.5e-4) / 6000.0 + 2.557e-4 * (x - x**2 / 2.0) / 1826.0
    assert found[0] == pytest.approx(-1e6 * (c * 122.86 + c_j), rel=0.01)
    assert found[1] == pytest.approx(-1e6 * (c * 200.0 + c_th * 1e-3), rel=0.06)
    assert found[2] == pytest.approx(-1e6 * (c * 45.0 + rho * c_th * 0.25), rel=0.08)


def test_external_force_deflects_by_the_compliance():
    command = np.zeros(6000)
    errors = []
    for force in (600.0, 1200.0):
        run = run_closed_loop(
            BENCH, nominal(), command, external_force_N=np.full(command.size, force)
        )
        errors.append(mechanical_error_um(run)[-500:].mean())
    # Positive pushes against positive motion: the table gives way to the negative side.
    assert errors[1] < errors[0] < 0.0
    assert (errors[0] - errors[1]) / 600.0 == pytest.approx(17.09e-3, rel=0.02)


def no_rotary_friction(par):
    for level, damping in (
        (k.P_MOTOR_LEVEL, k.P_MOTOR_DAMPING),
        (k.P_NUT_LEVEL, k.P_NUT_DAMPING),
    ):
        par[level] = 1e-9
        par[damping] = 0.0


def rhs_of(par, torque, friction):
    """Equations of motion of the drive, written a third time, for SciPy."""
    x = par[k.P_ORIGIN]
    rho = par[k.P_LEAD]
    kc, gj, kb, ea, kn = (
        par[i] for i in (k.P_K_COUPLING, k.P_GJ, k.P_K_BEARING, k.P_EA, k.P_K_NUT)
    )
    a = (1 / kc) / (1 / kc + x / gj)
    b = (1 / kb) / (1 / kb + x / ea)
    js = par[k.P_J_SCREW] * x / par[k.P_LENGTH]
    ms = par[k.P_M_SCREW] * x / par[k.P_LENGTH]
    mass = np.zeros((4, 4))
    mass[0, 0] = par[k.P_J_MOTOR]
    coupling = np.array([1 - a, a])
    far = np.array([0.0, 1.0])
    mass[:2, :2] += par[k.P_J_COUPLING] * np.outer(coupling, coupling)
    mass[:2, :2] += js / 3 * (np.outer(coupling, coupling) + np.outer(far, far))
    mass[:2, :2] += js / 6 * (np.outer(coupling, far) + np.outer(far, coupling))
    mass[1, 1] += par[k.P_J_SCREW] - js
    mass[2, 2] = ms / 3 * (1 + b + b * b) + par[k.P_M_SCREW] - ms
    mass[3, 3] = par[k.P_M_TABLE]
    v = np.array([0, -rho, -1, 1])
    stiff = kn * np.outer(v, v)
    stiff[:2, :2] += 1 / (1 / kc + x / gj) * np.array([[1, -1], [-1, 1]])
    stiff[2, 2] += 1 / (1 / kb + x / ea)
    inverse = np.linalg.inv(mass)

    def rhs(t, s):
        q, w, z, tm = s[:4], s[4:8], s[8], s[9]
        force = np.zeros(4)
        force[0] = tm - par[k.P_MOTOR_VISCOUS] * w[0]
        force[1] = -par[k.P_NUT_VISCOUS] * w[1]
        force[3] = -par[k.P_GUIDE_VISCOUS] * w[3]
        dz = 0.0
        if friction:
            g = par[k.P_GUIDE_LEVEL] + par[k.P_STRIBECK_N] * math.exp(
                -((w[3] / par[k.P_STRIBECK_SPEED]) ** 2)
            )
            sigma = par[k.P_GUIDE_LEVEL] / par[k.P_GUIDE_BREAK]
            dz = w[3] - abs(w[3]) * z * sigma / g
            force[3] -= sigma * z + par[k.P_GUIDE_DAMPING] * dz
        acc = inverse @ (force - stiff @ (q + par[k.P_BETA] * w))
        return np.concatenate([w, acc, [dz, par[k.P_BANDWIDTH] * (torque(t) - tm)]])

    return rhs


@pytest.mark.parametrize("friction", [False, True])
def test_drive_follows_a_scipy_integrator(friction):
    effects = {"stribeck": {"excess_N": 15.0}, "presliding": {"distance_um": 10.0}}
    plant = nominal(effects)
    par = plant.par
    par[k.P_DELAY] = 0.0
    par[k.P_NUT_LOAD] = 0.0
    no_rotary_friction(par)
    if not friction:
        par[k.P_GUIDE_LEVEL] = 1e-6
        par[k.P_GUIDE_DAMPING] = 0.0
        par[k.P_STRIBECK_N] = 0.0
    plant.reset()
    n = 300
    command = 1.5 * np.sign(np.sin(2 * math.pi * 40.0 * (np.arange(n) + 0.5) * TS))
    found = np.zeros((n, 4))
    for i in range(n):
        plant.step(command[i])
        found[i] = plant.state[[k.S_TH_MOTOR, k.S_TH_SCREW, k.S_AXIAL, k.S_TABLE]]
    state = np.zeros(10)
    wanted = np.zeros((n, 4))
    for i in range(n):
        rhs = rhs_of(par, lambda _t, i=i: command[i], friction)
        solved = solve_ivp(rhs, (0, TS), state, method="LSODA", rtol=1e-9, atol=1e-13)
        state = solved.y[:, -1]
        wanted[i] = state[:4]
    lead = par[k.P_LEAD]
    scale = np.array([lead, lead, 1.0, 1.0])
    travel = np.ptp(wanted[:, 3])
    assert travel > 200e-6
    # Motor and table within 0.2 % of the travel; the error between them within 0.08 um.
    assert np.max(np.abs((found - wanted) * scale)) < 2e-3 * travel
    error = (found[:, 3] - lead * found[:, 0]) - (wanted[:, 3] - lead * wanted[:, 0])
    assert np.max(np.abs(error)) < 0.08e-6


def test_finer_steps_converge():
    command = 2.0 * np.sin(2 * math.pi * 10.0 * np.arange(1000) * TS)
    results = []
    for fine in (4.0, 8.0, 16.0, 64.0):
        plant = nominal()
        plant.par[k.P_N_FINE] = fine
        results.append(plant.run(command)[:, 1])
    errors = [np.max(np.abs(r - results[-1])) for r in results[:-1]]
    assert errors[1] < 0.65 * errors[0]
    assert errors[2] < 0.65 * errors[1]


@pytest.mark.parametrize("time_us", [300.0, 626.0, 2000.0])
def test_heavy_damping_gets_the_steps_that_it_needs(time_us):
    command = 2.0 * np.sin(2 * math.pi * 10.0 * np.arange(1000) * TS)
    plants = [nominal({"chain_damping": {"time_us": time_us}}) for _ in range(2)]
    plants[1].par[k.P_N_FINE] *= 8.0
    found, fine = (p.run(command)[:, 1] for p in plants)
    assert np.max(np.abs(found - fine)) < 2e-3 * np.ptp(fine)


def test_compiled_step_equals_its_python_form_bit_for_bit():
    fast, slow = make_plant(BENCH, seed=5), make_plant(BENCH, seed=5)
    torque = 2.0 * np.sin(np.arange(300) * 0.05)
    for value in torque:
        k.ballscrew_step(fast.state, fast.par, fast.log, value)
        k.ballscrew_step.py_func(slow.state, slow.par, slow.log, value)
    np.testing.assert_array_equal(fast.state, slow.state)


def elastic_and_kinetic_J(plant) -> float:
    s, par = plant.state, plant.par
    v = s[[k.S_W_MOTOR, k.S_W_SCREW, k.S_V_AXIAL, k.S_V_TABLE]]
    kinetic = 0.5 * (
        par[k.P_J_MOTOR] * v[0] ** 2
        + (par[k.P_J_SCREW] + par[k.P_J_COUPLING]) * v[1] ** 2
        + par[k.P_M_TABLE] * v[3] ** 2
    )
    delta = s[k.S_TABLE] - par[k.P_LEAD] * s[k.S_TH_SCREW] - s[k.S_AXIAL]
    return float(kinetic + 0.5 * par[k.P_K_NUT] * delta**2)


def test_energy_dies_away_without_input():
    plant = nominal()
    plant.run(np.full(30, 8.0))
    start = elastic_and_kinetic_J(plant)
    previous = start
    for _ in range(40):
        plant.run(np.zeros(50))
        now = elastic_and_kinetic_J(plant)
        assert now <= previous * (1.0 + 1e-6) + 1e-9
        previous = now
    assert previous < 1e-6 * start


def test_a_standing_axis_sticks_under_a_vibrating_torque():
    plant = nominal()
    wobble = 0.2 + 0.1 * np.sin(2 * math.pi * 30.0 * np.arange(4000) * TS)
    out = plant.run(wobble)
    settled = out[500:, 1]
    # Break-away needs 0.52 N m: less than that must not creep.
    assert np.ptp(settled) < 1e-6
    assert abs(settled[-500:].mean() - settled[:500].mean()) < 1e-9
    moved = nominal().run(np.full(2000, 0.7))[-1, 1]
    assert moved > 1e-3


def test_current_loop_delay_and_limit():
    plant = nominal()
    plant.par[k.P_DELAY] = 2.5 * TS
    torques = []
    for _ in range(8):
        plant.step(50.0)
        torques.append(plant.state[k.S_TORQUE])
    assert torques[1] == 0.0
    rise = 19.11 * (1.0 - math.exp(-2 * math.pi * 300.0 * 0.5 * TS))
    assert torques[2] == pytest.approx(rise, rel=0.05)
    assert torques[-1] == pytest.approx(19.11, rel=0.02)


def run_with(effects, command=None):
    command = sine(0.02, 1.0) if command is None else command
    return run_closed_loop(BENCH, nominal(effects), command)


def difference_um(effects, command=None):
    """What an effect adds to the error between table and motor, as the sensors' truth."""
    plain, changed = run_with({}, command), run_with(effects, command)
    return mechanical_error_um(changed) - mechanical_error_um(plain), changed


def test_backlash_opens_by_its_clearance():
    t = np.arange(round(4.0 / TS)) * TS
    command = 0.05 * np.interp(t, [0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 1.0, 0.0, 1.0, 0.0])
    extra, _ = difference_um({"backlash": {"gap_um": 8.0}}, command)
    forward = extra[(t > 0.3) & (t < 0.9)].mean()
    backward = extra[(t > 1.3) & (t < 1.9)].mean()
    assert forward - backward == pytest.approx(-8.0, abs=0.1)


def test_lead_errors_are_static():
    extra, run = difference_um({"lead_linear": {"slope_um_per_m": 100.0}})
    slope = np.polyfit(run["commanded_position_m"], extra, 1)[0]
    assert slope == pytest.approx(100.0, rel=0.03)
    wave = {"amplitude_um": 3.0, "order_per_rev": 1.0, "phase_rad": 0.5}
    extra, run = difference_um({"lead_cyclic": wave})
    angle = run["true_motor_position_m"] / BENCH.lead_m_per_rad
    columns = np.column_stack([np.cos(angle), np.sin(angle), np.ones_like(angle)])
    found = np.linalg.lstsq(columns, extra, rcond=None)[0]
    assert found[0] == pytest.approx(3.0 * math.cos(0.5), rel=0.05)
    assert found[1] == pytest.approx(-3.0 * math.sin(0.5), rel=0.05)


def test_sensor_effects_show_in_readings_and_not_in_the_truth():
    command = sine(0.05, 1.0)
    for effects, size_um in (
        ({"channel_skew": {"time_us": 20.0}}, 20.0 * 0.05 * 2 * math.pi),
        ({"scale_slope": {"slope_um_per_m": 60.0}}, 60.0 * 0.05),
    ):
        extra, run = difference_um(effects, command)
        assert np.max(np.abs(extra)) < 0.05
        seen = 1e6 * (run["table_position_m"] - run["true_table_position_m"])
        assert np.max(np.abs(seen)) == pytest.approx(size_um, rel=0.08)
    run = run_with({"encoder_eccentricity": {"amplitude_um": 4.0}}, command)
    seen = 1e6 * (run["motor_position_m"] - run["true_motor_position_m"])
    assert np.ptp(seen[1000:]) == pytest.approx(8.0, abs=1.2)


@pytest.mark.parametrize(
    ("name", "parameters", "torque_Nm"),
    [
        ("bias_force", {"force_N": 100.0}, 100.0 * 0.01 / (2 * math.pi)),
        ("cable_drag", {"stiffness_N_per_m": 5000.0, "centre_mm": -20.0}, 5000 * 0.02 * 1.5915e-3),
    ],
)
def test_static_loads_show_in_the_mean_torque(name, parameters, torque_Nm):
    command = sine(0.02, 1.0, 3.0)
    last = slice(round(1.0 / TS), round(3.0 / TS))
    plain = run_with({}, command)["torque_command_Nm"][last].mean()
    changed = run_with({name: parameters}, command)["torque_command_Nm"][last].mean()
    # A positive bias force resists positive motion: the motor has more to do.
    assert changed - plain == pytest.approx(torque_Nm, rel=0.1)


def test_presliding_distance_is_that_of_63_percent():
    plant = nominal({"presliding": {"distance_um": 20.0, "place": "guide"}})
    no_rotary_friction(plant.par)
    share = np.linspace(0.0, 0.8, 8000)
    table_um = 1e6 * plant.run(share * 45.0 * BENCH.lead_m_per_rad)[:, 1]
    for part in (0.3, 1.0 - math.exp(-1.0), 0.75):
        expected_um = -20.0 * math.log(1.0 - part)
        assert np.interp(part, share, table_um) == pytest.approx(expected_um, rel=0.05)


def closure_of_an_inner_loop_um(elements):
    """Table shift after the guide force went up, back by half and up to the same value again."""
    effect = {"distance_um": 20.0, "place": "guide", "elements": elements}
    plant = nominal({"presliding": effect})
    no_rotary_friction(plant.par)
    share = np.interp(np.arange(16001), [0, 4000, 8000, 12000, 16000], [0, 0.7, 0.2, 0.7, 0.7])
    table_um = 1e6 * plant.run(share * 45.0 * BENCH.lead_m_per_rad)[:, 1]
    return table_um[12000] - table_um[4000]


def test_parallel_elements_remember_where_an_inner_loop_began():
    assert abs(closure_of_an_inner_loop_um(6.0)) < 0.3
    assert closure_of_an_inner_loop_um(0.0) > 2.0  # a single bristle drifts


def test_parallel_elements_reach_63_percent_at_the_stated_distance():
    plant = nominal({"presliding": {"distance_um": 20.0, "place": "guide", "elements": 6.0}})
    no_rotary_friction(plant.par)
    share = np.linspace(0.0, 0.8, 8000)
    table_um = 1e6 * plant.run(share * 45.0 * BENCH.lead_m_per_rad)[:, 1]
    assert np.interp(20.0, table_um, share) == pytest.approx(1.0 - math.exp(-1.0), abs=0.02)


def test_reversal_dip_recovers_with_distance():
    t = np.arange(9000) * TS
    command = np.where(t < 2.0, 0.01 * t, 0.04 - 0.01 * t)
    dip = {"post_reversal_dip": {"fraction": 0.4, "length_mm": 1.0}}
    less = np.abs(run_with({}, command)["torque_command_Nm"])
    less -= np.abs(run_with(dip, command)["torque_command_Nm"])
    travelled_mm = 10.0 * (t - 2.0)
    for low, high in ((0.5, 1.0), (1.0, 2.0), (8.0, 10.0)):
        window = (travelled_mm > low) & (travelled_mm < high)
        # Nut drag of the drive is 0.25 N m; the length is 1 mm.
        expected = 0.4 * 0.25 * (math.exp(-low) - math.exp(-high)) / (high - low)
        assert less[window].mean() == pytest.approx(expected, abs=0.012)


@pytest.mark.parametrize("name", sorted(PLANT_EFFECTS))
def test_every_effect_changes_the_drive_and_stays_finite(name):
    command = sine(0.02, 3.0, 1.2)
    given = {
        "coulomb": {"guide_N": 80.0},
        "viscous": {"guide_Ns_per_m": 600.0},
        "stribeck": {"excess_N": 20.0},
        "torque_saturation": {"limit_Nm": 2.0},
    }.get(name, {})
    plain, run = run_with({}, command), run_with({name: given}, command)
    changed = 0.0
    for signal in ("motor_position_m", "table_position_m", "torque_command_Nm"):
        assert np.all(np.isfinite(run[signal]))
        changed = max(changed, float(np.max(np.abs(run[signal] - plain[signal]))))
    assert changed > 0.0


@pytest.mark.parametrize("name", [n for n, effect in PLANT_EFFECTS.items() if effect.places])
def test_every_place_of_an_effect_is_another_drive(name):
    given = {"excess_Nm": 0.1} if name == "stribeck" else {}
    tables = [run_with({})["table_position_m"]]
    for place in PLANT_EFFECTS[name].places:
        tables.append(run_with({name: {**given, "place": place}})["table_position_m"])
        assert all(np.max(np.abs(tables[-1] - other)) > 1e-9 for other in tables[:-1])


def test_unknown_effects_and_parameters_are_refused():
    for effects in (
        {"nonsense": {}},
        {"backlash": {"gap_mm": 1.0}},
        {"presliding": {"place": "x"}},
    ):
        with pytest.raises(ConfigError):
            make_plant(BENCH, effects=effects)
    with pytest.raises(ConfigError, match="motor_inertia"):
        make_plant(load_bench("emps"))


def test_record_keeps_the_latest_cycles():
    plant = make_plant(BENCH)
    plant.record(100)
    plant.run(np.full(250, 1.0))
    truth = plant.recorded()
    assert truth["cycle"].tolist() == list(range(151, 251))
    assert truth["table_position_m"][-1] == plant.state[k.S_TABLE]
