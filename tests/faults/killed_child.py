"""A child that talks to the simulated card and is killed after a byte; the card survives."""

import os
import signal
import socket
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import NoReturn

from pmac_comp.base.clock import Deadline, SystemClock
from pmac_comp.base.errors import LinkLost, PmacCompError, ReplyTimeout
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.transport.base import Framing
from pmac_comp.machine.transport.tap import FaultyTransport
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.dialog.sessions import EthernetSession


class SkippingClock(SystemClock):
    """Waits are over at once; limits of time count both what passed and what was skipped.

    The card runs its cycles with the questions of the child, not with time.
    """

    def __init__(self) -> None:
        self._skipped_s = 0.0

    def now_s(self) -> float:
        return super().now_s() + self._skipped_s

    def sleep_s(self, duration_s: float) -> None:
        self._skipped_s += max(0.0, duration_s)


class SocketEnd:
    """Transport over one end of a socket pair that kills its own process after a byte."""

    framing = Framing.PACKETS
    name = "pair"

    def __init__(self, end: socket.socket, kill_after: int) -> None:
        self.end = end
        self.left = kill_after

    def send(self, data: bytes, deadline: Deadline) -> None:
        del deadline
        part = data[: max(0, self.left)]
        self.end.sendall(part)
        self.left -= len(data)
        if self.left < 0:
            os.kill(os.getpid(), signal.SIGKILL)

    def receive(self, deadline: Deadline) -> bytes:
        self.end.settimeout(max(1e-3, deadline.remaining_s()))
        try:
            data = self.end.recv(65536)
        except TimeoutError as error:
            raise ReplyTimeout("silence") from error
        if not data:
            raise LinkLost("gone")
        return data

    def drain(self) -> bytes:
        return b""

    def renew(self) -> None:
        raise LinkLost("one end of a pair cannot be renewed")

    def close(self) -> None:
        self.end.close()


def serve_child(
    card: Card,
    work: Callable[[Commander], object],
    kill_after: int,
    *,
    timeout_s: float = 2.0,
    cycles: int = 60,
) -> tuple[int, int]:
    """Fork a child that does its work and is killed after so many bytes. Exit status and bytes.

    The card stays with us: the questions of the child serve the card cycles.
    """
    ours, theirs = socket.socketpair()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            ours.close()
            end = SocketEnd(theirs, kill_after)
            work(Commander(end, clock=SkippingClock(), timeout_s=timeout_s))
            code = 0
        except PmacCompError:
            traceback.print_exc()
        finally:
            os._exit(code)
    theirs.close()
    session = EthernetSession(card)
    received = 0
    while data := ours.recv(65536):
        received += len(data)
        card.run_cycles(cycles)
        for answer in session.answers(data):
            ours.sendall(answer)
    session.close()
    ours.close()
    return os.waitpid(child, 0)[1], received


class Killed(BaseException):
    """Nothing catches it; what a ``finally`` still does reaches neither disk nor card."""


@contextmanager
def dies_after(tap: FaultyTransport, n_bytes: int) -> Iterator[None]:
    """Within ``with``, this program is dead once so many bytes were sent; ``with`` swallows that.

    For long lists: a fork for each case takes ten times as long. What the system does at the end
    of a process, closing files and giving locks back, is left to ``finally``.
    """
    inner, left = tap.send, n_bytes
    names = ("open", "write", "fsync", "replace", "unlink", "ftruncate")
    real = {name: getattr(os, name) for name in names}

    def send(data: bytes, deadline: Deadline) -> None:
        nonlocal left
        part, left = data[: max(0, left)], left - len(data)
        if part:
            inner(part, deadline)
        if left < 0:
            for name in names:
                setattr(os, name, dead)
            tap.send = tap.receive = tap.drain = dead  # type: ignore[method-assign]
            raise Killed

    def dead(*_arguments: object, **_options: object) -> NoReturn:
        raise Killed

    tap.send = send  # type: ignore[method-assign]
    try:
        with suppress(Killed):
            yield
    finally:
        for name, function in real.items():
            setattr(os, name, function)
