"""What a candidate must show to be worth a name."""

from types import SimpleNamespace
from typing import Any

import pytest

from pmac_comp.physics.diagnose.acceptance import earned
from pmac_comp.physics.diagnose.contenders import Rules


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
