"""A gap that the runs showed: kept with the law, in its model and in words."""

import json

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.clearance import Clearance
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.model import slots
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.workflow.law.dynamic_law import nut_gap
from pmac_comp.workflow.law.loose_nut import (
    clearance_note,
    clearance_remarks,
    flank_remarks,
    found_clearance,
    loosened,
)

BENCH = load_bench("paper")
MODEL = DriveModel.base(BENCH)
FOUND = Clearance({"backlash.gap_m": 2e-6, "coulomb.guide_N": 41.0}, 0.64, 0.22)


def test_promise_is_made_by_the_model_with_the_gap_also_from_a_file() -> None:
    note = json.loads(json.dumps(clearance_note(FOUND)))
    loose = loosened(MODEL, CompensationLaw(provenance=note))
    gap = nut_gap(loose)
    assert gap is not None
    assert gap.half_m == pytest.approx(1e-6)
    assert loose.parameters["coulomb.guide_N"] == 41.0
    assert loosened(loose, CompensationLaw(provenance=note)) == loose


def test_nothing_found_changes_and_says_nothing() -> None:
    law = CompensationLaw(provenance=clearance_note(None))
    assert loosened(MODEL, law) is MODEL
    assert loosened(MODEL, None) is MODEL
    assert clearance_remarks(law) == []
    assert found_clearance(BENCH, MODEL, (), ()) is None


def test_person_reads_what_was_found_and_who_names_it() -> None:
    (text,) = clearance_remarks(CompensationLaw(provenance=clearance_note(FOUND)))
    assert "2.00 um" in text
    assert "as a gap does" in text
    assert "0.22 um rms" in text
    assert "diagnose" in text


def test_soft_nut_is_said_as_such() -> None:
    zone = {"preload_loss.half_width_m": 2e-6, "preload_loss.stiffness_ratio": 0.4}
    note = clearance_note(Clearance(zone, 0.43, 0.18))
    (text,) = clearance_remarks(CompensationLaw(provenance=note))
    assert "2.40 um" in text
    assert "soft around zero force" in text
    gap = nut_gap(loosened(MODEL, CompensationLaw(provenance=note)))
    assert gap is not None
    assert gap.half_m == pytest.approx(1.2e-6)


def test_load_that_presses_the_nut_stays_with_the_law_and_is_said() -> None:
    loaded = {**FOUND.values, "bias_force.force_N": -60.0}
    note = json.loads(json.dumps(clearance_note(Clearance(loaded, 1.1, 0.4))))
    (text,) = clearance_remarks(CompensationLaw(provenance=note))
    assert "pressed to one side by -60 N" in text
    gap = nut_gap(loosened(MODEL, CompensationLaw(provenance=note)))
    assert gap is not None
    mass_kg = MODEL.kernel_vector()[slots.M_TABLE]
    assert gap.load_m_per_s2 == pytest.approx(-60.0 / mass_kg)


def test_accelerations_at_which_a_loaded_nut_changes_its_flank_are_said() -> None:
    law = CompensationLaw(
        inertia_s2=2e-6, coulomb_m=1e-6, gap_half_m=2e-6, gap_width_m=1e-7, gap_load_m=3e-6
    )
    (text,) = flank_remarks(law)
    assert "accelerations of -1.00 and -2.00 m/s2" in text
    (text,) = flank_remarks(law.with_values(gap_load_m=-3e-6))
    assert "accelerations of +1.00 and +2.00 m/s2" in text


def test_small_load_leaves_one_acceleration_as_friction_turns_the_nut_at_the_other() -> None:
    law = CompensationLaw(
        inertia_s2=2e-6, coulomb_m=2e-6, gap_half_m=2e-6, gap_width_m=1e-7, gap_load_m=1e-6
    )
    (text,) = flank_remarks(law)
    assert "accelerations of -1.50 m/s2" in text


def test_friction_higher_near_standstill_moves_the_flank_between_two_accelerations() -> None:
    law = CompensationLaw(
        inertia_s2=2e-6, coulomb_m=1e-6, stribeck_m=0.5e-6, gap_half_m=2e-6, gap_width_m=1e-7
    )
    (text,) = flank_remarks(law)
    assert "lies from 0.50 to 0.75 m/s2" in text
    _, text = flank_remarks(law.with_values(gap_load_m=-3e-6))
    assert "lies from 0.75 to 1.00 and from 2.00 to 2.25 m/s2" in text
    # At rest friction holds this load, in motion it does not.
    _, text = flank_remarks(law.with_values(gap_load_m=1.2e-6))
    assert "lies from 0.00 to 0.15 and from 1.10 to 1.35 m/s2" in text


def test_nut_without_load_or_without_gap_has_nothing_said_of_its_flank() -> None:
    assert flank_remarks(CompensationLaw(gap_load_m=3e-6)) == []
    assert flank_remarks(CompensationLaw(coulomb_m=1e-6, gap_half_m=2e-6, gap_width_m=1e-7)) == []


def test_law_that_knows_no_inertia_has_no_acceleration_to_tell() -> None:
    law = CompensationLaw(coulomb_m=1e-6, gap_half_m=2e-6, gap_width_m=1e-7, gap_load_m=3e-6)
    assert law.inertia_s2 == 0.0
    assert flank_remarks(law) == []
