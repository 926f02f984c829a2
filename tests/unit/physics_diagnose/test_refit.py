"""Refits: when columns may serve again, and what may end the search."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmac_comp.physics.diagnose import refit as module
from pmac_comp.physics.diagnose.refit import Fitted, Frozen, refit


def valley(monkeypatch: pytest.MonkeyPatch, used_gain: float) -> list[str]:
    """A bent valley: fresh columns halve what is left, used ones find ``used_gain`` of it."""
    taken: list[str] = []

    def linearised(bench: Any, point: Fitted, frozen: Frozen | None, **options: Any) -> Any:
        taken.append("fresh" if frozen is None else "used")
        share = 0.5 if frozen is None else used_gain
        solution = SimpleNamespace(chi2=point.chi2 * (1.0 - share), share=share)
        return SimpleNamespace(n_columns=0, solve=lambda columns: solution), [], []

    def line_search(bench: Any, point: Fitted, directions: Any, solution: Any) -> Fitted:
        return replace(point, chi2=solution.chi2)

    monkeypatch.setattr(module, "linearised", linearised)
    monkeypatch.setattr(module, "_line_search", line_search)
    return taken


def start(chi2: float) -> Fitted:
    return Fitted(SimpleNamespace(), [], chi2, np.zeros(1))  # type: ignore[arg-type]


def test_little_left_in_used_columns_does_not_end_the_search(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken = valley(monkeypatch, used_gain=1e-7)
    ended = refit(SimpleNamespace(), start(1000.0), rounds=40)  # type: ignore[arg-type]
    assert taken[:4] == ["fresh", "used", "fresh", "used"]
    assert taken[-1] == "fresh"
    assert ended.chi2 < 1.0


def test_columns_that_find_far_more_than_they_foretold_are_taken_afresh(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken = valley(monkeypatch, used_gain=0.3)

    def generous(bench: Any, point: Fitted, directions: Any, solution: Any) -> Fitted:
        return replace(point, chi2=point.chi2 * (1.0 - 1.6 * solution.share))

    monkeypatch.setattr(module, "_line_search", generous)
    refit(SimpleNamespace(), start(1000.0), rounds=4)  # type: ignore[arg-type]
    assert taken == ["fresh"] * 4


def test_weights_taken_from_more_than_is_left_are_taken_again_until_they_fit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    weighed: list[float] = []
    rows = SimpleNamespace(fitting=np.ones(1, dtype=np.bool_), rows=np.array([100.0]))

    def bench(left: float) -> SimpleNamespace:
        def with_noise(noise: float) -> SimpleNamespace:
            weighed.append(noise)
            return bench(noise)

        return SimpleNamespace(
            left=left,
            residuals=lambda simulated: simulated[0],
            noise_from=lambda left, floor: left,
            floor_m=lambda description: 0.0,
            with_noise=with_noise,
        )

    def model(left: float, under: Any) -> Fitted:
        # Chi-square counts what a model leaves in units of what its weights were taken from.
        chi2 = 100.0 * left / under.left
        drive = SimpleNamespace(bench=None, left=left)
        return Fitted(drive, [left], chi2, np.array([chi2]))  # type: ignore[arg-type, list-item]

    def refitted(under: Any, start: Fitted, **options: Any) -> Fitted:
        return model(max(1.0, 0.1 * start.model.left), under)  # type: ignore[attr-defined]

    monkeypatch.setattr(module, "empty_gram", lambda bench, simulated: rows)
    monkeypatch.setattr(module, "evaluate", lambda under, drive: model(drive.left, under))
    monkeypatch.setattr(module, "refit", refitted)
    loose = bench(1000.0)
    ended = module.under_own_weights(loose, model(40.0, loose), rounds=2)  # type: ignore[arg-type]
    assert weighed == [40.0, 4.0, 1.0]
    assert ended.chi2 == pytest.approx(100.0)
