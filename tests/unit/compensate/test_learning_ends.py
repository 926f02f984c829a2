"""Learning says why it ended: little was gained, the error grew, or the passes were used up."""

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.compensate.exact import learn

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
    assert converged
    assert "grew 3 times" in str(reason)


def test_passes_end_it() -> None:
    converged, reason = answering(0.2)
    assert not converged
    assert "the 6 passes allowed" in str(reason)
