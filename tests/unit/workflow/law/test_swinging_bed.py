"""A bed that the runs showed to swing: kept with the law, in its model, in the law and in words."""

import json
import math
from dataclasses import asdict

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.identify.swinging_bed import SwingingBed
from pmac_comp.physics.model import slots
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.workflow.law.beyond_model import made_with
from pmac_comp.workflow.law.dynamic_law import swung_bed
from pmac_comp.workflow.law.swinging_bed import bed_remarks, noted_bed, on_bed

BENCH = load_bench("paper_x4")
MODEL = DriveModel.base(BENCH)
FOUND = SwingingBed(
    21.3, 0.125, 0.03, 0.001, {"viscous.guide_Ns_per_m": 211.0, "gone.x": 1.0}, 0.144, 0.066
)
NOTE = json.loads(json.dumps({"bed": asdict(FOUND)}))


def test_promise_is_made_by_the_drive_on_its_bed_also_from_a_file() -> None:
    model = made_with(MODEL, CompensationLaw(provenance=NOTE))
    assert model.values_of("base_mode") == {
        "frequency_Hz": 21.3,
        "mass_ratio": 0.125,
        "damping_ratio": 0.03,
    }
    assert model.parameters["viscous.guide_Ns_per_m"] == 211.0
    assert "gone.x" not in model.parameters
    assert made_with(MODEL, CompensationLaw()) == MODEL


def test_a_model_that_holds_a_bed_is_taken_at_its_word() -> None:
    model = MODEL.with_effect("base_mode", {"frequency_Hz": 30.0})
    assert noted_bed(BENCH, model, ()) == {}
    assert on_bed(model, NOTE) is model
    assert noted_bed(BENCH, MODEL, ()) == {}  # no runs, nothing to look at


def test_the_bed_of_a_law_swings_as_that_of_the_model() -> None:
    bed = swung_bed(on_bed(MODEL, NOTE))
    assert bed is not None
    assert bed.share == pytest.approx(0.125 / 1.125)  # of the table's mass in both
    # Bed and table together: slower than the bed alone, by the root of the masses.
    omega = 2.0 * math.pi * 21.3
    assert bed.stiffness_per_s2 == pytest.approx(omega**2 / 1.125)
    assert bed.damping_per_s == pytest.approx(2.0 * 0.03 * omega / 1.125)
    mass_kg = MODEL.kernel_vector()[slots.M_TABLE]
    assert bed.torque_Nm_s2_per_m == pytest.approx(mass_kg * BENCH.lead_m_per_rad)
    assert swung_bed(MODEL) is None
    assert swung_bed(MODEL.with_effect("base_mode", {"mass_ratio": 0.0})) is None


def test_person_reads_what_swings_and_how_sure_that_is() -> None:
    (text,) = bed_remarks(CompensationLaw(provenance=NOTE))
    for said in ("21.3 Hz", "0.125 +- 0.002", "0.14 um", "0.07 with it", "diagnose"):
        assert said in text
    assert bed_remarks(CompensationLaw()) == []
