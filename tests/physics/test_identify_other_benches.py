"""Identification on benches unlike the paper's. The plant is written apart from the model."""

import pytest

from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.linear_start import starting_model
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.simulator.closed_loop import closed_loop_capture
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.plant.ballscrew import BallscrewPlant
from pmac_comp.workflow.campaigns import calibration_motions
from tools.acceptance.identify_coverage import truth_si

BENCH = load_bench("paper")
GRAVITY_N = -1200.0


def runs_of(bench: Bench, plant: BallscrewPlant) -> list[Capture]:
    """The default campaign, each run from rest and from no torque."""
    return [closed_loop_capture(bench, plant, m.position_m) for m in calibration_motions(bench)]


@pytest.fixture(scope="module")
def hanging() -> tuple[list[Capture], dict[str, float]]:
    plant = make_plant(BENCH, effects={"bias_force": {"force_N": GRAVITY_N}}, seed=2)
    return runs_of(BENCH, plant), {**truth_si(plant.truth), "bias_force.force_N": GRAVITY_N}


def test_the_fit_of_a_vertical_axis_starts_from_its_weight(
    hanging: tuple[list[Capture], dict[str, float]],
) -> None:
    start = starting_model(hanging[0], BENCH, DriveModel.base(BENCH).with_effect("bias_force"))
    assert start.parameters["bias_force.force_N"] == pytest.approx(GRAVITY_N, rel=0.02)


def test_a_base_model_starts_without_a_bias(
    hanging: tuple[list[Capture], dict[str, float]],
) -> None:
    start = starting_model(hanging[0], BENCH, DriveModel.base(BENCH))
    assert "bias_force.force_N" not in start.parameters
