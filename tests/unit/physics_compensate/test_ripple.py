"""Torque per turn: order, amplitudes and phases are those of the plant, and nothing is found where
nothing is."""

import math

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.evaluation import evaluate_law
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import model_loop
from pmac_comp.physics.compensate.ripple import (
    Kind,
    TurnTorque,
    turn_torque,
    turning_model,
    with_turn_torque,
)
from pmac_comp.physics.signals.trajectory import Trajectory, sinusoid, trapezoid
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture
from tests.compensations import rubbing_model

BENCH = load_bench("paper_x4")
PERIOD = BENCH.servo_period_s
LAW = CompensationLaw(turn_m=BENCH.pitch_m, torque_breakaway_m=2e-6, torque_limit_Nm=10.0)
DELAY_s = 1.2e-3


MODEL = rubbing_model(BENCH)
MOVES = (
    trapezoid(
        period_s=PERIOD, distance_m=0.06, speed_m_per_s=0.05, acceleration_m_per_s2=0.5,
        s_curve_s=0.05, start_m=-0.02,
    ),
    sinusoid(period_s=PERIOD, amplitude_m=0.02, frequency_Hz=1.0, cycles=3.0),
)  # fmt: skip


# Torque that goes with the acceleration, in runs enough to tell how far its share scatters.
HARD_MOVES = (
    *MOVES,
    sinusoid(period_s=PERIOD, amplitude_m=0.025, frequency_Hz=2.0, cycles=3.0),
    sinusoid(period_s=PERIOD, amplitude_m=0.012, frequency_Hz=3.0, cycles=4.0),
    trapezoid(
        period_s=PERIOD, distance_m=0.12, speed_m_per_s=0.25, acceleration_m_per_s2=4.0,
        s_curve_s=0.02, start_m=-0.06,
    ),
)  # fmt: skip


def found(
    effects: dict[str, dict[str, float | str]],
    *,
    added_Nm: float = 0.0,
    moves: tuple[Trajectory, ...] = MOVES,
    law: CompensationLaw = LAW,
) -> TurnTorque:
    """What is found on a plant that five waves per turn of added torque push as well."""
    plant = make_plant(BENCH, effects=effects, spread=0.0)
    runs = []
    for move in moves:
        wave = added_Nm * np.sin(5.0 * 2.0 * math.pi * move.position_m / BENCH.pitch_m)
        runs.append(closed_loop_capture(BENCH, plant, move.position_m, torque_feedforward_Nm=wave))
    return turn_torque(law, model_loop(MODEL), runs, drive_delay_s=DELAY_s)


def test_cogging_of_the_plant_is_found_with_its_order_size_and_phase() -> None:
    got = found({"cogging": {"amplitude_Nm": 0.05, "order_per_rev": 12.0, "phase_rad": 0.4}})
    assert got.order == 12
    assert got.ripple_Nm == pytest.approx(0.05, rel=0.1)
    # The plant resists with 0.05 cos(12 angle + 0.4) or pushes with it: the law does the opposite.
    angle = np.linspace(0.0, 2.0 * math.pi, 400)
    law = got.ripple_Nm * np.sin(12.0 * angle + got.ripple_phase_rad)
    plant = 0.05 * np.cos(12.0 * angle + 0.4)
    assert abs(np.corrcoef(law, plant)[0, 1]) > 0.97
    assert got.second_size < 0.01


def test_two_coggings_are_found_and_sent() -> None:
    cogging: dict[str, float | str] = {
        "amplitude_Nm": 0.05, "order_per_rev": 12.0, "phase_rad": 0.4,
    }  # fmt: skip
    got = found({"cogging": cogging}, added_Nm=0.04)
    assert {got.order, got.second_order} == {5, 12}
    assert got.second_kind is Kind.PUSHES
    sizes = {got.order: got.ripple_Nm, got.second_order: got.second_size}
    assert sizes[12] == pytest.approx(0.05, rel=0.15)
    assert sizes[5] == pytest.approx(0.04, rel=0.15)
    law = with_turn_torque(LAW, got)
    assert law.turn_order == -got.second_order
    r = np.concatenate([np.zeros(50), 0.05 * PERIOD * np.arange(4000)])
    for way in (r, -r):  # whichever way the screw turns
        angle = 2.0 * math.pi * way[100:] / BENCH.pitch_m
        want = got.ripple_Nm * np.sin(got.order * angle + got.ripple_phase_rad)
        want += got.second_size * np.sin(got.second_order * angle + got.second_phase_rad)
        assert np.max(np.abs(evaluate_law(law, way, PERIOD).torque_Nm[100:] - want)) < 1e-6


def test_friction_once_per_turn_is_found() -> None:
    got = found(
        {"friction_per_rev": {"amplitude_Nm": 0.05, "order_per_rev": 1.0, "phase_rad": 0.7}}
    )
    assert got.order == 0
    assert got.second_size == pytest.approx(0.05, rel=0.15)


def test_a_fit_begins_with_the_waves_of_the_turn_as_the_plant_has_them() -> None:
    waves = {
        "cogging": {"amplitude_Nm": 0.05, "order_per_rev": 12.0, "phase_rad": 0.4},
        "friction_per_rev": {"amplitude_Nm": 0.04, "order_per_rev": 1.0, "phase_rad": 0.7},
    }
    plant = make_plant(BENCH, effects=waves, spread=0.0)
    runs = [closed_loop_capture(BENCH, plant, move.position_m) for move in MOVES]
    grown = turning_model(MODEL, runs)
    assert set(grown.effects) == {*MODEL.effects, *waves}
    for name, wave in waves.items():
        own = grown.values_of(name)
        assert own["order_per_rev"] == wave["order_per_rev"]
        assert own["amplitude_Nm"] == pytest.approx(wave["amplitude_Nm"], rel=0.2)
        assert own["phase_rad"] == pytest.approx(wave["phase_rad"], abs=0.3)
    assert turning_model(grown, runs) is grown  # it has its own


def test_torque_that_ripples_with_its_size_is_found_as_a_wave_of_friction() -> None:
    got = found({"torque_ripple": {"amplitude_Nm": 0.8, "order_per_rev": 10.0, "phase_rad": 0.4}})
    assert got.second_order == 10
    # Of 0.8 N m at rated torque what friction, nearly all of the torque here, has of that.
    friction_Nm = 0.45 + 45.0 * BENCH.lead_m_per_rad
    assert got.second_size == pytest.approx(0.8 * friction_Nm / 6.37, rel=0.15)
    assert got.ripple_Nm < 0.2 * got.second_size
    assert got.explained > 0.3


RIPPLE: dict[str, float | str] = {"amplitude_Nm": 0.5, "order_per_rev": 6.0, "phase_rad": 0.4}


def test_torque_that_ripples_is_found_by_its_share_and_undone() -> None:
    got = found({"torque_ripple": RIPPLE}, moves=HARD_MOVES)
    assert (got.second_kind, got.second_order) == (Kind.RIPPLES, 6)
    assert got.second_size == pytest.approx(0.5 / 6.37, rel=0.1)
    assert got.ripple_Nm == 0.0
    law = with_turn_torque(LAW.with_values(torque_inertia_Nm_s2_per_m=0.1), got)
    assert law.turn_friction_Nm == 0.0
    assert law.torque_loop_Nm_s2_per_m == pytest.approx(got.whole_Nm_s2_per_m - 0.1)
    assert law.torque_loop_Nm_s_per_m == got.whole_Nm_s_per_m > 0.5
    # What the law and its loop send is, times the wave of the motor's constant, what it needs.
    command = HARD_MOVES[2].position_m
    v = np.gradient(command, PERIOD)
    a = np.gradient(v, PERIOD)
    need = got.whole_Nm_s2_per_m * a + got.whole_Nm_s_per_m * v
    sent = evaluate_law(law, command, PERIOD).torque_Nm
    sent += law.torque_loop_Nm_s2_per_m * a + law.torque_loop_Nm_s_per_m * v
    wave = got.second_size * np.sin(
        6.0 * 2.0 * math.pi * command / BENCH.pitch_m + got.second_phase_rad
    )
    # To first order: the square of the share is left.
    left = np.abs(sent * (1.0 - wave) - need)[20:-20]
    assert np.max(left) < 1.05 * got.second_size**2 * np.max(np.abs(need))
    plant = np.cos(6.0 * 2.0 * math.pi * command / BENCH.pitch_m + 0.4)
    assert abs(np.corrcoef(wave, plant)[0, 1]) > 0.97


def test_the_load_of_an_axis_ripples_too() -> None:
    weight: dict[str, float | str] = {"force_N": 400.0}
    got = found({"torque_ripple": RIPPLE, "bias_force": weight}, moves=HARD_MOVES)
    assert (got.second_kind, got.second_order) == (Kind.RIPPLES, 6)
    assert got.second_size == pytest.approx(0.5 / 6.37, rel=0.1)
    assert got.second_phase_rad == pytest.approx(0.4 - 0.5 * math.pi, abs=0.1)
    assert got.order == 0  # the law's wave multiplies its load too: as cogging it was sent twice


def test_a_small_ripple_is_told_beside_cogging_of_its_neighbourhood() -> None:
    ripple = RIPPLE | {"amplitude_Nm": 0.13, "order_per_rev": 8.0}
    cogging: dict[str, float | str] = {"amplitude_Nm": 0.05, "order_per_rev": 7.0}
    got = found({"torque_ripple": ripple, "cogging": cogging}, moves=HARD_MOVES)
    assert got.order == 7
    assert (got.second_kind, got.second_order) == (Kind.RIPPLES, 8)
    assert got.second_size == pytest.approx(0.13 / 6.37, rel=0.15)


def test_no_ripple_is_taken_for_one_where_a_law_has_no_room_or_no_torque_ripples() -> None:
    gap = LAW.with_values(coulomb_m=1e-6, gap_half_m=1e-6, gap_width_m=1e-6)
    assert found({"torque_ripple": RIPPLE}, moves=HARD_MOVES, law=gap).second_kind is Kind.RIPPLES
    full = gap.with_values(bed_share=0.1, bed_stiffness_per_s2=1e4)
    assert found({"torque_ripple": RIPPLE}, moves=HARD_MOVES, law=full).second_kind is Kind.GRIPS
    other: dict[str, dict[str, float | str]] = {
        "friction_per_rev": {"amplitude_Nm": 0.05, "order_per_rev": 1.0, "phase_rad": 0.7},
        "viscous_nonlinear": {"coefficient_N": 100.0, "exponent": 0.5},
    }
    assert found(other, moves=HARD_MOVES).second_kind is Kind.GRIPS


def test_nothing_is_found_on_a_drive_without_ripple() -> None:
    got = found({})
    assert (got.order, got.ripple_Nm, got.second_size) == (0, 0.0, 0.0)
    assert with_turn_torque(LAW, got).ripple_Nm == 0.0


def test_the_law_sends_the_torque_ahead_of_the_angle() -> None:
    got = TurnTorque(8, 0.05, 0.3, 0.0, 0.0, 1, Kind.GRIPS, explained=1.0)
    law = with_turn_torque(LAW.with_values(lookahead_s=DELAY_s + PERIOD), got)
    r = np.concatenate([np.zeros(50), 0.05 * PERIOD * np.arange(4000)])
    sent = evaluate_law(law, r, PERIOD).torque_Nm
    there = r + 0.05 * (DELAY_s + PERIOD)
    want = 0.05 * np.sin(8.0 * 2.0 * math.pi * there / BENCH.pitch_m + 0.3)
    assert np.max(np.abs(sent - want)[100:]) < 1e-6
