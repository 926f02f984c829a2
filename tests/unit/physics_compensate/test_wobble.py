"""Wobble of the lead: its wave in a map, what a table leaves of it at speed, torque for that."""

import math

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.delay import drive_delay_s
from pmac_comp.physics.compensate.design import start_law
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap, LeadWave
from pmac_comp.physics.compensate.loop import model_loop
from pmac_comp.physics.compensate.promise import Static, expect
from pmac_comp.physics.compensate.wobble import with_wobble
from pmac_comp.physics.signals.trajectory import Trajectory, trapezoid
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture
from tests.compensations import rubbing_model

BENCH = load_bench("paper_x4")
PERIOD_s, TURN_m = BENCH.servo_period_s, BENCH.pitch_m
MODEL = rubbing_model(BENCH)
LOOP = model_loop(MODEL)
WAVE = LeadWave(3e-6, 2, 0.7, TURN_m)
LATENCY = 1


def move(speed_m_per_s: float, way: float = 1.0) -> Trajectory:
    return trapezoid(
        period_s=PERIOD_s,
        distance_m=way * 0.12,
        speed_m_per_s=speed_m_per_s,
        acceleration_m_per_s2=4.0,
        s_curve_s=0.015,
        start_m=-way * 0.06,
        dwell_s=0.05,
    )


def law() -> CompensationLaw:
    found = start_law(
        BENCH, LOOP, [move(0.2), move(0.4)], delay_s=drive_delay_s(MODEL), latency_cycles=LATENCY
    )
    return found.with_values(turn_m=TURN_m)


def residual_um(law: CompensationLaw, wave: LeadWave, motion: Trajectory) -> float:
    """e_r with a table against the wave beyond that without both, um rms."""

    def static(at_m: np.ndarray) -> Static:
        table = wave.at(at_m[:1]) - wave.at(at_m)
        return Static(wave.at(at_m), table, table)

    with_wave = expect(
        law, model_loop(MODEL, wave), motion, latency_cycles=LATENCY, static=static
    ).residual_m
    plain = law.with_values(torque_wobble_Nm_s3_per_m3=0.0)
    without = expect(plain, LOOP, motion, latency_cycles=LATENCY).residual_m
    return float(np.std(with_wave - without)) * 1e6


def helped(wave: LeadWave, given: CompensationLaw | None = None) -> CompensationLaw:
    loops = LOOP, model_loop(MODEL, wave)
    return with_wobble(given or law(), BENCH, wave, *loops, latency_cycles=LATENCY)


def test_wave_of_a_map_is_the_one_that_shakes_the_most() -> None:
    x = np.arange(-0.1, 0.1, 0.5e-3)
    once, twice = LeadWave(3e-6, 1, 0.4, TURN_m), LeadWave(1.5e-6, 2, -1.1, TURN_m)
    line = 2e-6 + 30e-6 * x
    both = LeadMap(x, line + once.at(x) + twice.at(x), 0.0 * x, 0.0)
    found = both.wave(TURN_m)
    assert found is not None
    assert (found.order, found.turn_m) == (2, TURN_m)
    assert found.amplitude_m == pytest.approx(1.5e-6, rel=1e-3)
    assert found.phase_rad == pytest.approx(-1.1, abs=1e-3)
    alone = LeadMap(x, line + once.at(x), 0.0 * x, 0.0).wave(TURN_m)
    assert alone is not None
    assert alone.order == 1
    often = LeadMap(x, line + LeadWave(0.5e-6, 6, 0.4, TURN_m).at(x), 0.0 * x, 0.0).wave(TURN_m)
    assert often is not None
    assert often.order == 6
    assert LeadMap(x, line, 0.0 * x, 0.0).wave(TURN_m) is None
    assert LeadMap(x[:40], (line + once.at(x))[:40], 0.0 * x[:40], 0.0).wave(TURN_m) is None


def test_loop_with_a_wobble_is_the_plant_s() -> None:
    # Without a table the nut leads the table along the wobble: at 80 Hz it overshoots that.
    effects = {
        "lead_cyclic": {"amplitude_um": 3.0, "order_per_rev": 2.0, "phase_rad": 0.7},
    }
    motion = move(0.4)
    r = motion.position_m

    def error_um(loop_effects: dict[str, dict[str, float]]) -> np.ndarray:
        plant = make_plant(BENCH, effects=loop_effects, spread=0.0)
        true = closed_loop_capture(BENCH, plant, r).extra
        return np.asarray(true["true_table_position_m"] - true["true_motor_position_m"]) * 1e6

    shaken = error_um(effects) - error_um({}) - WAVE.at(r) * 1e6
    told = [model_loop(MODEL, wave)(r, None, None) for wave in (WAVE, None)]
    one, other = ((s.table_position_m - s.motor_position_m) * 1e6 for s in told)
    assert np.std(shaken) > 0.5
    assert np.std(one - other - shaken) < 0.15 * np.std(shaken)


def test_torque_takes_most_of_what_a_wobble_leaves_at_speed_both_ways() -> None:
    plain, more = law(), helped(WAVE)
    assert more.torque_wobble_Nm_s3_per_m3 > 0.0
    assert more.turn_order == 2.0
    for way in (1.0, -1.0):
        for speed in (0.3, 0.37, 0.45):
            before, after = (residual_um(one, WAVE, move(speed, way)) for one in (plain, more))
            assert before > 0.35
            assert after < 0.3 * before


@pytest.mark.parametrize(("order", "speed_m_per_s"), [(3, 0.43), (4, 0.32), (6, 0.21)])
def test_torque_is_right_where_the_wobble_passes_the_first_mode(
    order: int, speed_m_per_s: float
) -> None:
    wave = LeadWave(1e-6, order, -0.4, TURN_m)
    motion = move(speed_m_per_s)
    before, after = (residual_um(one, wave, motion) for one in (law(), helped(wave)))
    assert before > 3.0
    assert after < 0.2 * before


def test_torque_goes_with_the_wobble() -> None:
    one = helped(WAVE)
    half = helped(LeadWave(1.5e-6, 2, 0.7 + 1.0, TURN_m))
    size, other = one.torque_wobble_Nm_s3_per_m3, half.torque_wobble_Nm_s3_per_m3
    assert other == pytest.approx(0.5 * size, rel=0.05)
    assert math.sin(half.turn_phase_rad - one.turn_phase_rad - 1.0) == pytest.approx(0.0, abs=1e-6)


def test_a_wobble_that_shakes_little_is_left_alone() -> None:
    given = law()
    assert helped(LeadWave(0.4e-6, 1, 0.7, TURN_m), given) == given


def test_the_wave_that_matters_more_has_the_place() -> None:
    rubbing = law().with_values(turn_friction_Nm=0.02, turn_phase_rad=0.2)
    assert helped(WAVE, rubbing).turn_friction_Nm == 0.0
    hard = rubbing.with_values(turn_friction_Nm=0.5)
    assert helped(WAVE, hard) == hard
