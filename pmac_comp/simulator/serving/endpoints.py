"""Where clients reach the card: streams over TCP, datagrams over UDP, a pseudo terminal.

What lives here: bytes in and out of an event loop, shared time between clients, and the limits that
keep hostile or dead clients from taking memory or time (connections, bytes not yet read, half-sent
requests). What may not: what the bytes mean (``sessions``), and how time passes (``pace``).
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, cast

from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.dialog.sessions import AsciiSession, EthernetSession

MOST_CLIENTS = 32
MOST_UNSENT_BYTES = 1_000_000
HALF_REQUEST_TIMEOUT_s = 30.0
_SLICE_s = 0.005  # longest time one client is served before others have their turn
_PTY_READ = 4096

_SAVE_LOOK_s = 0.005  # between two looks whether a SAVE is over

Session = EthernetSession | AsciiSession


class SaveWatch:
    """Holds an answer back until the SAVE that belongs to it is over (p. 394).

    Parameters
    ----------
    card : Card
        The card.
    """

    def __init__(self, card: Card) -> None:
        self._card = card
        self._known = card.saves
        self._timer: asyncio.TimerHandle | None = None

    def look(self) -> None:
        """A command is about to be carried out."""
        self._known = self._card.saves

    @property
    def has_begun(self) -> bool:
        """Whether one has begun with that command."""
        return self._card.saves != self._known and self._card.is_saving

    def then(self, act: Callable[[], None]) -> None:
        """Act when it is over."""
        if self._card.is_saving:
            loop = asyncio.get_running_loop()
            self._timer = loop.call_later(_SAVE_LOOK_s, self.then, act)
        else:
            self._timer = None
            act()

    def cancel(self) -> None:
        """Nobody waits any more."""
        if self._timer is not None:
            self._timer.cancel()


class StreamClient(asyncio.Protocol):
    """One TCP client of the packet port or of the ASCII port.

    Parameters
    ----------
    card : Card
        The card.
    clients : set of StreamClient
        All that are connected; this one joins and leaves.
    make : callable
        Session that speaks the port's language with the card.
    tell : callable
        Receives why a client was turned away.
    """

    def __init__(
        self,
        card: Card,
        clients: set[StreamClient],
        make: Callable[[Card], Session],
        tell: Callable[[str], None],
    ) -> None:
        self.card = card
        self.clients = clients
        self.make = make
        self.tell = tell
        self.session: Session | None = None
        self.transport: asyncio.Transport | None = None
        self.timer: asyncio.TimerHandle | None = None
        self.late: asyncio.TimerHandle | None = None
        self.work: deque[Iterator[bytes]] = deque()
        self.save = SaveWatch(card)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take the client, or turn it away when there are too many."""
        if not isinstance(transport, asyncio.Transport):
            raise TypeError("stream transport expected")
        self.transport = transport
        if len(self.clients) >= MOST_CLIENTS:
            transport.abort()
            return
        transport.set_write_buffer_limits(high=MOST_UNSENT_BYTES)
        self.session = self.make(self.card)
        self.clients.add(self)

    def data_received(self, data: bytes) -> None:
        """Answer what is complete, after what came before it."""
        if self.session is None:
            return
        self.work.append(self.session.answers(data))
        if len(self.work) == 1:
            self._serve()

    def _serve(self) -> None:
        """Answer for one time slice; the rest waits until others had their turn."""
        transport, loop = self.transport, asyncio.get_running_loop()
        if transport is None or self.session is None:
            return
        until_s = loop.time() + _SLICE_s
        while self.work:
            self.save.look()
            answer = next(self.work[0], None)
            if answer is None:
                self.work.popleft()
                continue
            if self.save.has_begun:
                transport.pause_reading()
                self.save.then(partial(self._send_late, answer))
                return
            delay_s = self.card.link_faults.delay_s
            if delay_s and answer:
                transport.pause_reading()
                self.late = loop.call_later(delay_s, self._send_late, answer)
                return
            transport.write(answer)  # one send per answer: clients read it with one receive
            if transport.get_write_buffer_size() > MOST_UNSENT_BYTES:
                self.work.clear()
                transport.abort()
                return
            if loop.time() > until_s:
                transport.pause_reading()
                loop.call_soon(self._serve)
                return
        transport.resume_reading()
        if self.session.closed:
            if isinstance(self.session, EthernetSession) and self.session.reason:
                self.tell(f"a client's connection was closed: {self.session.reason}")
            transport.close()
        self._watch_half_request()

    def _send_late(self, answer: bytes) -> None:
        """Send an answer that SAVE or a commanded fault held back, then go on."""
        if self.transport is not None:
            self.transport.write(answer)
            self._serve()

    def _watch_half_request(self) -> None:
        if self.timer is not None:
            self.timer.cancel()
            self.timer = None
        if isinstance(self.session, EthernetSession) and self.session.half_received:
            loop = asyncio.get_running_loop()
            self.timer = loop.call_later(HALF_REQUEST_TIMEOUT_s, self._drop)

    def _drop(self) -> None:
        if self.transport is not None:
            self.transport.abort()

    def flush_announcements(self) -> None:
        """Send what programs said meanwhile."""
        if isinstance(self.session, AsciiSession) and self.transport is not None:
            said = self.session.pending()
            if said:
                self.transport.write(said)
            if self.transport.get_write_buffer_size() > MOST_UNSENT_BYTES:
                self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the client."""
        del exc
        self.work.clear()
        self.save.cancel()
        for handle in (self.timer, self.late):
            if handle is not None:
                handle.cancel()
        if self.session is not None:
            self.session.close()
        self.clients.discard(self)


class DatagramPort(asyncio.DatagramProtocol):
    """Packet port over UDP: one request per datagram, addressing kept per peer."""

    def __init__(self, card: Card) -> None:
        self.card = card
        self.transport: asyncio.DatagramTransport | None = None
        self.sessions: dict[Any, EthernetSession] = {}

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the socket."""
        self.transport = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Answer one datagram; what is no request is dropped."""
        session = self.sessions.pop(addr, None) or EthernetSession(self.card)
        save = SaveWatch(self.card)
        answers = session.datagram(data)
        if session.closed:
            return
        self.sessions[addr] = session
        if len(self.sessions) > MOST_CLIENTS:
            oldest = next(iter(self.sessions))
            self.sessions.pop(oldest).close()
        if self.transport is not None:
            wait_s = self.card.link_faults.delay_s
            for answer in answers:
                if save.has_begun:
                    save.then(partial(self.transport.sendto, answer, addr))
                elif wait_s:
                    loop = asyncio.get_running_loop()
                    loop.call_later(wait_s, self.transport.sendto, answer, addr)
                else:
                    self.transport.sendto(answer, addr)


class PseudoTerminal:
    """Serial line of the card on a pseudo terminal."""

    def __init__(self, card: Card) -> None:
        import tty  # Windows has none, and no pseudo terminals

        self.session = AsciiSession(card)
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.path = os.ttyname(self.slave)
        self.unsent = bytearray()
        self._save = SaveWatch(card)
        self._held: bytearray | None = None  # answers from that to SAVE on, while it goes on

    def readable(self) -> None:
        """Take characters from the line."""
        try:
            data = os.read(self.master, _PTY_READ)
        except (BlockingIOError, OSError):
            return
        self._save.look()
        answer = self.session.receive(data)
        if self._held is not None:
            self._held += answer
        elif self._save.has_begun:
            self._held = bytearray(answer)
            self._save.then(self._release)
        else:
            self.send(answer)

    def _release(self) -> None:
        held, self._held = self._held, None
        if held:
            self.send(bytes(held))

    def send(self, data: bytes) -> None:
        """Put bytes on the line; what nobody reads is dropped beyond the limit."""
        self.unsent += data
        del self.unsent[MOST_UNSENT_BYTES:]
        with contextlib.suppress(BlockingIOError, OSError):
            while self.unsent:
                done = os.write(self.master, bytes(self.unsent[:_PTY_READ]))
                del self.unsent[:done]

    def close(self) -> None:
        """Give the line back."""
        self._save.cancel()
        self.session.close()
        os.close(self.master)
        os.close(self.slave)
