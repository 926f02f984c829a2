"""Break-away distance of the friction torque: a plant that slides into its friction shows it."""

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.grip import gripping_law, gripping_torque
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import model_loop
from pmac_comp.physics.compensate.unmodelled import model_law
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.trajectory import sinusoid
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture

BENCH = load_bench("paper_x4")
LAW = CompensationLaw(torque_coulomb_Nm=0.5, torque_breakaway_m=0.6e-6, torque_limit_Nm=10.0)
LOOP = model_loop(
    DriveModel.base(
        BENCH,
        {
            "coulomb.guide_N": 45.0,
            "coulomb.nut_Nm": 0.25,
            "coulomb.motor_Nm": 0.2,
            "viscous.guide_Ns_per_m": 200.0,
        },
    )
)


def captures(effects: dict[str, dict[str, float | str]]) -> list[Capture]:
    plant = make_plant(BENCH, effects=effects, spread=0.0)
    motion = sinusoid(period_s=BENCH.servo_period_s, amplitude_m=0.01, frequency_Hz=2.0, cycles=3.0)
    return [closed_loop_capture(BENCH, plant, motion.position_m)]


def test_torque_grips_over_the_distance_of_the_drives_friction() -> None:
    runs = captures({"presliding": {"distance_um": 30.0, "place": "nut"}})
    law, explained = gripping_law(LAW, LOOP, runs)
    # Half of the friction slides into it, the other half turns over at once.
    assert 2e-6 <= law.torque_breakaway_m <= 16e-6
    assert explained > 0.1
    # With that friction the model explains the run, and its own word stays its own.
    rest = [
        float(np.std(runs[0].motor_position_m - LOOP(command, None, torque).motor_position_m))
        for command in [runs[0].commanded_position_m]
        for torque in (None, gripping_torque(law, runs[0]))
    ]
    assert rest[1] < 0.9 * rest[0]
    assert model_law(law).torque_breakaway_m == pytest.approx(LAW.torque_breakaway_m)


@pytest.mark.parametrize("law", [LAW, LAW.without_torque()])
def test_law_of_a_drive_with_coulomb_friction_stays_as_it_is(law: CompensationLaw) -> None:
    assert gripping_law(law, LOOP, captures({})) == (law, 0.0)


def test_without_captures_nothing_is_known() -> None:
    assert gripping_law(LAW, LOOP, []) == (LAW, 0.0)
