"""Learning says why it ended: little was gained, the error grew, or the passes were used up."""

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.compensate.exact import Learning, learn
from pmac_comp.physics.signals.rests import moving_of, rests_of
from pmac_comp.physics.signals.trajectory import dwell, sinusoid

N, PERIOD_s = 4000, 442e-6
DISTURBANCE_m = 3e-6 * np.sin(2.0 * np.pi * 2.0 * PERIOD_s * np.arange(N))


def answering(gain: float) -> "list[str | bool]":
    """How learning ends on an axis that answers an offset with a gain."""

    def total(offset: FloatArray) -> FloatArray:
        return np.asarray(DISTURBANCE_m + gain * offset)

    found = learn(total, N, PERIOD_s, passes=6, cutoff_Hz=40.0, limit_m=60e-6)
    return [found.converged, found.ended]


def test_little_gained_ends_it() -> None:
    converged, reason = answering(1.0)
    assert converged
    assert "changed the error by less than" in str(reason)


def test_growth_ends_it() -> None:
    converged, reason = answering(-1.0)
    assert not converged
    assert "grew 3 times" in str(reason)


def test_retreats_to_slower_bands_are_no_convergence() -> None:
    """Less of one error lies below a lower cutoff: that was told as 'it converges'."""
    swings_m = 3e-6 * np.sin(2.0 * np.pi * 18.0 * PERIOD_s * np.arange(N))
    found = learn(lambda offset: swings_m - offset, N, PERIOD_s, passes=6, cutoff_Hz=40.0)
    assert "grew 3 times" in found.ended
    assert min(found.history_um) == found.history_um[0]
    assert found.contraction == 1.0
    assert found.cutoff_Hz == pytest.approx(40.0 * 0.6**2)  # the last that was tried
    assert len(found.learnable_um) == len(found.history_um)
    assert min(found.learnable_um) == found.learnable_um[0]  # all in one band


def test_passes_end_it() -> None:
    converged, reason = answering(0.2)
    assert not converged
    assert "the 6 passes allowed" in str(reason)


def cut_in_run(number: int, *, confirm: int = 0, keeps: bool = True) -> Learning:
    """Learning of three passes, where somebody presses Ctrl-C in a run (0: before any)."""
    runs = 0

    def total(offset: FloatArray) -> FloatArray:
        nonlocal runs
        runs += 1
        if runs > number:
            raise KeyboardInterrupt
        return np.asarray(DISTURBANCE_m + 0.4 * offset)

    return learn(
        total, N, PERIOD_s, passes=3, cutoff_Hz=40.0, confirm=confirm, keeps_interrupted=keeps
    )


def test_an_interruption_ends_it_with_the_passes_that_were_complete() -> None:
    """All that was learned was lost, also in the last of many passes."""
    found = cut_in_run(3, confirm=2)
    assert found.interrupted
    assert found.ended == "it was interrupted after 2 passes"
    assert len(found.history_um) == len(found.learnable_um) == 3
    assert found.history_um[2] < 0.6 * found.history_um[0]
    assert np.ptp(found.correction_m) > 0.0
    assert (found.confirmed_um, found.converged) == ((), False)
    assert cut_in_run(2).ended == "it was interrupted after 1 pass"


@pytest.mark.parametrize("number", [0, 1])
def test_an_interruption_before_a_pass_is_complete_leaves_nothing_to_keep(number: int) -> None:
    with pytest.raises(KeyboardInterrupt):
        cut_in_run(number)


@pytest.mark.parametrize("number", [2, 5])
def test_learning_on_a_model_is_simply_interrupted(number: int) -> None:
    with pytest.raises(KeyboardInterrupt):
        cut_in_run(number, confirm=2, keeps=False)


def test_an_interrupted_fresh_run_leaves_those_before_it() -> None:
    found = cut_in_run(5, confirm=2)
    assert found.interrupted
    assert "the 3 passes allowed were made; the fresh runs after it were" in found.ended
    assert (len(found.history_um), len(found.confirmed_um)) == (4, 1)
    assert found.scatter_um == 0.0


def there_and_back_m() -> FloatArray:
    """A command that rests before, between and after its two moves, m."""
    time = np.arange(N) * PERIOD_s
    there = np.clip((time - 0.3) / 0.4, 0.0, 1.0) - np.clip((time - 1.1) / 0.4, 0.0, 1.0)
    return np.asarray(0.05 * there * there * (3.0 - 2.0 * there))


RESTS = rests_of(there_and_back_m(), PERIOD_s)


def test_a_lag_that_goes_at_rest_takes_its_correction_along() -> None:
    """The offset stayed as the motion left it: the table was held off for the whole rest."""
    assert [round(r.start * PERIOD_s, 1) for r in RESTS] == [0.0, 0.7, 1.5]
    lag_m = np.where(np.gradient(there_and_back_m()) > 0.0, -20e-6, 20e-6)
    lag_m[RESTS[0]] = 0.0
    for rest in RESTS[1:]:
        gone = np.exp(-np.arange(rest.stop - rest.start) * PERIOD_s / 0.03)
        lag_m[rest] = lag_m[rest.start - 1] * gone

    found = learn(
        lambda offset: lag_m + offset, N, PERIOD_s, passes=12, cutoff_Hz=20.0, rests=RESTS
    )
    for rest in RESTS[1:]:
        assert abs(found.correction_m[rest.stop - 50]) < 2e-6
    assert min(found.history_um) < 0.25 * found.history_um[0]


def creeping(creep_um: float) -> tuple[Learning, list[float]]:
    """Learning where the axis creeps anew in every rest, and what is left in motion, um rms."""
    rng = np.random.default_rng(1)
    in_motion_um: list[float] = []

    def total(offset: FloatArray) -> FloatArray:
        creep = np.zeros(N)
        for rest in RESTS:
            creep[rest] = rng.normal(0.0, 1e-6 * creep_um)
        error = DISTURBANCE_m + offset
        in_motion_um.append(1e6 * float(np.std(error[moving_of(N, RESTS)])))
        return np.asarray(error + creep)

    found = learn(total, N, PERIOD_s, passes=6, cutoff_Hz=20.0, rests=RESTS, confirm=2)
    return found, in_motion_um


@pytest.mark.parametrize("creep_um", [0.5, 5.0])
def test_creep_that_is_new_at_every_rest_spoils_no_motion(creep_um: float) -> None:
    found, in_motion_um = creeping(creep_um)
    assert min(found.history_um) <= found.history_um[0]
    assert in_motion_um[-1] < 0.5 * in_motion_um[0]  # the last runs are those of the best
    assert found.scatter_um > 0.1 * creep_um


def test_creep_below_the_error_of_the_motion_lets_that_be_learned() -> None:
    found, in_motion_um = creeping(0.5)
    assert in_motion_um[-1] < 0.5 * in_motion_um[0]
    assert found.confirmed_um[0] < 0.7 * found.history_um[0]


def test_a_sinusoid_has_no_rests_and_a_dwell_is_one() -> None:
    moving = sinusoid(period_s=PERIOD_s, amplitude_m=0.01, frequency_Hz=1.0, cycles=2.0)
    inner = [r for r in rests_of(moving.position_m, PERIOD_s) if 0 < r.start < moving.n // 2]
    assert inner == []
    assert len(rests_of(dwell(period_s=PERIOD_s, duration_s=0.1).position_m, PERIOD_s)) == 1
