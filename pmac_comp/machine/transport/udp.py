"""UDP to the packet port: one datagram a request, one or none back."""

import socket

from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import ConnectFailed, LinkLost, ReplyTimeout
from pmac_comp.machine.transport.base import Framing

_DATAGRAM = 65536
_SHORTEST_WAIT_s = 1e-3


class UdpTransport:
    """Datagrams to one address.

    A lost answer cannot be told from a late one. :meth:`renew` therefore moves to a fresh local
    port after a time-out: whatever still arrives for the old one reaches nobody.
    """

    def __init__(self, host: str, port: int) -> None:
        self._name = f"udp://{host}:{port}"
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        except socket.gaierror as error:
            raise ConnectFailed(
                f"the name '{host}' is not known: {error.strerror}",
                hint="Check the spelling, or use the controller's address (factory: 192.6.94.5).",
            ) from error
        self._family: int = found[0][0]
        self._address: tuple[object, ...] = found[0][4]
        self._closed = False
        self._socket = self._open()

    def _open(self) -> socket.socket:
        link = socket.socket(self._family, socket.SOCK_DGRAM)
        try:
            link.connect(self._address)
        except OSError as error:
            link.close()
            raise ConnectFailed(
                f"no route to {self._name}: {error.strerror}",
                hint="This computer needs an address in the controller's network; check its cable.",
            ) from error
        return link

    @property
    def name(self) -> str:
        """Where it leads."""
        return self._name

    @property
    def framing(self) -> Framing:
        """Always packets."""
        return Framing.PACKETS

    def send(self, data: bytes, deadline: Deadline) -> None:
        """Send one datagram."""
        self._require_open()
        try:
            self._socket.settimeout(max(_SHORTEST_WAIT_s, deadline.remaining_s()))
            self._socket.send(data)
        except TimeoutError as error:
            raise ReplyTimeout(f"{self._name} does not take what is sent") from error
        except OSError as error:
            raise self._lost(error) from error

    def receive(self, deadline: Deadline) -> bytes:
        """The next datagram that is not empty."""
        self._require_open()
        data = b""
        while not data:
            try:
                self._socket.settimeout(max(_SHORTEST_WAIT_s, deadline.remaining_s()))
                data = self._socket.recv(_DATAGRAM)
            except TimeoutError as error:
                raise ReplyTimeout(f"{self._name} did not answer in time") from error
            except OSError as error:
                raise self._lost(error) from error
        return data

    def drain(self) -> bytes:
        """Take what has arrived."""
        self._require_open()
        taken = bytearray()
        self._socket.settimeout(0.0)
        try:
            while True:
                taken += self._socket.recv(_DATAGRAM)
        except (BlockingIOError, TimeoutError):
            return bytes(taken)
        except OSError as error:
            raise self._lost(error) from error

    def renew(self) -> None:
        """Move to a fresh local port."""
        self._require_open()
        old, self._socket = self._socket, self._open()
        old.close()

    def close(self) -> None:
        """Close the socket."""
        self._closed = True
        self._socket.close()

    def _require_open(self) -> None:
        if self._closed:
            raise LinkLost(f"the connection to {self._name} is closed")

    def _lost(self, error: OSError) -> LinkLost:
        self.close()
        return LinkLost(
            f"nobody listens at {self._name}: {error.strerror or error}",
            hint="Check address and port; the packet port of a Turbo PMAC is 1025.",
        )
