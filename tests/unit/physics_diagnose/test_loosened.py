"""Where backlash is begun: what friction the guide gives up, the shaft takes."""

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.diagnose.contenders import _with_friction_at_shaft
from pmac_comp.physics.model.drive import DriveModel

BENCH = load_bench("paper")


def torque_Nm(model: DriveModel, speed_m_per_s: float) -> float:
    """Torque at the motor that all friction of a model takes at a steady speed."""
    p, lead = model.parameters, BENCH.lead_m_per_rad
    guide_N = p["coulomb.guide_N"] + p["viscous.guide_Ns_per_m"] * speed_m_per_s
    shaft_Nms = p["viscous.nut_Nms_per_rad"] + p["viscous.motor_Nms_per_rad"]
    shaft = p["coulomb.nut_Nm"] + p["coulomb.motor_Nm"] + shaft_Nms * speed_m_per_s / lead
    return guide_N * lead + shaft


@pytest.mark.parametrize("speed_m_per_s", [0.0, 0.05, 0.5])
def test_friction_that_goes_to_the_shaft_stays_the_same_at_the_motor(speed_m_per_s):
    model = DriveModel.base(BENCH)
    moved = model.with_parameters(_with_friction_at_shaft(model, 0.5))
    assert torque_Nm(moved, speed_m_per_s) == pytest.approx(torque_Nm(model, speed_m_per_s))
    assert moved.parameters["coulomb.guide_N"] == pytest.approx(
        0.5 * model.parameters["coulomb.guide_N"]
    )


def test_friction_that_a_model_lacks_is_not_moved():
    model = DriveModel.base(BENCH)
    assert "viscous.guide_Ns_per_m" in _with_friction_at_shaft(model, 0.5)
    bare = model.without_effect("viscous")
    assert set(_with_friction_at_shaft(bare, 0.5)) == {"coulomb.guide_N", "coulomb.motor_Nm"}
