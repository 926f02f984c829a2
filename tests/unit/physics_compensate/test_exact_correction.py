"""The correction of one known motion: learned in the slow band, then in a wider one."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal.windows import hann

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.compensate.exact import (
    Aim,
    Learning,
    LEARNING_CUTOFF_Hz,
    MEASURED_CUTOFF_Hz,
    exact_correction,
    faded,
)
from pmac_comp.physics.compensate.loop import LoopSignals
from pmac_comp.physics.signals.trajectory import sinusoid

PERIOD_s = 442e-6
MOTION_m = sinusoid(period_s=PERIOD_s, amplitude_m=0.01, frequency_Hz=2.0, cycles=4.0).position_m


def sine_m(amplitude_um: float, frequency_Hz: float) -> FloatArray:
    """A disturbance that comes and goes along the motion."""
    phase = 2.0 * np.pi * frequency_Hz * PERIOD_s * np.arange(MOTION_m.size)
    return np.asarray(1e-6 * amplitude_um * np.sin(phase) * hann(MOTION_m.size))


def test_the_model_runs_the_offset_as_the_routes_send_it() -> None:
    """Learned without the fade, an offset met its ends as no run does."""
    sent: list[FloatArray] = []

    def loop(
        commanded: FloatArray,
        desired: FloatArray | None,
        torque: FloatArray | None,
        resting_Nm: float = 0.0,
        /,
    ) -> LoopSignals:
        assert desired is not None
        sent.append(desired - commanded)
        table = desired + 5e-6 * np.cos(400.0 * commanded)
        return LoopSignals(desired, table, np.zeros_like(table))

    found = exact_correction(loop, MOTION_m, PERIOD_s)
    assert abs(found.correction_m[0]) > 1e-6
    assert all(offset[0] == offset[-1] == 0.0 for offset in sent)
    assert any(np.allclose(offset, faded(found.correction_m), atol=1e-12) for offset in sent)


def corrected(*disturbances: FloatArray, share: float = 1.0, **options: object) -> Learning:
    """Correction of a loop that answers an offset with a share of it; disturbances add."""

    def loop(
        commanded: FloatArray,
        desired: FloatArray | None,
        torque: FloatArray | None,
        resting_Nm: float = 0.0,
        /,
    ) -> LoopSignals:
        assert desired is not None
        motor = commanded + share * (desired - commanded)
        return LoopSignals(motor, motor + sum(disturbances), np.zeros_like(motor))

    return exact_correction(loop, MOTION_m, PERIOD_s, **options)  # type: ignore[arg-type]


def slow_only() -> Callable[[FloatArray], bool]:
    """A machine that runs the first offset that it is asked for, and no other."""
    answers = iter((True, False))
    return lambda _offset_m: next(answers)


@pytest.mark.parametrize("aim", list(Aim))
def test_what_the_slow_band_leaves_is_learned_in_the_wider_one(aim: Aim) -> None:
    disturbances = sine_m(20.0, 3.0), sine_m(3.0, 35.0)
    slow = corrected(*disturbances, aim=aim, may_run=slow_only())
    found = corrected(*disturbances, aim=aim)
    assert (slow.cutoff_Hz, found.cutoff_Hz) == (LEARNING_CUTOFF_Hz, MEASURED_CUTOFF_Hz)
    assert min(found.history_um) < 0.3 * min(slow.history_um)
    assert found.history_um[: len(slow.history_um)] == slow.history_um


def test_the_wider_band_is_left_where_it_gains_nothing() -> None:
    found = corrected(sine_m(20.0, 3.0), sine_m(3.0, 150.0))
    assert found.cutoff_Hz == LEARNING_CUTOFF_Hz


def test_the_wider_band_is_left_where_the_slow_one_was_too_wide() -> None:
    found = corrected(sine_m(20.0, 3.0), share=-1.0)
    assert found.cutoff_Hz < LEARNING_CUTOFF_Hz


def test_the_wider_band_is_left_where_the_machine_may_run_the_slow_one_only() -> None:
    disturbances = sine_m(20.0, 3.0), sine_m(3.0, 28.0)
    found = corrected(*disturbances, may_run=slow_only())
    assert found.cutoff_Hz == LEARNING_CUTOFF_Hz
    # What the machine runs neither way is no reason: somebody else has to refuse it.
    assert corrected(*disturbances, may_run=lambda _: False).cutoff_Hz == MEASURED_CUTOFF_Hz
