"""Noise floor from repeats."""

import numpy as np
import pytest

from pmac_comp.physics.diagnose.noise import broadband_power, fractional_period, period_samples

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


def test_a_period_between_samples_is_found_and_taken_where_it_is_nearly_whole():
    # 3.393 Hz at 2262 Hz is 666.8 samples; five of them are nearest to a whole number.
    time_s = 442e-6 * np.arange(13574)
    wave = 0.012 * np.sin(2 * np.pi * 3.393 * time_s) * np.minimum(1.0, 3.393 * time_s)
    assert period_samples(wave) == 0
    assert fractional_period(wave) == pytest.approx(5 / (3.393 * 442e-6), abs=1e-3)
    assert fractional_period(0.01 * time_s) == 0.0


def test_power_of_a_band_is_that_of_noise_and_not_of_a_wave_in_it():
    rng = np.random.default_rng(2)
    noise = rng.standard_normal(9000)
    wave = 5.0 * np.sin(0.05 * np.arange(9000))
    assert broadband_power(noise) == pytest.approx(1.0, rel=0.1)
    assert broadband_power(noise + wave) == pytest.approx(1.0, rel=0.2)
