"""TCP to the packet port or to an ASCII port; also the socket part of the SSH tunnel."""

import select
import socket
import sys
from collections.abc import Callable
from typing import Protocol

from pmac_comp.base.clock import Deadline, VirtualClock
from pmac_comp.base.errors import ConnectFailed, LinkLost, ReplyTimeout
from pmac_comp.base.units import MS_PER_S
from pmac_comp.machine.transport.base import Framing

RECEIVE_SIZE = 16384
_SHORTEST_WAIT_s = 1e-3
_AT_ONCE = Deadline(VirtualClock(), 0.0)


class SocketLike(Protocol):
    """What a TCP socket and an SSH channel have in common."""

    def settimeout(self, timeout: float | None, /) -> None:
        """Set the time limit of the next calls in s."""
        ...

    def sendall(self, data: bytes, /) -> object:
        """Send everything."""
        ...

    def recv(self, size: int, /) -> bytes:
        """Receive something, nothing at the end of the stream."""
        ...

    def close(self) -> object:
        """Close it."""
        ...


class SocketTransport:
    """Bytes over a connected stream.

    Parameters
    ----------
    link : SocketLike
        Connected socket or channel; closed by :meth:`close`.
    name : str
        Where it leads.
    framing : Framing
        What the bytes are.
    """

    def __init__(self, link: SocketLike, name: str, framing: Framing = Framing.PACKETS) -> None:
        self._link = link
        self._name = name
        self._framing = framing
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
        """Send all bytes before the deadline."""
        self._require_open()
        try:
            self._link.settimeout(max(_SHORTEST_WAIT_s, deadline.remaining_s()))
            self._link.sendall(data)
        except TimeoutError as error:
            raise ReplyTimeout(f"{self._name} does not take what is sent") from error
        except OSError as error:
            raise self._lost(str(error)) from error

    def receive(self, deadline: Deadline) -> bytes:
        """At least one byte before the deadline."""
        self._require_open()
        try:
            self._link.settimeout(max(_SHORTEST_WAIT_s, deadline.remaining_s()))
            data = self._link.recv(RECEIVE_SIZE)
        except TimeoutError as error:
            raise ReplyTimeout(f"{self._name} did not answer in time") from error
        except OSError as error:
            raise self._lost(str(error)) from error
        if not data:
            raise self._lost("it closed the connection")
        return data

    def drain(self) -> bytes:
        """Take what has arrived."""
        taken = bytearray()
        self._require_open()
        self._link.settimeout(0.0)
        try:
            while data := self._link.recv(RECEIVE_SIZE):
                taken += data
        except (BlockingIOError, TimeoutError):
            return bytes(taken)
        except OSError as error:
            raise self._lost(str(error)) from error
        raise self._lost("it closed the connection")

    def renew(self) -> None:
        """Nothing: a stream keeps its order, so a mark in it can be found."""

    def close(self) -> None:
        """Close the stream."""
        self._closed = True
        self._link.close()

    def _require_open(self) -> None:
        if self._closed:
            raise LinkLost(f"the connection to {self._name} is closed")

    def _lost(self, reason: str) -> LinkLost:
        self.close()
        return LinkLost(
            f"the connection to {self._name} was lost: {reason}",
            hint="Check cable and controller, then run the command again.",
        )


def _readiness(link: socket.socket) -> Callable[[float], object]:
    """A function that waits, at most some seconds, until there is something to receive."""
    if sys.platform == "win32":
        return lambda wait_s: select.select([link], [], [], wait_s)[0]
    # Less than half the cost of select, and good for any number of open files.
    poll = select.poll()
    poll.register(link, select.POLLIN)
    return lambda wait_s: poll.poll(wait_s * MS_PER_S)


class TcpTransport(SocketTransport):
    """A TCP connection; the socket never blocks, waiting is done by polling it.

    A socket with a time limit costs two more calls of the system for each exchange.
    """

    def __init__(self, link: socket.socket, name: str, framing: Framing) -> None:
        super().__init__(link, name, framing)
        self._socket = link
        self._socket.settimeout(0.0)
        self._readable = _readiness(link)

    def send(self, data: bytes, deadline: Deadline) -> None:
        """Send all bytes before the deadline."""
        self._require_open()
        rest = memoryview(data)
        while rest:
            try:
                rest = rest[self._socket.send(rest) :]
            except BlockingIOError:
                if not select.select([], [self._socket], [], deadline.remaining_s())[1]:
                    raise ReplyTimeout(f"{self._name} does not take what is sent") from None
            except OSError as error:
                raise self._lost(str(error)) from error

    def receive(self, deadline: Deadline) -> bytes:
        """At least one byte before the deadline."""
        self._require_open()
        while True:
            if not self._readable(deadline.remaining_s()):
                raise ReplyTimeout(f"{self._name} did not answer in time")
            try:
                data = self._socket.recv(RECEIVE_SIZE)
            except BlockingIOError:
                continue
            except OSError as error:
                raise self._lost(str(error)) from error
            if not data:
                raise self._lost("it closed the connection")
            return data

    def drain(self) -> bytes:
        """Take what has arrived."""
        self._require_open()
        taken = b""
        while self._readable(0.0):
            taken += self.receive(_AT_ONCE)
        return taken


def open_tcp(
    host: str, port: int, deadline: Deadline, framing: Framing = Framing.PACKETS
) -> TcpTransport:
    """Connect over TCP.

    Raises
    ------
    ConnectFailed
        If the name is unknown, nobody listens or nobody answers before the deadline.
    """
    name = f"tcp://{host}:{port}"
    try:
        link = socket.create_connection((host, port), max(_SHORTEST_WAIT_s, deadline.remaining_s()))
    except socket.gaierror as error:
        raise ConnectFailed(
            f"the name '{host}' is not known: {error.strerror}",
            hint="Check the spelling, or use the controller's address (factory: 192.6.94.5).",
        ) from error
    except TimeoutError as error:
        raise ConnectFailed(
            f"{name} does not answer",
            hint="Check power, cable and that this machine is on the controller's network.",
        ) from error
    except OSError as error:
        raise ConnectFailed(
            f"no connection to {name}: {error.strerror or error}",
            hint="Check address and port; the packet port of a Turbo PMAC is 1025.",
        ) from error
    # Requests are small and answered one by one: waiting to fill a segment only costs time.
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    return TcpTransport(link, name, framing)
