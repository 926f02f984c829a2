"""Data gathering at the servo rate: to the RAM buffer, or without end through the DPRAM ring.

The servo-cycle counter X:$0 is always the last source, so that every sample proves its own time: a
missing or doubled sample is found exactly, and a block that was overwritten while it was read is
told from a good one. What lives here: the plan, the two ways of running it, the check of the
counter. What a count is worth in um is the business of ``workflow``. Source: Software Reference
Manual p. 170-171, 307, 321, 344; User Manual p. 401-402.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

import numpy as np

from pmac_comp.base.arrays import IntArray
from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import (
    CaptureError,
    CommandRefused,
    ConfigError,
    GatherOverflow,
    PmacCompError,
    SampleGap,
)
from pmac_comp.machine.controller import registers as reg
from pmac_comp.machine.controller.capture_log import CaptureLog
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.numbers import parse_integer
from pmac_comp.machine.controller.variables import verify_many
from pmac_comp.machine.wire.gather_words import SampleLayout, words_from_dpram, words_from_listing

COUNTER_NAME: Final = "servo_cycle"
COUNTER_MODULUS: Final = 1 << 24
SOURCES_MAX: Final = 48
PACKET_BYTES: Final = 1400
LIST_LONG_WORDS: Final = 1600  # per question: 100 lines, some 21 kB
_STALLED_s: Final = 0.5  # without a sample the card does not gather any more
POLL_FRACTION: Final = 0.25  # of the time in which the ring fills
POLL_LONGEST_s: Final = 0.02  # whoever watches the blocks stops the axis within this
HEADER_LONG_WORDS: Final = 47  # allowed for in RAM, as the maker's client does


class GatherMode(Enum):
    """Value of I5000."""

    RAM = 0
    RAM_WRAP = 1
    DPRAM = 2
    RING = 3


@dataclass(frozen=True)
class GatherSource:
    """One register to gather.

    Parameters
    ----------
    name : str
        Name of the column.
    address : int
        Word of I5001-I5048: kind in the first hex digit, address below.
    counter : bool
        Whether a 24-bit word counts around and is to be unwrapped.
    """

    name: str
    address: int
    counter: bool = False

    @property
    def width(self) -> int:
        """24-bit words: 1 or 2."""
        return reg.GatherAddress(self.address).n_words


def motor_source(name: str, motor: int, offset: int) -> GatherSource:
    """48-bit register of a motor, e.g. ``motor_source("actual", 1, registers.ACTUAL)``."""
    return GatherSource(name, reg.LONG | reg.motor_register(motor, offset))


def output_source(name: str, motor: int) -> GatherSource:
    """Servo command of a motor, 24 bits, 1/256 DAC unit."""
    return GatherSource(name, reg.X_WORD | reg.motor_register(motor, reg.OUTPUT))


def bench_sources(motor: int, scale_motor: int | None) -> tuple[GatherSource, ...]:
    """What a calibration gathers.

    ``commanded`` (trajectory), ``actual``, ``master`` (law), ``compensation`` (tables), ``scale``
    in 1/(32 Ixx08) count of their motors; ``output`` in 1/256 DAC unit.
    """
    sources = [
        motor_source("commanded", motor, reg.COMMANDED),
        motor_source("actual", motor, reg.ACTUAL),
        motor_source("master", motor, reg.MASTER),
        motor_source("compensation", motor, reg.COMPENSATION),
    ]
    if scale_motor is not None:
        sources.append(motor_source("scale", scale_motor, reg.ACTUAL))
    return (*sources, output_source("output", motor))


@dataclass(frozen=True)
class GatherPlan:
    """What to gather and how.

    Parameters
    ----------
    sources : tuple of GatherSource
        48-bit sources are put first (so that none straddles two long words), the servo counter
        last.
    period_cycles : int
        Servo cycles between samples, I5049.
    mode : GatherMode
        RAM buffer or DPRAM ring.
    dpram : str
        ``small`` or ``large``.
    """

    sources: tuple[GatherSource, ...]
    period_cycles: int = 1
    mode: GatherMode = GatherMode.RING
    dpram: str = "large"

    def __post_init__(self) -> None:
        given = [s for s in self.sources if s.name != COUNTER_NAME]
        names = [s.name for s in given]
        if len(set(names)) != len(names) or not given:
            raise ConfigError(f"Gather sources need different names: {names}.", code="PC-GAT-001")
        if len(given) + 1 > SOURCES_MAX:
            raise ConfigError(
                f"{len(given)} sources and the counter are more than {SOURCES_MAX}.",
                code="PC-GAT-002",
            )
        if not 1 <= self.period_cycles <= 8388607:
            raise ConfigError("The gather period is 1 to 8388607 cycles.", code="PC-GAT-003")
        if self.mode in {GatherMode.RING, GatherMode.DPRAM} and self.dpram not in reg.DPRAM_END:
            raise ConfigError(
                "This card has no dual-ported RAM.", code="PC-GAT-004", hint="Use the RAM buffer."
            )
        counter = GatherSource(COUNTER_NAME, reg.X_WORD | reg.SERVO_COUNTER)
        ordered = sorted(given, key=lambda s: -s.width)
        object.__setattr__(self, "sources", (*ordered, counter))

    @property
    def layout(self) -> SampleLayout:
        """Words of a sample."""
        padded = self.mode in {GatherMode.RAM, GatherMode.RAM_WRAP}
        return SampleLayout(tuple(s.width for s in self.sources), padded=padded)

    @property
    def cells(self) -> int:
        """Cells of the dual-ported RAM that the ring takes: whole samples."""
        room = reg.DPRAM_END[self.dpram] - reg.GATHER_RING + 1
        return room // self.layout.words * self.layout.words

    @property
    def ring_samples(self) -> int:
        """Samples that the ring holds."""
        return self.cells // self.layout.words

    def variables(self) -> dict[str, float]:
        """I-variables that set the plan up."""
        n = len(self.sources)
        masks = (1 << min(n, 24)) - 1, (1 << max(0, n - 24)) - 1
        return {
            "I5000": self.mode.value,
            **{f"I{5001 + k}": s.address for k, s in enumerate(self.sources)},
            "I5049": self.period_cycles,
            "I5050": masks[0],
            "I5051": masks[1],
        }


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


# Running a plan ----------------------------------------------------------------------------------


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


def gather_ram(
    link: Link, plan: GatherPlan, duration_s: float, servo_period_s: float
) -> GatherResult:
    """Samples of a fixed duration through the RAM buffer.

    Raises
    ------
    CommandRefused
        The buffer does not fit (ERR006).
    CaptureError
        The card stored fewer samples than were asked for.
    """
    n_samples = 1 + int(np.ceil(duration_s / (servo_period_s * plan.period_cycles)))
    words = plan.layout.long_words * n_samples + HEADER_LONG_WORDS
    with prepared(link, plan, words):
        link.command("GATHER")
        link.clock.sleep_s(n_samples * plan.period_cycles * servo_period_s)
        await_stored(link, plan, n_samples)
        link.command("ENDGATHER")
        return read_ram(link, plan, n_samples)


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
            f"{n_samples} samples were asked for, the card stored {stored}.", code="PC-GAT-011"
        )
    blocks = []
    wanted = n_samples * plan.layout.long_words
    for at in range(0, wanted, LIST_LONG_WORDS):
        count = min(LIST_LONG_WORDS, wanted - at)
        blocks.append(words_from_listing(link.query(f"LIST GATHER {at},{count}")))
    return collect(plan, np.concatenate(blocks))


def collect(plan: GatherPlan, words: IntArray) -> GatherResult:
    """Result of consecutive words of whole samples."""
    values = dict(zip((s.name for s in plan.sources), plan.layout.values(words), strict=True))
    counter = Unwrapper(plan.period_cycles)
    cycles = counter.feed(values.pop(COUNTER_NAME))
    return GatherResult(_unwrapped(plan, values), cycles, tuple(counter.gaps), plan)


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
        return GatherResult(
            _unwrapped(self.plan, joined), cycles, gaps, self.plan, complete, reason
        )

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


def _unwrapped(plan: GatherPlan, values: dict[str, IntArray]) -> dict[str, IntArray]:
    around = {s.name for s in plan.sources if s.counter}
    return {name: unwrap_word(v) if name in around else v for name, v in values.items()}


def source_names(sources: Sequence[GatherSource]) -> list[str]:
    """Names in order."""
    return [s.name for s in sources]
