"""An error of the screw at one place is told, noise and what only one run shows are not."""

import numpy as np
import pytest
from scipy.signal import lfilter

from pmac_comp.physics.diagnose.place import PlacePattern, place_pattern

PITCH_m = 0.01
PERIOD_s = 2e-3
NOISE_m = 0.07e-6
DENT_m, DENT_AT_m = 1.0e-6, 0.045


def runs(seed: int) -> list[np.ndarray]:
    """Places that six runs of 4 s visit, each in its own way."""
    rng = np.random.default_rng(seed)
    time = PERIOD_s * np.arange(2000)
    return [
        0.05 * rng.uniform(-1.0, 1.0) + 0.15 * np.sin(2 * np.pi * rng.uniform(0.2, 1.0) * time)
        for _ in range(6)
    ]


def coloured(size: int, rng: np.random.Generator) -> np.ndarray:
    """Noise with a memory of half a second, as drift of a sensor has."""
    return np.asarray(lfilter([0.09], [1.0, -0.996], rng.normal(0.0, 1.0, size))) * NOISE_m


def seen(seed: int, error) -> PlacePattern:
    rng = np.random.default_rng([seed, 7])
    places = runs(seed)
    left = [coloured(x.size, rng) + error(i, x) + 3e-6 * i for i, x in enumerate(places)]
    counted = [np.ones(x.size, dtype=bool) for x in places]
    found = place_pattern(left, places, counted, pitch_m=PITCH_m, block=250)
    assert found is not None
    return found


def dent(place_m: np.ndarray) -> np.ndarray:
    return DENT_m * np.exp(-0.5 * ((place_m - DENT_AT_m) / 0.012) ** 2)


@pytest.mark.parametrize("seed", range(4))
def test_a_dent_shorter_than_the_pieces_of_the_rivals_is_told(seed):
    found = seen(seed, lambda i, x: dent(x))
    assert found.p_value < 0.01
    assert found.rms_um > 0.15
    assert found.region.low < 1e3 * DENT_AT_m + 5.0
    assert found.region.high > 1e3 * DENT_AT_m - 5.0
    assert found.region.size_um == pytest.approx(1e6 * DENT_m, rel=0.35)


@pytest.mark.parametrize("seed", range(4))
def test_slow_noise_and_the_error_of_one_run_foretell_nothing(seed):
    for error in (lambda i, x: 0.0, lambda i, x: dent(x) * (i == 2)):
        found = seen(seed, error)
        assert found.rms_um < 0.06


def test_two_runs_do_not_tell():
    places = runs(1)[:2]
    counted = [np.ones(x.size, dtype=bool) for x in places]
    assert place_pattern([dent(x) for x in places], places, counted, pitch_m=0.01, block=50) is None
