"""Gathered samples and the check of their counter.

A missing or doubled sample is found exactly, from the servo-cycle counter that comes with each; a
block that was overwritten while it was read is told from a good one. Source: Software Reference
Manual p. 170-171; User Manual p. 401-402.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from pmac_comp.base.arrays import IntArray
from pmac_comp.base.errors import GatherOverflow, SampleGap
from pmac_comp.machine.controller.gather.gather_plan import COUNTER_NAME, GatherMode, GatherPlan

COUNTER_MODULUS: Final = 1 << 24


@dataclass(frozen=True)
class Gap:
    """A break in the counter: ``n_missing`` samples lost after sample ``index``, or doubled."""

    index: int
    n_missing: int


@dataclass(frozen=True)
class GatherResult:
    """Samples as the card had them.

    Parameters
    ----------
    raw : dict of IntArray, shape (n,)
        Signed integers per source.
    servo_cycle : IntArray, shape (n,)
        Servo counter, unwrapped.
    gaps : tuple of Gap
        Where samples are missing or doubled; empty for a whole run.
    plan : GatherPlan
        What was asked for.
    complete : bool
        Whether the run ended as planned.
    reason : str
        Why it ended.
    """

    raw: dict[str, IntArray]
    servo_cycle: IntArray
    gaps: tuple[Gap, ...]
    plan: GatherPlan
    complete: bool = True
    reason: str = "complete"

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.servo_cycle)

    def require_whole(self) -> "GatherResult":
        """The result itself, if no sample is missing.

        Raises
        ------
        GatherOverflow, SampleGap
            With place and length of each gap.
        """
        if not self.gaps:
            return self
        lost = sum(max(0, gap.n_missing) for gap in self.gaps)
        kind = GatherOverflow if self.plan.mode is GatherMode.RING and lost else SampleGap
        first = self.gaps[0]
        raise kind(
            f"{lost} samples are missing in {len(self.gaps)} gap(s); "
            f"the first after sample {first.index}, {first.n_missing} long.",
            code="PC-GAT-010",
            hint="Gather fewer sources, or every second cycle.",
            context={"gaps": [(g.index, g.n_missing) for g in self.gaps]},
        )


@dataclass
class Unwrapper:
    """Unwraps a 24-bit counter across blocks, exactly, and finds breaks."""

    period_cycles: int
    last: int | None = None
    gaps: list[Gap] = field(default_factory=list)
    n_seen: int = 0

    def feed(self, words: IntArray) -> IntArray:
        """Unwrapped counter of a block; breaks are added to ``gaps``.

        A step that is no multiple of the period counts as a gap of the whole samples missing.
        """
        if not len(words):
            return np.empty(0, dtype=np.int64)
        start = int(words[0]) % COUNTER_MODULUS if self.last is None else self.last
        raw = np.diff(np.asarray(words, dtype=np.int64), prepend=start)
        steps = np.mod(raw, COUNTER_MODULUS)
        # Half a range back (1.9 h at 2262 Hz) tells a repeated block from a jump ahead.
        steps = np.where(steps >= COUNTER_MODULUS // 2, steps - COUNTER_MODULUS, steps)
        values = start + np.cumsum(steps)
        checked = steps if self.last is not None else steps[1:]
        offset = self.n_seen - 1 if self.last is not None else 0
        for k in np.flatnonzero(checked != self.period_cycles).tolist():
            missing = int(checked[k]) // self.period_cycles - 1
            self.gaps.append(Gap(offset + k, missing))
        self.last = int(values[-1])
        self.n_seen += len(values)
        return values


def unwrap_word(values: IntArray, modulus: int = COUNTER_MODULUS) -> IntArray:
    """Signed words made continuous: each step is taken the short way round."""
    array = np.asarray(values, dtype=np.int64)
    if not len(array):
        return array
    half = modulus // 2
    steps = np.mod(np.diff(array) + half, modulus) - half
    return np.concatenate([array[:1], array[0] + np.cumsum(steps)])


def collect(plan: GatherPlan, words: IntArray) -> GatherResult:
    """Result of consecutive words of whole samples."""
    values = dict(zip((s.name for s in plan.sources), plan.layout.values(words), strict=True))
    counter = Unwrapper(plan.period_cycles)
    cycles = counter.feed(values.pop(COUNTER_NAME))
    return GatherResult(unwrapped(plan, values), cycles, tuple(counter.gaps), plan)


def unwrapped(plan: GatherPlan, values: dict[str, IntArray]) -> dict[str, IntArray]:
    """Columns of 24-bit counters made continuous, the others as they are."""
    around = {s.name for s in plan.sources if s.counter}
    return {name: unwrap_word(v) if name in around else v for name, v in values.items()}
