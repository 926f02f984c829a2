"""Intervals of parameters: of fractions of something else, and under other weights."""

from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import load_bench
from pmac_comp.physics.diagnose.estimates import (
    _estimate,
    _finding,
    _weighting_spread,
    possible,
)
from pmac_comp.physics.diagnose.gram import Prior
from pmac_comp.physics.diagnose.statistics import Whitener
from pmac_comp.physics.diagnose.workbench import Noise, Workbench
from pmac_comp.physics.model.drive import DriveModel

BENCH = load_bench("paper_x4")
NAME = "friction_asymmetry.fraction"
POLE = 0.98


def _std(place: str, guide_share: float) -> float:
    model = DriveModel.base(BENCH).with_effect(f"friction_asymmetry@{place}", {"fraction": -0.5})
    guide = model.parameters["viscous.guide_Ns_per_m"]
    column: Any = SimpleNamespace(label=NAME, unit=0.01)
    known = {"viscous.guide_Ns_per_m": guide_share * guide}
    return _estimate(model, column, 1.5, 0.0, known).std


@pytest.mark.parametrize("place", ["viscous", "sliding"])
def test_a_fraction_of_the_guides_friction_is_no_surer_than_that_friction(place):
    assert _std(place, 0.0) == pytest.approx((0.015**2 + 0.01**2) ** 0.5)
    assert _std(place, 0.06) == pytest.approx((0.015**2 + 0.01**2 + 0.03**2) ** 0.5)


def test_a_fraction_of_what_the_torque_shows_alone_is_not_widened():
    assert _std("rotary", 0.06) == pytest.approx(0.015)


def _slow(seed: int) -> FloatArray:
    """Noise with a memory of a tenth of a second at 500 Hz: a servo's integrator that unwinds."""
    rng = np.random.default_rng(seed)
    return np.asarray(lfilter([1.0], [1.0, -POLE], rng.normal(0.0, 1.0, 2000)))[:, None]


def _moved(left: list[FloatArray], lags: float) -> tuple[float, float]:
    """Step along one column of two runs and how far other weights would move it."""
    runs: list[Any] = [
        SimpleNamespace(
            usable=np.ones(2000, dtype=bool), coarse_measured_m=x, coarse_period_s=2e-3,
            channels=1, number=i,
        )
        for i, x in enumerate(left)
    ]  # fmt: skip
    time = np.linspace(0.0, 1.0, 2000)
    # Where noise is slow the fast wave tells the size; weights that leave noise in ask the other.
    shape = np.cos(8.0 * time) + 0.3 * np.cos(2000.0 * time)
    columns = [shape[:, None, None].astype(np.float32) for _ in runs]
    whitener = Whitener(np.full((1, 1, 1), lags), np.eye(1))
    with ThreadPoolExecutor(1) as executor:
        every = tuple(np.ones(2000, dtype=bool) for _ in runs)
        part = Workbench(tuple(runs), every, executor, Noise(whitener))
        point: Any = SimpleNamespace(simulated=[np.zeros_like(x) for x in left])
        prior = Prior(*(np.full(1, v) for v in (-np.inf, np.inf, 0.0, np.inf)))
        step = part.gram(left, columns, prior).solve([0]).step[0]
        return float(step), float(_weighting_spread(part, point, columns, prior)[0])


def test_weights_that_leave_slow_noise_in_do_not_widen_an_interval_by_their_own_noise():
    found = [_moved([_slow(2 * seed), _slow(2 * seed + 1)], POLE) for seed in range(30)]
    true_std = float(np.std([step for step, _ in found]))
    assert np.median([spread for _, spread in found]) < 0.5 * true_std


def test_weights_show_what_a_model_lacks():
    # The slow wave without the fast one: whatever makes it, it is not this column.
    slow = np.cos(8.0 * np.linspace(0.0, 1.0, 2000))[:, None]
    rng = np.random.default_rng(3)
    left = [slow + 0.1 * rng.normal(0.0, 1.0, slow.shape) for _ in range(2)]
    step, spread = _moved(left, POLE)
    assert abs(step) < 0.05
    assert spread > 0.5


def test_what_cannot_be_is_no_finding():
    model = DriveModel.base(BENCH)
    stiffness = model.spec("chain.torsional_stiffness_Nm_per_rad")
    softer, below_zero = (
        _finding(stiffness, value, 0.1 * stiffness.nominal)
        for value in (0.5 * stiffness.nominal, -2.2 * stiffness.nominal)
    )
    efficiency = model.spec("chain.efficiency")
    above_one = _finding(efficiency, 1.3, 0.05)
    kept, told = possible(model, (softer, below_zero, above_one))
    assert kept == (softer,)
    assert [line.split()[6] for line in told] == [
        "torsional_stiffness_Nm_per_rad,",
        "efficiency,",
    ]
    assert not any("-" in line for line in told)
