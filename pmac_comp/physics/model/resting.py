"""How a run begins: what its axis holds at rest, and from when on that no longer matters.

What lives here: the state of controller and friction at the first sample, as captures tell it. What
may not: captures themselves.

Real runs begin where an earlier move ended: friction strained by it, the integrator holding
against that. Both show in the torque at rest; how the strain is shared shows nowhere.
"""

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots
from pmac_comp.physics.model.drive import DriveModel

# A command rests within this (its sum of fractions of a count is not exact); so long, and at
# least so many samples, tell what an integrator holds.
_REST_m = 1e-12
_REST_s = 0.02
_LEAST_REST = 5
# Four lengths of usual presliding, but no more than a part of a small motion.
_TAKE_UP_m = 200e-6
_LARGEST_SHARE = 0.25


def resting_torque_Nm(
    bench: Bench,
    desired_m: FloatArray,
    motor_m: FloatArray,
    torque_Nm: FloatArray | None,
    period_s: float,
) -> float:
    """Torque that the integrator holds when the run begins; 0 where it cannot be known.

    The median while the command rests: an encoder that flickers by one count at rest makes the
    derivative term jump by far more than the integrator moves meanwhile.

    Parameters
    ----------
    bench : Bench
        Gives the control law.
    desired_m, motor_m : ndarray, shape (n,)
        Command and reading.
    torque_Nm : ndarray, shape (n,), or None
        Measured torque command.
    period_s : float
        Sample period.
    """
    vector = DriveModel.base(bench).kernel_vector()
    left = np.flatnonzero(np.abs(desired_m - desired_m[0]) > _REST_m)
    resting = min(int(left[0]) if left.size else desired_m.size, round(_REST_s / period_s))
    if torque_Nm is None or vector[slots.KI] <= 0.0 or resting < _LEAST_REST:
        return 0.0
    error_m = desired_m[:resting] - motor_m[:resting]
    held = np.median(torque_Nm[:resting] - vector[slots.KP] * error_m) - vector[slots.OFFSET]
    return float(np.clip(held, -vector[slots.LIMIT], vector[slots.LIMIT]))


def first_under_way(desired_m: FloatArray) -> int:
    """The sample from which on a run has left behind where in a gap or a stick it began."""
    away = np.abs(desired_m - desired_m[0])
    taken_up = min(_TAKE_UP_m, _LARGEST_SHARE * float(away.max()))
    moved = np.flatnonzero(away > taken_up)
    return int(moved[0]) if moved.size else 0
