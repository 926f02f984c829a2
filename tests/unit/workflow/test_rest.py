"""A law after a rest in which the integrator wound itself up against friction."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.design import design_law, model_loop
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.trajectory import Trajectory, trapezoid
from pmac_comp.simulator.card import Card
from pmac_comp.simulator.plant import make_plant
from pmac_comp.workflow.axis import Axis
from pmac_comp.workflow.compensation_file import Compensation
from pmac_comp.workflow.deploy import context_of, deploy
from pmac_comp.workflow.motions import Motion
from pmac_comp.workflow.routes import LATENCY_CYCLES
from pmac_comp.workflow.simulated import default_servo, embedded
from tests.generators.true_values import friction_of

BENCH = load_bench("paper_x4")
# Not in the law: the axis stops a few um off, inside its friction.
HIDDEN = {"friction_per_rev": {"amplitude_Nm": 0.05, "order_per_rev": 1.0, "phase_rad": 0.7}}


@pytest.fixture(scope="module", params=["law", "servo"])
def axis(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Axis]:
    """Axis with a law that does not hold all of its drive, armed."""
    plant = make_plant(BENCH, effects=HIDDEN, spread=0.0)
    model = DriveModel.base(
        BENCH,
        friction_of(plant.truth),
    )
    route = request.param
    law = design_law(BENCH, model_loop(model), latency_cycles=LATENCY_CYCLES[route])
    source = default_servo().read_text(encoding="utf-8") if route == "servo" else None
    with embedded(Card(BENCH, plant=plant, servo_source=source)) as link:
        axis = Axis(link, BENCH, "card")
        axis.enable()
        if route == "servo":
            link.command(f"I{axis.motor}59=1")
        folder: Path = tmp_path_factory.mktemp(route)
        deploy(axis, Compensation(route, law), context_of(axis, folder))
        yield axis


def peak_um(run: Capture) -> float:
    """Largest control error of a run against its value at rest."""
    control_m = run.motor_position_m - run.desired_m
    return float(np.max(np.abs(control_m - control_m[-1])) * 1e6)


def after_rest(distance_m: float) -> Motion:
    """A move that begins after two seconds at its start."""
    shape = trapezoid(
        period_s=BENCH.servo_period_s,
        distance_m=distance_m,
        speed_m_per_s=0.15,
        acceleration_m_per_s2=2.0,
        s_curve_s=0.015,
        start_m=0.0,
    )
    rest = np.zeros(round(2.0 / BENCH.servo_period_s))
    position = np.concatenate([rest, shape.position_m])
    time_s = BENCH.servo_period_s * np.arange(position.size, dtype=np.float64)
    return Motion("one way", Trajectory(time_s, position))


@pytest.mark.parametrize("distance_m", [-0.02, 0.02])
def test_motion_after_a_rest_finds_friction_where_it_stands(axis: Axis, distance_m: float) -> None:
    # The integrator has wound through the whole friction and the motor has crept: without a look
    # at that the motion in one of the directions begins with 60 um.
    assert peak_um(axis.run(after_rest(distance_m))) < 20.0
