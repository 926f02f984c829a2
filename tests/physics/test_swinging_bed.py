"""A bed that swings: found in the calibration runs beside what else a drive may have."""

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.identify.swinging_bed import measured_bed
from pmac_comp.simulator.plant.effects import PlantEffects
from pmac_comp.workflow.law.beyond_model import made_with, shown_by_runs, shown_remarks
from tests.physics.identified import SLOW, identified

BENCH = load_bench("paper_x4")


@pytest.mark.parametrize(
    ("frequency_Hz", "ratio", "beside"),
    [
        pytest.param(
            21.4,
            0.12,
            {"torque_ripple": {"amplitude_Nm": 0.05, "order_per_rev": 12.0}},
            marks=pytest.mark.slow,
        ),
        (46, 0.06, {}),
        pytest.param(7.5, 0.1, {}, marks=pytest.mark.slow),
    ],
    ids=["slow-and-ripple", "fast", "on-wheels"],
)
def test_a_bed_is_found_with_its_frequency_and_mass(
    frequency_Hz: float, ratio: float, beside: PlantEffects
) -> None:
    swings = {"frequency_Hz": frequency_Hz, "mass_ratio": ratio, "damping_ratio": 0.03}
    runs, model = identified(BENCH, {"base_mode": swings, **beside}, seed=5, without=SLOW)
    found = measured_bed(runs, BENCH, model)
    assert found is not None
    assert found.frequency_Hz == pytest.approx(frequency_Hz, rel=0.02)
    assert found.mass_ratio == pytest.approx(ratio, rel=0.1)
    assert found.damping_ratio == pytest.approx(0.03, abs=0.01)
    assert found.with_um < 0.7 * found.without_um


@pytest.mark.slow
def test_friction_that_a_slow_bed_hid_is_found_beside_it() -> None:
    friction: PlantEffects = {"presliding": {"distance_um": 12.0, "place": "guide"}}
    swings: PlantEffects = {
        "base_mode": {"frequency_Hz": 7.5, "mass_ratio": 0.11, "damping_ratio": 0.05}
    }
    runs, model = identified(BENCH, {**friction, **swings}, seed=3)
    shown = shown_by_runs(BENCH, model, runs, [], with_gap=False)
    found = shown.model.parameters
    assert found["base_mode.frequency_Hz"] == pytest.approx(7.5, rel=0.01)
    assert found["base_mode.mass_ratio"] == pytest.approx(0.11, rel=0.05)
    assert found["presliding.distance_m"] == pytest.approx(12e-6, rel=0.25)
    law = CompensationLaw(provenance=shown.noted)
    again = made_with(model, law)  # what the compensation file keeps of it
    assert again.parameters["presliding.distance_m"] == found["presliding.distance_m"]
    assert any("friction that it hid" in said for said in shown_remarks(law))


@pytest.mark.slow
def test_a_late_motor_on_a_still_bed_shows_none() -> None:
    runs, model = identified(BENCH, {"actuator_delay": {"time_us": 900.0}}, seed=3)
    assert measured_bed(runs, BENCH, model) is None


@pytest.mark.slow
def test_samples_that_are_lost_do_not_hide_it() -> None:
    runs, model = identified(BENCH, {"base_mode": {}}, seed=5)
    lost = []
    for run in runs:
        table = np.array(run.table_position_m)
        table[500:520] = np.nan
        valid = np.isfinite(table)
        lost.append(
            Capture(
                run.time_s,
                run.commanded_position_m,
                run.motor_position_m,
                table_position_m=table,
                torque_command_Nm=run.torque_command_Nm,
                valid=valid,
            )
        )
    found = measured_bed(lost, BENCH, model)
    assert found is not None
    assert found.frequency_Hz == pytest.approx(35.0, rel=0.02)
