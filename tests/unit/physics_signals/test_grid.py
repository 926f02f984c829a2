"""Samples of a slower gather brought onto the servo's grid."""

import numpy as np
import pytest

from pmac_comp.physics.signals.grid import onto_servo_grid

TS_s = 442e-6


@pytest.mark.parametrize("stride", [2, 4])
def test_a_command_between_samples_keeps_its_acceleration(stride: int) -> None:
    time_s = TS_s * np.arange(4 * 500 + 1)
    command_m = 12e-3 * np.sin(4.0 * np.pi * time_s)
    fine_m = onto_servo_grid(command_m[::stride], stride)
    assert fine_m.shape == command_m.shape
    assert np.abs(fine_m - command_m).max() < 1e-9
    acceleration = np.diff(fine_m, 2)[20:-20] / TS_s**2
    given = np.diff(command_m, 2)[20:-20] / TS_s**2
    assert np.abs(acceleration - given).max() < 1e-2 * np.abs(given).max()


def test_servo_rate_samples_and_the_shortest_captures_stay_what_they_are() -> None:
    assert onto_servo_grid(np.array([1.0, 3.0, 2.0]), 1).tolist() == [1.0, 3.0, 2.0]
    assert onto_servo_grid(np.array([1.0, 3.0]), 2) == pytest.approx([1.0, 2.0, 3.0])
