"""One known motion, repeated: its pre-compensated program, and learning from the scale.

What lives here: how an offset reaches the motion program, how such a run becomes a capture in the
terms of the contract, and ``--refine``. What may not: the learning rule (``physics.compensate``).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ConfigError
from pmac_comp.files.capture import Capture
from pmac_comp.machine.controller.context import Context
from pmac_comp.physics.compensate.exact import (
    Learning,
    MEASURED_CUTOFF_Hz,
    faded,
    learn,
    moving_of,
    rests_of,
)
from pmac_comp.physics.signals.trajectory import Trajectory
from pmac_comp.workflow.axis import Axis
from pmac_comp.workflow.compensation_file import Compensation
from pmac_comp.workflow.late_scale import read_together, scale_age_s
from pmac_comp.workflow.motions import Motion

Progress = Callable[[str, float], None]
_FRESH_RUNS = 2
# Of its way, after which a command has begun: before a learned offset a card's cubics bow by nm.
_BEGUN_FRAC = 1e-3
_SOFT_START = 150  # samples by which beginnings may lie apart


@dataclass(frozen=True)
class Refinement:
    """What the model alone gave and what learning added, total error rms in um."""

    motion: str
    without_um: float
    model_um: float
    learning: Learning

    @property
    def confirmed_um(self) -> float:
        """Rms of the total error of fresh runs with what was learned."""
        fresh = self.learning.confirmed_um
        return float(np.sqrt(np.mean(np.square(fresh)))) if fresh else min(self.learning.history_um)

    @property
    def model_share(self) -> float:
        """Share of the error without anything that the model alone takes away."""
        return 1.0 - self.model_um / max(self.without_um, 1e-12)

    @property
    def learning_share(self) -> float:
        """Share of it that learning takes away on top of the model."""
        return (self.model_um - self.confirmed_um) / max(self.without_um, 1e-12)

    @property
    def is_gain(self) -> bool:
        """Whether fresh runs are better with what was learned than with the model alone."""
        return self.confirmed_um < self.model_um

    def as_compensation(self, compensation: Compensation) -> Compensation | None:
        """The compensation with what was learned in it; None where its route has no place for it.

        Learning began from the correction of the same motion: what it ends with takes its place.
        """
        if compensation.motion_correction_m is None or not self.is_gain:
            return None
        return replace(compensation, motion_correction_m=self.learning.correction_m)

    def lines(self) -> tuple[str, ...]:
        """Sentences for people."""
        learning = self.learning
        steps = " -> ".join(f"{value:.2f}" for value in learning.history_um)
        part = " -> ".join(f"{value:.2f}" for value in learning.learnable_um)
        if learning.contraction < 1.0:
            proof = f"it converges: by {learning.contraction:.2f} per pass"
        elif learning.converged:
            proof = "nothing was left that learning could take away"
        else:
            proof = "no pass made it smaller: what the model gives stands, with nothing learned"
        return (
            f"'{self.motion}', total error rms in motion: {self.without_um:.2f} um bare, "
            f"{self.model_um:.2f} um with the model alone, {self.confirmed_um:.2f} um with what "
            f"was learned (on {len(learning.confirmed_um)} fresh runs, which differ among "
            f"themselves by {learning.scatter_um:.2f} um)",
            f"the model takes {100 * self.model_share:.0f} % of it away, learning "
            f"{100 * self.learning_share:.0f} % more",
            f"learning: {steps} um, below {learning.cutoff_Hz:.0f} Hz {part} um; {proof}; it "
            f"ended because {learning.ended}",
        )

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        return {
            "motion": self.motion,
            "without_um": self.without_um,
            "model_um": self.model_um,
            "learned_um": self.confirmed_um,
            "model_share": self.model_share,
            "learning_share": self.learning_share,
            "history_um": list(self.learning.history_um),
            "learnable_um": list(self.learning.learnable_um),
            "contraction": self.learning.contraction,
            "converged": self.learning.converged,
            "scatter_um": self.learning.scatter_um,
            "ended": self.learning.ended,
        }


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
    """Capture of a drawn motion in the terms of the contract: command and desired position."""
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


def refine_motion(
    axis: Axis,
    context: Context,
    compensation: Compensation,
    motion: Motion,
    passes: int,
    progress: Progress | None = None,
) -> Refinement:
    """Learn on top of the compensation: the error that the scale measures is fed back.

    The motion runs from a program that carries the learned offset; tables and law act beside it.
    A correction that is for this motion only (``cam``, ``program``) is where learning starts from.

    Raises
    ------
    ConfigError
        The bench has no scale.
    """
    from pmac_comp.workflow.deploy import switch

    if axis.bench.scale is None:
        raise ConfigError(
            "Learning needs a scale at the table.",
            code="PC-REF-001",
            hint="Leave --refine out, or add [scale] to the bench file.",
        )
    nothing = np.zeros(motion.position_m.size)

    def total(offset: FloatArray) -> FloatArray:
        run = run_with_offset(axis, motion, offset, progress)
        capture = read_together(run, scale_age_s(compensation.law.provenance))
        table = capture.table_position_m
        if table is None:
            raise ConfigError(
                "Learning needs a scale at the table.",
                code="PC-REF-001",
                hint="Leave --refine out, or state the scale in [scale] of the bench file.",
            )
        return on_motion_grid(motion, capture, table - capture.commanded_position_m)

    switch(axis, context, compensation, on=False)
    rests = rests_of(motion.position_m, axis.scales.period_s)
    moving = moving_of(nothing.size, rests)
    without = float(np.std(total(nothing)[moving]) * 1e6)
    switch(axis, context, compensation, on=True)
    limit = axis.bench.safety.max_correction_um / 1e6
    learned = learn(
        total,
        nothing.size,
        axis.scales.period_s,
        start_m=_start_offset(compensation, motion),
        passes=passes,
        cutoff_Hz=MEASURED_CUTOFF_Hz,
        limit_m=limit,
        confirm=_FRESH_RUNS,
        rests=rests,
    )
    return Refinement(motion.name, without, learned.history_um[0], learned)


def _start_offset(compensation: Compensation, motion: Motion) -> FloatArray | None:
    """The model's own correction of this very motion, None where the law or tables carry it."""
    known, correction = compensation.motion_position_m, compensation.motion_correction_m
    if known is None or correction is None or known.shape != motion.position_m.shape:
        return None
    return correction if np.allclose(known, motion.position_m, atol=1e-9) else None
