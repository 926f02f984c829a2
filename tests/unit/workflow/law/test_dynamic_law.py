"""A grown model must not lose what the captures feed forward, and states its own delays."""

import math

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.constant import BY_PLACE, LOAD, UNEVEN
from pmac_comp.physics.compensate.delay import drive_delay_s
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import STATIC_EFFECTS, model_loop
from pmac_comp.physics.compensate.promise import promise
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.trajectory import sinusoid
from pmac_comp.workflow.law.dynamic_law import (
    constant_remarks,
    dynamic_law,
    nut_gap,
    without_fed_forward,
)

BENCH = load_bench("paper")


def test_torque_per_turn_is_read_from_captures_whether_or_not_the_model_holds_it() -> None:
    base = DriveModel.base(BENCH)
    grown = base.with_effect("cogging", {"amplitude_Nm": 0.08}).with_effect("friction_per_rev", {})
    grown = grown.with_effect("backlash", {"gap_m": 5e-6})
    assert without_fed_forward(grown).effects == (*base.effects, "backlash")
    assert without_fed_forward(base).effects == base.effects


def test_delays_that_a_diagnosis_found_are_those_of_the_law() -> None:
    base = DriveModel.base(BENCH)
    half_s = 0.5 * BENCH.servo_period_s
    assert drive_delay_s(base) == pytest.approx(442e-6 + 1.0 / (600.0 * math.pi) + half_s)
    slow = base.with_effect("actuator_delay", {"time_s": 900e-6})
    assert drive_delay_s(slow) - drive_delay_s(base) == pytest.approx(458e-6)
    soft = base.with_effect("current_bandwidth", {"bandwidth_Hz": 100.0})
    lag_s = 1.0 / (200.0 * math.pi) - 1.0 / (600.0 * math.pi)
    assert drive_delay_s(soft) - drive_delay_s(base) == pytest.approx(lag_s)


def test_a_cable_that_the_model_holds_is_in_the_torque_and_not_in_its_dynamics(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cable = {"stiffness_N_per_m": 400.0, "centre_m": -0.3}
    plain = CompensationLaw(torque_limit_Nm=17.0, origin_m=BENCH.mid_travel_m)
    monkeypatch.setattr("pmac_comp.workflow.law.dynamic_law.design_law", lambda *_, **__: plain)
    held = dynamic_law(BENCH, DriveModel.base(BENCH).with_effect("cable_drag", cable), "law")
    slope = 400.0 * BENCH.lead_m_per_rad
    assert held.torque_place_Nm_per_m == pytest.approx(slope)
    assert held.torque_constant_Nm == pytest.approx(slope * (BENCH.mid_travel_m + 0.3))
    # What it does to the nut is taken by the table of the lead, as slow runs show it.
    assert "cable_drag" in STATIC_EFFECTS


def test_gap_of_a_grown_model_is_that_of_backlash_or_of_the_soft_zone() -> None:
    base = DriveModel.base(BENCH)
    assert nut_gap(base) is None
    found = nut_gap(base.with_effect("backlash", {"gap_m": 5e-6}))
    assert found is not None
    assert found.half_m == pytest.approx(2.5e-6)
    assert found.edge_m_per_s2 == 0.0
    soft = {"half_width_m": 4e-6, "stiffness_ratio": 0.25}
    found = nut_gap(base.with_effect("preload_loss", soft))
    assert found is not None
    assert found.half_m == pytest.approx(3e-6)
    # At the edge of the zone the nut's 180 N/um carry a quarter of 4 um: the force on 122.86 kg.
    assert found.edge_m_per_s2 == pytest.approx(180.0 / 122.86, rel=0.02)


def test_law_of_a_nut_without_preload_follows_its_soft_zone() -> None:
    soft = {"half_width_m": 2e-6, "stiffness_ratio": 0.4}
    model = DriveModel.base(BENCH).with_effect("preload_loss", soft)
    law = dynamic_law(BENCH, model, "law")
    # The nut's spring gives 144 N there, on 122.86 kg at 2.2 um per m/s2.
    assert law.gap_width_m == pytest.approx(144.0 / 122.86 * 2.2e-6, rel=0.25)
    assert law.gap_half_m == pytest.approx(1.2e-6, rel=0.25)
    slow = sinusoid(period_s=BENCH.servo_period_s, amplitude_m=0.047, frequency_Hz=0.72, cycles=2.0)
    expected = promise(law, model_loop(model), slow, latency_cycles=1)
    assert expected.e_r_after_um < 0.08 * expected.e_before_um


def test_load_that_only_the_runs_know_is_said_with_its_force() -> None:
    assert constant_remarks(BENCH, CompensationLaw(torque_constant_Nm=0.1)) == []
    noted = {LOAD: {"torque_Nm": 0.0955, "two_std_Nm": 0.0004}}
    (said,) = constant_remarks(BENCH, CompensationLaw(provenance=noted))
    assert "+0.096 +- 0.0004 N m" in said
    assert "+60 N" in said


def test_friction_that_is_more_one_way_is_said_with_what_it_takes() -> None:
    noted = {UNEVEN: {"torque_Nm_s_per_m": -0.4, "two_std_Nm_s_per_m": 0.05, "speed_m_per_s": 0.35}}
    (said,) = constant_remarks(BENCH, CompensationLaw(provenance=noted))
    assert "faster with the speed in negative direction: at 350 mm/s" in said
    assert "0.14 +- 0.02 N m more" in said
    assert "less in positive direction" in said


def test_a_torque_that_changes_along_the_travel_is_said():
    noted = {BY_PLACE: {"slope_Nm_per_m": 0.6, "two_std_Nm_per_m": 0.05, "reach_m": 0.4}}
    (said,) = constant_remarks(BENCH, CompensationLaw(provenance=noted))
    assert "+0.24 +- 0.02 N m along the 400 mm" in said
    assert "(+377 N per m at the table)" in said
    assert "The law sends it" in said
