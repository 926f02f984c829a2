"""Peers on loopback sockets: a scripted card, and machines that are no card at all."""

import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tests.contract.scripted_card import LinePort, PacketPort, ScriptedCard

Handler = Callable[[socket.socket], None]


class Peer:
    """A listening socket whose connections are handled one after another in a thread."""

    def __init__(self, handler: Handler, kind: socket.SocketKind) -> None:
        self._handler = handler
        self._socket = socket.socket(socket.AF_INET, kind)
        self._socket.bind(("127.0.0.1", 0))
        self.port = self._socket.getsockname()[1]
        self._tcp = kind is socket.SOCK_STREAM
        if self._tcp:
            self._socket.listen()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while True:
            try:
                link = self._socket.accept()[0] if self._tcp else self._socket
            except OSError:
                return
            try:
                self._handler(link)
            except OSError:
                if not self._tcp:
                    return
            finally:
                if self._tcp:
                    link.close()

    def close(self) -> None:
        if self._tcp:
            # shutdown wakes the thread that waits in accept; close alone does not
            self._socket.shutdown(socket.SHUT_RDWR)
        else:
            self._socket.sendto(b"", self._socket.getsockname())
        self._thread.join(5.0)
        self._socket.close()


@contextmanager
def peer(handler: Handler, kind: socket.SocketKind = socket.SOCK_STREAM) -> Iterator[Peer]:
    server = Peer(handler, kind)
    try:
        yield server
    finally:
        server.close()


def card_handler(card: ScriptedCard, port: type[PacketPort] | type[LinePort]) -> Handler:
    """Serve a scripted card on a stream."""

    def handle(link: socket.socket) -> None:
        serve = port(card)
        while data := link.recv(4096):
            answer = serve(data)
            if answer:
                link.sendall(answer)

    return handle


def datagram_handler(card: ScriptedCard, drop: set[int] | None = None) -> Handler:
    """Serve a scripted card on datagrams; those numbered in ``drop`` get no answer."""
    count = 0

    def handle(link: socket.socket) -> None:
        nonlocal count
        serve = PacketPort(card)
        while True:
            data, address = link.recvfrom(4096)
            if not data:
                raise OSError("closed by the test")
            answer = serve(data)
            count += 1
            if answer and count - 1 not in (drop or set()):
                link.sendto(answer, address)

    return handle


def saying(text: bytes, *, record: bytearray | None = None, hold_s: float = 2.0) -> Handler:
    """Say something at once, note what comes, answer nothing."""

    def handle(link: socket.socket) -> None:
        link.sendall(text)
        link.settimeout(hold_s)
        while data := link.recv(4096):
            if record is not None:
                record.extend(data)

    return handle


def echoing(link: socket.socket) -> None:
    """Send everything back."""
    while data := link.recv(4096):
        link.sendall(data)


def resetting(link: socket.socket) -> None:
    """Take a request, then end with RST."""
    link.recv(4096)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
