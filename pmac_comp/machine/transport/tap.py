"""A transport with faults: what a link can do to bytes, as data that can be printed and replayed.

Used by tests and by nothing else; the faults of the card itself are the simulator's.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import LinkLost, ReplyTimeout
from pmac_comp.machine.transport.base import Framing, Transport


class Way(Enum):
    """Direction of the bytes, seen from the host."""

    SEND = "send"
    RECEIVE = "receive"


class FaultKind(Enum):
    """What happens to the stream."""

    CUT = "cut"
    """The connection ends before byte ``at``."""
    SILENCE = "silence"
    """Nothing from byte ``at`` on arrives, and nobody says so."""
    FLIP = "flip"
    """Bits ``argument`` (a mask) of byte ``at`` are inverted."""
    DROP = "drop"
    """``argument`` bytes from byte ``at`` are lost."""
    DUPLICATE = "duplicate"
    """``argument`` bytes from byte ``at`` come twice."""
    INJECT = "inject"
    """Bytes ``data`` come before byte ``at``."""
    DELAY = "delay"
    """Byte ``at`` and all behind it come ``argument`` seconds late."""
    SLOW = "slow"
    """From byte ``at`` on, each byte takes ``argument`` seconds."""
    SPLIT = "split"
    """Bytes come in pieces of ``argument``; ``at`` has no meaning."""


@dataclass(frozen=True)
class Fault:
    """One fault of a schedule.

    Parameters
    ----------
    kind : FaultKind
        What happens.
    way : Way
        To which direction.
    at : int
        Byte number in that direction, counted from 0 over the life of the connection.
    argument : float
        Depends on the kind.
    data : bytes
        Bytes that are put in (``INJECT``).
    """

    kind: FaultKind
    way: Way
    at: int = 0
    argument: float = 1.0
    data: bytes = b""


class FaultyTransport:
    """A transport that applies a schedule of faults to another one.

    ``sent`` and ``received`` count the bytes that the healthy link would have carried, so that a
    first run without faults tells where faults can be put.
    """

    def __init__(self, inner: Transport, faults: Iterable[Fault] = ()) -> None:
        self._inner = inner
        self._faults = tuple(faults)
        self._queue: list[tuple[float, bytes]] = []
        self._blocks: dict[Fault, bytearray] = {}
        self._cut = False
        self.sent = 0
        self.received = 0

    def schedule(self, faults: Iterable[Fault]) -> None:
        """Replace the schedule; positions count from ``sent`` and ``received`` as they are."""
        self._faults = tuple(faults)
        self._blocks.clear()

    @property
    def name(self) -> str:
        """Where it leads."""
        return self._inner.name

    @property
    def framing(self) -> Framing:
        """What the bytes are."""
        return self._inner.framing

    def send(self, data: bytes, deadline: Deadline) -> None:
        """Send through the faults."""
        self._require_link()
        start, self.sent = self.sent, self.sent + len(data)
        pieces, cut = self._apply(data, start, Way.SEND, deadline)
        for _, piece in pieces:
            if piece:
                self._inner.send(piece, deadline)
        if cut:
            self._lose()

    def receive(self, deadline: Deadline) -> bytes:
        """Receive through the faults."""
        while True:
            if self._queue:
                return self._next_piece(deadline)
            self._require_link()
            data = self._inner.receive(deadline)
            start, self.received = self.received, self.received + len(data)
            pieces, cut = self._apply(data, start, Way.RECEIVE, deadline)
            self._queue += [piece for piece in pieces if piece[1]]
            if cut:
                self._inner.close()
                self._cut = True

    def drain(self) -> bytes:
        """Take what has arrived; what is delayed has not."""
        # Without a clock of its own a tap cannot tell which delayed piece is due, so it leaves
        # them all: draining less than possible is what a real line may do as well.
        return b"" if self._cut else self._drain_undelayed()

    def _drain_undelayed(self) -> bytes:
        taken = b"".join(piece for due_s, piece in self._queue if due_s == 0.0)
        self._queue = [item for item in self._queue if item[0] != 0.0]
        return taken if self._queue else taken + self._inner.drain()

    def renew(self) -> None:
        """Renew the link below; what was under way is lost with it."""
        self._inner.renew()

    def close(self) -> None:
        """Close the link below."""
        self._inner.close()

    def _next_piece(self, deadline: Deadline) -> bytes:
        due_s, piece = self._queue[0]
        now_s = deadline.clock.now_s()
        if due_s > now_s:
            wait_s = min(due_s, deadline.at_s) - now_s
            deadline.clock.sleep_s(max(0.0, wait_s))
            if due_s > deadline.at_s:
                raise ReplyTimeout(f"{self.name} did not answer in time")
        del self._queue[0]
        return piece

    def _apply(
        self, data: bytes, start: int, way: Way, deadline: Deadline
    ) -> tuple[list[tuple[float, bytes]], bool]:
        """Pieces with the time they are due, and whether the link ends behind them."""
        clean = self._untouched(start, way)
        out = bytearray(data[:clean])
        pieces: list[tuple[float, bytes]] = []
        due_s = self._queue[-1][0] if self._queue else 0.0
        for position, value in enumerate(data[clean:], start + clean):
            for fault in self._faults:
                if fault.way is not way or fault.at != position:
                    continue
                if fault.kind is FaultKind.CUT:
                    pieces.append((due_s, bytes(out)))
                    return pieces, True
                if fault.kind is FaultKind.DELAY:
                    pieces.append((due_s, bytes(out)))
                    out.clear()
                    due_s = deadline.clock.now_s() + fault.argument
                if fault.kind is FaultKind.INJECT:
                    out += fault.data
            pause_s = self._pause_s(position, way)
            if pause_s:
                pieces.append((due_s, bytes(out)))
                out.clear()
                due_s = max(due_s, deadline.clock.now_s()) + pause_s
            out += self._altered(value, position, way)
        pieces.append((due_s, bytes(out)))
        return self._split(pieces, way), False

    def _untouched(self, start: int, way: Way) -> int:
        """How many bytes from ``start`` on lie before the first fault."""
        first = (f.at for f in self._faults if f.way is way and f.kind is not FaultKind.SPLIT)
        return max(0, min(first, default=start + (1 << 62)) - start)

    def _pause_s(self, position: int, way: Way) -> float:
        slow = (f for f in self._faults if f.kind is FaultKind.SLOW and f.way is way)
        return sum(fault.argument for fault in slow if position >= fault.at)

    def _altered(self, value: int, position: int, way: Way) -> bytes:
        out = bytes([value])
        for fault in self._faults:
            if fault.way is not way or position < fault.at:
                continue
            inside = position < fault.at + fault.argument
            if fault.kind is FaultKind.SILENCE or (fault.kind is FaultKind.DROP and inside):
                return b""
            if fault.kind is FaultKind.FLIP and position == fault.at:
                out = bytes([value ^ int(fault.argument)])
            if fault.kind is FaultKind.DUPLICATE and inside:
                out = self._repeat(fault, position, out)
        return out

    def _repeat(self, fault: Fault, position: int, out: bytes) -> bytes:
        block = self._blocks.setdefault(fault, bytearray())
        block += out
        whole = position + 1 >= fault.at + fault.argument
        return out + bytes(block) if whole else out

    def _split(self, pieces: list[tuple[float, bytes]], way: Way) -> list[tuple[float, bytes]]:
        for fault in self._faults:
            if fault.kind is FaultKind.SPLIT and fault.way is way:
                size = int(fault.argument)
                pieces = [
                    (due_s, piece[at : at + size])
                    for due_s, piece in pieces
                    for at in range(0, len(piece), size)
                ]
        return pieces

    def _require_link(self) -> None:
        if self._cut:
            raise LinkLost(f"the connection to {self.name} was lost")

    def _lose(self) -> None:
        self._inner.close()
        self._cut = True
        raise LinkLost(f"the connection to {self.name} was lost while sending")
