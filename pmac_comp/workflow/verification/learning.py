"""Learning on one known motion, on top of the model: ``--refine``, fed by what the scale measured.

What lives here: the passes on a connected axis, and what they gave in figures and words. What may
not: the learning rule (``physics.compensate``), how an offset reaches the motion (``repeated``).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ConfigError
from pmac_comp.base.progress import Progress
from pmac_comp.base.units import UM_PER_M
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.physics.compensate.exact import (
    Aim,
    Learning,
    MEASURED_CUTOFF_Hz,
    learn,
)
from pmac_comp.physics.signals.metrics import centred_rms_um
from pmac_comp.physics.signals.rests import rests_of
from pmac_comp.workflow.accuracy.late_scale import read_together, scale_age_s
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.compensation.file import EXACT, Compensation
from pmac_comp.workflow.compensation.repeated import on_motion_grid, run_with_offset
from pmac_comp.workflow.controller.deploy import switch
from pmac_comp.workflow.motion.motions import Motion

_FRESH_RUNS = 2


@dataclass(frozen=True)
class Refinement:
    """What learning began from and what it added.

    Parameters
    ----------
    motion : str
        The motion that was repeated.
    without_um, start_um : float
        Rms of the total error without compensation and with what learning began from, over the
        whole motion with its rests, um.
    learning : Learning
        What was learned; its errors are of the whole motion too.
    began_learned : bool
        Whether it began from what had been learned before; else from the model alone.
    """

    motion: str
    without_um: float
    start_um: float
    learning: Learning
    began_learned: bool = False

    @property
    def start(self) -> str:
        """What learning began from, for people."""
        return "what was learned before" if self.began_learned else "the model alone"

    @property
    def confirmed_um(self) -> float:
        """Rms of the total error of fresh runs with what was learned."""
        fresh = self.learning.confirmed_um
        return float(np.sqrt(np.mean(np.square(fresh)))) if fresh else min(self.learning.history_um)

    @property
    def basis(self) -> str:
        """On which runs the error with what was learned stands, for people."""
        n = len(self.learning.confirmed_um)
        if n > 1:
            return f"on {n} fresh runs, which differ by {self.learning.scatter_um:.2f} um"
        return "on 1 fresh run" if n else "in its best pass, which no fresh run confirms"

    @property
    def start_share(self) -> float:
        """Share of the error without anything that is away before learning."""
        return 1.0 - self.start_um / max(self.without_um, 1e-12)

    @property
    def learning_share(self) -> float:
        """Share of it that learning takes away on top."""
        return (self.start_um - self.confirmed_um) / max(self.without_um, 1e-12)

    @property
    def is_worth_it(self) -> bool:
        """Whether fresh runs with what was learned are better than without compensation."""
        return self.confirmed_um < self.without_um

    @property
    def is_gain(self) -> bool:
        """Whether they are also better than with what learning began from."""
        return self.is_worth_it and self.confirmed_um < self.start_um

    def as_compensation(self, compensation: Compensation) -> Compensation | None:
        """The compensation with what was learned in it; None where its route has no place for it.

        Learning began from the correction of the same motion: what it ends with takes its place.
        The file tells that it was learned, and from what; it takes the total error away.
        """
        if compensation.motion_correction_m is None or not self.is_gain:
            return None
        learned = [*compensation.learned, self._told()]
        said = {**compensation.exact, "aim": Aim.TOTAL.value, "learned": learned}
        return replace(
            compensation,
            law=compensation.law.noting({EXACT: said}),
            motion_correction_m=self.learning.correction_m,
        )

    def _told(self) -> dict[str, Any]:
        """Where a learned correction comes from, for its file."""
        return {
            "from": self.start,
            "passes": len(self.learning.history_um) - 1,
            "without_um": self.without_um,
            "error_um": list(self.learning.history_um),
            "confirmed_um": list(self.learning.confirmed_um),
        }

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
            proof = "no pass made it smaller: what it began from stands, with nothing learned"
        return (
            f"'{self.motion}', total error rms with its rests: {self.without_um:.2f} um bare, "
            f"{self.start_um:.2f} um with {self.start}, {self.confirmed_um:.2f} um with what "
            f"was learned ({self.basis})",
            _shares_text(self),
            f"learning: {steps} um, below {learning.cutoff_Hz:.0f} Hz {part} um; {proof}; it "
            f"ended because {learning.ended}",
        )

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        return {
            "motion": self.motion,
            "start": self.start,
            "without_um": self.without_um,
            "start_um": self.start_um,
            "learned_um": self.confirmed_um,
            "start_share": self.start_share,
            "learning_share": self.learning_share,
            "history_um": list(self.learning.history_um),
            "learnable_um": list(self.learning.learnable_um),
            "contraction": self.learning.contraction,
            "converged": self.learning.converged,
            "scatter_um": self.learning.scatter_um,
            "ended": self.learning.ended,
        }


def _shares_text(found: Refinement) -> str:
    """What learning began from and learning itself do to the error without compensation."""
    start, learning = (round(100.0 * share) for share in (found.start_share, found.learning_share))
    begun = found.start.removesuffix(" alone")
    if start < 0:
        return f"{begun} makes it {-start} % larger, learning takes {learning} % of it away"
    said = f"{begun} takes {start} % of it away, learning "
    return said + (f"{learning} % more" if learning >= 0 else f"gives {-learning} % back")


def learned_remarks(compensation: Compensation) -> list[str]:
    """That a correction was learned from runs, for people; the model alone knows nothing of it."""
    learned = compensation.learned
    if not learned:
        return []
    last = learned[-1]
    fresh = last["confirmed_um"] or [min(last["error_um"])]
    return [
        f"this correction was learned from runs, {sum(one['passes'] for one in learned)} passes on "
        f"top of the model's: the total error was {last['without_um']:.2f} um without it and "
        f"{fresh[-1]:.2f} um with it then; the model's promise knows nothing of what the runs "
        "showed beyond it"
    ]


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
    Ctrl-C stops the axis and ends learning with its complete passes; before there is one it is
    raised.

    Raises
    ------
    ConfigError
        The bench has no scale.
    """
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
    without = centred_rms_um(total(nothing))
    switch(axis, context, compensation, on=True)
    room_um = compensation.exact.get("room_um")
    limit = (room_um or axis.bench.safety.max_correction_um) / UM_PER_M
    learned = learn(
        total,
        nothing.size,
        axis.scales.period_s,
        start_m=_start_offset(compensation, motion),
        passes=passes,
        cutoff_Hz=MEASURED_CUTOFF_Hz,
        limit_m=limit,
        confirm=_FRESH_RUNS,
        rests=rests_of(motion.position_m, axis.scales.period_s),
        keeps_interrupted=True,
    )
    began_learned = bool(compensation.learned)
    return Refinement(motion.name, without, learned.history_um[0], learned, began_learned)


def _start_offset(compensation: Compensation, motion: Motion) -> FloatArray | None:
    """The model's own correction of this very motion, None where the law or tables carry it."""
    known, correction = compensation.motion_position_m, compensation.motion_correction_m
    if known is None or correction is None or known.shape != motion.position_m.shape:
        return None
    return correction if np.allclose(known, motion.position_m, atol=1e-9) else None
