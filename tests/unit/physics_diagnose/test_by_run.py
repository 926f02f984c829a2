"""Runs that show what has no name, and the torque that parts them from the others."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmac_comp.physics.diagnose.by_run import RunLeft, sentences, told_by_run

GENTLE = [RunLeft("slow", 0.3, 2.0), RunLeft("move", 0.5, 6.5)]
HARD = [RunLeft("chirp", 204.0, 45.0), RunLeft("sine", 60.0, 9.1)]


def test_a_torque_that_the_drive_does_not_deliver_is_told_by_its_level():
    runs, level = sentences([HARD[0], GENTLE[0], HARD[1], GENTLE[1]])
    assert "most: chirp (204 um); least: slow (0.3 um)" in runs
    assert "within 6.5 N m leave at most 0.5 um" in level
    assert "pass 9.1 N m at least 60 um" in level


@pytest.mark.parametrize(
    "runs",
    [
        [RunLeft("hard", 0.3, 40.0), RunLeft("slow", 1.0, 1.0), RunLeft("move", 0.4, 5.0)],
        [RunLeft("a", 0.3, 0.0), RunLeft("b", 0.3, 0.0), RunLeft("c", 3.0, 0.0)],  # no torque
    ],
)
def test_runs_that_differ_otherwise_are_told_without_a_level(runs):
    assert len(sentences(runs)) == 1


def test_what_came_with_the_runs_that_judge_is_told():
    fitted = [RunLeft("a", 0.2, 1.0), RunLeft("b", 0.3, 5.0), RunLeft("rests", 1.0, 1.0)]
    judging = [RunLeft("c", 2.2, 3.0, judges=True), RunLeft("d", 8.3, 5.0, judges=True)]
    _, new = sentences([*fitted, *judging])
    assert "fitted leave 0.61 um rms, at most 1 um; all that judge leave at least 2.2 um" in new
    assert "without --validate" in new
    as_before = RunLeft("e", 0.2, 5.0, judges=True)
    assert len(sentences([*fitted, *judging, as_before])) == 1


def test_nothing_is_told_where_all_runs_show_it_alike():
    assert sentences([RunLeft("a", 1.0, 1.0), RunLeft("b", 1.5, 9.0)]) == ()
    assert sentences([RunLeft("a", 1.0, 1.0)]) == ()


@pytest.mark.parametrize("unexplained", [True, False])
def test_only_what_has_no_name_is_told_by_run(unexplained):
    missed = [1e-6 * size * np.array([[1.0], [-1.0], [7.0]]) for size in (0.1, 2.0)]
    records = [SimpleNamespace(name=n, torque_Nm=None) for n in ("slow", "fast")]
    counted = [np.array([True, True, False])] * 2
    bench = SimpleNamespace(
        records=records, fitting=counted, counted=counted, residuals=lambda simulated: missed
    )
    grown: Any = SimpleNamespace(workbench=bench, final=SimpleNamespace(simulated=None))
    left: Any = SimpleNamespace(unexplained=unexplained)
    told = told_by_run(grown, left)
    assert told == (
        ("Runs that show it most: fast (2 um); least: slow (0.1 um).",) if unexplained else ()
    )
