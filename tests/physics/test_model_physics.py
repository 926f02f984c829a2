"""What physics demands of the drive model: modes, closed forms, energy, order, oracles."""

import dataclasses
import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.model import kernel, kernel_chain, quasi_static
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.signals import trajectory as tr

BENCH = load_bench("paper")
TS = BENCH.servo_period_s
MODEL = DriveModel.base(BENCH)


def test_first_mode_with_motor_free_and_held_over_the_travel():
    # Screw of 60 finite elements; four degrees of freedom come within 0.2 %.
    for x_m, free, held in (
        (0.15, 150.5, 126.2),
        (0.30, 139.5, 116.8),
        (0.45, 130.6, 109.3),
        (0.60, 123.2, 103.1),
        (0.75, 116.9, 97.8),
    ):
        table = x_m - 0.45
        assert quasi_static.modes_Hz(MODEL, table)[0] == pytest.approx(free, rel=2e-3)
        locked = quasi_static.modes_Hz(MODEL, table, motor_held=True)[0]
        assert locked == pytest.approx(held, rel=2e-3)


def test_compliance_over_the_travel():
    # By hand, nm/N: at 0.45 m bearing 4.74, screw 5.75, nut 5.56, coupling 0.42, torsion 0.62.
    found = 1e9 * quasi_static.compliance_m_per_N(MODEL, np.array([-0.3, 0.0, 0.3]))
    np.testing.assert_allclose(found, [12.84, 17.09, 21.34], rtol=1e-3)


def test_regression_coefficients_of_the_closed_form():
    # By hand, um and SI: intercepts at the bearing and slopes per m.
    found = quasi_static.regression_coefficients(MODEL)
    values = 1e6 * np.array([*found.acceleration, *found.velocity, *found.direction])
    np.testing.assert_allclose(values, [1.376, 1.816, 2.31, 3.38, 0.549, 0.855], rtol=5e-3)


def test_closed_loop_bandwidth():
    # 28.7 Hz is the -3 dB point of the loop without feedforward: small sinusoids that
    # are large against friction.
    vector_free = MODEL.without_effect("coulomb")
    bench = BENCH.model_copy(
        update={
            "controller": BENCH.controller.model_copy(
                update={"ivariables": {**BENCH.controller.ivariables, "I132": 0.0, "I135": 0.0}}
            )
        }
    )
    model = DriveModel(bench, vector_free.effects, vector_free.parameters)
    gains = []
    frequencies = np.array([24.0, 27.0, 30.0, 33.0])
    for frequency in frequencies:
        motion = tr.sinusoid(period_s=TS, amplitude_m=1e-4, frequency_Hz=frequency, cycles=30.0)
        response = simulate(model, motion)
        part = slice(motion.n // 3, 2 * motion.n // 3)
        wave = np.exp(-2j * np.pi * frequency * response.time_s[part])
        ratio = (wave @ response.motor_position_m[part]) / (wave @ motion.position_m[part])
        gains.append(abs(ratio))
    crossing = float(np.interp(-np.sqrt(0.5), -np.asarray(gains), frequencies))
    assert crossing == pytest.approx(28.7, abs=0.6)


@pytest.mark.parametrize("place_m", [-0.25, 0.0, 0.25])
def test_simulated_error_follows_the_closed_form(place_m):
    motion = tr.sinusoid(
        period_s=TS, amplitude_m=0.01, frequency_Hz=5.0, cycles=6.0, centre_m=place_m
    )
    response = simulate(MODEL, motion)
    x = response.table_position_m
    v = np.gradient(x, TS)
    a = np.gradient(v, TS)
    formula = quasi_static.mechanical_error_m(MODEL, x, v, a)
    steady = (np.abs(v) > 0.05) & (np.arange(x.size) > 1000)
    miss = (response.mechanical_error_m - formula)[steady]
    assert np.std(response.mechanical_error_m[steady]) > 10e-6
    assert np.sqrt(np.mean(miss**2)) < 0.25e-6


def test_regression_of_a_simulated_run_gives_the_stated_coefficients():
    # The closed form at mid travel: 2.205 um per m/s2, 3.84 um per m/s, 0.935 um by direction. A
    # run has the transients of its reversals too, worth 1.1 % of the share by speed.
    parts = [
        tr.sinusoid(period_s=TS, amplitude_m=a, frequency_Hz=f, cycles=4.0)
        for a, f in ((0.01, 1.0), (0.01, 3.0), (0.005, 5.0), (0.025, 2.0))
    ]
    rows, target = [], []
    for motion in parts:
        response = simulate(MODEL, motion)
        x = response.table_position_m
        v = np.gradient(x, TS)
        a = np.gradient(v, TS)
        keep = np.abs(v) > 0.01
        rows.append(np.column_stack([a, v, np.sign(v)])[keep])
        target.append(response.mechanical_error_m[keep])
    found, *_ = np.linalg.lstsq(np.vstack(rows), -np.concatenate(target), rcond=None)
    np.testing.assert_allclose(1e6 * found, [2.205, 3.84, 0.935], rtol=0.02)


def test_constant_load_at_rest_gives_the_static_deflection():
    # Without any friction at the nut: it would hold part of the wind-up.
    model = MODEL.without_effect("coulomb").with_parameters({"chain.efficiency": 1.0})
    n = 6000
    force = np.where(np.arange(n) > 200, 500.0, 0.0)
    still = np.full(n, 0.1)
    response = simulate(model, still, external_force_N=force)
    expected = -500.0 * quasi_static.compliance_m_per_N(model, 0.1)[0]
    assert response.mechanical_error_m[-1] == pytest.approx(expected, rel=1e-3)


def free_chain_energy(par, state):
    mass, _, stiffness = kernel_chain.chain_matrices(par, 0.45)
    q, v = state[:4], state[4:]
    return 0.5 * v @ mass @ v + 0.5 * q @ stiffness @ q


def test_exact_steps_keep_energy_without_damping_and_lose_it_with():
    par = MODEL.kernel_vector()
    for site in (s.GUIDE, s.NUT, s.MOTOR):
        par[site + s.VISCOUS] = 0.0
    rng = np.random.default_rng(1)
    start = rng.normal(size=8) * np.array([1e-4, 1e-4, 1e-7, 1e-6, 1e-1, 1e-1, 1e-3, 1e-2])
    for beta, falls in ((0.0, False), (7.3e-5, True)):
        par[s.BETA] = beta
        step = kernel_chain.step_matrices(par, 0.45, 1.1e-4)[:, :8]
        state = start.copy()
        energies = [free_chain_energy(par, state)]
        for _ in range(2000):
            state = step @ state
            energies.append(free_chain_energy(par, state))
        if falls:
            assert np.all(np.diff(energies) <= 1e-12 * energies[0])
            assert energies[-1] < 0.9 * energies[0]
        else:
            np.testing.assert_allclose(energies, energies[0], rtol=1e-8)


def test_friction_only_takes_energy():
    # Work of the motor torque on the rigid mass is never less than its kinetic energy.
    bench = load_bench("emps")
    model = DriveModel.base(bench, {"chain.mass_kg": 95.0, "coulomb.guide_N": 20.0})
    motion = tr.trapezoid(
        period_s=bench.servo_period_s,
        distance_m=0.1,
        speed_m_per_s=0.1,
        acceleration_m_per_s2=0.8,
    )
    response = simulate(model, motion)
    force = response.torque_command_Nm / bench.lead_m_per_rad
    moved = np.diff(response.table_position_m)
    work = np.cumsum(force[:-1] * moved)
    speed = np.gradient(response.table_position_m, bench.servo_period_s)[1:]
    kinetic = 0.5 * 95.0 * speed**2
    assert np.max(kinetic - work) < 0.02 * np.max(kinetic)
    assert work[-1] > 20.0 * 0.19


@pytest.mark.parametrize(
    ("effects", "order"),
    [
        ((), 1.5),
        (("presliding",), 1.3),
        (("stribeck@nut",), 1.0),
        (("backlash",), 1.4),
        (("smooth_coulomb",), 1.4),
    ],
)
def test_halving_the_step_converges(effects, order):
    model = MODEL
    for name in effects:
        model = model.with_effect(name)
    motion = tr.sinusoid(period_s=TS, amplitude_m=0.01, frequency_Hz=3.0, cycles=2.0)
    start = model.substeps
    truth = simulate(model, motion, substeps=16 * start).table_position_m
    misses = [
        np.std(simulate(model, motion, substeps=n * start).table_position_m - truth)
        for n in (1, 2, 4)
    ]
    assert misses[0] < 15e-9
    slopes = np.log2(np.array(misses[:-1]) / np.array(misses[1:]))
    assert np.mean(slopes) > order


@pytest.mark.parametrize("ratio", [0.25, 1.0, 3.0])
def test_smooth_friction_is_the_hyperbolic_tangent_of_speed(ratio):
    # At constant speed by hand: guide and screw side each at their own speed, and viscous friction.
    guide, turning = 2e-3, 1e-3
    speeds = {"speed_m_per_s": guide, "rotary_m_per_s": turning}
    model = MODEL.with_effect("smooth_coulomb", speeds)
    v, own, lead = ratio * guide, model.parameters, BENCH.lead_m_per_rad
    time_s = np.arange(0.0, 2.0, TS)
    torque_Nm = simulate(model, v * time_s).motor_torque_Nm
    sharp = own["coulomb.nut_Nm"] + own["coulomb.motor_Nm"]
    turns = own["viscous.nut_Nms_per_rad"] + own["viscous.motor_Nms_per_rad"]
    expected = sharp * np.tanh(v / turning) + turns * v / lead
    expected += own["coulomb.guide_N"] * lead * np.tanh(v / guide)
    expected += own["viscous.guide_Ns_per_m"] * lead * v
    # The load raises the nut's friction by the share that its efficiency loses.
    rubbing = torque_Nm[time_s > 1.5].mean()
    assert rubbing == pytest.approx(expected, rel=0.02)


def test_smooth_friction_over_no_speed_is_coulombs():
    motion = tr.sinusoid(period_s=TS, amplitude_m=0.01, frequency_Hz=3.0, cycles=2.0)
    sharp = simulate(MODEL, motion).table_position_m
    moving = np.abs(motion.velocity_m_per_s) > 1e-3
    left = []
    for speed in (1e-3, 1e-4):
        both = {"speed_m_per_s": speed, "rotary_m_per_s": speed}
        smooth = simulate(MODEL.with_effect("smooth_coulomb", both), motion).table_position_m
        left.append(smooth - sharp)
    assert np.std(left[1][moving]) < 0.15 * np.std(left[0][moving])
    assert np.std(left[1][moving]) < 0.1e-6
    # It holds nothing: with either the motor ends where the integrator lets it, not where it stood.
    assert abs(left[0][-1]) > 5e-6


def test_default_steps_are_within_ten_nanometres():
    motions = [
        tr.sinusoid(period_s=TS, amplitude_m=0.01, frequency_Hz=5.0, cycles=5.0),
        tr.trapezoid(period_s=TS, distance_m=0.1, speed_m_per_s=0.3, acceleration_m_per_s2=3.0),
        tr.triangle(period_s=TS, amplitude_m=0.002, speed_m_per_s=0.002),
    ]
    for motion in motions:
        coarse = simulate(MODEL, motion)
        fine = simulate(MODEL, motion, substeps=64)
        assert np.std(coarse.table_position_m - fine.table_position_m) < 10e-9


@pytest.mark.parametrize("mass_ratio", [0.1, 0.5, 2.0])
def test_a_light_stiff_table_on_a_light_bed_is_stable_and_exact_with_few_steps(mass_ratio):
    # 8 kg on 97 N/um: 500 Hz against a bed of 60 Hz. Felt one step late, the bed's answer drove it.
    model = DriveModel(
        MODEL.bench,
        (*MODEL.effects, "base_mode"),
        {
            "chain.table_mass_kg": 8.0,
            "base_mode.frequency_Hz": 60.0,
            "base_mode.mass_ratio": mass_ratio,
        },
    )
    move = tr.trapezoid(
        period_s=TS, distance_m=0.05, speed_m_per_s=0.2, acceleration_m_per_s2=3.0, dwell_s=0.1
    )
    fine = simulate(model, move.position_m, substeps=48).mechanical_error_m
    for substeps in (model.substeps, 2):
        coarse = simulate(model, move.position_m, substeps=substeps).mechanical_error_m
        assert np.sqrt(np.mean((coarse - fine) ** 2)) < 0.03e-6


def test_compiled_kernel_equals_its_python_source_bit_for_bit():
    # The whole module as plain Python: helpers are replaced by their sources too.
    model = MODEL.with_effect("backlash").with_effect("stribeck").with_effect("presliding@nut")
    motion = tr.sinusoid(period_s=TS, amplitude_m=1e-3, frequency_Hz=20.0, cycles=1.0)
    n = 120
    desired = motion.position_m[200 : 200 + n].copy()
    vector = model.kernel_vector()
    zeros = np.zeros(n)
    rows, values = np.zeros((0, s.TERM_COLUMNS)), np.zeros((0, 1))
    bank = kernel_chain.step_bank(vector, 0.43, 0.01, 5, TS / 4)
    compiled, plain = np.zeros((5, n)), np.zeros((5, n))
    kernel.run(vector, bank, 0.43, 0.01, 4, desired, zeros, zeros, rows, values, 0.0, compiled)
    run_as_python(vector, bank, 0.43, 0.01, 4, desired, zeros, zeros, rows, values, 0.0, plain)
    assert np.array_equal(compiled, plain)
    assert np.ptp(compiled[1]) > 1e-4


def run_as_python(*arguments):
    names = [n for n, v in vars(kernel).items() if hasattr(v, "py_func")]
    with pytest.MonkeyPatch.context() as patch:
        for name in names:
            patch.setattr(kernel, name, getattr(kernel, name).py_func)
        kernel.run(*arguments)


def test_simulation_against_scipy_with_the_same_torque():  # noqa: PLR0915 one set of equations
    # Independent oracle: the equations of motion written out for solve_ivp, smooth friction only,
    # driven by the torque that the simulated loop commanded.
    model = MODEL.without_effect("coulomb").with_parameters({"chain.efficiency": 1.0})
    motion = tr.sinusoid(
        period_s=TS, amplitude_m=0.005, frequency_Hz=4.0, cycles=0.6, ramp_cycles=0.4, dwell_s=0.02
    )
    response = simulate(model, motion, substeps=16)
    torque = response.torque_command_Nm
    p = dict(model.parameters)
    rho = BENCH.lead_m_per_rad

    def matrices(x):
        j_c = p["chain.motor_inertia_kgm2"] / 5.45
        length = BENCH.screw.length_mm / 1e3
        k_c, k_axial = p["chain.torsional_stiffness_Nm_per_rad"], p["chain.axial_stiffness_N_per_m"]
        k_b, k_n = k_axial * (1 + 211 / 180), k_axial * (1 + 180 / 211)
        gj = p["chain.screw_rigidity_N"] * (79.4 / 206.0) * 0.022**2 / 8
        ea = p["chain.screw_rigidity_N"]
        j_s = p["chain.screw_inertia_kgm2"]
        m_s = 7850.0 * np.pi / 4 * np.sqrt(32 * j_s / (np.pi * 7850.0 * length)) * length
        a = (1 / k_c) / (1 / k_c + x / gj)
        b = (1 / k_b) / (1 / k_b + x / ea)
        near = j_s * x / length
        # theta_c = (1 - a) theta_m + a theta_s; the screw turns linearly between theta_c, theta_s.
        T = np.array([[1 - a, a], [0.0, 1.0]])
        M = np.zeros((4, 4))
        M[:2, :2] = T.T @ (near / 6 * np.array([[2.0, 1.0], [1.0, 2.0]])) @ T
        M[:2, :2] += 0.5 * j_c * np.outer(T[0], T[0])
        M[0, 0] += p["chain.motor_inertia_kgm2"] - 0.5 * j_c
        M[1, 1] += j_s * (1 - x / length)
        M[2, 2] = m_s * (x / length * (b * b + b + 1) / 3 + 1 - x / length)
        M[3, 3] = p["chain.table_mass_kg"]
        v = np.array([0.0, -rho, -1.0, 1.0])
        K = k_n * np.outer(v, v)
        k_th = 1 / (1 / k_c + x / gj)
        K[:2, :2] += k_th * np.array([[1.0, -1.0], [-1.0, 1.0]])
        K[2, 2] += 1 / (1 / k_b + x / ea)
        C = p["chain.damping_time_s"] * K
        C += np.diag(
            [p["viscous.motor_Nms_per_rad"], p["viscous.nut_Nms_per_rad"], 0.0,
             p["viscous.guide_Ns_per_m"]]
        )  # fmt: skip
        return M, C, K

    delay, rate = p["chain.actuator_delay_s"], 2 * np.pi * p["chain.current_bandwidth_Hz"]

    def right_side(_, y, held, M, C, K):
        force = -C @ y[4:8] - K @ y[:4]
        force[0] += y[8]
        return np.concatenate([y[4:8], np.linalg.solve(M, force), [rate * (held - y[8])]])

    y = np.zeros(9)
    times, tables, errors = [0.0], [0.0], [0.0]
    end = (motion.n - 1) * TS
    breaks = np.arange(0, motion.n) * TS + delay
    edges = [0.0, *[float(t) for t in breaks if t < end], end]
    for low, high in itertools.pairwise(edges):
        cell = int(np.floor((low - delay) / TS + 1e-9))
        held = torque[cell] if cell >= 0 else 0.0
        # Within a servo period the table moves less than 0.1 mm along the screw.
        middle = matrices(y[3] + 0.5 * (high - low) * y[7] + 0.45)
        got = solve_ivp(
            right_side, (low, high), y, "DOP853", args=(held, *middle), rtol=1e-8, atol=1e-13
        )
        y = got.y[:, -1]
        times.append(high)
        tables.append(y[3])
        errors.append(y[3] - rho * y[0])
    ours = np.interp(times, response.time_s, response.table_position_m)
    bent = np.interp(times, response.time_s, response.mechanical_error_m)
    assert np.ptp(errors) > 10e-6
    assert np.std(bent - errors) < 5e-9
    # Under a given torque the table is a double integrator: what adds up over 0.4 s stays small.
    assert np.max(np.abs(ours - tables)) < 3e-5 * np.ptp(tables)


def test_slip_element_curve_is_exponential():
    from pmac_comp.physics.model.effects import presliding_gms as gms

    distance = np.linspace(0.0, 6.0, 200)
    curve = sum(
        share * np.minimum(distance / at, 1.0)
        for share, at in zip(gms._SHARES, gms._DISTANCES, strict=True)
    )
    assert np.max(np.abs(curve - (1.0 - np.exp(-distance)))) < 0.03


def test_dahl_force_reaches_63_percent_after_its_distance():
    model = MODEL.with_effect("presliding", {"distance_m": 50e-6}).with_parameters(
        {"coulomb.nut_Nm": 0.0, "coulomb.motor_Nm": 0.0}
    )
    motion = tr.triangle(
        period_s=TS, amplitude_m=0.4e-3, speed_m_per_s=1e-3, acceleration_m_per_s2=0.1, cycles=1
    )
    response = simulate(model, motion)
    up = slice(int(0.1 / TS), int(0.4 / TS))
    travelled = response.table_position_m[up] - response.table_position_m[0]
    force = -response.joint_force_N[up] / 45.0
    at = np.interp(50e-6, travelled, force)
    assert at == pytest.approx(1.0 - np.exp(-1.0), abs=0.03)


def test_rigid_bench_follows_the_published_cascade():
    bench = load_bench("emps")
    model = DriveModel.base(bench, {"chain.mass_kg": 95.1, "viscous.guide_Ns_per_m": 203.0})
    motion = tr.trapezoid(
        period_s=bench.servo_period_s,
        distance_m=0.2,
        speed_m_per_s=0.1,
        acceleration_m_per_s2=0.8,
    )
    response = simulate(model, motion)
    # Velocity lag of a P position loop: v / kp, plus the friction's share over the gains.
    middle = motion.n // 4
    friction = 203.0 * 0.1 + 20.0
    lag = 0.1 / 160.18 + friction / (35.1507 * 243.45 * 160.18)
    assert -response.control_error_m[middle] == pytest.approx(lag, rel=0.01)
    np.testing.assert_allclose(
        response.table_position_m, response.motor_position_m, rtol=0.0, atol=1e-12
    )


def test_quantised_loop_reads_whole_counts():
    motion = tr.sinusoid(period_s=TS, amplitude_m=0.005, frequency_Hz=2.0, cycles=1.0)
    response = simulate(MODEL, motion, quantise=True)
    counts = response.motor_position_m / BENCH.motor_resolution_m
    steps = response.table_position_m / BENCH.scale_resolution_m
    assert np.max(np.abs(counts - np.round(counts))) < 1e-6
    assert np.max(np.abs(steps - np.round(steps))) < 1e-6
    smooth = simulate(MODEL, motion)
    assert np.std(response.table_position_m - smooth.table_position_m) < 1e-6


def test_torque_feedforward_of_friction_takes_the_reversal_peaks_away():
    motion = tr.sinusoid(period_s=TS, amplitude_m=0.01, frequency_Hz=2.0, cycles=3.0)
    plain = simulate(MODEL, motion)
    sense = np.sign(motion.velocity_m_per_s)
    helped = simulate(MODEL, motion, torque_feedforward_Nm=0.52 * sense)
    # 45 to 70 um without.
    assert 30e-6 < np.max(np.abs(plain.control_error_m)) < 80e-6
    assert np.std(helped.control_error_m) < 0.4 * np.std(plain.control_error_m)


def test_response_is_frozen():
    response = simulate(MODEL, np.zeros(5))
    with pytest.raises(dataclasses.FrozenInstanceError):
        response.time_s = np.zeros(5)
    assert np.all(response.table_position_m == 0.0)


def test_a_pushed_drive_without_torque_loses_energy_until_it_rests():
    drive = BENCH.drive.model_copy(update={"torque_limit_Nm": 1e-12})
    bench = BENCH.model_copy(update={"drive": drive})
    n = 3000
    force = np.where(np.arange(n) < 300, -1500.0, 0.0)
    model = DriveModel.base(bench)
    response = simulate(model, np.zeros(n), external_force_N=force)
    v = np.gradient(response.table_position_m, TS)
    free = v[320:]
    par = model.kernel_vector()
    moving = par[s.M_TABLE] + (par[s.J_MOTOR] + par[s.J_COUPLING] + par[s.J_SCREW]) / (
        BENCH.lead_m_per_rad**2
    )
    spring = 0.5 * response.joint_force_N[320:] ** 2 / par[s.K_NUT]
    energy = 0.5 * moving * free**2 + spring
    # Means over a period of the first mode: within one, energy passes between springs.
    means = energy[: energy.size // 17 * 17].reshape(-1, 17).mean(axis=1)
    assert v[320] > 0.05
    assert np.all(np.diff(means) < 1e-3 * means[0])
    assert np.all(np.abs(v[-200:]) < 1e-9)
