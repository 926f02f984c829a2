"""A law after a rest in which the integrator wound itself up against friction."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.physics.compensate.design import design_law
from pmac_comp.physics.compensate.loop import model_loop
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.trajectory import Trajectory, trapezoid
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.plant.door import Plant
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import default_servo, embedded
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller.deploy import deploy, switch
from pmac_comp.workflow.law.routes import LATENCY_CYCLES
from pmac_comp.workflow.motion.motions import Motion, parse_motion
from tests.generators.true_values import friction_of

BENCH = load_bench("paper_x4")
COARSE = load_bench("paper")
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
    with deployed(BENCH, plant, Compensation(route, law), tmp_path_factory.mktemp(route)) as found:
        yield found[0]


@contextmanager
def deployed(
    bench: Bench, plant: Plant, compensation: Compensation, folder: Path
) -> Iterator[tuple[Axis, Context]]:
    """Axis of a drive with its compensation armed."""
    in_servo = compensation.route == "servo"
    source = default_servo().read_text(encoding="utf-8") if in_servo else None
    with embedded(Card(bench, plant=plant, servo_source=source)) as link:
        axis = Axis(link, bench, "card")
        axis.enable()
        if in_servo:
            link.command(f"I{axis.motor}59=1")
        context = context_of(axis, folder)
        deploy(axis, compensation, context)
        yield axis, context


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


class NoisyDrive:
    """Motor, screw and table in one, against sharp friction, seen by a noisy encoder."""

    def __init__(self, friction_Nm: float) -> None:
        lead, nominal = COARSE.lead_m_per_rad, COARSE.nominal
        assert nominal.table_mass_kg is not None
        rotary = (nominal.motor_inertia_kgm2 or 0.0) + (nominal.screw_inertia_kgm2 or 0.0)
        self.inertia_kgm2 = rotary + nominal.table_mass_kg * lead**2
        self.friction_Nm = friction_Nm
        self.noise = np.random.default_rng(3)
        self.reset()

    def reset(self, table_position_m: float = 0.0) -> None:
        self.angle_rad, self.speed_rad_per_s = table_position_m / COARSE.lead_m_per_rad, 0.0

    def set_external_force(self, force_N: float) -> None:
        assert force_N == 0.0

    def step(self, torque_Nm: float) -> tuple[float, float]:
        period_s = COARSE.servo_period_s / 4
        for _ in range(4):
            speed = self.speed_rad_per_s + period_s * torque_Nm / self.inertia_kgm2
            least = period_s * self.friction_Nm / self.inertia_kgm2
            self.speed_rad_per_s = math.copysign(max(0.0, abs(speed) - least), speed)
            self.angle_rad += period_s * self.speed_rad_per_s
        half_a_count = math.pi / COARSE.encoder.counts_per_rev
        seen_rad = self.angle_rad + half_a_count * float(self.noise.standard_normal())
        return seen_rad, self.angle_rad * COARSE.lead_m_per_rad


@contextmanager
def noisy_axis(route: str, folder: Path) -> Iterator[tuple[Axis, Context, Compensation]]:
    """Axis of a noisy drive with the law of one that is as stiff and has as much friction."""
    law = design_law(
        COARSE, model_loop(DriveModel.base(COARSE)), latency_cycles=LATENCY_CYCLES[route]
    )
    plant, compensation = NoisyDrive(law.breaks_loose_Nm), Compensation(route, law)
    with deployed(COARSE, plant, compensation, folder) as (axis, context):
        yield axis, context, compensation


@pytest.mark.usefixtures("whole_search")
@pytest.mark.parametrize(("route", "held"), [("law", 7130), ("servo", 7123)])
def test_torque_against_the_integrator_does_not_add_up_over_moves_one_way(
    tmp_path: Path, route: str, held: int
) -> None:
    kept_Nm = []
    with noisy_axis(route, tmp_path) as (axis, _, compensation):
        for k in range(15):
            axis.move_to(0.2e-3 * k / axis.scales.motor_m_per_ct)
            axis.link.clock.sleep_s(6.0)
            kept_Nm.append(float(axis.link.query(f"P{held}")[0]) * COARSE.drive.torque_per_dac_Nm)
    # It was twice the friction, and grew.
    assert np.mean(kept_Nm[-5:]) < 0.5 * compensation.law.breaks_loose_Nm


@pytest.mark.parametrize("route", ["law", "servo"])
def test_what_the_integrator_holds_leaves_no_steady_lag(tmp_path: Path, route: str) -> None:
    motion = parse_motion("trapezoid:distance_mm=60,speed_mm_per_s=60,start_mm=-30", COARSE)
    with noisy_axis(route, tmp_path) as (axis, context, compensation):
        switch(axis, context, compensation, on=False)
        axis.move_to(-30e-3 / axis.scales.motor_m_per_ct)  # the integrator holds friction downwards
        switch(axis, context, compensation, on=True)
        runs = [axis.run(motion) for _ in range(6)]
    lags = []
    for run in runs:
        speed = np.gradient(run.commanded_position_m, COARSE.servo_period_s)
        up = np.flatnonzero(speed > 59e-3)
        steady = up[up.size // 3 : -50]
        lags.append(np.mean((run.motor_position_m - run.desired_m)[steady]))
    # It was 0.5 um and more, as the loop shed what the integrator held.
    assert abs(np.mean(lags)) < 0.42e-6
