"""How a run begins: what its axis holds at rest, and from when on that no longer matters.

What lives here: the state of controller and friction at the first sample, as captures tell it. What
may not: captures themselves.

Real runs begin where an earlier move ended: friction strained by it, the integrator holding
against that. Both show in the torque at rest; how the strain is shared shows nowhere. Others are
cut out of a motion: there the axis has its speed, and the law what the torque leaves.
"""

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.start import RELAXED, Start
from pmac_comp.physics.signals.grid import onto_servo_grid

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
# An axis moves with its command if it covers half of the way in which four counts show.
_SHARED = 0.5
_COUNTS = 4.0
# Windings of a chain that is met in motion are not known; its modes have rung out by then. So many
# times its own time, and an integrator has forgotten where it began.
_RINGING_s = 0.3
_FORGETTING = 6.0


def start_of(
    bench: Bench,
    desired_m: FloatArray,
    motor_m: FloatArray,
    torque_Nm: FloatArray | None,
    period_s: float,
    *,
    added_Nm: FloatArray | None = None,
) -> Start:
    """State of controller and axis when a run begins.

    Where the command rests at first, a median: an encoder that flickers by one count at rest makes
    the derivative term jump by far more than the integrator moves meanwhile. Where it sets out at
    once or is under way, what the law of the bench file leaves of the torque: the integrator began
    with that.

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
    added_Nm : ndarray, shape (n,), or None
        Captured part of that torque which was added to what the control law gave.

    Returns
    -------
    Start
    """
    if not np.ptp(motor_m) and np.ptp(desired_m):
        return RELAXED  # a column left empty, as of a run that is to be foretold
    if torque_Nm is not None and added_Nm is not None:
        torque_Nm = torque_Nm - added_Nm
    vector = DriveModel.base(bench).kernel_vector()
    left = np.flatnonzero(np.abs(desired_m - desired_m[0]) > _REST_m)
    first = slice(0, max(round(_REST_s / period_s), _LEAST_REST))
    resting = min(int(left[0]) if left.size else desired_m.size, first.stop)
    rests = resting >= _LEAST_REST
    speed_m_per_s = 0.0 if rests else _shared_speed(bench, desired_m, motor_m, period_s)
    if torque_Nm is None or not torque_Nm.any() or vector[slots.KI] <= 0.0:
        left_m = float(desired_m[0] - motor_m[0]) if speed_m_per_s != 0.0 else 0.0
        return Start(0.0, left_m, speed_m_per_s)
    if rests:
        error_m = desired_m[:resting] - motor_m[:resting]
        integrated = vector[slots.KI] * period_s * (np.cumsum(error_m) - error_m)
        held = torque_Nm[:resting] - vector[slots.KP] * error_m - integrated - vector[slots.OFFSET]
        left_m = float(error_m.mean())
    else:
        vector[slots.START_SPEED] = speed_m_per_s
        stretch = max(round(period_s / bench.servo_period_s), 1)
        held = _beside_law_Nm(vector, stretch, desired_m[first], motor_m[first], torque_Nm[first])
        left_m = float(desired_m[0] - motor_m[0])
    largest = vector[slots.LIMIT]
    return Start(float(np.clip(np.median(held), -largest, largest)), left_m, speed_m_per_s)


def _shared_speed(
    bench: Bench, desired_m: FloatArray, motor_m: FloatArray, period_s: float
) -> float:
    """Speed of a command that an axis follows from the first sample on, m/s; 0 where it sets out.

    The first step from rest is none or one of its acceleration. A command may begin with a jump in
    speed too: then the axis lags at first, and covers less of the way than the command.
    """
    steps = np.diff(desired_m[:3])
    if abs(steps[0]) <= max(_FIRST_STEP * abs(steps[-1] - steps[0]), _REST_m):
        return 0.0
    way = desired_m - desired_m[0]
    shows = np.flatnonzero(np.abs(way) >= _COUNTS * bench.motor_resolution_m)
    last = min(max(int(shows[0]), _LEAST_REST) if shows.size else way.size, way.size - 1)
    # Times the command's way, which may be none by then: so either sign compares alike.
    follows = (motor_m[last] - motor_m[0]) * way[last] > _SHARED * way[last] ** 2
    return float(steps[0] / period_s) if follows else 0.0


def _beside_law_Nm(
    vector: FloatArray,
    stretch: int,
    desired_m: FloatArray,
    motor_m: FloatArray,
    torque_Nm: FloatArray,
) -> FloatArray:
    """Torque that the law, its integrator empty at first, does not give on a reading, N m.

    ``stretch`` is the number of servo cycles per sample.
    """
    from pmac_comp.physics.model.kernel import law_Nm

    desired_m, motor_m = (onto_servo_grid(c, stretch) for c in (desired_m, motor_m))
    return np.asarray(torque_Nm - law_Nm(vector, desired_m, motor_m)[::stretch])


def first_under_way(bench: Bench, desired_m: FloatArray, start: Start, period_s: float) -> int:
    """The sample from which on a run has left behind where in a gap or a stick it began.

    ``desired_m`` has shape (n,).

    One that begins in motion has a chain wound up and a loop under way as well, nobody knows how.
    """
    away = np.abs(desired_m - desired_m[0])
    taken_up = min(_TAKE_UP_m, _LARGEST_SHARE * float(away.max()))
    moved = np.flatnonzero(away > taken_up)
    first = int(moved[0]) if moved.size else 0
    if start.speed_m_per_s == 0.0:
        return first
    settled_s = max(_RINGING_s, forgetting_s(bench))
    return max(first, min(round(settled_s / period_s), desired_m.size // 3))


def forgetting_s(bench: Bench) -> float:
    """Time in which an integrator forgets where it began; 0 without one."""
    vector = DriveModel.base(bench).kernel_vector()
    if vector[slots.KI] <= 0.0:
        return 0.0
    return float(_FORGETTING * vector[slots.KP] / vector[slots.KI])
