"""One conversation with a controller, done right.

What lives here: which calls may be repeated (reads), which never (everything else), how long they
may take in total, and how refusals become errors. Imports the link, not the physics and not the
simulator.
"""

import re
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import Self, TypeVar

from pmac_comp.base.clock import Clock, Deadline, SystemClock
from pmac_comp.base.errors import (
    CommandRefused,
    LinkError,
    LinkLost,
    LocalProtocolError,
    ProtocolError,
    RemoteProtocolError,
    ReplyTimeout,
)
from pmac_comp.machine.client.batches import buffer_batches, line_batches, merged_runs
from pmac_comp.machine.client.line_link import CHANGED_ON_THE_WAY, LineLink
from pmac_comp.machine.client.link import Statistics
from pmac_comp.machine.client.modes import Modes, establish, restore
from pmac_comp.machine.client.packet_link import PacketLink
from pmac_comp.machine.client.reads import is_read
from pmac_comp.machine.client.refusals import (
    accepted,
    batch_refused,
    encoded,
    encoded_lines,
    garbled,
)
from pmac_comp.machine.transport.base import Framing, Transport
from pmac_comp.machine.transport.opening import open_transport
from pmac_comp.machine.transport.url import parse_url
from pmac_comp.machine.wire import ethernet, ethernet_requests
from pmac_comp.machine.wire.replies import MAX_ANSWER, Reply

_T = TypeVar("_T")

DEFAULT_TIMEOUT_s = 3.0
SSH_CONNECT_s = 15.0
"""Least time for a login: keys are agreed on and checked before the first byte."""
LISTING_s = 600.0
"""Longest time of a listing: a megabyte takes five minutes at 38400 baud."""
_LISTING = re.compile("LIST", re.IGNORECASE)
_FIRST_TRY = 0.5
_PERHAPS_NOISE = (3, 4)
"""Errors with which an ASCII port refuses a question that noise has changed."""
_REPORTING = frozenset({0x02, 0x03, 0x06, 0x07, 0x10, 0x16})


@dataclass(frozen=True)
class Capabilities:
    """What the connection can carry.

    Parameters
    ----------
    packets : bool
        Whether it is a packet port, with buffered writes.
    memory : bool
        Whether the dual-ported RAM can be read and written.
    """

    packets: bool
    memory: bool


class Commander:
    """A conversation: one thing asked at a time, each within a total deadline.

    Reads are repeated once after a time-out or a garbled answer. Everything else is sent exactly
    once: after a doubt the caller reads back. All calls may come from several threads.

    Parameters
    ----------
    transport : Transport
        Connected transport; owned and closed by the commander.
    clock : Clock or None
        Clock of deadlines; of a simulated card in process, the card's own.
    timeout_s : float
        Default total time of a call in s.
    checksum : bool
        Ask an ASCII port for line checksums (I4=1). Not used on the packet port.
    max_answer : int
        Most bytes of one answer.

    Raises
    ------
    ConnectFailed
        If what answers is not a PMAC; nothing was written then.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        clock: Clock | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_s,
        checksum: bool = False,
        max_answer: int = MAX_ANSWER,
    ) -> None:
        self.clock: Clock = clock or SystemClock()
        self.timeout_s = timeout_s
        self._lock = threading.RLock()
        self._max_answer = max_answer
        packets = transport.framing is Framing.PACKETS
        self._modes = Modes(i4=1 if checksum and not packets else 0)
        self._reopen: Callable[[Deadline], Transport] | None = None
        self._statistics = Statistics()
        self._link = self._start(transport, self._deadline(None))

    @classmethod
    def open(
        cls,
        url: str,
        *,
        clock: Clock | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_s,
        checksum: bool | None = None,
    ) -> "Commander":
        """Conversation with the controller at an address.

        Parameters
        ----------
        url : str
            Connection address; ``sim://`` is opened by the workflow, which owns the card.
        clock : Clock or None
            Clock of deadlines.
        timeout_s : float
            Default total time of a call in s, and of connecting.
        checksum : bool or None
            Line checksums on an ASCII port; by default on serial lines, where noise is real.
        """
        endpoint = parse_url(url)
        used_clock = clock or SystemClock()
        sums = endpoint.option_flag("checksum", default=endpoint.scheme == "serial")
        connect_s = max(timeout_s, SSH_CONNECT_s) if endpoint.scheme == "ssh" else timeout_s
        transport = open_transport(endpoint, Deadline.after(used_clock, connect_s))
        commander = cls(
            transport,
            clock=used_clock,
            timeout_s=timeout_s,
            checksum=sums if checksum is None else checksum,
        )
        commander._reopen = lambda deadline: open_transport(endpoint, deadline)
        return commander

    def _start(self, transport: Transport, deadline: Deadline) -> PacketLink | LineLink:
        kind = PacketLink if transport.framing is Framing.PACKETS else LineLink
        link = kind(transport, self.clock, i4=self._modes.i4, limit=self._max_answer)
        link.statistics = self._statistics
        try:
            self._found = establish(link, self._modes, deadline)
        except (LinkError, ProtocolError):
            transport.close()
            raise
        return link

    # Text -----------------------------------------------------------------------------------------

    def query(
        self,
        text: str,
        *,
        timeout_s: float | None = None,
        meanwhile: Callable[[], None] | None = None,
    ) -> list[str]:
        """Lines that answer a question; asked again once if the answer is late or garbled.

        A line that is not certain to be a question (:func:`is_read`) is sent once only. A listing
        may take ten minutes, since nobody knows how long it is, but may not pause for longer than
        other answers take.

        Parameters
        ----------
        text : str
            Command line, at most 255 characters.
        timeout_s : float or None
            Total time in s, repetition included.
        meanwhile : callable or None
            Work of the host that is done once while the controller answers.

        Raises
        ------
        CommandRefused
            If the controller answers with an error.
        ReplyTimeout
            If there was no whole answer in time.
        """
        if meanwhile is not None:
            with self._lock, self._link.doing(meanwhile):
                return self.query(text, timeout_s=timeout_s)
        if timeout_s is None and _LISTING.search(text):
            with self._lock, self._link.longest_pause(self.timeout_s):
                return self._query(text, LISTING_s)
        return self._query(text, timeout_s)

    def _query(self, text: str, timeout_s: float | None) -> list[str]:
        command = encoded(text)
        deadline = self._deadline(timeout_s)
        with self._lock:
            if not is_read(text):
                return accepted(self._link.exchange(command, deadline), text)
            ask = partial(self._exchange_clean, command)
            reply = self._read(ask, deadline)
            if reply.error in _PERHAPS_NOISE and not self.capabilities.packets:
                self._statistics.retries += 1
                reply = self._read(ask, deadline)
            return accepted(reply, text)

    def command(self, text: str, *, timeout_s: float | None = None) -> list[str]:
        """Lines that answer a command, usually none; sent exactly once.

        Raises
        ------
        CommandRefused
            If the controller answers with an error; what stood before it on the line was done.
        ReplyTimeout, LinkLost, RemoteProtocolError
            If there is no certain answer: the command may have been carried out, read it back.
        """
        command = encoded(text)
        with self._lock:
            return accepted(self._link.exchange(command, self._deadline(timeout_s)), text)

    def query_many(self, questions: Iterable[str], *, timeout_s: float | None = None) -> list[str]:
        """One line for each question, asked many at a time.

        Parameters
        ----------
        questions : iterable of str
            Questions that give exactly one line each, such as ``P100`` or ``#1P``.
        timeout_s : float or None
            Total time in s of each line sent.

        Raises
        ------
        RemoteProtocolError
            If the number of lines is not the number of questions.
        """
        answers: list[str] = []
        with self._lock:
            for batch in line_batches(merged_runs(questions)):
                lines = self.query("".join(text for text, _ in batch), timeout_s=timeout_s)
                wanted = sum(count for _, count in batch)
                if len(lines) != wanted:
                    raise RemoteProtocolError(
                        f"{wanted} questions gave {len(lines)} lines",
                        context={"questions": [text for text, _ in batch], "lines": lines},
                    )
                answers += lines
        return answers

    def control(self, character: str | int, *, timeout_s: float | None = None) -> str:
        """Send a control character, e.g. ``"K"`` or 11 for control-K; its answer, if it has one.

        Parameters
        ----------
        character : str or int
            Letter or code 1 to 31. Control-B, C, F, G, P and V answer with a line.
        """
        code = character if isinstance(character, int) else ord(character.upper()) - 0x40
        if not 0 < code < 0x20:
            raise LocalProtocolError(f"{character!r} is no control character")
        deadline = self._deadline(timeout_s)
        with self._lock:
            if code not in _REPORTING:
                return self._link.control(code, deadline, answers=False).decode("ascii", "replace")
            data = self._read(partial(self._link.control, code, answers=True), deadline)
            return data.decode("ascii", "replace").strip()

    # Buffers --------------------------------------------------------------------------------------

    def write_buffer(
        self,
        lines: Sequence[str],
        *,
        timeout_s: float | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Send lines in order, each exactly once, many to a request where the port allows it.

        Parameters
        ----------
        lines : sequence of str
            Command or program lines, at most 255 characters each.
        timeout_s : float or None
            Total time in s of each request.
        progress : callable or None
            Called with lines done and lines in all after each request.

        Raises
        ------
        CommandRefused
            For the first refused line. ``context`` holds ``line_index`` (None if the controller's
            count leaves two candidates), ``candidates``, ``error`` and ``lines_accepted``, the
            number of lines in requests that were accepted as a whole.
        """
        packed = encoded_lines(lines)
        done = 0
        with self._lock:
            for batch in buffer_batches(packed, single=not self.capabilities.packets):
                self._write_batch(batch, done, self._deadline(timeout_s))
                done += len(batch)
                if progress is not None:
                    progress(done, len(packed))

    def _write_batch(self, batch: Sequence[bytes], start: int, deadline: Deadline) -> None:
        if not isinstance(self._link, PacketLink):
            text = batch[0].decode("ascii")
            try:
                accepted(self._link.exchange(batch[0], deadline), text)
            except CommandRefused as error:
                error.context |= {
                    "line_index": start,
                    "candidates": [start],
                    "lines_accepted": start,
                }
                raise
            return
        data = self._link.request(ethernet_requests.write_buffer(batch), deadline)
        verdict = ethernet.BufferVerdict.decode(data)
        if verdict.refused:
            raise batch_refused(batch, start, verdict)

    # Memory ---------------------------------------------------------------------------------------

    def get_memory(self, offset: int, size: int, *, timeout_s: float | None = None) -> bytes:
        """Bytes of the dual-ported RAM from byte ``offset``, in requests of at most 1400.

        Raises
        ------
        LocalProtocolError
            On an ASCII port, which cannot reach the memory.
        """
        link = self._packet_link("the dual-ported RAM")
        deadline = self._deadline(timeout_s)
        out = bytearray()
        with self._lock:
            while len(out) < size:
                part = min(ethernet.MAX_REPLY, size - len(out))
                request = ethernet_requests.get_memory(offset + len(out), part)
                out += self._read(partial(link.request, request), deadline)
        return bytes(out)

    def set_memory(self, offset: int, data: bytes, *, timeout_s: float | None = None) -> None:
        """Write bytes into the dual-ported RAM from byte ``offset``, once."""
        link = self._packet_link("the dual-ported RAM")
        deadline = self._deadline(timeout_s)
        with self._lock:
            for start in range(0, len(data), ethernet.MAX_REPLY):
                part = data[start : start + ethernet.MAX_REPLY]
                link.request(ethernet_requests.set_memory(offset + start, part), deadline)

    def set_bits(
        self, offset: int, *, set_mask: int = 0, clear_mask: int = 0, timeout_s: float | None = None
    ) -> None:
        """Set and clear bits of one 32-bit cell of the dual-ported RAM in one access."""
        link = self._packet_link("the dual-ported RAM")
        with self._lock:
            request = ethernet_requests.set_bits(offset, set_mask, clear_mask)
            link.request(request, self._deadline(timeout_s))

    def _packet_link(self, what: str) -> PacketLink:
        if not isinstance(self._link, PacketLink):
            raise LocalProtocolError(
                f"{self.name} is an ASCII port and cannot reach {what}",
                hint="Connect over tcp:// or udp:// to the packet port (1025).",
            )
        return self._link

    # The conversation itself ----------------------------------------------------------------------

    @property
    def name(self) -> str:
        """Where the conversation leads."""
        return self._link.transport.name

    @property
    def capabilities(self) -> Capabilities:
        """What the connection can carry."""
        packets = isinstance(self._link, PacketLink)
        return Capabilities(packets=packets, memory=packets)

    @property
    def statistics(self) -> Statistics:
        """What the session has cost so far."""
        return self._statistics

    @property
    def found_modes(self) -> Modes:
        """The communication modes that were set when the conversation began."""
        return self._found

    def take_unsolicited(self) -> list[str]:
        """Lines that programs on the controller sent on their own since the last call."""
        with self._lock:
            taken, self._link.unsolicited = self._link.unsolicited, []
        return taken

    def flush(self) -> None:
        """Drop what is pending and make sure that questions and answers belong together."""
        with self._lock:
            self._link.settle(self._deadline(None))

    @contextmanager
    def exclusive(self) -> Iterator[Self]:
        """Keep other threads of this program out for several calls."""
        with self._lock:
            yield self

    def reconnect(self) -> None:
        """Open the connection anew after it was lost, and set the modes again.

        Raises
        ------
        LinkLost
            If the commander was not opened from an address.
        """
        if self._reopen is None:
            raise LinkLost(f"{self.name} was opened by its owner and cannot be opened again here")
        with self._lock:
            self._link.transport.close()
            deadline = self._deadline(None)
            self._link = self._start(self._reopen(deadline), deadline)

    def close(self) -> None:
        """Put the modes back as they were found and end the conversation; safe to repeat."""
        with self._lock:
            try:
                restore(self._link, self._found, self._modes, self._deadline(1.0))
            finally:
                self._found = self._modes
                self._link.transport.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    # Repetition -----------------------------------------------------------------------------------

    def _deadline(self, timeout_s: float | None) -> Deadline:
        return Deadline.after(self.clock, self.timeout_s if timeout_s is None else timeout_s)

    def _read(self, ask: Callable[[Deadline], _T], deadline: Deadline) -> _T:
        """Ask; after a late or garbled answer settle the link and ask once more."""
        first = Deadline(self.clock, deadline.at_s - _FIRST_TRY * deadline.remaining_s())
        try:
            return ask(first)
        except (ReplyTimeout, RemoteProtocolError) as error:
            if error.code == CHANGED_ON_THE_WAY:
                raise
            self._statistics.retries += 1
            self._link.unsettled = True
            return ask(deadline)

    def _exchange_clean(self, command: bytes, deadline: Deadline) -> Reply:
        reply = self._link.exchange(command, deadline)
        if reply.faults:
            raise garbled(reply, command.decode("ascii"))
        return reply
