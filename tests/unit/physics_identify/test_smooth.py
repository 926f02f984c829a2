"""Friction that turns over with speed is seen at rests, and in no drive that holds."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.refit import _smooth_part
from pmac_comp.physics.identify.smooth import smooth_values
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.rests import slow_motion_at_rest
from pmac_comp.simulator.plant import Plant, make_plant
from pmac_comp.simulator.plant.door import load_plant
from pmac_comp.workflow.model.identification import base_friction
from tests.physics.identified import moves_with_rests

BENCH = load_bench("paper_x4")
BASE = DriveModel.base(BENCH)
TWO_MASSES = Path(__file__).parents[3] / "configs" / "plant_two_masses.py"


def creeping(tmp_path: Path, factor: float) -> Plant:
    """The two masses with friction that turns over within ``factor`` times the speed."""
    text = TWO_MASSES.read_text(encoding="utf-8")
    speeds = f"CREEP_m_per_s, CREEP_rad_per_s = {2e-4 * factor}, {0.1 * factor}"
    plant = tmp_path / "creeping.py"
    plant.write_text(text.replace("CREEP_m_per_s, CREEP_rad_per_s = 2e-4, 0.1", speeds))
    assert speeds in plant.read_text(encoding="utf-8")
    return load_plant(str(plant), BENCH)


@pytest.mark.parametrize("factor", [1.0, 5.0, 25.0])
def test_a_drive_that_creeps_starts_where_its_friction_turns_over(
    tmp_path: Path, factor: float
) -> None:
    own = smooth_values(moves_with_rests(BENCH, creeping(tmp_path, factor)), BASE)
    assert own is not None
    # Between the 0.16 mm/s of the motor and the 0.2 of the guide; a fit begins there.
    assert own["speed_m_per_s"] == pytest.approx(0.18e-3 * factor, rel=0.4)
    assert own["rotary_m_per_s"] == own["speed_m_per_s"]


def test_no_job_begins_from_coulomb_friction_where_the_drive_creeps(tmp_path: Path) -> None:
    assert base_friction(moves_with_rests(BENCH, creeping(tmp_path, 5.0)), BENCH) == "auto"
    assert (
        base_friction(moves_with_rests(BENCH, make_plant(BENCH, effects={}, seed=3)), BENCH)
        == "coulomb"
    )
    assert base_friction([], BENCH) == "coulomb"


@pytest.mark.parametrize(
    "effects",
    [
        {},
        {"presliding": {"distance_um": 30.0, "place": "guide"}},
        {"backlash": {"gap_um": 4.0}},
        {"bias_force": {"force_N": 40.0}},
        {"cable_drag": {"stiffness_N_per_m": 60.0}},
        {"stribeck": {"excess_N": 20.0, "speed_m_per_s": 0.004}},
    ],
    ids=lambda effects: next(iter(effects), "plain"),
)
def test_a_drive_that_holds_has_none(effects: dict[str, dict[str, float | str]]) -> None:
    assert (
        smooth_values(moves_with_rests(BENCH, make_plant(BENCH, effects=effects, seed=3)), BASE)
        is None
    )


def test_a_fit_beside_play_tries_it_where_the_drive_creeps(tmp_path: Path) -> None:
    loose = BASE.with_effect("backlash", {"gap_m": 4e-6})
    part = _smooth_part(moves_with_rests(BENCH, creeping(tmp_path, 5.0)), loose)
    assert set(part) == {"smooth_coulomb"}
    assert set(part["smooth_coulomb"]) == {"speed_m_per_s", "rotary_m_per_s"}
    assert _smooth_part(moves_with_rests(BENCH, make_plant(BENCH, effects={}, seed=3)), loose) == {}


def test_runs_without_torque_or_rests_tell_nothing(tmp_path: Path) -> None:
    runs = [
        replace(run, torque_command_Nm=None)
        for run in moves_with_rests(BENCH, creeping(tmp_path, 1.0))
    ]
    assert slow_motion_at_rest(runs[0]).shape == (3, 0)
    assert smooth_values(runs, BASE) is None


def test_slow_motion_at_rest_is_speed_under_torque() -> None:
    period, n = BENCH.servo_period_s, 1000
    rest = np.zeros(n)
    motor = 2e-3 * period * np.arange(n)
    run = Capture(
        time_s=period * np.arange(n),
        commanded_position_m=rest,
        motor_position_m=motor,
        table_position_m=motor,
        torque_command_Nm=np.full(n, 0.3),
    )
    torque, speed, place = slow_motion_at_rest(run)
    assert torque == pytest.approx(0.3)
    assert speed == pytest.approx(2e-3)
    assert place.size == speed.size >= 20
