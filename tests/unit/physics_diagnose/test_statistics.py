"""Whitening, effective size, p-values and intervals."""

import numpy as np
import pytest

from pmac_comp.physics.diagnose import statistics as st


def coloured(seed: int, n: int = 20000) -> np.ndarray:
    rng = np.random.default_rng(seed)
    white = rng.normal(size=(n, 2)) @ np.array([[1.0, 0.6], [0.0, 0.5]])
    out = np.zeros_like(white)
    transition = np.array([[0.9, 0.05], [0.1, 0.8]])
    for i in range(1, n):
        out[i] = transition @ out[i - 1] + white[i]
    return out


def test_whitener_removes_correlation_in_time_and_between_channels():
    series = coloured(1)
    good = np.ones(series.shape[0], dtype=bool)
    whitener = st.fit_whitener([series], [good], order=4, floor=np.array([1e-9, 1e-9]))
    white = whitener.apply(series)[4:]
    cross = white.T @ white / white.shape[0]
    assert np.allclose(cross, np.eye(2), atol=0.05)
    for lag in (1, 2, 5, 20):
        moved = white[lag:].T @ white[:-lag] / white.shape[0]
        assert np.abs(moved).max() < 0.04


def test_whitener_filters_columns_like_residuals():
    series = coloured(2, 500)
    good = np.ones(500, dtype=bool)
    whitener = st.fit_whitener([series], [good], order=3, floor=np.array([1e-9, 1e-9]))
    stacked = whitener.apply(np.stack([series, 2 * series], axis=2))
    assert np.allclose(stacked[..., 0], whitener.apply(series))
    assert np.allclose(stacked[..., 1], 2 * whitener.apply(series))


def test_floor_bounds_the_claimed_precision():
    series = np.random.default_rng(3).normal(scale=1e-3, size=(2000, 1))
    good = np.ones(2000, dtype=bool)
    whitener = st.fit_whitener([series], [good], order=2, floor=np.array([1.0]))
    assert np.abs(whitener.apply(series)).max() < 0.01


def test_rows_with_past_drop_the_neighbours_of_bad_samples():
    good = np.ones(10, dtype=bool)
    good[5] = False
    assert np.flatnonzero(~st.rows_with_past(good, 2)).tolist() == [0, 1, 5, 6, 7]


@pytest.mark.parametrize(("rho", "share"), [(0.0, 1.0), (0.5, 1 / 3), (0.9, 0.1 / 1.9)])
def test_effective_size_of_first_order_noise_matches_theory(rho, share):
    rng = np.random.default_rng(5)
    n = 40000
    x = np.zeros(n)
    for i, e in enumerate(rng.normal(size=n - 1)):
        x[i + 1] = rho * x[i] + e
    assert st.effective_size(x) / n == pytest.approx(share, rel=0.25)


def test_sign_flip_p_is_uniform_without_an_effect_and_small_with_one():
    rng = np.random.default_rng(7)
    p = np.array([st.sign_flip_p(rng.normal(size=30), seed=i, draws=500) for i in range(300)])
    assert 0.02 < np.mean(p < 0.05) < 0.09
    assert st.sign_flip_p(rng.normal(1.5, 1.0, size=60), seed=1) < 1e-4


def test_sign_flip_p_claims_nothing_from_too_few_blocks():
    assert st.sign_flip_p(np.array([1.0, 1.0, 1.0]), seed=0) == 1.0
    assert st.sign_flip_p(np.full(5, 1.0), seed=0) >= 2.0**-5


def test_wilson_interval_matches_published_values():
    # Newcombe (1998), table I: 81/263 -> 0.2553 to 0.3662; 0/20 -> 0 to 0.1611
    assert st.wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert st.wilson_interval(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)
    assert st.wilson_interval(0, 0) == (0.0, 1.0)


def test_corrected_p_counts_candidates():
    assert st.corrected_p(0.01, 30) == pytest.approx(1 - 0.99**30)
    assert st.corrected_p(1e-20, 30) == pytest.approx(3e-19, rel=1e-6, abs=0.0)
    assert st.corrected_p(1.0, 30) == 1.0


def test_huber_weights_leave_ordinary_samples_alone():
    weights = st.huber_weights(np.array([[0.5], [3.5], [14.0]]))
    assert weights[:, 0] == pytest.approx([1.0, 1.0, 0.5])


def test_rotation_p_proves_a_single_event_and_nothing_from_noise():
    rng = np.random.default_rng(5)
    rows = np.full(100, 400.0)
    noise = rng.chisquare(400.0, 100)
    event = noise.copy()
    event[17] = 300_000.0
    assert st.sign_flip_p(event - noise, seed=1) > 0.4
    assert st.rotation_p(event, noise, rows, parameters=1) < 1e-6
    assert st.rotation_p(noise, noise - rng.chisquare(1.0, 100) / 100.0, rows, parameters=1) > 0.05
    assert st.rotation_p(noise, noise, rows, parameters=1) == 1.0
