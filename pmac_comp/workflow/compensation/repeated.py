"""One known motion with an offset in its program, and what the card drew of it as a capture."""

from dataclasses import replace

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.progress import Progress
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.exact import faded
from pmac_comp.physics.signals.trajectory import Trajectory
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.motion.motions import Motion

# Of its way, after which a command has begun: before a learned offset a card's cubics bow by nm.
_BEGUN_FRAC = 1e-3
_SOFT_START = 150  # samples by which beginnings may lie apart


def with_offset(motion: Motion, offset_m: FloatArray) -> Motion:
    """The motion whose program carries an offset; at both ends the offset fades to zero."""
    shape = Trajectory(motion.trajectory.time_s, motion.position_m + faded(offset_m))
    return Motion(motion.name, shape)


def run_with_offset(
    axis: Axis, motion: Motion, offset_m: FloatArray, progress: Progress | None = None
) -> Capture:
    """Run a motion with its offset in the program.

    The capture has the motion itself as command and what the card drew as desired position.
    """
    drawn = with_offset(motion, offset_m)
    return as_compensated(axis.run(drawn, progress=progress), motion, drawn)


def as_compensated(capture: Capture, motion: Motion, drawn: Motion) -> Capture:
    """Capture of a drawn motion, commanded and desired position as README, Words, has them."""
    planned, gathered = drawn.position_m, capture.commanded_position_m
    index = np.clip(np.arange(capture.n) - delay_samples(planned, gathered), 0, planned.size - 1)
    correction = (planned - motion.position_m)[index]
    return replace(
        capture, commanded_position_m=gathered - correction, desired_position_m=capture.desired_m
    )


def on_motion_grid(motion: Motion, capture: Capture, values: FloatArray) -> FloatArray:
    """Values of a capture at the samples of the motion that is its command."""
    planned = motion.position_m
    late = delay_samples(planned, capture.commanded_position_m)
    return np.asarray(values[np.clip(np.arange(planned.size) + late, 0, capture.n - 1)])


def delay_samples(planned: FloatArray, gathered: FloatArray) -> int:
    """Samples by which a gathered command comes after the one that was planned.

    Both are laid over each other as a whole: the first step of a soft start lies some
    milliseconds off, as the card draws parabolas between points.
    """
    begun_m = _BEGUN_FRAC * float(np.ptp(planned))
    first = int(np.argmax(np.abs(planned - planned[0]) > begun_m))
    start = int(np.argmax(np.abs(gathered - gathered[0]) > begun_m))
    at = np.arange(planned.size)

    def distance(late: int) -> float:
        laid = gathered[np.clip(at + late, 0, gathered.size - 1)]
        return float(np.sum((laid - planned) ** 2))

    near = start - first
    return min(range(near - _SOFT_START, near + _SOFT_START + 1), key=distance)
