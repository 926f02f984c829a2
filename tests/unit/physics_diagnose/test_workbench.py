"""What the workbench takes for noise."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmac_comp.base.arrays import BoolArray
from pmac_comp.physics.diagnose.workbench import Noise, Workbench


@pytest.mark.parametrize("zero_m", [0.0, 1e-6, 50e-6])
def test_where_a_scale_has_its_zero_is_no_slow_noise(zero_m):
    # A constant per run that counted as noise would hide whatever grows slowly.
    rng = np.random.default_rng(3)
    runs = [1e-7 * rng.standard_normal((2000, 2)) for _ in range(3)]
    moved = [r + np.array([0.0, zero_m * (i - 1)]) for i, r in enumerate(runs)]
    bench = SimpleNamespace(counted=[np.ones(2000, dtype=np.bool_)] * 3, noise=None)
    noise = Workbench.noise_from(bench, moved, np.full(2, 1e-10))  # type: ignore[arg-type]
    slow = noise.whitener.scale @ (np.eye(2) - noise.whitener.lags.sum(axis=0))
    assert np.diag(slow) == pytest.approx(1e7, rel=0.2)


def test_what_columns_leave_where_they_were_not_fitted_is_no_noise():
    # Held-out parts of a run hold whatever badly determined columns foretell there.
    rng = np.random.default_rng(4)
    runs = [1e-7 * rng.standard_normal((2000, 2)) for _ in range(2)]
    fitted = np.arange(2000) // 200 % 3 < 2
    slow = 1e-4 * np.sin(np.arange(2000) / 60.0)[:, None]
    left = [np.where(fitted[:, None], r, r + slow) for r in runs]
    every = [np.ones(2000, dtype=np.bool_)] * 2
    bench = SimpleNamespace(counted=every, fitting=[fitted] * 2, noise=None)
    floor_m = np.full(2, 1e-10)
    noise = Workbench.noise_from(bench, left, floor_m, foretold=False)  # type: ignore[arg-type]
    gain = noise.whitener.scale @ (np.eye(2) - noise.whitener.lags.sum(axis=0))
    assert np.diag(gain) == pytest.approx(1e7, rel=0.25)
    assert noise.robust is not None
    assert np.all(noise.robust[0][~fitted] == 1.0)


def test_a_run_in_which_rounding_decides_everything_is_no_noise():
    # A short run between rests on a fine encoder may hold no evidence at all.
    rng = np.random.default_rng(5)
    runs = [1e-7 * rng.standard_normal((2000, 2)) for _ in range(2)]
    counted = [np.ones(2000, dtype=np.bool_), np.zeros(2000, dtype=np.bool_)]
    bench = SimpleNamespace(counted=counted, noise=None)
    noise = Workbench.noise_from(bench, runs, np.full(2, 1e-10))  # type: ignore[arg-type]
    assert np.diag(noise.whitener.scale) == pytest.approx(1e7, rel=0.2)
    assert noise.robust is not None
    assert all(np.all(np.isfinite(w)) for w in noise.robust)


def _judged(moved_m: list[float]) -> tuple[Workbench, list[Any]]:
    """A fitted run and those that judge, and by how much rounding moves each of them."""
    every = np.ones(400, dtype=np.bool_)
    none: Any = None
    records: Any = tuple(
        Run(usable=every, valid=np.ones(800, dtype=np.bool_), factor=2) for _ in moved_m
    )
    fitting = tuple(np.full(400, i == 0) for i in range(len(moved_m)))
    wave = np.sign(np.sin(np.arange(400) / 9.0))[:, None]
    return Workbench(records, fitting, none), [size * wave for size in moved_m]


@dataclass(frozen=True)
class Run:
    """What the workbench asks of a record here."""

    usable: BoolArray
    valid: BoolArray
    factor: int
    coarse_period_s: float = 1e-3

    def masked(self, valid: BoolArray) -> "Run":
        return replace(self, valid=valid)


@pytest.mark.parametrize(
    ("moved_m", "left_out", "calm"),
    [
        ([1e-8, 1e-8, 1e-8], [0, 0, 0], 2),
        ([1e-8, 1e-8, 1e-8, 1e-5], [0, 0, 0, 400], 2),  # one of the judges says nothing
        ([1e-8, 1e-8, 1e-5, 1e-5], [0, 0, 0, 0], 3),  # rounding is common
        ([1e-8, 1e-8, 1e-8, 1e-8, 1e-5], [0, 0, 0, 0, 400], 3),
        ([1e-5, 1e-8, 1e-8, 1e-8], [0, 0, 0, 0], 3),  # nothing would be left to fit
    ],
)
def test_where_rounding_decides_is_left_out_as_long_as_evidence_is_left(moved_m, left_out, calm):
    bench, rounded = _judged(moved_m)
    model: Any = SimpleNamespace(bench=SimpleNamespace(motor_resolution_m=1e-7))
    unruly = bench.unruly(model, rounded)
    assert [int(u.sum()) for u in unruly] == left_out
    whitener: Any = None
    calmed = bench.with_noise(Noise(whitener, unruly=unruly))
    assert len(calmed.calm_records) == len(calmed.whole_records(calm=True)) == calm
    assert all(np.any(r.valid) for r in calmed.calm_records)


def test_a_few_calm_samples_are_no_evidence_to_judge_by():
    # Rounding decides the judging run but for its first five samples, which have no past.
    bench, rounded = _judged([1e-8, 1e-8, 1e-5])
    bench = replace(bench, fitting=tuple(np.full(400, i < 2) for i in range(3)))
    rounded[2][:105] = 0.0
    model: Any = SimpleNamespace(bench=SimpleNamespace(motor_resolution_m=1e-7))
    assert not np.any(np.concatenate(bench.unruly(model, rounded)))


def test_samples_tell_only_with_those_that_their_whitening_takes_in():
    bench, _ = _judged([1e-8, 1e-8])
    every = np.ones(400, dtype=np.bool_)
    few = np.zeros(400, dtype=np.bool_)
    few[100:106] = True
    assert bench.telling([every, few]) == (394, 0)
    few[106] = True
    assert bench.telling([every, few]) == (394, 1)
