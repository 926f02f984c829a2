"""Coordinates and the tests that say where a residual lives."""

import numpy as np

from pmac_comp.physics.diagnose import localise as lo

LEAD_M = 0.01


def motion(n=4000, ts=2e-3):
    t = ts * np.arange(n)
    # Two tones, so that speed is not a function of position or of the distance travelled.
    return t, 0.03 * np.sin(2 * np.pi * 0.7 * t) + 0.012 * np.sin(2 * np.pi * 1.83 * t)


def located(residual, x, t):
    coordinates = lo.machine_coordinates(t, x, None, LEAD_M)
    noise = 0.1e-6 * np.random.default_rng(4).normal(size=t.size)
    return lo.localise([residual + noise], [coordinates], channel="table", sample_s=t[1] - t[0])


def test_reversals_are_found_and_hunting_is_not():
    t, _ = motion()
    x = 0.03 * np.sin(2 * np.pi * 0.7 * t)
    turns = lo.reversal_indices(x)
    expected = (np.arange(0.25, 0.7 * t[-1], 0.5)) / 0.7 / (t[1] - t[0])
    assert turns.size == np.count_nonzero(expected < t.size - 1)
    np.testing.assert_allclose(turns, expected[: turns.size], rtol=0.0, atol=2)
    hunting = 0.5e-6 * np.sin(40 * t)
    assert lo.reversal_indices(hunting).size == 0


def test_distance_since_reversal_is_signed_travel():
    x = np.array([0.0, 1.0, 2.0, 1.5, 1.0, 1.2]) * 1e-3
    d = lo.distance_since_reversal_m(x)
    assert np.allclose(d, np.array([0.0, 1.0, 0.0, -0.5, 0.0, 0.2]) * 1e-3)


def test_a_wobble_is_found_in_the_screw_angle():
    t, x = motion()
    regions = located(1e-6 * np.cos(2 * np.pi * x / LEAD_M), x, t)
    assert regions[0].coordinate == "screw_angle"
    assert regions[0].share > 0.8
    assert 0.8 < regions[0].size_um < 1.2


def test_a_skew_is_found_in_the_speed():
    t, x = motion()
    regions = located(5e-6 * np.gradient(x, t), x, t)
    assert regions[0].coordinate == "speed"


def test_a_slope_is_found_in_the_position():
    t, x = motion()
    regions = located(40e-6 * x, x, t)
    assert regions[0].coordinate == "position"


def test_friction_that_differs_by_place_is_told_from_what_grows_with_the_force():
    """It was said to follow the force, and a run in the middle was asked for, where there is none.

    Friction is higher towards the upper end, as much against the motion either way.
    """
    t, x = motion()
    way = np.sign(np.gradient(x, t))
    first = located(20e-6 * x * way, x, t)[0]
    assert first.coordinate == lo.TURNED
    assert first.share > 0.8
    assert max(abs(first.low), abs(first.high)) > 30.0
    assert "turns over with the direction and differs by place" in first.describe()


def test_friction_that_changed_between_runs_at_several_places_is_not_taken_for_a_guide():
    """Friction that warms up shows at the place of each run: both causes are told."""
    t, x = motion()
    places = [x - 0.1, x, x + 0.1]
    coordinates = [lo.machine_coordinates(t, at, None, LEAD_M) for at in places]
    noise = np.random.default_rng(4).normal(size=(3, t.size))
    way = np.sign(np.gradient(x, t))
    left = [1e-6 * (1.0 - 0.5 * i) * way + 0.1e-6 * noise[i] for i in range(3)]  # less in every run
    first = lo.localise(left, coordinates, channel="table", sample_s=t[1] - t[0])[0]
    assert first.coordinate == lo.TURNED
    assert "or not in the runs that were made there" in first.describe()


def test_friction_that_is_the_same_everywhere_does_not_differ_by_place():
    t, x = motion()
    regions = located(1e-6 * np.sign(np.gradient(x, t)), x, t)
    assert lo.TURNED not in {region.coordinate for region in regions}


def test_white_noise_lives_nowhere():
    t, x = motion()
    assert located(np.zeros_like(t), x, t) == ()


def test_marked_samples_are_left_out():
    t, x = motion()
    residual = 40e-6 * x
    residual[100:200] = np.nan
    assert located(residual, x, t)[0].coordinate == "position"


def _runs_at(frequencies, ring_Hz):
    """Residuals of runs that follow their motion's period, with or without a mode that rings."""
    rng = np.random.default_rng(7)
    t = 2.2e-3 * np.arange(3000)
    for own in frequencies:
        slow = 0.6e-6 * np.sin(2 * np.pi * own * t) + 0.3e-6 * np.sin(2 * np.pi * 5 * own * t)
        ringing = 0.4e-6 * np.sin(2 * np.pi * ring_Hz * t) if ring_Hz else 0.0
        yield slow + ringing + 0.1e-6 * rng.normal(size=t.size)


def test_what_rings_in_every_run_is_told_first_and_with_its_band():
    coordinates = [lo.machine_coordinates(*motion(3000), None, LEAD_M)] * 4
    found, without = (
        lo.localise(list(_runs_at((0.7, 2.0, 4.1, 7.3), ring)), coordinates, channel="table",
                    sample_s=2.2e-3)
        for ring in (56.0, 0.0)
    )  # fmt: skip
    assert found[0].rings
    assert found[0].low < 56.0 < found[0].high < 1.4 * found[0].low
    assert 0.3e-6 < 1e-6 * found[0].size_um < 0.5e-6
    assert "rings between" in found[0].describe()
    # 5 x 4.1 and 5 x 7.3 Hz lie above the lowest band: each is one run's own.
    assert not any(region.rings for region in without)
