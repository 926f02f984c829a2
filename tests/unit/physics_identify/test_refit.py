"""A nut with play is fitted from other splits of the lost motion, which keep what they share."""

from collections.abc import Mapping

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.identify import refit
from pmac_comp.physics.model.drive import DriveModel

BENCH = load_bench("paper_x4")
MODEL = DriveModel.base(BENCH)
LOOSE = MODEL.with_effect("backlash", {"gap_m": 4e-6})


def test_only_play_is_fitted_from_other_splits(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object) -> None:
        raise AssertionError("a trial was made")

    monkeypatch.setattr(refit, "Trial", never)
    assert refit.fitted_in_valleys([], BENCH, MODEL) is None
    with pytest.raises(AssertionError, match="a trial"):
        refit.fitted_in_valleys([], BENCH, LOOSE)


def test_other_splits_keep_lost_motion_and_torque() -> None:
    own = LOOSE.parameters
    for factor in (0.85, 1.08):
        other = refit._split_anew(LOOSE, factor).parameters
        assert other["coulomb.guide_N"] == pytest.approx(factor * own["coulomb.guide_N"])
        assert _lost_m(other) == pytest.approx(_lost_m(own))
        assert _torque_Nm(other) == pytest.approx(_torque_Nm(own))


def _lost_m(own: Mapping[str, float]) -> float:
    stiffness = own["chain.axial_stiffness_N_per_m"]
    return own["backlash.gap_m"] + 2.0 * own["coulomb.guide_N"] / stiffness


def _torque_Nm(own: Mapping[str, float]) -> float:
    return own["coulomb.motor_Nm"] + own["coulomb.guide_N"] * BENCH.lead_m_per_rad


def test_friction_that_turns_over_with_speed_is_a_kind_of_presliding() -> None:
    assert refit._family("smooth_coulomb") == refit._family("presliding@all") == "presliding"
    assert refit._family("stribeck@nut") == "stribeck"
