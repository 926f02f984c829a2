"""How a run begins: what its axis holds at rest, and from when on that no longer matters.

What lives here: the state of controller and friction at the first sample, as captures tell it. What
may not: captures themselves.

Real runs begin where an earlier move ended: friction strained by it, the integrator holding
against that. Both show in the torque at rest; how the strain is shared shows nowhere.
"""

from dataclasses import dataclass

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
# The first step of a constant acceleration from rest is half its growth, or all of it where the
# speed is held over a sample; a command under way has hardly any growth beside its step.
_FIRST_STEP = 1.5
# Four lengths of usual presliding, but no more than a part of a small motion.
_TAKE_UP_m = 200e-6
_LARGEST_SHARE = 0.25


@dataclass(frozen=True)
class Start:
    """How the loop of a run begins.

    Parameters
    ----------
    torque_Nm : float
        What the integrator holds, N m; 0 where it cannot be known.
    error_m : float
        By how much the motor rests behind the command, m; 0 where the torque cannot be known.
    """

    torque_Nm: float = 0.0
    error_m: float = 0.0


RELAXED = Start()


def start_of(
    bench: Bench,
    desired_m: FloatArray,
    motor_m: FloatArray,
    torque_Nm: FloatArray | None,
    period_s: float,
) -> Start:
    """What integrator and friction hold when a run begins.

    Where the command rests at first, a median: an encoder that flickers by one count at rest makes
    the derivative term jump by far more than the integrator moves meanwhile. Where it sets out at
    once, what the law of the bench file leaves of the torque: the integrator began with that.

    Friction that holds an axis holds its error too, and the integrator goes on by it: a micrometre
    that a tenth of a second of rest adds up is a micrometre of the motion that follows.

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

    Returns
    -------
    Start
    """
    vector = DriveModel.base(bench).kernel_vector()
    left = np.flatnonzero(np.abs(desired_m - desired_m[0]) > _REST_m)
    first = slice(0, max(round(_REST_s / period_s), _LEAST_REST))
    resting = min(int(left[0]) if left.size else desired_m.size, first.stop)
    if torque_Nm is None or vector[slots.KI] <= 0.0:
        return RELAXED
    if resting >= _LEAST_REST:
        error_m = desired_m[:resting] - motor_m[:resting]
        integrated = vector[slots.KI] * period_s * (np.cumsum(error_m) - error_m)
        held = torque_Nm[:resting] - vector[slots.KP] * error_m - integrated - vector[slots.OFFSET]
        left_m = float(error_m.mean())
    elif _sets_out(desired_m) and round(period_s / bench.servo_period_s) == 1:
        held = torque_Nm[first] - _law_Nm(vector, desired_m[first], motor_m[first])
        left_m = float(desired_m[0] - motor_m[0])
    else:
        return RELAXED
    largest = vector[slots.LIMIT]
    return Start(float(np.clip(np.median(held), -largest, largest)), left_m)


def _sets_out(desired_m: FloatArray) -> bool:
    """Whether a command begins at rest: its first step is none, or one of its acceleration."""
    steps = np.diff(desired_m[:3])
    return bool(abs(steps[0]) <= max(_FIRST_STEP * abs(steps[-1] - steps[0]), _REST_m))


def _law_Nm(vector: FloatArray, desired_m: FloatArray, motor_m: FloatArray) -> FloatArray:
    """Torque of the control law on a reading, its integrator empty at first."""
    from pmac_comp.physics.model.kernel import law_Nm

    return np.asarray(law_Nm(vector, desired_m, motor_m))


def first_under_way(desired_m: FloatArray) -> int:
    """The sample from which on a run has left behind where in a gap or a stick it began."""
    away = np.abs(desired_m - desired_m[0])
    taken_up = min(_TAKE_UP_m, _LARGEST_SHARE * float(away.max()))
    moved = np.flatnonzero(away > taken_up)
    return int(moved[0]) if moved.size else 0
