"""A form of friction is better where nearly every held-out block says so, or their sum does."""

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.identify.trial import is_better


def blocks(seed: int, n: int = 70) -> FloatArray:
    """Mean squares per block: a few with reversals hold most of what is left."""
    rng = np.random.default_rng(seed)
    small = rng.lognormal(0.0, 0.3, (n, 2))
    small[:4] *= 300.0
    return small


@pytest.mark.parametrize("seed", range(4))
def test_few_large_blocks_do_not_hide_a_gain_that_all_blocks_show(seed: int) -> None:
    old = blocks(seed)
    new = 0.2 * old * np.random.default_rng(seed + 50).lognormal(0.0, 0.3, old.shape)
    gain = ((old - new) / old.mean(axis=0)).sum(axis=1)
    assert gain.mean() < 3.0 * gain.std() / np.sqrt(gain.size)
    assert is_better(new, old, 3.0)
    assert not is_better(old, new, 1.0)


@pytest.mark.parametrize("seed", range(20))
def test_chance_is_no_gain(seed: int) -> None:
    old = blocks(seed)
    new = old * np.random.default_rng(seed + 50).lognormal(0.0, 0.2, old.shape)
    assert not is_better(new, old, 3.0)


def test_torque_that_scatters_does_not_hide_a_clear_gain_of_table_minus_motor() -> None:
    rng = np.random.default_rng(3)
    old = rng.lognormal(0.0, 0.2, (39, 2))
    torque = rng.permutation(old[:, 1])  # as large as before, block by block not
    new = np.column_stack([old[:, 0] * rng.uniform(0.75, 1.05, 39), torque])
    gain, share = (old - new) / old.mean(axis=0), (old - new) / (old + new)
    for both in (gain.sum(axis=1), share.sum(axis=1)):
        assert both.mean() < 3.0 * both.std() / np.sqrt(both.size)
    assert is_better(new, old, 3.0)
    new[:, 1] += 0.3 * old[:, 1].mean()  # a torque that gets worse by more is not outweighed
    assert not is_better(new, old, 3.0)


def test_small_gains_everywhere_do_not_outweigh_a_large_loss() -> None:
    old = blocks(1)
    new = 0.5 * old
    new[:4] = 1.1 * old[:4]
    assert not is_better(new, old, 3.0)


def test_what_takes_nearly_all_out_of_the_large_blocks_need_not_help_the_small_ones() -> None:
    # Table minus motor and torque of 65 blocks as a bed of 7 Hz left them, and with it found.
    rng = np.random.default_rng(5)
    old = rng.lognormal(0.0, 0.3, (65, 2))
    old[:8] *= np.array([[280.0], [225.0], [120.0], [110.0], [50.0], [38.0], [27.0], [23.0]])
    new = 1.1 * old
    new[:8] = 0.12 * old[:8]
    gain = ((old - new) / old.mean(axis=0)).sum(axis=1)
    assert gain.mean() < 3.0 * gain.std() / np.sqrt(gain.size)
    assert is_better(new, old, 3.0)
    new[3:8] = old[3:8]  # three blocks are not enough
    assert not is_better(new, old, 3.0)


def test_a_gain_too_small_to_be_worth_parameters_or_of_too_few_blocks_is_none() -> None:
    old = blocks(2)
    assert not is_better(0.99 * old, old, 3.0)
    assert not is_better(0.2 * old[:7], old[:7], 3.0)
