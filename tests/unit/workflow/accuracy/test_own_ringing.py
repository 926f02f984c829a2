"""A loop that rings by itself is told from what a law leaves."""

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.workflow.accuracy.outcome import ErrorSignals, MotionOutcome, Ratio, Spread
from pmac_comp.workflow.accuracy.own_ringing import own_ringing, own_ringing_remarks

PERIOD_s = 442e-6
TIME_s = np.arange(6000) * PERIOD_s
FLOOR_um = 0.29


def signals(mechanical_um: FloatArray) -> ErrorSignals:
    noise = np.random.default_rng(1).uniform(-0.5, 0.5, TIME_s.size)
    e_m = 1e-6 * (mechanical_um + noise)
    return ErrorSignals(TIME_s, e_m, e_m, e_m)


def slow(rms_um: float) -> FloatArray:
    return np.sqrt(2.0) * rms_um * np.sin(2.0 * np.pi * 2.0 * TIME_s)


def rings(rms_um: float, frequency_Hz: float = 153.0) -> FloatArray:
    """Only while it moves, as friction damps it at rest."""
    while_moving = (TIME_s > 0.5) & (TIME_s < 1.8)
    share = float(np.mean(while_moving))
    swing = np.sin(2.0 * np.pi * frequency_Hz * TIME_s) * while_moving
    return np.sqrt(2.0 / share) * rms_um * swing


def told(before: FloatArray, after: FloatArray) -> tuple[str, ...]:
    first, second = [signals(before)], [signals(after)]
    sides = [[s.mechanical_m for s in side] for side in (first, second)]
    e, e_r = (Spread.of(side, PERIOD_s) for side in sides)
    ratio = Ratio.of(sides[0], sides[1], PERIOD_s)
    outcome = MotionOutcome("sine", 1, e, e_r, e, e_r, e, e_r, ratio, ratio)
    return own_ringing_remarks([outcome], [first], [second], FLOOR_um, PERIOD_s)


def test_rms_and_frequency_of_a_ring_that_comes_and_goes() -> None:
    found = own_ringing([signals(slow(5.0) + rings(0.4))], [signals(rings(1.5))], PERIOD_s)
    assert found.frequency_Hz == pytest.approx(153.0, abs=1.5)
    assert found.after_um == pytest.approx(1.5, rel=0.05)
    assert found.before_um == pytest.approx(0.4, rel=0.1)


def test_a_loop_that_rings_is_told_with_both_figures() -> None:
    (said,) = told(slow(5.0) + rings(0.4), slow(0.3) + rings(1.5))
    assert "1.50 um at 152 Hz" in said
    assert "lower the gains" in said
    assert "(0.4" in said or "(0.3" in said


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (slow(5.0), slow(1.0)),  # an error of the law, with the sensors' steps
        (slow(5.0), slow(0.1)),  # nothing but steps
        (slow(5.0), slow(1.2) + rings(0.7)),  # less than half of what is left
        (slow(9.0), rings(0.6)),  # all of it, below a tenth of the error before
        (slow(5.0), rings(1.5, 12.0)),  # as slow as friction and motions
    ],
    ids=["law", "steps", "part", "small", "as slow as friction"],
)
def test_what_does_not_keep_the_error_up_is_not_told(before: FloatArray, after: FloatArray) -> None:
    assert told(before, after) == ()


@pytest.mark.parametrize("longer", ["before", "after"])
def test_sides_of_two_lengths_are_compared(longer: str) -> None:
    """Runs of half a second, of which one side was longer, ended in an IndexError."""
    short, whole = signals(rings(1.5)), signals(rings(1.5))
    part = slice(1500, 2700)
    short = ErrorSignals(
        short.time_s[part],
        short.mechanical_m[part],
        short.control_m[part],
        short.total_m[part],
    )
    before, after = (whole, short) if longer == "before" else (short, whole)
    found = own_ringing([before], [after], PERIOD_s)
    assert found.frequency_Hz == pytest.approx(153.0, abs=3.0)
