"""Intervals of parameters that are fractions of something else."""

from types import SimpleNamespace
from typing import Any

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.diagnose.estimates import _estimate
from pmac_comp.physics.model.drive import DriveModel

BENCH = load_bench("paper_x4")
NAME = "friction_asymmetry.fraction"


def _std(place: str, guide_share: float) -> float:
    model = DriveModel.base(BENCH).with_effect(f"friction_asymmetry@{place}", {"fraction": -0.5})
    guide = model.parameters["viscous.guide_Ns_per_m"]
    column: Any = SimpleNamespace(label=NAME, unit=0.01)
    known = {"viscous.guide_Ns_per_m": guide_share * guide}
    return _estimate(model, column, 1.5, 0.0, known).std


@pytest.mark.parametrize("place", ["viscous", "sliding"])
def test_a_fraction_of_the_guides_friction_is_no_surer_than_that_friction(place):
    assert _std(place, 0.0) == pytest.approx((0.015**2 + 0.01**2) ** 0.5)
    assert _std(place, 0.06) == pytest.approx((0.015**2 + 0.01**2 + 0.03**2) ** 0.5)


def test_a_fraction_of_what_the_torque_shows_alone_is_not_widened():
    assert _std("rotary", 0.06) == pytest.approx(0.015)
