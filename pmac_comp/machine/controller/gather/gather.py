"""Data gathering at the servo rate: to the RAM buffer, or without end through the DPRAM ring.

What lives here: the two ways of running a plan (``gather_plan``) and of reading its samples
(``gather_samples``) from the card. Source: Software Reference Manual p. 170-171, 307, 321, 344;
User Manual p. 401-402.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from pmac_comp.base.arrays import IntArray
from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import CaptureError, CommandRefused, PmacCompError
from pmac_comp.machine.controller.card import registers as reg
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.card.variables import verify_many
from pmac_comp.machine.controller.gather.capture_log import CaptureLog
from pmac_comp.machine.controller.gather.gather_plan import COUNTER_NAME, GatherPlan
from pmac_comp.machine.controller.gather.gather_samples import (
    GatherResult,
    Unwrapper,
    collect,
    unwrapped,
)
from pmac_comp.machine.wire.gather_words import words_from_dpram, words_from_listing

PACKET_BYTES: Final = 1400
LIST_LONG_WORDS: Final = 1600  # per question: 100 lines, some 21 kB
_STALLED_s: Final = 0.5  # without a sample the card does not gather any more
POLL_FRACTION: Final = 0.25  # of the time in which the ring fills
POLL_LONGEST_s: Final = 0.02  # whoever watches the blocks stops the axis within this
HEADER_LONG_WORDS: Final = 47  # allowed for in RAM, as the maker's client does


@contextmanager
def prepared(link: Link, plan: GatherPlan, long_words: int | None = None) -> Iterator[None]:
    """Gathering set up and the buffer defined; afterwards stopped and deleted, whatever happened.

    The buffer must go: while it exists no table can be defined or deleted.
    """
    stop(link)
    values = plan.variables()
    link.write_buffer([f"{name}={int(value)}" for name, value in values.items()])
    verify_many(link, values)
    size = plan.cells if long_words is None else long_words
    link.command(f"DEFINE GATHER {size}")
    try:
        yield
    except PmacCompError as error:
        note_failure(error, lambda: stop(link))
        raise
    except BaseException:
        stop(link)
        raise
    stop(link)


def stop(link: Link) -> None:
    """End gathering and delete the buffer; no error if there is none."""
    link.command("ENDGATHER")
    try:
        link.command("DELETE GATHER")
    except CommandRefused:
        # Refused in the cycle in which gathering ends; the second time it must go.
        link.clock.sleep_s(0.01)
        link.command("DELETE GATHER")


def await_stored(link: Link, plan: GatherPlan, n_samples: int) -> None:
    """Wait while the card still stores the last of its samples: its own time counts, not ours."""
    stored = _stored(link, plan)
    stalled = Deadline.after(link.clock, _STALLED_s)
    while stored < n_samples and not stalled.expired():
        link.clock.sleep_s(POLL_LONGEST_s)
        before, stored = stored, _stored(link, plan)
        if stored > before:
            stalled = Deadline.after(link.clock, _STALLED_s)


def _stored(link: Link, plan: GatherPlan) -> int:
    """Samples in the RAM buffer by its pointers."""
    start, storage = (
        parse_integer(item)
        for line in link.query(f"RX:${reg.GATHER_POINTERS:X} RY:${reg.GATHER_POINTERS:X}")
        for item in line.split()
    )
    return (storage - start) // plan.layout.long_words


def read_ram(link: Link, plan: GatherPlan, n_samples: int) -> GatherResult:
    """First ``n_samples`` of the RAM buffer; the pointers say how many there are."""
    stored = _stored(link, plan)
    if stored < n_samples:
        raise CaptureError(
            f"{n_samples} samples were asked for, the card stored {stored}.",
            code="PC-GAT-011",
            hint="The buffer is full, or something else ended gathering: shorten the motion, "
            "gather every second cycle, or close the other program.",
        )
    blocks = []
    wanted = n_samples * plan.layout.long_words
    for at in range(0, wanted, LIST_LONG_WORDS):
        count = min(LIST_LONG_WORDS, wanted - at)
        blocks.append(words_from_listing(link.query(f"LIST GATHER {at},{count}")))
    return collect(plan, np.concatenate(blocks))


@dataclass
class RingReader:
    """Reads the DPRAM ring behind the card's back: call ``poll`` often enough.

    Parameters
    ----------
    link : Link
        Conversation with memory access.
    plan : GatherPlan
        Plan in ring mode.
    log : CaptureLog, optional
        Where every block is stored at once.
    on_block : callable, optional
        Given the raw columns of every new block; what it raises ends the reading.
    """

    link: Link
    plan: GatherPlan
    log: CaptureLog | None = None
    on_block: Callable[[dict[str, IntArray]], None] | None = None
    _read: int = 0  # next sample slot of the ring
    _blocks: list[dict[str, IntArray]] = field(default_factory=list)
    _counter: Unwrapper = field(init=False)
    _n_gaps_logged: int = 0

    def __post_init__(self) -> None:
        self._counter = Unwrapper(self.plan.period_cycles)

    @property
    def n(self) -> int:
        """Samples read so far."""
        return self._counter.n_seen

    def poll(self) -> int:
        """Read what is new; returns the number of samples.

        The storage pointer is read again afterwards: slots the card may have written meanwhile
        are not believed.
        """
        before = self._storage_slot()
        n_new = (before - self._read) % self.plan.ring_samples
        if n_new == 0:
            return 0
        words = self._read_slots(self._read, n_new)
        after = self._storage_slot()
        advanced = (after - before) % self.plan.ring_samples
        torn = max(0, n_new + advanced + 1 - self.plan.ring_samples)
        if torn:
            words = words[min(torn, n_new) * self.plan.layout.words :]
        self._read = before
        return self._take(words)

    def result(self, *, complete: bool = True, reason: str = "complete") -> GatherResult:
        """Everything read so far."""
        names = [s.name for s in self.plan.sources]
        joined = {
            name: np.concatenate([block[name] for block in self._blocks])
            if self._blocks
            else np.empty(0, dtype=np.int64)
            for name in names
        }
        cycles = joined.pop(COUNTER_NAME)
        gaps = tuple(self._counter.gaps)
        return GatherResult(unwrapped(self.plan, joined), cycles, gaps, self.plan, complete, reason)

    def _take(self, words: IntArray) -> int:
        values = dict(
            zip((s.name for s in self.plan.sources), self.plan.layout.values(words), strict=True)
        )
        values[COUNTER_NAME] = self._counter.feed(values[COUNTER_NAME])
        self._blocks.append(values)
        if self.log is not None:
            for gap in self._counter.gaps[self._n_gaps_logged :]:
                self.log.gap(gap.index, gap.n_missing, "servo counter")
            self._n_gaps_logged = len(self._counter.gaps)
            self.log.append(values)
        if self.on_block is not None:
            self.on_block(values)
        return len(values[COUNTER_NAME])

    def _storage_slot(self) -> int:
        data = self.link.get_memory(reg.dpram_offset(reg.GATHER_RING_HEADER), 4)
        pointer = int.from_bytes(data[2:4], "little")
        if not 0 <= pointer <= self.plan.cells:
            raise CaptureError(
                f"The gather pointer says {pointer}, the ring has {self.plan.cells} cells.",
                code="PC-GAT-012",
                hint="Another program has set gathering up anew; close it and capture again.",
            )
        return pointer % self.plan.cells // self.plan.layout.words

    def _read_slots(self, first: int, count: int) -> IntArray:
        head = min(count, self.plan.ring_samples - first)
        parts = [self._read_cells(first, head)]
        if count > head:
            parts.append(self._read_cells(0, count - head))
        return np.concatenate(parts)

    def _read_cells(self, first_slot: int, n_slots: int) -> IntArray:
        width = 4 * self.plan.layout.words
        start = reg.dpram_offset(reg.GATHER_RING) + first_slot * width
        end = start + n_slots * width
        data = b"".join(
            self.link.get_memory(at, min(PACKET_BYTES, end - at))
            for at in range(start, end, PACKET_BYTES)
        )
        return words_from_dpram(data)


def gather_ring(
    link: Link,
    plan: GatherPlan,
    duration_s: float,
    servo_period_s: float,
    *,
    log: CaptureLog | None = None,
    during: Callable[[], None] | None = None,
    keep_going: Callable[[], bool] | None = None,
    on_block: Callable[[dict[str, IntArray]], None] | None = None,
) -> GatherResult:
    """Samples of a duration of the card's time through the DPRAM ring.

    Parameters
    ----------
    link : Link
        Conversation with memory access.
    plan : GatherPlan
        Plan in ring mode.
    duration_s : float
        How long to gather.
    servo_period_s : float
        Servo period.
    log : CaptureLog, optional
        Blocks are appended as they come.
    during : callable, optional
        Called once, as soon as gathering runs: starts the motion.
    keep_going : callable, optional
        Called at every poll; False ends the run early, the result then says so.
    on_block : callable, optional
        Given the raw columns of every new block; what it raises ends the run.

    Raises
    ------
    StorageFull, LinkError
        Gathering is stopped on the card first where the link allows it.
    """
    reader = RingReader(link, plan, log, on_block)
    wait_s = ring_poll_s(plan, servo_period_s)
    complete, reason = True, "complete"
    with prepared(link, plan):
        link.command("GATHER")
        if during is not None:
            during()
        deadline = Deadline.after(link.clock, duration_s)
        # The card's own time counts: a simulated one on a busy machine falls behind ours.
        wanted = int(duration_s / (plan.period_cycles * servo_period_s))
        stalled = Deadline.after(link.clock, duration_s + _STALLED_s)
        while not deadline.expired() or (reader.n < wanted and not stalled.expired()):
            late = deadline.expired()
            link.clock.sleep_s(wait_s if late else min(wait_s, deadline.remaining_s()))
            if reader.poll() and late:
                stalled = Deadline.after(link.clock, _STALLED_s)
            if keep_going is not None and not keep_going():
                complete, reason = False, "stopped"
                break
        link.command("ENDGATHER")
        reader.poll()
    return reader.result(complete=complete, reason=reason)


def ring_poll_s(plan: GatherPlan, servo_period_s: float) -> float:
    """Time in s between polls: a quarter of the time in which the ring fills."""
    fills_s = plan.ring_samples * plan.period_cycles * servo_period_s
    return min(POLL_LONGEST_s, POLL_FRACTION * fills_s)


def note_failure(error: PmacCompError, clean_up: Callable[[], None]) -> None:
    """Run a clean-up after an error; if that fails too, its error becomes a note of the first."""
    try:
        clean_up()
    except PmacCompError as second:
        error.add_note(f"Cleaning up failed as well: {second.message}")
