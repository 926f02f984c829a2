"""A part of friction that does not stand out by itself is kept where held-out samples need it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import load_bench
from pmac_comp.physics.identify.friction_form import _chosen
from pmac_comp.physics.model.drive import DriveModel

BASE = DriveModel.base(load_bench("paper_x4"))
PLAIN = np.random.default_rng(1).lognormal(0.0, 0.2, (60, 2))
WHOLE = ("presliding@all", "stribeck")


class Trial:
    """Fits that end where they began, with a held-out misfit that depends on the parts."""

    def __init__(self, excess_std_N: float, left: dict[tuple[str, ...], float]) -> None:
        self.excess_std_N, self.left = excess_std_N, left

    def shaped(self, start: DriveModel) -> DriveModel:
        return start

    def fitted(self, start: DriveModel) -> Any:
        if "stribeck@nut" in start.effects:
            return None
        sizes = {name: SimpleNamespace(value=v, std=0.0) for name, v in start.parameters.items()}
        if "stribeck" in start.effects:
            sizes["stribeck.excess_N"].std = self.excess_std_N
        return SimpleNamespace(model=start, parameters=sizes)

    def fitted_at_guide(self, start: DriveModel) -> Any:
        return None

    def errors(self, found: Any) -> FloatArray:
        parts = tuple(n for n in found.model.effects if n not in BASE.effects)
        return self.left.get(parts, 1.0) * PLAIN


@pytest.mark.parametrize(
    ("without", "kept"), [(0.8, WHOLE), (0.1, ("presliding@all",))], ids=["needed", "not needed"]
)
def test_stribeck_friction_within_its_deviation(without: float, kept: tuple[str, ...]) -> None:
    trial = Trial(excess_std_N=8.0, left={WHOLE: 0.1, ("presliding@all",): without})
    found = _chosen(trial, BASE, PLAIN, {}, suspected=False)  # type: ignore[arg-type]
    assert found is not None
    assert found.model is not None
    assert tuple(n for n in found.model.effects if n not in BASE.effects) == kept


def test_a_whole_that_predicts_nothing_is_not_taken() -> None:
    trial = Trial(excess_std_N=8.0, left={WHOLE: 1.0, ("presliding@all",): 1.0})
    assert _chosen(trial, BASE, PLAIN, {}, suspected=False) is None  # type: ignore[arg-type]


@pytest.mark.parametrize("place", ["nut", "motor"])
def test_presliding_at_nut_or_motor_alone_is_taken_where_it_predicts_more(place: str) -> None:
    """With one distance for both a fit gave the motor all friction of a nut that slides first."""
    alone = (f"presliding@{place}", "stribeck")
    trial = Trial(excess_std_N=1.0, left={WHOLE: 0.2, alone: 0.1})
    figures: dict[str, float] = {}
    levels = {"coulomb.nut_Nm": 0.02, "coulomb.motor_Nm": 0.42}
    start = DriveModel.base(BASE.bench, {**BASE.parameters, **levels})
    found = _chosen(trial, start, PLAIN, figures, suspected=False)  # type: ignore[arg-type]
    assert found is not None
    assert tuple(n for n in found.model.effects if n not in BASE.effects) == alone
    assert found.model.parameters["coulomb.nut_Nm"] == pytest.approx(0.22)  # begun even
    assert f"held_out_presliding_{place}_um" in figures
    trial.left[alone] = 0.2
    found = _chosen(trial, start, PLAIN, figures, suspected=False)  # type: ignore[arg-type]
    assert found is not None
    assert tuple(n for n in found.model.effects if n not in BASE.effects) == WHOLE
