"""In-process pair: the other end is a function, time is the clock that is handed in."""

from collections.abc import Callable

from pmac_comp.base.clock import Clock, Deadline
from pmac_comp.base.errors import LinkLost, ReplyTimeout
from pmac_comp.machine.transport.base import Framing

_FIRST_STEP_s = 1e-3
_LONGEST_STEP_s = 0.02


class PairTransport:
    """Bytes to a function and from it; nothing else can come between.

    Parameters
    ----------
    peer : callable
        Takes the bytes sent and gives back the bytes answered; called with no bytes while the
        host waits. It may raise ``LinkLost``.
    clock : Clock
        Clock on which waiting passes time; a simulated card runs its servo cycles in
        ``sleep_s``.
    name : str
        Shown in messages.
    framing : Framing
        What the bytes are.
    """

    def __init__(
        self,
        peer: Callable[[bytes], bytes],
        clock: Clock,
        *,
        name: str = "sim://",
        framing: Framing = Framing.PACKETS,
    ) -> None:
        self._peer = peer
        self._clock = clock
        self._name = name
        self._framing = framing
        self._arrived = bytearray()
        self._closed = False

    @property
    def name(self) -> str:
        """Where it leads."""
        return self._name

    @property
    def framing(self) -> Framing:
        """What the bytes are."""
        return self._framing

    def send(self, data: bytes, deadline: Deadline) -> None:
        """Hand the bytes to the peer and keep its answer."""
        self._require_open()
        if deadline.expired():
            raise ReplyTimeout(f"{self._name} had no time left to send")
        self._arrived += self._peer(data)

    def receive(self, deadline: Deadline) -> bytes:
        """What the peer answered; waiting lets time pass."""
        self._require_open()
        step_s = _FIRST_STEP_s
        while not self._arrived:
            if deadline.expired():
                raise ReplyTimeout(f"{self._name} did not answer in time")
            self._clock.sleep_s(min(step_s, deadline.remaining_s()))
            step_s = min(2.0 * step_s, _LONGEST_STEP_s)
            self._arrived += self._peer(b"")
        return self.drain()

    def drain(self) -> bytes:
        """Take what has arrived."""
        self._require_open()
        data = bytes(self._arrived)
        self._arrived.clear()
        return data

    def renew(self) -> None:
        """Nothing: the pair keeps its order."""

    def close(self) -> None:
        """End the conversation."""
        self._closed = True
        self._arrived.clear()

    def _require_open(self) -> None:
        if self._closed:
            raise LinkLost(f"the connection to {self._name} is closed")
