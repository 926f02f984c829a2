"""The search for a law on errors that are known functions of its coefficients."""

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import NonFinite
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.search import polished


def test_the_search_gives_a_law_no_more_friction_torque_than_there_is() -> None:
    def errors(law: CompensationLaw) -> list[tuple[FloatArray, ...]]:
        return [(np.array([0.6 - law.torque_coulomb_Nm, 0.1]),)]  # motions that would like 0.6 N m

    law = CompensationLaw(torque_coulomb_Nm=0.4, torque_limit_Nm=10.0)
    assert polished(law, errors, None).torque_coulomb_Nm == pytest.approx(0.6, abs=0.02)
    assert polished(law, errors, None, most_Nm=0.5).torque_coulomb_Nm == 0.5
    # What the fit found before the search is not taken back.
    assert polished(law, errors, None, most_Nm=0.3).torque_coulomb_Nm == 0.4


def test_where_no_law_reaches_one_aim_the_other_is_not_given_away_for_a_little_less_of_it() -> None:
    """What would take a tenth off 3.5 of one aim takes the other, which is reached, beyond its."""

    def errors(law: CompensationLaw) -> list[tuple[FloatArray, ...]]:
        more = law.torque_inertia_Nm_s2_per_m
        return [(np.array([3.5 - more]),), (np.array([0.5 + 5.0 * more]),)]

    found = polished(CompensationLaw(torque_limit_Nm=10.0), errors, None)
    mechanical, total = (float(kind[0][0]) for kind in errors(found))
    assert mechanical < 3.5
    assert total < 0.6


def test_a_step_at_which_the_model_runs_away_is_not_taken() -> None:
    def errors(law: CompensationLaw) -> list[tuple[FloatArray, ...]]:
        if law.inertia_s2 < 1.5e-6:
            raise NonFinite("desired_position_m holds nan", code="PC-ARR-003")
        return [(np.array([law.inertia_s2 / 1e-6]),)]

    found = polished(CompensationLaw(inertia_s2=2e-6), errors, None)
    assert 1.5e-6 <= found.inertia_s2 < 1.75e-6


def test_the_search_leaves_the_torque_of_a_constant_load_alone() -> None:
    """Rests tell it apart from friction, motions hardly do."""

    def errors(law: CompensationLaw) -> list[tuple[FloatArray, ...]]:
        return [(np.array([law.inertia_s2 / 1e-6, law.torque_constant_Nm - 1.0]),)]

    law = CompensationLaw(inertia_s2=2e-6, torque_constant_Nm=0.24, torque_limit_Nm=10.0)
    found = polished(law, errors, None)
    assert found.inertia_s2 < law.inertia_s2
    assert found.torque_constant_Nm == law.torque_constant_Nm


def test_beside_play_steps_that_slopes_do_not_see_are_found_too(whole_search: None) -> None:
    """A crossing comes or does not: what is left jumps, and between the jumps it is level."""

    def errors(law: CompensationLaw) -> list[tuple[FloatArray, ...]]:
        return [(np.array([0.5 + np.floor(law.gap_width_m / 0.05e-6)]),)]

    play = CompensationLaw(coulomb_m=1e-6, gap_half_m=2e-6, gap_width_m=0.11e-6, gap_lag_s=3e-3)
    assert polished(play, errors, None).gap_width_m < 0.05e-6
