"""Friction that lets go at rest: found in captures, and let go of by the law."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.creep import CREEP, creep_at_rest, with_creep
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.plant.door import load_plant
from pmac_comp.workflow.law.dynamic_law import creep_remarks
from tests.physics.identified import moves_with_rests

BENCH = load_bench("paper_x4")
# Of the creeping drive, 0.4 N m and 40 N, and about that of the others.
LAW = CompensationLaw(torque_coulomb_Nm=0.46, coulomb_m=0.4e-6, torque_limit_Nm=10.0)
TWO_MASSES = Path(__file__).parents[3] / "configs" / "plant_two_masses.py"


def test_a_drive_that_creeps_at_rest_is_known_and_the_law_lets_go() -> None:
    runs = moves_with_rests(BENCH, load_plant(str(TWO_MASSES), BENCH))
    found = creep_at_rest(LAW, runs)
    assert found is not None
    # Friction of motor and guide turns over within 0.16 and 0.2 mm/s.
    assert found.speed_m_per_s == pytest.approx(0.18e-3, rel=0.25)
    assert found.two_std_m_per_s < 0.2 * found.speed_m_per_s
    assert found.held_share < 0.5
    law = with_creep(LAW, runs)
    assert law.rest_fade_per_s == law.rest_unwind_per_s == 400.0
    (said,) = creep_remarks(law)
    assert "creep" in said
    assert "mm/s" in said


@pytest.mark.parametrize(
    "effects",
    [
        {},
        {"presliding": {"distance_um": 30.0, "place": "nut"}},
        {"backlash": {"gap_um": 4.0}, "bias_force": {"force_N": 150.0}},
    ],
    ids=["coulomb", "presliding", "play under a load"],
)
def test_a_drive_that_friction_holds_keeps_its_law(
    effects: dict[str, dict[str, float | str]],
) -> None:
    load_Nm = 150.0 * BENCH.lead_m_per_rad if "bias_force" in effects else 0.0
    law = LAW.with_values(torque_constant_Nm=load_Nm)
    assert (
        with_creep(law, moves_with_rests(BENCH, make_plant(BENCH, effects=effects, seed=3))) is law
    )


def test_guide_that_holds_keeps_its_lag_while_the_motor_creeps() -> None:
    (run,) = moves_with_rests(BENCH, load_plant(str(TWO_MASSES), BENCH), n=1)
    way = np.diff(run.commanded_position_m, prepend=run.commanded_position_m[0])
    last = np.maximum.accumulate(np.where(np.abs(way) > 1e-9, np.arange(way.size), 0))
    went = np.sign(way)[last]  # the direction in which it went last
    held = replace(run, table_position_m=run.motor_position_m - LAW.coulomb_m * went)
    law = with_creep(LAW, [held])
    assert law.rest_fade_per_s == 400.0
    assert law.rest_unwind_per_s == LAW.rest_unwind_per_s
    assert law.provenance[CREEP]["held_share"] > 0.7


def test_runs_that_do_not_tell_leave_the_law() -> None:
    assert with_creep(LAW, []) is LAW
    (run,) = moves_with_rests(BENCH, load_plant(str(TWO_MASSES), BENCH), n=1)
    assert with_creep(LAW.with_values(torque_coulomb_Nm=0.0), [run]).rest_fade_per_s < 400.0
    assert creep_remarks(LAW) == []
