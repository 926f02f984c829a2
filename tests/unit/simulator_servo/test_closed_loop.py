"""The light closed loop: control laws against their definitions, and against the card."""

import itertools
import math

import numpy as np
import pytest

from pmac_comp.base.errors import ConfigError, NonFinite
from pmac_comp.files.bench import load_bench, parse_bench
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.plant.kernel_ballscrew import S_CYCLE
from pmac_comp.simulator.servo import trajectory as traj
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture, run_closed_loop

BENCH = load_bench("paper")
TS = BENCH.servo_period_s


def sine(n=3000, amplitude_m=0.005, frequency_Hz=2.0):
    t = np.arange(n) * TS
    ramp = np.clip(t * frequency_Hz, 0, 1)
    return amplitude_m * np.sin(2 * math.pi * frequency_Hz * t) * ramp**2 * (3 - 2 * ramp)


class Rigid:
    """One mass and nothing else, as a user would write a plant."""

    def __init__(self, bench):
        self.period = bench.servo_period_s
        self.lead = bench.lead_m_per_rad
        self.angle = self.speed = 0.0

    def reset(self, table_position_m=0.0):
        self.angle, self.speed = table_position_m / self.lead, 0.0

    def step(self, torque_command_Nm):
        acceleration = (torque_command_Nm - 0.01 * self.speed) / 1.1e-3
        self.angle += self.period * (self.speed + 0.5 * self.period * acceleration)
        self.speed += self.period * acceleration
        return self.angle, self.angle * self.lead


def si_bench(limit_Nm=19.11):
    text = BENCH.text.replace('kind = "pmac"', 'kind = "si"').replace(
        "torque_limit_Nm = 19.11", f"torque_limit_Nm = {limit_Nm}"
    )
    text += """
[controller.si]
Kp_Nm_per_mm = 14.9
Ki_Nm_per_mm_s = 187.0
Kd_Nm_s_per_mm = 0.1426
Kvff_Nm_s_per_mm = 0.1442
Kaff_Nm_s2_per_mm = 6.987e-4
velocity_filter_alpha = 0.5
"""
    return parse_bench(text)


@pytest.mark.parametrize("limit_Nm", [19.11, 1.0])
def test_si_law_is_the_stated_one(limit_Nm):
    bench = si_bench(limit_Nm)
    run = run_closed_loop(bench, Rigid(bench), sine())
    r, y = run["commanded_position_m"] * 1e3, run["motor_position_m"] * 1e3
    ts = bench.servo_period_s
    integral, filtered, before, speed_before = 0.0, 0.0, y[0], 0.0
    wanted = []
    for k in range(r.size):
        e = r[k] - y[k]
        filtered += 0.5 * ((y[k] - before) / ts - filtered)
        v = (r[k] - r[max(k - 1, 0)]) / ts
        a = (v - speed_before) / ts
        rest = 14.9 * e - 0.1426 * filtered + 0.1442 * v + 6.987e-4 * a
        u = rest + integral + 187.0 * ts * e
        if not (abs(u) > limit_Nm and u * e > 0):
            integral += 187.0 * ts * e
        wanted.append(float(np.clip(rest + integral, -limit_Nm, limit_Nm)))
        before, speed_before = y[k], v
    np.testing.assert_allclose(run["torque_command_Nm"], wanted, atol=1e-9)


def test_cascade_law_is_that_of_the_record():
    text = (
        BENCH.text.replace('kind = "pmac"', 'kind = "cascade"')
        + """
[controller.cascade]
kp_per_s = 160.18
kv_V_per_m_per_s = 243.45
gain_N_per_V = 35.1507
"""
    )
    bench = parse_bench(text)
    run = run_closed_loop(bench, Rigid(bench), sine())
    q = run["motor_position_m"]
    back2 = np.concatenate([[q[0], q[0]], q[:-2]])
    volts = 243.45 * (
        160.18 * (run["commanded_position_m"] - q) - (q - back2) / (2 * bench.servo_period_s)
    )
    wanted = np.clip(volts * 35.1507 * bench.lead_m_per_rad, -19.11, 19.11)
    np.testing.assert_allclose(run["torque_command_Nm"], wanted, atol=1e-9)


def test_pmac_law_is_that_of_the_manual():
    # 2^-19 Ixx30 [Ixx08 (FE + (Ixx32 CV + Ixx35 CA)/128 + Ixx33 IE/2^23) - Ixx09 Ixx31 AV/128]
    plant = Rigid(BENCH)
    run = run_closed_loop(BENCH, plant, sine())
    i = BENCH.controller.ivariables
    count_m = BENCH.motor_resolution_m
    cmd = np.floor(run["commanded_position_m"] / count_m * 3072 + 0.5) / 3072
    act = run["motor_position_m"] / count_m
    fe = cmd - act
    cv = np.diff(cmd, prepend=cmd[0])
    ca = np.diff(cv, prepend=0.0)
    av = np.diff(act, prepend=act[0])
    ie = np.concatenate([[0.0], np.cumsum(fe)[:-1]])
    law = 96 * (fe + (i["I132"] * cv + i["I135"] * ca) / 128 + i["I133"] * ie / 2**23)
    dac = i["I130"] * (law - 96 * i["I131"] * av / 128) / 2**19
    wanted = np.clip(dac, -32767, 32767) * BENCH.drive.torque_per_dac_Nm
    np.testing.assert_allclose(
        run["torque_command_Nm"], wanted, atol=1.1 * BENCH.drive.torque_per_dac_Nm
    )


def test_card_and_light_loop_drive_the_same_axis(make_servo):
    servo = make_servo()
    servo.enable(1)
    servo.run(400)
    servo.plant.reset(0.0)
    servo.kill(1)
    servo.run(20)
    servo.enable(1)
    command = sine(2000, 0.004)
    units = command / BENCH.motor_resolution_m * 3072
    segments = [traj.Segment(1.0, (float(a), float(b - a))) for a, b in itertools.pairwise(units)]
    servo.plant.record(4000)
    queued = 0
    while queued < len(segments):
        servo.queue.push(1, segments[queued : queued + 400])
        queued += 400
        servo.run(400 if queued < len(segments) else len(segments) - queued + 400)
    truth = servo.plant.recorded()
    light = run_closed_loop(BENCH, make_plant(BENCH), command)
    # The card commands sample i + 1 in its cycle i and records the end of the cycle; the light
    # loop records the start of cycle i, before command i acts.
    n = min(truth["cycle"].size, command.size - 2)
    for name in ("motor_position_m", "table_position_m"):
        gap = truth[name][:n] - light[f"true_{name}"][2 : n + 2]
        assert np.max(np.abs(gap - gap[:5].mean())) < 3e-6


def test_plain_and_compiled_doors_agree():
    class Plain:
        def __init__(self):
            self.plant = make_plant(BENCH)
            self.reset, self.step = self.plant.reset, self.plant.step
            self.set_external_force = self.plant.set_external_force

    force = np.full(600, 50.0)
    command = sine(600)
    fast = run_closed_loop(BENCH, make_plant(BENCH), command, external_force_N=force)
    slow = run_closed_loop(BENCH, Plain(), command, external_force_N=force)
    for name in ("motor_position_m", "table_position_m", "torque_command_Nm"):
        np.testing.assert_array_equal(fast[name], slow[name])


def test_sensors_lie_on_their_lattice():
    capture = closed_loop_capture(BENCH, make_plant(BENCH), sine(500))
    for column, step in ((capture.motor_position_m, 1e-6), (capture.table_position_m, 0.125e-6)):
        counts = column / step
        np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
    assert {"true_motor_position_m", "true_table_position_m"} <= set(capture.extra)


def test_extension_gives_32nds():
    text = BENCH.text.replace('extension = "none"', 'extension = "1/T"')
    run = run_closed_loop(parse_bench(text), make_plant(BENCH), sine(500))
    counts = run["motor_position_m"] * 1e6 * 32
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-4)
    assert np.any(np.abs(counts / 32 - np.round(counts / 32)) > 0.1)


def test_feedforward_shows_and_continue_goes_on():
    plant = make_plant(BENCH)
    first = run_closed_loop(BENCH, plant, np.zeros(200))
    second = run_closed_loop(
        BENCH, plant, np.zeros(200), start="continue", torque_feedforward_Nm=np.full(200, 0.2)
    )
    assert plant.state[S_CYCLE] == 400
    assert second["torque_command_Nm"][0] - first["torque_command_Nm"][-1] > 0.1


def test_bad_arrays_are_refused():
    plant = make_plant(BENCH)
    with pytest.raises(NonFinite):
        run_closed_loop(BENCH, plant, np.array([0.0, math.nan]))
    with pytest.raises(ConfigError):
        run_closed_loop(BENCH, plant, np.zeros(5), desired_position_m=np.zeros(4))
