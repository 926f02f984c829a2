"""What a candidate must show to be worth a name."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmac_comp.physics.diagnose.acceptance import earned, tied_with
from pmac_comp.physics.diagnose.contenders import Rules
from pmac_comp.physics.model.effect import effect_library


def _round(effects: tuple[str, ...] = ("coulomb", "viscous")) -> Any:
    return SimpleNamespace(
        before=SimpleNamespace(model=SimpleNamespace(effects=effects)),
        rows_fit=32000.0,
        rows_judge=16000.0,
        gap_um=0.143,
        floor_um=0.115,
        torque_Nm=None,
    )


def _candidate(effect: str = "payload", **changed: float) -> Any:
    """A mass that changes a fiftieth of the noise's variance, beyond all chance."""
    shown = {"fit_gain": 1229.0, "judged_gain": 315.0, "p_value": 6e-26, "bic_gain": 138.0}
    return SimpleNamespace(effect=effect, gap_um=0.136, torque_Nm=None, **{**shown, **changed})


def test_a_small_change_of_a_stated_quantity_is_named_where_chance_is_out_of_the_question():
    assert earned(_candidate(), _round(), Rules())


@pytest.mark.parametrize(
    "candidate",
    [
        _candidate("viscous_nonlinear"),  # a form of friction idealises: certain is not enough
        _candidate(p_value=1e-12),
        _candidate(judged_gain=100.0),
        _candidate(bic_gain=-1.0),
    ],
)
def test_a_small_change_is_not_named_otherwise(candidate):
    assert not earned(candidate, _round(), Rules())


def test_what_a_first_effect_leaves_is_not_named_so_easily():
    done = _round(("coulomb", "viscous", "backlash"))
    assert not earned(_candidate(), done, Rules())


def test_a_large_change_is_named_whatever_it_is():
    candidate = _candidate("stribeck", fit_gain=3000.0, judged_gain=900.0)
    assert earned(candidate, _round(("coulomb", "viscous", "backlash")), Rules())


def _spring(effect: str, place: str, gap_um: float, lost: float) -> Any:
    blocks = np.array([900.0, 1100.0, 1000.0, 1050.0]) + lost
    key = f"{effect}@{place}" if place else effect
    return SimpleNamespace(
        effect=effect, key=key, gap_um=gap_um, gain=1000.0 - lost,
        fitted=SimpleNamespace(blocks=blocks, model=SimpleNamespace(parameters={})),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("place", "gap_um", "tied"),
    [
        # A corner and a curve that leave nearly the same: which of them data does not say.
        ("beyond", 0.2185, ("axial_stiffness_nonlinear",)),
        ("beyond", 0.26, ()),
        # Soft in the middle is no contact that softens with the force.
        ("centre", 0.2185, ()),
    ],
)
def test_a_joint_that_gives_way_beyond_a_force_may_as_well_soften_towards_it(place, gap_um, tied):
    corner = _spring("preload_loss", place, 0.2136, 0.0)
    corner.fitted.model.parameters["preload_loss.stiffness_ratio"] = 0.5
    curve = _spring("axial_stiffness_nonlinear", "", gap_um, 400.0)
    rows = np.full(4, 500.0)
    found = tied_with(corner, [corner, curve], effect_library(), rows, Rules(), gap_um=0.312)
    assert found == tied
