"""Torque that comes back at the same places of the axis."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmac_comp.physics.diagnose.torque_place import TorqueLeft, sentences, told_by_torque

PERIOD_s = 2e-3
FRICTION, FORCE = "friction differs by place", "a force differs by place"


def runs(torque_Nm: Any, n_runs: int = 4) -> list[TorqueLeft]:
    """Sinusoids about places of their own; ``torque_Nm`` of position and direction, with noise."""
    rng = np.random.default_rng(3)
    time_s = PERIOD_s * np.arange(2000)
    found = []
    for i in range(n_runs):
        position_m = 0.02 * (i - 1.5) + 0.08 * np.sin(2.0 * np.pi * (0.4 + 0.1 * i) * time_s)
        speed = np.gradient(position_m, PERIOD_s)
        noise = 0.02 * rng.standard_normal(time_s.size)
        left = torque_Nm(position_m, np.sign(speed)) + noise
        found.append(TorqueLeft(left, position_m, speed, np.ones(time_s.size, dtype=bool)))
    return found


def place(position_m: np.ndarray) -> np.ndarray:
    """0.04 N m about 30 mm, on a stretch of some turns."""
    return np.asarray(0.04 * np.exp(-(((position_m - 0.03) / 0.02) ** 2)))


@pytest.mark.parametrize(
    ("torque_Nm", "said"),
    [
        (lambda x, way: way * place(x), FRICTION),
        (lambda x, way: place(x), FORCE),
        (lambda x, way: 0.0 * x, ""),
        (lambda x, way: 0.03 * way, ""),  # friction that is the same everywhere
    ],
)
def test_friction_and_forces_by_place_are_told_apart(torque_Nm, said):
    told = " ".join(sentences(runs(torque_Nm), pitch_m=0.01, block=100))
    assert (said in told) if said else (told == "")
    if said:
        assert "around 3" in told or "around 2" in told
        assert "by +0.0" in told


def test_two_runs_are_too_few_to_foretell_a_third():
    left = runs(lambda x, way: way * place(x), n_runs=2)
    assert sentences(left, pitch_m=0.01, block=100) == ()


@pytest.mark.parametrize(("unexplained", "torque"), [(False, np.zeros(4)), (True, None)])
def test_where_all_has_a_name_or_no_torque_was_captured_nothing_is_said(unexplained, torque):
    grown: Any = SimpleNamespace(
        workbench=SimpleNamespace(records=[SimpleNamespace(torque_Nm=torque)])
    )
    left: Any = SimpleNamespace(unexplained=unexplained)
    assert told_by_torque(grown, left) == ()
