"""Whitening, jackknife regression and the words about what is not known."""

import numpy as np
import pytest
from scipy.signal import lfilter

from pmac_comp.base.errors import NotIdentifiable
from pmac_comp.physics.identify.derivatives import usable_rows
from pmac_comp.physics.identify.regression import regress
from pmac_comp.physics.identify.whitening import fit_whitener, white


def coloured(n: int, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.0, 2.0, n)
    return np.asarray(lfilter([1.0], [1.0, -0.9], noise))


def test_whitener_leaves_white_unit_innovations() -> None:
    values = coloured(20000, 1)
    valid = np.ones(values.size, dtype=np.bool_)
    left = fit_whitener(values, valid, 1e-6).apply(values)[10:]
    assert left.std() == pytest.approx(1.0, abs=0.03)
    assert abs(np.corrcoef(left[1:], left[:-1])[0, 1]) < 0.03


def test_rows_near_invalid_samples_do_not_count() -> None:
    valid = np.ones(400, dtype=np.bool_)
    valid[200] = False
    rows = fit_whitener(coloured(400, 2), valid, 1e-6, order=5).rows(valid)
    assert not rows[200:206].any()
    assert rows[199]
    assert rows[206]
    assert white(2.0).rows(valid).sum() == 399


def test_border_and_gap_are_cut_out() -> None:
    valid = np.ones(1000, dtype=np.bool_)
    valid[500] = False
    rows = usable_rows(valid, 50)
    assert list(np.flatnonzero(~rows)) == [*range(50), *range(450, 551), *range(950, 1000)]


def test_sandwich_intervals_hold_for_coloured_noise() -> None:
    n, inside, white_inside = 4000, 0, 0
    t = np.arange(n) / 100.0
    columns = np.column_stack([np.sin(0.3 * t), np.ones(n)])
    for seed in range(200):
        fit = regress(
            ("a", "b"), columns, columns @ [1.0, 2.0] + coloured(n, seed), block=100, advice={}
        )
        inside += abs(fit.value("a") - 1.0) < 2.0 * fit.std("a")
        white_inside += abs(fit.value("a") - 1.0) < 2.0 * fit.white_std[0]
    assert 175 <= inside <= 200
    assert white_inside < 120  # what the textbook formula claims is far too narrow


def test_columns_that_say_the_same_are_named() -> None:
    x = np.random.default_rng(0).normal(size=300)
    columns = np.column_stack([x, np.ones(300), 2.0 * x + 1e-6])
    with pytest.raises(NotIdentifiable, match=r"viscous friction and Coulomb friction") as caught:
        regress(
            ("speed", "bias", "direction"),
            columns,
            x,
            block=10,
            advice={"speed": "several speeds"},
        )
    assert "several speeds" in caught.value.hint
