"""Noise floor from repeats."""

import numpy as np
import pytest

from pmac_comp.physics.diagnose.noise import period_samples

TIME_s = 4e-4 * np.arange(20000)


def test_a_repeating_command_gives_its_period_and_ramps_do_not_hide_it():
    wave = 1e-2 * np.sin(2 * np.pi * 2.5 * TIME_s)
    assert period_samples(wave) == 1000
    assert period_samples(wave * np.minimum(1.0, TIME_s)) == 1000


@pytest.mark.parametrize(
    "command",
    [
        0.01 * TIME_s,
        1e-2 * np.sin(2 * np.pi * (0.2 + 0.3 * TIME_s) * TIME_s),
        np.cumsum(np.random.default_rng(1).normal(size=5000)) * 1e-4,
    ],
)
def test_a_command_that_does_not_repeat_gives_none(command):
    assert period_samples(command) == 0
