"""Samples of a run that hold another motion beside their own, or not all of it, are not kept."""

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import CaptureError
from pmac_comp.workflow.capture.run_cut import moving_range

PERIOD_s = 442e-6
REST = np.zeros(1000)
MOVE = 0.01 * (1.0 - np.cos(2.0 * np.pi * np.linspace(0.0, 1.0, 4000)))


def range_of(*parts: FloatArray) -> tuple[int, int]:
    return moving_range(np.concatenate(parts), PERIOD_s, MOVE, 0)


def test_the_motion_alone_is_cut_out_with_some_rest() -> None:
    first, last = range_of(REST, MOVE, REST)
    assert (first, last) == pytest.approx((1000 - 113, 5000 + 339), abs=5)


def test_rests_of_a_known_motion_are_kept_whole() -> None:
    """Before and after were judged over rests of different lengths."""
    own = np.zeros(600)
    planned = np.concatenate([own, MOVE, own])
    gathered = np.concatenate([REST, planned, REST])
    cut = moving_range(gathered, PERIOD_s, planned, 0)
    whole = moving_range(gathered, PERIOD_s, planned, 0, with_rests=True)
    assert cut == pytest.approx((1600 - 113, 5600 + 339), abs=5)
    assert whole == pytest.approx((1000 - 113, 6200 + 339), abs=5)


def test_a_soft_start_that_the_card_draws_otherwise_is_the_same_motion() -> None:
    begun_m = 2e-6 * np.linspace(0.0, 1.0, 500) ** 3
    drawn = np.concatenate([REST, begun_m, np.maximum(MOVE, begun_m[-1]), REST])
    moving_range(drawn, PERIOD_s, MOVE, 0)


@pytest.mark.parametrize("before", [True, False])
def test_a_jog_of_somebody_else_beside_the_motion_is_found(before: bool) -> None:  # noqa: FBT001
    jog = np.linspace(0.02, 0.0, 2000) if before else np.linspace(0.0, 0.02, 2000)
    held = np.full(1000, 0.02)
    parts = (held, jog, REST, MOVE, REST) if before else (REST, MOVE, REST, jog, held)
    with pytest.raises(CaptureError, match="Another program or terminal") as refused:
        range_of(*parts)
    assert refused.value.code == "PC-WRK-004"


def test_a_motion_that_somebody_ended_is_found() -> None:
    with pytest.raises(CaptureError, match="the motion takes"):
        range_of(REST, MOVE[:2000], np.full(3000, MOVE[2000]))
