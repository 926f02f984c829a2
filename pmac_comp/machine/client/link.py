"""One exchange over a transport: send a line, read the whole answer, find the mark after trouble.

What lives here: what the two ways in which a line and its answer travel share (``packet_link``,
``line_link``), and how a conversation is brought to a known point. It does not know which commands
may be repeated, nor what they mean; that is the commander's.

The wire has no request numbers. After a missed deadline a late answer would be taken for the
answer to the next question; so a link that missed one is *unsettled*, and settles only by seeing
the answer to a question that nobody else can have asked: a random pattern of I3 and I6, whose
values (2 and 1) were set when the session began. The question only reads.
"""

import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

from pmac_comp.base.clock import Clock, Deadline
from pmac_comp.base.errors import LinkLost, RemoteProtocolError, ReplyTimeout
from pmac_comp.machine.transport.base import Transport
from pmac_comp.machine.wire import dialog
from pmac_comp.machine.wire.replies import Reply, ReplyReader

SETTLE_s = 0.06
"""How long nothing may come before a line counts as quiet."""
_MARK_LENGTH = 16
_MARK_TRIES = 3
_MARK_SYMBOLS = (("I3", "2"), ("I6", "1"))


@dataclass
class Statistics:
    """What a session has cost so far."""

    requests: int = 0
    bytes_sent: int = 0
    bytes_received: int = 0
    retries: int = 0
    resynchronisations: int = 0
    stray_bytes: int = 0


@dataclass(frozen=True)
class Mark:
    """A question that identifies its answer.

    Parameters
    ----------
    question : bytes
        Command line, reads only.
    values : tuple of str
        The values it is answered with.
    """

    question: bytes
    values: tuple[str, ...]

    @classmethod
    def fresh(cls) -> "Mark":
        """A mark that was not used before in this session, up to chance 1 in 65536."""
        bits = secrets.randbits(_MARK_LENGTH)
        chosen = [_MARK_SYMBOLS[bits >> k & 1] for k in range(_MARK_LENGTH)]
        return cls("".join(name for name, _ in chosen).encode(), tuple(v for _, v in chosen))

    def answer(self, i4: int) -> bytes:
        """The bytes that answer it with I3=2 and I6=1."""
        return dialog.format_reply(self.values, i3=2, i4=i4, i6=1, command=self.question)


class Link(Protocol):
    """A conversation in which one thing at a time is asked."""

    transport: Transport
    statistics: Statistics
    unsettled: bool

    def exchange(self, command: bytes, deadline: Deadline) -> Reply:
        """Send a command line once and read its whole answer."""
        ...

    def control(self, character: int, deadline: Deadline, *, answers: bool) -> bytes:
        """Send a control character; the line that answers it, if it is one that answers."""
        ...

    def collect(self, command: bytes, deadline: Deadline) -> bytes:
        """Send a command line and take all bytes until the line goes quiet, in any mode."""
        ...

    def settle(self, deadline: Deadline) -> None:
        """Bring the conversation to a known point, or end it."""
        ...


class BaseLink:
    """What both kinds of link share: counting, deadlines, stray bytes, the search for the mark."""

    def __init__(self, transport: Transport, clock: Clock, *, i4: int = 0, limit: int) -> None:
        self.transport = transport
        self.statistics = Statistics()
        self.unsettled = False
        self.unsolicited: list[str] = []
        self._clock = clock
        self.i4 = i4
        self._limit = limit
        self._pause_s: float | None = None
        self._meanwhile: Callable[[], None] | None = None

    def _send(self, data: bytes, deadline: Deadline) -> None:
        self.statistics.requests += 1
        self.statistics.bytes_sent += len(data)
        self.transport.send(data, deadline)
        if self._meanwhile is not None:
            work, self._meanwhile = self._meanwhile, None
            work()

    @contextmanager
    def doing(self, work: Callable[[], None]) -> Iterator[None]:
        """Within ``with``, the first thing that is sent has ``work`` done before its answer."""
        self._meanwhile = work
        try:
            yield
        finally:
            self._meanwhile = None

    def _receive(self, deadline: Deadline) -> bytes:
        if deadline.expired():
            raise ReplyTimeout(f"{self.transport.name} did not answer in time")
        if self._pause_s is not None:
            at_s = min(self._clock.now_s() + self._pause_s, deadline.at_s)
            deadline = Deadline(self._clock, at_s)
        data = self.transport.receive(deadline)
        self.statistics.bytes_received += len(data)
        return data

    @contextmanager
    def longest_pause(self, pause_s: float) -> Iterator[None]:
        """Within the deadline no pause may be longer than this: for answers of unknown length."""
        self._pause_s = pause_s
        try:
            yield
        finally:
            self._pause_s = None

    def _require_within_pause(self, heard_s: float) -> None:
        """Raise if an answer of unknown length pauses for too long; waiting in steps hides that."""
        if self._pause_s is not None and self._clock.now_s() - heard_s >= self._pause_s:
            raise ReplyTimeout(f"{self.transport.name} stopped in the middle of its answer")

    def _receive_within(self, wait_s: float, deadline: Deadline) -> bytes:
        """Bytes, or none if none came within ``wait_s``; the deadline still raises."""
        at_s = min(self._clock.now_s() + wait_s, deadline.at_s)
        try:
            return self._receive(Deadline(self._clock, at_s))
        except ReplyTimeout:
            if deadline.expired():
                raise
            return b""

    def _clear_way(self, deadline: Deadline) -> None:
        """Nothing may be under way when a question is asked."""
        if self.unsettled:
            self.settle(deadline)
        stray = self.transport.drain()
        if stray and not self._take_unsolicited(stray):
            self.statistics.stray_bytes += len(stray)
            self.settle(deadline)

    def _take_unsolicited(self, data: bytes) -> bool:
        """Keep what programs have sent on their own; False if there is anything else."""
        reader = ReplyReader(checksum=bool(self.i4 & 1), limit=self._limit)
        finished = reader.receive(data)
        reply = reader.reply
        if finished or reply.lines or reply.faults or not reader.at_line_start:
            return False
        self.unsolicited += reply.unsolicited
        return True

    def _finish(self, reader: ReplyReader) -> Reply:
        reply = reader.reply
        self.unsolicited += reply.unsolicited
        if reader.rest and not self._take_unsolicited(reader.rest):
            # One of the two answers belongs to another question, and nothing tells which.
            self.unsettled = True
            self.statistics.stray_bytes += len(reader.rest)
            reply = replace(reply, faults=(*reply.faults, "more than one answer came"))
        return reply

    def settle(self, deadline: Deadline) -> None:
        """Drop what is pending and find a mark; the link is closed if it does not come."""
        self.statistics.resynchronisations += 1
        self.transport.renew()
        try:
            self._settle_in_steps(deadline)
        except (ReplyTimeout, RemoteProtocolError) as error:
            self.transport.close()
            kind = ReplyTimeout if isinstance(error, ReplyTimeout) else LinkLost
            raise kind(
                f"{self.transport.name}: the conversation could not be brought to a known point",
                hint="The connection was closed. Does another client ask here at the same time "
                "(another command, a panel)? Their answers mix. Run the command again to open a "
                "new one.",
            ) from error
        self.unsettled = False

    def _settle_in_steps(self, deadline: Deadline) -> None:
        # A mark may itself be lost or garbled: ask anew while there is time.
        for tries_left in range(_MARK_TRIES, 0, -1):
            part_s = deadline.remaining_s() / tries_left
            try:
                self._seek_mark(Deadline.after(self._clock, part_s))
            except (ReplyTimeout, RemoteProtocolError):
                if tries_left == 1:
                    raise
            else:
                return

    def _seek_mark(self, deadline: Deadline) -> None:
        mark = Mark.fresh()
        self._silence(deadline)
        self._ask(mark.question, deadline)
        self._find(mark.answer(self.i4), deadline)

    def _find(self, wanted: bytes, deadline: Deadline) -> None:
        seen = bytearray()
        while not seen.endswith(wanted):
            seen += self._receive(deadline)
            if len(seen) > self._limit:
                raise RemoteProtocolError("endless answer while looking for the mark")

    def _silence(self, deadline: Deadline) -> None:
        raise NotImplementedError

    def _ask(self, command: bytes, deadline: Deadline) -> None:
        raise NotImplementedError

    def _take_until_quiet(self, deadline: Deadline) -> bytes:
        taken = bytearray()
        while data := self._receive_within(SETTLE_s, deadline):
            taken += data
            if len(taken) > self._limit:
                raise RemoteProtocolError(f"the answer exceeds {self._limit} bytes")
        return bytes(taken)
