"""What a gap in the nut, a late scale and a bed that swings hide of each other is found."""

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.identify.scale_age import measured_scale_age
from pmac_comp.physics.identify.swinging_bed import measured_bed
from pmac_comp.simulator.plant.effects import PlantEffects
from pmac_comp.workflow.beyond_model import Shown, made_with, shown_by_runs
from tests.physics.identified import SLOW, identified

BENCH = load_bench("paper_x4")


def shown(effects: PlantEffects, *, seed: int = 4) -> Shown:
    """What the calibration runs of a simulated drive show beyond the base model of them."""
    runs, model = identified(BENCH, effects, seed)
    found = shown_by_runs(BENCH, model, runs, ())
    again = made_with(model, CompensationLaw(provenance=found.noted))
    assert set(again.effects) == set(found.model.effects)
    assert again.parameters == found.model.parameters
    return found


def test_a_drive_with_neither_shows_no_late_scale_and_no_bed() -> None:
    runs, model = identified(BENCH, {}, seed=3, without=SLOW)
    assert measured_scale_age(runs, BENCH, model) is None
    assert measured_bed(runs, BENCH, model) is None


@pytest.mark.slow
def test_stribeck_friction_behind_play_is_found() -> None:
    friction = {"excess_N": 28.0, "excess_Nm": 0.0, "speed_m_per_s": 0.0043}
    found = shown({"stribeck": friction, "backlash": {"gap_um": 2.2}}).model.parameters
    assert found["backlash.gap_m"] == pytest.approx(2.2e-6, abs=0.1e-6)
    assert found["stribeck.excess_N"] == pytest.approx(28.0, rel=0.2)
    assert found["stribeck.speed_m_per_s"] == pytest.approx(4.3e-3, rel=0.2)


@pytest.mark.slow
def test_a_bed_that_swings_behind_play_is_found() -> None:
    swings = {"frequency_Hz": 25.0, "mass_ratio": 0.12}
    found = shown({"base_mode": swings, "backlash": {"gap_um": 2.0}})
    assert found.noted["bed"]["frequency_Hz"] == pytest.approx(25.0, rel=0.02)
    assert found.noted["bed"]["mass_ratio"] == pytest.approx(0.12, rel=0.1)
    assert found.model.parameters["backlash.gap_m"] == pytest.approx(2e-6, abs=0.1e-6)
    assert not any(name.startswith("stribeck") for name in found.model.effects)
    assert "scale_age" not in found.noted


@pytest.mark.slow
def test_a_late_scale_beside_a_bed_that_swings_is_found() -> None:
    found = shown({"channel_skew": {"time_us": 5.0}, "base_mode": {"mass_ratio": 0.15}})
    assert found.noted["scale_age"]["time_s"] == pytest.approx(5e-6, abs=0.6e-6)
    assert found.noted["bed"]["frequency_Hz"] == pytest.approx(35.0, rel=0.02)
    assert "clearance" not in found.noted
