"""All that runs showed beyond a model: kept with the law, and said."""

import json

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.clearance import Clearance
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.workflow.law.beyond_model import made_with, shown_remarks
from pmac_comp.workflow.law.loose_nut import clearance_note

BENCH = load_bench("paper_x4")
MODEL = DriveModel.base(BENCH)
WHOLE = MODEL.with_effect("backlash", {"gap_m": 2.1e-6}).with_effect("stribeck")
GAP = Clearance({"backlash.gap_m": 2.1e-6, "coulomb.guide_N": 41.0}, 0.64, 0.05)
NOTE = {
    **clearance_note(GAP),
    "whole_model": {
        "effects": ["backlash", "stribeck"],
        "values": {**WHOLE.parameters, "stribeck.excess_N": 28.0, "gone.x": 1.0},
    },
}
LAW = CompensationLaw(provenance=json.loads(json.dumps(NOTE)))


def test_promise_is_made_by_the_whole_drive_as_it_was_fitted_beside_the_gap() -> None:
    model = made_with(MODEL, LAW)
    assert model.effects == WHOLE.effects
    assert model.parameters == {**WHOLE.parameters, "stribeck.excess_N": 28.0}
    # A model file that names one of the effects gets the values that belong together.
    assert made_with(WHOLE, LAW).parameters == model.parameters


def test_friction_that_stood_for_the_gap_is_not_in_the_model_that_promises() -> None:
    whole = {**NOTE["whole_model"], "without": ["presliding@all"]}
    law = CompensationLaw(provenance={**NOTE, "whole_model": whole})
    model = made_with(MODEL.with_effect("presliding@all"), law)
    assert model.effects == WHOLE.effects
    assert made_with(MODEL, law).effects == WHOLE.effects  # a model file that never named it
    *_, given_up = shown_remarks(law)
    assert "presliding@all" in given_up
    assert "left out" in given_up


def test_person_reads_of_the_gap_and_of_the_friction_that_it_hid() -> None:
    gap, friction = shown_remarks(LAW)
    assert "2.10 um" in gap
    assert "stribeck" in friction
    assert "diagnose" in friction
    smooth = {"effects": ["smooth_coulomb"], "values": {"smooth_coulomb.speed_m_per_s": 1e-3}}
    assert len(shown_remarks(CompensationLaw(provenance={**NOTE, "whole_model": smooth}))) == 2
    sharp = {"effects": ["presliding@all"], "values": {"presliding.distance_m": 2e-8}}
    assert len(shown_remarks(CompensationLaw(provenance={**NOTE, "whole_model": sharp}))) == 1
    alone = CompensationLaw(provenance=clearance_note(GAP))
    assert len(shown_remarks(alone)) == 1
    assert shown_remarks(CompensationLaw()) == []
