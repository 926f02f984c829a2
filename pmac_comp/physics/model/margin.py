"""How near a loop is to ringing: the peak of its sensitivity, from the answer to a blow of torque.

What lives here: the linear loop without friction, at one place of the travel. What may not: what
counts as too much, words. Imports this package.
"""

import math
from dataclasses import dataclass

import numpy as np

from pmac_comp.physics.model.drive import DriveModel, simulate

_LENGTH_s = 2.0  # of the answer: its spectrum resolves half a hertz
_BLOW_FRAC = 1e-3  # of the torque limit: far from what would clip
_FIRST_CYCLE = 4
_LEAST_Hz = 2.0  # below, the blow itself is cut off at the end of the run


@dataclass(frozen=True)
class SensitivityPeak:
    """Largest |S| = |1/(1 + L)| of a loop L, and where; its inverse is the modulus margin.

    Infinite where the loop is unstable, at the frequency with which it swings up.
    """

    value: float
    frequency_Hz: float


def sensitivity_peak(model: DriveModel, position_m: float) -> SensitivityPeak:
    """Peak of the sensitivity of a drive's loop at a place of its travel.

    Parameters
    ----------
    model : DriveModel
        The drive; only its chain counts: friction damps at some places and speeds only.
    position_m : float
        Where the table stands, in m.

    Source
    ------
    A torque d added to the controller's output gives u = d/(1 + L): the spectrum of u over that of
    d is S, whatever the feed-forward. Aastroem and Murray, Feedback Systems, 2nd ed., section 10.3.
    """
    bench = model.bench
    linear = DriveModel(bench, (), {f"chain.{k}": v for k, v in model.values_of("chain").items()})
    n = round(_LENGTH_s / bench.servo_period_s)
    blow = np.zeros(n)
    blow[_FIRST_CYCLE] = _BLOW_FRAC * bench.drive.torque_limit_Nm
    # Clipped torque keeps an unstable loop finite.
    answer = simulate(linear, np.full(n, position_m), torque_feedforward_Nm=blow).torque_command_Nm
    sensitivity = np.abs(np.fft.rfft(answer)) / blow[_FIRST_CYCLE]
    frequency_Hz = np.fft.rfftfreq(n, bench.servo_period_s)
    sensitivity[frequency_Hz < _LEAST_Hz] = 0.0
    at = int(np.argmax(sensitivity))
    swings_up = np.max(np.abs(answer[-n // 10 :])) > blow[_FIRST_CYCLE]
    return SensitivityPeak(
        math.inf if swings_up else float(sensitivity[at]), float(frequency_Hz[at])
    )
