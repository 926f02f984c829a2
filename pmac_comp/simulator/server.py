"""Servers of the simulated card: packet port over TCP and UDP, ASCII port, pseudo terminal.

One event loop serves all clients and lets simulated time pass between their requests, so a request
never meets a half-finished servo cycle. Limits per client and per server keep hostile or dead
clients from taking memory or time (connections, bytes not yet read, half-sent requests).

``serve`` runs until it is stopped; ``running_server`` runs it in a thread for as long as a ``with``
block lasts.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from pmac_comp.base.errors import ConfigError, ConnectFailed
from pmac_comp.simulator.card import Card
from pmac_comp.simulator.sessions import AsciiSession, EthernetSession

MOST_CLIENTS = 32
MOST_UNSENT_BYTES = 1_000_000
HALF_REQUEST_TIMEOUT_s = 30.0
_TICK_s = 0.005
_SLICE_s = 0.005  # longest time one client is served before others have their turn
_MAX_CHUNK_CYCLES = 300
_LONGEST_CHUNK_s = 0.005  # of wall time between two looks at the clients
_LONGEST_LAG_s = 0.25
_IDLE_s = 0.0002  # between two looks at what the host grants
_PTY_READ = 4096

_TOLD_LAG_s = 1.0  # time that slipped before a person is told
_MOST_NOTICES = 100

Session = EthernetSession | AsciiSession


def _to_stderr(text: str) -> None:
    print(f"pmac-comp sim: {text}", file=sys.stderr, flush=True)


def _too_slow(factor: float, lost: int, start: int, now: int) -> str:
    """What is said when time falls behind; `start` has been moved by the lost cycles."""
    done = now - start - lost
    share = done / (done + lost)
    return (
        f"simulated time falls behind: {share * factor:.2g} of real time instead of {factor:g}. "
        "A plant written in Python may take longer than a servo period; see tools/bench simulator."
    )


class HostPace:
    """Servo cycles that the host in the same process has granted; the card never runs ahead.

    A host that shares its interpreter with the card could otherwise be starved by it for longer
    than the gather ring holds.
    """

    def __init__(self) -> None:
        self._granted = 0
        self._lock = threading.Lock()

    def grant(self, cycles: int) -> None:
        """Let the card run so many cycles more."""
        with self._lock:
            self._granted += cycles

    def take(self, most: int) -> int:
        """Cycles to run now, at most ``most``."""
        with self._lock:
            taken = min(self._granted, most)
            self._granted -= taken
            return taken


@dataclass(frozen=True)
class ServeOptions:
    """What to serve; see ``pmac-comp sim --help``.

    Parameters
    ----------
    tcp, udp, ascii_port : int or None
        Port numbers, 0 for any free one, None for none.
    pty : bool
        Serial line on a pseudo terminal.
    host : str
        Address to listen on.
    speed : str
        ``real``, a factor, or ``max``; faster than real time the card waits for a host that empties
        the gather ring (`ring_hold`).
    force : Path or None
        CSV file with ``time_s,force_N``.
    pace : HostPace or None
        Grants of a host in this process; then ``speed`` has no meaning.
    """

    tcp: int | None = None
    udp: int | None = None
    ascii_port: int | None = None
    pty: bool = False
    host: str = "127.0.0.1"
    speed: str = "real"
    force: Path | None = None
    pace: HostPace | None = None

    @property
    def factor(self) -> float:
        """Multiple of real time, infinite for ``max``."""
        if self.speed == "real":
            return 1.0
        if self.speed == "max":
            return float("inf")
        try:
            factor = float(self.speed)
        except ValueError as error:
            raise ConfigError(f"--speed takes real, max or a factor, not '{self.speed}'") from error
        if not factor > 0.0:
            raise ConfigError(f"--speed must be above zero, not '{self.speed}'")
        return factor


class _StreamClient(asyncio.Protocol):
    """One TCP client of the packet port or of the ASCII port."""

    def __init__(self, server: SimulatorServer, make: Callable[[Card], Session]) -> None:
        self.server = server
        self.make = make
        self.session: Session | None = None
        self.transport: asyncio.Transport | None = None
        self.timer: asyncio.TimerHandle | None = None
        self.late: asyncio.TimerHandle | None = None
        self.work: deque[Iterator[bytes]] = deque()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take the client, or turn it away when there are too many."""
        if not isinstance(transport, asyncio.Transport):
            raise TypeError("stream transport expected")
        self.transport = transport
        if len(self.server.clients) >= MOST_CLIENTS:
            transport.abort()
            return
        transport.set_write_buffer_limits(high=MOST_UNSENT_BYTES)
        self.session = self.make(self.server.card)
        self.server.clients.add(self)

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
            answer = next(self.work[0], None)
            if answer is None:
                self.work.popleft()
                continue
            delay_s = self.server.card.link_faults.delay_s
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
                self.server.tell(f"a client's connection was closed: {self.session.reason}")
            transport.close()
        self._watch_half_request()

    def _send_late(self, answer: bytes) -> None:
        """Send an answer that a commanded fault held back, then go on."""
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

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the client."""
        del exc
        self.work.clear()
        for handle in (self.timer, self.late):
            if handle is not None:
                handle.cancel()
        if self.session is not None:
            self.session.close()
        self.server.clients.discard(self)


class _DatagramPort(asyncio.DatagramProtocol):
    """Packet port over UDP: one request per datagram, addressing kept per peer."""

    def __init__(self, server: SimulatorServer) -> None:
        self.server = server
        self.transport: asyncio.DatagramTransport | None = None
        self.sessions: dict[Any, EthernetSession] = {}

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the socket."""
        self.transport = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Answer one datagram; what is no request is dropped."""
        session = self.sessions.pop(addr, None) or EthernetSession(self.server.card)
        answers = session.datagram(data)
        if session.closed:
            return
        self.sessions[addr] = session
        if len(self.sessions) > MOST_CLIENTS:
            oldest = next(iter(self.sessions))
            self.sessions.pop(oldest).close()
        if self.transport is not None:
            wait_s = self.server.card.link_faults.delay_s
            for answer in answers:
                if wait_s:
                    loop = asyncio.get_running_loop()
                    loop.call_later(wait_s, self.transport.sendto, answer, addr)
                else:
                    self.transport.sendto(answer, addr)


class _PseudoTerminal:
    """Serial line of the card on a pseudo terminal."""

    def __init__(self, card: Card) -> None:
        self.session = AsciiSession(card)
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.path = os.ttyname(self.slave)
        self.unsent = bytearray()

    def readable(self) -> None:
        """Take characters from the line."""
        try:
            data = os.read(self.master, _PTY_READ)
        except (BlockingIOError, OSError):
            return
        self.send(self.session.receive(data))

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
        self.session.close()
        os.close(self.master)
        os.close(self.slave)


@dataclass
class SimulatorServer:
    """All ports of one card.

    Parameters
    ----------
    card : Card
        The card.
    options : ServeOptions
        What to serve.
    notice : callable
        Receives what a person at the server should know, a line at a time.
    """

    card: Card
    options: ServeOptions
    clients: set[_StreamClient] = field(default_factory=set)
    endpoints: dict[str, str] = field(default_factory=dict)
    notice: Callable[[str], None] = _to_stderr
    _chunk_cycles: int = field(default=_MAX_CHUNK_CYCLES, init=False)
    _notices: int = field(default=0, init=False)

    async def run(self, ready: Callable[[dict[str, str]], None], stop: asyncio.Event) -> None:
        """Serve until `stop` is set; `ready` is called with the endpoints once they listen."""
        loop = asyncio.get_running_loop()
        self._schedule_force()
        warm_up(self.card)
        async with contextlib.AsyncExitStack() as stack:
            try:
                await self._open(loop, stack)
            except OSError as error:
                raise ConnectFailed(
                    f"cannot listen on {self.options.host}: {error}",
                    hint="Choose another port, or 0 for any free one.",
                ) from error
            ready(self.endpoints)
            pacer = asyncio.create_task(self._pass_time())
            stopper = asyncio.create_task(stop.wait())
            done, _ = await asyncio.wait({pacer, stopper}, return_when=asyncio.FIRST_COMPLETED)
            pacer.cancel()
            stopper.cancel()
            for client in list(self.clients):
                if client.transport is not None:
                    client.transport.abort()
            if pacer in done:
                pacer.result()

    async def _open(
        self, loop: asyncio.AbstractEventLoop, stack: contextlib.AsyncExitStack
    ) -> None:
        options, host = self.options, self.options.host
        if options.tcp is not None:
            port = await self._listen(loop, stack, options.tcp, EthernetSession)
            self.endpoints["tcp"] = f"tcp://{host}:{port}"
        if options.ascii_port is not None:
            port = await self._listen(loop, stack, options.ascii_port, AsciiSession)
            self.endpoints["ascii"] = f"tcp://{host}:{port}?dialog=ascii"
        if options.udp is not None:
            transport, _ = await loop.create_datagram_endpoint(
                lambda: _DatagramPort(self), local_addr=(host, options.udp)
            )
            stack.callback(transport.close)
            port = transport.get_extra_info("sockname")[1]
            self.endpoints["udp"] = f"udp://{host}:{port}"
        if options.pty:
            terminal = _PseudoTerminal(self.card)
            loop.add_reader(terminal.master, terminal.readable)
            stack.callback(terminal.close)
            stack.callback(loop.remove_reader, terminal.master)
            self.terminal = terminal
            self.endpoints["pty"] = f"serial://{terminal.path}"

    async def _listen(
        self,
        loop: asyncio.AbstractEventLoop,
        stack: contextlib.AsyncExitStack,
        port: int,
        make: Callable[[Card], Session],
    ) -> int:
        server = await loop.create_server(
            lambda: _StreamClient(self, make), self.options.host, port, backlog=128
        )
        stack.callback(server.close)
        return int(server.sockets[0].getsockname()[1])

    def _schedule_force(self) -> None:
        if self.options.force is None:
            return
        try:
            table = np.genfromtxt(self.options.force, delimiter=",", names=True)
            time_s, force_N = np.atleast_1d(table["time_s"]), np.atleast_1d(table["force_N"])
        except (OSError, ValueError, IndexError) as error:
            raise ConfigError(
                f"The force schedule {self.options.force} needs columns time_s,force_N: {error}."
            ) from error
        if not (np.all(np.isfinite(time_s)) and np.all(np.isfinite(force_N))):
            raise ConfigError(f"The force schedule {self.options.force} holds values not finite.")
        self.card.servo.set_force_schedule(time_s, force_N)

    # --- time -----------------------------------------------------------------------------------

    async def _follow(self, pace: HostPace) -> None:
        while True:
            cycles = pace.take(self._chunk_cycles)
            if cycles:
                self._run_chunk(cycles)
            self._announce()
            await asyncio.sleep(0 if cycles else _IDLE_s)

    async def _pass_time(self) -> None:
        if self.options.pace is not None:
            await self._follow(self.options.pace)
        factor = self.options.factor
        if factor == float("inf"):
            while True:
                cycles = min(_MAX_CHUNK_CYCLES, self._allowed())
                if cycles:
                    self._run_chunk(cycles)
                self._announce()
                await asyncio.sleep(0 if cycles else _IDLE_s)
        loop = asyncio.get_running_loop()
        period_s = self.card.bench.servo_period_s / factor
        start_s, start_cycles = loop.time(), self.card.cycles
        lost = 0
        while True:
            due = int((loop.time() - start_s) / period_s)
            behind = due - (self.card.cycles - start_cycles)
            if behind * period_s > _LONGEST_LAG_s:
                # The machine cannot keep up: time slips rather than clients starve.
                slipped = behind - int(_LONGEST_LAG_s / period_s)
                start_cycles -= slipped
                behind -= slipped
                if lost * period_s < _TOLD_LAG_s <= (lost + slipped) * period_s:
                    self.tell(_too_slow(factor, lost + slipped, start_cycles, self.card.cycles))
                lost += slipped
            if factor > 1.0 and behind > (allowed := self._allowed()):
                start_cycles -= behind - allowed
                behind = allowed
            if behind > 0:
                self._run_chunk(behind)
            self._announce()
            await asyncio.sleep(0 if behind > self._chunk_cycles else _TICK_s)

    def tell(self, text: str) -> None:
        """Tell the person at the server; what comes too often is told no more."""
        self._notices += 1
        if self._notices <= _MOST_NOTICES:
            self.notice(text)

    def _allowed(self) -> int:
        """Cycles that a host which empties the gather ring can follow."""
        return self.card.ring_hold.allowance(self.card.cycles, time.perf_counter())

    def _run_chunk(self, wanted: int) -> None:
        """Run at most as many cycles as keep clients waiting for ``_LONGEST_CHUNK_s``.

        A plant written in Python may take 0.1 ms a cycle, the compiled one 1 us: the number of
        cycles in a chunk follows what the last one took.
        """
        cycles = min(wanted, self._chunk_cycles)
        start_s = time.perf_counter()
        self.card.run_cycles(cycles)
        per_cycle_s = (time.perf_counter() - start_s) / cycles
        affordable = int(_LONGEST_CHUNK_s / per_cycle_s)
        self._chunk_cycles = max(1, min(_MAX_CHUNK_CYCLES, affordable, 2 * self._chunk_cycles))

    def _announce(self) -> None:
        for client in self.clients:
            client.flush_announcements()
        terminal = getattr(self, "terminal", None)
        if terminal is not None:
            terminal.send(terminal.session.pending())


def warm_up(card: Card) -> None:
    """Compile what the first cycles need, so that the first client does not wait for it."""
    card.run_cycles(2)


def serve(
    card: Card,
    options: ServeOptions,
    *,
    ready: Callable[[str], None] = print,
) -> None:
    """Serve a card until interrupted or terminated.

    Parameters
    ----------
    card : Card
        The card.
    options : ServeOptions
        What to serve.
    ready : callable
        Receives one line of JSON with the endpoints once all of them listen.

    Raises
    ------
    ConnectFailed
        A port cannot be opened.
    """

    async def main() -> None:
        stop = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, stop.set)

        def announce(endpoints: dict[str, str]) -> None:
            told = {"ready": True, "speed": options.speed, "faults": card.faults, **endpoints}
            ready(json.dumps(told))

        await SimulatorServer(card, options).run(announce, stop)

    asyncio.run(main())


@contextlib.contextmanager
def running_server(card: Card, options: ServeOptions) -> Iterator[dict[str, str]]:
    """Serve a card in a thread; gives the endpoints by kind."""
    listening = threading.Event()
    endpoints: dict[str, str] = {}
    failure: list[BaseException] = []
    control: dict[str, Any] = {}

    def announce(found: dict[str, str]) -> None:
        endpoints.update(found)
        listening.set()

    async def main() -> None:
        control["stop"] = asyncio.Event()
        control["loop"] = asyncio.get_running_loop()
        await SimulatorServer(card, options).run(announce, control["stop"])

    def body() -> None:
        try:
            asyncio.run(main())
        except (ConnectFailed, ConfigError) as error:
            failure.append(error)
        finally:
            listening.set()

    thread = threading.Thread(target=body, name="simulated card", daemon=True)
    thread.start()
    listening.wait()
    if failure:
        raise failure[0]
    try:
        yield endpoints
    finally:
        if thread.is_alive():
            control["loop"].call_soon_threadsafe(control["stop"].set)
        thread.join(timeout=10.0)
