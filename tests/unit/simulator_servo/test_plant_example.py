"""The worked example of a plant file: loads, obeys mechanics, and a card holds it."""

from pathlib import Path

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.simulator.plant import BallscrewPlant, load_plant
from pmac_comp.simulator.servo.closed_loop import run_closed_loop

EXAMPLE = Path(__file__).parents[3] / "configs/plant_two_masses.py"
BENCH = load_bench("paper")


def test_the_example_accelerates_as_its_masses_say() -> None:
    plant = load_plant(str(EXAMPLE), BENCH)
    steps, torque_Nm, lead = 200, 4.0, BENCH.lead_m_per_rad
    for _ in range(steps):
        angle, table = plant.step(torque_Nm)
    known = BENCH.nominal
    inertia = known.motor_inertia_kgm2 + known.screw_inertia_kgm2 + known.table_mass_kg * lead**2
    time_s = steps * BENCH.servo_period_s
    friction_Nm = 0.4 + 40.0 * lead + 100.0 * lead**2 * angle / time_s
    assert angle == pytest.approx(0.5 * (torque_Nm - friction_Nm) / inertia * time_s**2, rel=0.03)
    assert table == pytest.approx(lead * angle, abs=50e-6)


def test_the_loop_of_the_bench_holds_it() -> None:
    time_s = BENCH.servo_period_s * np.arange(1200)
    command_m = 0.005 * (1.0 - np.cos(2 * np.pi * 2.0 * time_s))
    found = run_closed_loop(BENCH, load_plant(str(EXAMPLE), BENCH), command_m)
    error_m = found["motor_position_m"] - command_m
    assert 1e-6 < np.max(np.abs(error_m)) < 300e-6


def test_the_other_factory_adds_play_to_the_built_in_drive() -> None:
    plant = load_plant(f"{EXAMPLE}:loose_nut", BENCH)
    assert isinstance(plant, BallscrewPlant)
    assert plant.effects["backlash"] == {"gap_um": 4.0}
    assert "presliding" in plant.effects
