"""A load that pulls one way is told from friction, which turns with the direction."""

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.constant import (
    BY_PLACE,
    LOAD,
    UNEVEN,
    constant_torque,
    with_constant_torque,
)
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import model_loop
from pmac_comp.physics.compensate.unmodelled import model_law
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.trajectory import sinusoid, trapezoid
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture

BENCH = load_bench("paper")
LAW = CompensationLaw(torque_coulomb_Nm=0.5, torque_limit_Nm=10.0)
# Friction and mass are wrong on purpose: the load must not depend on them.
MODEL = DriveModel.base(
    BENCH,
    {
        "coulomb.guide_N": 60.0,
        "coulomb.nut_Nm": 0.15,
        "coulomb.motor_Nm": 0.2,
        "viscous.guide_Ns_per_m": 100.0,
    },
)


def captures(effects: dict[str, dict[str, float | str]], *, there_only: bool) -> list[Capture]:
    plant = make_plant(BENCH, effects=effects, spread=0.0)
    period = BENCH.servo_period_s
    sine = sinusoid(period_s=period, amplitude_m=0.01, frequency_Hz=2.0, cycles=3.0)
    move = trapezoid(
        period_s=period, distance_m=0.1, speed_m_per_s=0.1, acceleration_m_per_s2=2.0,
        s_curve_s=0.02, start_m=-0.05,
    )  # fmt: skip
    out = [closed_loop_capture(BENCH, plant, each.position_m) for each in (sine, move)]
    if not there_only:
        return out
    n = int(np.argmax(move.position_m))
    return [out[1].slice(0, n)]


@pytest.mark.parametrize("force_N", [60.0, -150.0])
def test_load_is_found_whatever_friction_the_model_has(force_N: float) -> None:
    runs = captures({"bias_force": {"force_N": force_N}}, there_only=False)
    found = constant_torque(model_loop(MODEL), runs)
    assert found is not None
    assert found.torque_Nm == pytest.approx(force_N * BENCH.lead_m_per_rad, rel=0.05)
    assert found.two_std_Nm < 0.1 * abs(found.torque_Nm)
    law = with_constant_torque(LAW, model_loop(MODEL), runs)
    assert law.torque_constant_Nm == found.torque_Nm
    noted = {"torque_Nm": found.torque_Nm, "two_std_Nm": found.two_std_Nm}
    assert law.provenance[LOAD] == noted
    # The model promises for what it holds itself.
    assert model_law(law).torque_constant_Nm == pytest.approx(LAW.torque_constant_Nm)


def test_load_that_differs_by_place_is_sent_from_where_it_pulls_nowhere() -> None:
    runs = captures(
        {"cable_drag": {"stiffness_N_per_m": 1500.0, "centre_mm": -200.0}}, there_only=False
    )
    law = with_constant_torque(LAW, model_loop(MODEL), runs)
    noted = law.provenance[BY_PLACE]
    assert noted["slope_Nm_per_m"] == pytest.approx(1500.0 * BENCH.lead_m_per_rad, rel=0.1)
    assert noted["two_std_Nm_per_m"] < 0.3 * noted["slope_Nm_per_m"]
    assert noted["reach_m"] == pytest.approx(0.1, abs=2e-3)
    slope = law.torque_place_Nm_per_m
    assert slope == noted["slope_Nm_per_m"]
    assert law.origin_m - law.torque_constant_Nm / slope == pytest.approx(-0.2, abs=0.03)
    assert model_law(law) == law.with_values(torque_constant_Nm=0.0, torque_place_Nm_per_m=0.0)


def test_load_that_the_model_holds_is_not_sent_twice() -> None:
    runs = captures({"bias_force": {"force_N": 60.0}}, there_only=False)
    grown = MODEL.with_effect("bias_force", {"force_N": 60.0})
    assert with_constant_torque(LAW, model_loop(grown), runs) == LAW


def test_friction_alone_is_no_load() -> None:
    runs = captures({"stribeck": {"excess_N": 20.0}}, there_only=False)
    assert with_constant_torque(LAW, model_loop(MODEL), runs) == LAW


@pytest.mark.parametrize("fraction", [0.4, -0.3])
def test_viscous_friction_that_differs_by_direction_is_found(fraction: float) -> None:
    guide_Ns_per_m = 600.0
    effects = {
        "coulomb": {"guide_N": 60.0, "nut_Nm": 0.15, "motor_Nm": 0.2},
        "viscous": {"guide_Ns_per_m": guide_Ns_per_m},
        "friction_asymmetry": {"fraction": fraction, "place": "viscous"},
    }
    runs = captures(effects, there_only=False)
    law = with_constant_torque(LAW, model_loop(MODEL), runs)
    true = fraction * guide_Ns_per_m * BENCH.lead_m_per_rad
    noted = law.provenance[UNEVEN]
    assert law.torque_uneven_Nm_s_per_m == noted["torque_Nm_s_per_m"]
    assert law.torque_uneven_Nm_s_per_m == pytest.approx(true, rel=0.15)
    assert noted["two_std_Nm_s_per_m"] < 0.5 * abs(true)
    assert noted["speed_m_per_s"] == pytest.approx(0.126, rel=0.05)
    assert model_law(law).torque_uneven_Nm_s_per_m == 0.0  # the model's word is without it
    # A law that takes up a gap has no place for it.
    loose = LAW.with_values(gap_half_m=1e-6, gap_width_m=1e-6, coulomb_m=1e-6)
    assert with_constant_torque(loose, model_loop(MODEL), runs).torque_uneven_Nm_s_per_m == 0.0


def test_runs_of_one_direction_cannot_tell() -> None:
    runs = captures({"bias_force": {"force_N": 60.0}}, there_only=True)
    assert constant_torque(model_loop(MODEL), runs) is None
    assert with_constant_torque(LAW, model_loop(MODEL), runs) == LAW


def test_runs_without_torque_cannot_tell() -> None:
    assert constant_torque(model_loop(MODEL), []) is None
