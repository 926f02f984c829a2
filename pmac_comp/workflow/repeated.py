"""One known motion, repeated: its pre-compensated program, and learning from the scale.

What lives here: how an offset reaches the motion program, how such a run becomes a capture in the
terms of the contract, and ``--refine``. What may not: the learning rule (``physics.compensate``).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ConfigError
from pmac_comp.files.capture import Capture
from pmac_comp.machine.controller.context import Context
from pmac_comp.physics.compensate.exact import Learning, learn
from pmac_comp.physics.signals.trajectory import Trajectory
from pmac_comp.workflow.axis import Axis
from pmac_comp.workflow.compensation_file import Compensation
from pmac_comp.workflow.motions import Motion

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Refinement:
    """What the model alone gave and what learning added, total error rms in um."""

    motion: str
    without_um: float
    model_um: float
    learning: Learning

    def lines(self) -> tuple[str, ...]:
        """Sentences for people."""
        steps = " -> ".join(f"{value:.2f}" for value in self.learning.history_um)
        end = "by its stop rule" if self.learning.converged else "after the passes allowed"
        return (
            f"learning on '{self.motion}': total error {self.without_um:.2f} um without anything, "
            f"{self.model_um:.2f} um with the model alone, then {steps} um; ended {end}",
        )


def with_offset(motion: Motion, offset_m: FloatArray) -> Motion:
    """The motion whose program carries an offset; at both ends the offset fades to zero."""
    n = motion.position_m.size
    edge = np.clip(np.minimum(np.arange(n), np.arange(n)[::-1]) / max(1.0, 0.02 * n), 0.0, 1.0)
    fade = edge * edge * (3.0 - 2.0 * edge)
    shape = Trajectory(motion.trajectory.time_s, motion.position_m + fade * offset_m)
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
    """Capture of a drawn motion in the terms of the contract: command and desired position."""
    planned = drawn.position_m
    first = int(np.flatnonzero(np.abs(planned - planned[0]) > 1e-9)[0])
    gathered = capture.commanded_position_m
    start = int(np.flatnonzero(np.abs(gathered - gathered[0]) > 1e-9)[0])
    index = np.clip(np.arange(capture.n) - start + first, 0, planned.size - 1)
    correction = (planned - motion.position_m)[index]
    return replace(
        capture, commanded_position_m=gathered - correction, desired_position_m=capture.desired_m
    )


def on_motion_grid(motion: Motion, capture: Capture, values: FloatArray) -> FloatArray:
    """Values of a capture at the samples of the motion, aligned by its first step."""
    drawn = capture.desired_m
    start = int(np.flatnonzero(np.abs(drawn - drawn[0]) > 1e-9)[0])
    first = int(np.flatnonzero(np.abs(motion.position_m - motion.position_m[0]) > 1e-9)[0])
    index = np.clip(np.arange(motion.position_m.size) - first + start, 0, capture.n - 1)
    return np.asarray(values[index])


def refine_motion(
    axis: Axis,
    context: Context,
    compensation: Compensation,
    motion: Motion,
    passes: int,
    progress: Progress | None = None,
) -> Refinement:
    """Learn on top of the compensation: the error that the scale measures is fed back.

    Raises
    ------
    ConfigError
        The bench has no scale.
    """
    from pmac_comp.workflow.deploy import switch

    if axis.bench.scale is None:
        raise ConfigError("Learning needs a scale at the table.", code="PC-REF-001")
    nothing = np.zeros(motion.position_m.size)

    def total(offset: FloatArray) -> FloatArray:
        capture = run_with_offset(axis, motion, offset, progress)
        table = capture.table_position_m
        if table is None:
            raise ConfigError("Learning needs a scale at the table.", code="PC-REF-001")
        return on_motion_grid(motion, capture, table - capture.commanded_position_m)

    switch(axis, context, compensation, on=False)
    without = float(np.std(total(nothing)) * 1e6)
    switch(axis, context, compensation, on=True)
    limit = axis.bench.safety.max_correction_um / 1e6
    learned = learn(total, nothing.size, axis.scales.period_s, passes=passes, limit_m=limit)
    return Refinement(motion.name, without, learned.history_um[0], learned)
