"""What every transport offers: bytes out, bytes in, each within a deadline.

What lives here: the interface and the framing a transport carries. A transport knows neither
commands nor answers; it turns the failures of its medium into ``LinkError``.
"""

from enum import Enum
from typing import Protocol

from pmac_comp.base.clock import Deadline


class Framing(Enum):
    """What the bytes of a transport are."""

    PACKETS = "packets"
    LINES = "lines"


class Transport(Protocol):
    """One connection to a controller."""

    @property
    def name(self) -> str:
        """Where it leads, for messages; never holds a secret."""
        ...

    @property
    def framing(self) -> Framing:
        """Packet port or ASCII dialog."""
        ...

    def send(self, data: bytes, deadline: Deadline) -> None:
        """Send all bytes.

        Raises
        ------
        LinkLost
            If the connection ended; some bytes may have left.
        ReplyTimeout
            If the peer did not take them before the deadline.
        """
        ...

    def receive(self, deadline: Deadline) -> bytes:
        """At least one byte.

        Raises
        ------
        ReplyTimeout
            If none came before the deadline.
        LinkLost
            If the connection ended.
        """
        ...

    def drain(self) -> bytes:
        """Take whatever has already arrived, without waiting."""
        ...

    def renew(self) -> None:
        """Make answers to what was sent before impossible, where the medium allows it."""
        ...

    def close(self) -> None:
        """End the connection; safe to repeat."""
        ...
