"""The server of the simulated card: what it serves, and how it starts and stops.

One event loop serves all clients (``endpoints``) and lets simulated time pass between their
requests (``pace``), so a request never meets a half-finished servo cycle.

``serve`` runs until it is stopped; ``running_server`` runs it in a thread for as long as a ``with``
block lasts.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ConfigError, ConnectFailed
from pmac_comp.base.reading import why
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.dialog.sessions import AsciiSession, EthernetSession
from pmac_comp.simulator.serving.endpoints import (
    DatagramPort,
    PseudoTerminal,
    Session,
    StreamClient,
)
from pmac_comp.simulator.serving.pace import AS_FAST_AS_FOLLOWED, HostPace, Pace

_MOST_NOTICES = 100


def _to_stderr(text: str) -> None:
    print(f"pmac-comp sim: {text}", file=sys.stderr, flush=True)


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
        """Multiple of real time, infinite for ``max``; ConfigError for any other word."""
        if self.speed == "real":
            return 1.0
        if self.speed == "max":
            return AS_FAST_AS_FOLLOWED
        try:
            factor = float(self.speed)
        except ValueError:
            factor = 0.0
        if not factor > 0.0:
            raise ConfigError(
                f"'{self.speed}' is no speed of the simulated card.",
                code="PC-SIM-002",
                hint="--speed takes real, max, or a factor above zero such as 10.",
            )
        return factor


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
    clients: set[StreamClient] = field(default_factory=set)
    endpoints: dict[str, str] = field(default_factory=dict)
    notice: Callable[[str], None] = _to_stderr
    _terminal: PseudoTerminal | None = field(default=None, init=False)
    _notices: int = field(default=0, init=False)

    async def run(self, ready: Callable[[dict[str, str]], None], stop: asyncio.Event) -> None:
        """Serve until `stop` is set; `ready` is called with the endpoints once they listen."""
        loop = asyncio.get_running_loop()
        options = self.options
        pace = Pace(
            self.card, options.factor, options.pace, after_chunk=self._announce, tell=self.tell
        )
        self._schedule_force()
        # A host in this process waits for the answer while it grants no time.
        self.card.saves_aside = options.pace is None
        warm_up(self.card)
        async with contextlib.AsyncExitStack() as stack:
            try:
                await self._open(loop, stack)
            except OSError as error:
                raise ConnectFailed(
                    f"The simulated card cannot listen on {options.host}: {why(error)}.",
                    code="PC-SIM-003",
                    hint="Choose another port, or 0 for any free one.",
                ) from error
            ready(self.endpoints)
            pacer = asyncio.create_task(pace.run())
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
                lambda: DatagramPort(self.card), local_addr=(host, options.udp)
            )
            stack.callback(transport.close)
            port = transport.get_extra_info("sockname")[1]
            self.endpoints["udp"] = f"udp://{host}:{port}"
        if options.pty:
            terminal = self._terminal = PseudoTerminal(self.card)
            loop.add_reader(terminal.master, terminal.readable)
            stack.callback(terminal.close)
            stack.callback(loop.remove_reader, terminal.master)
            self.endpoints["pty"] = f"serial://{terminal.path}"

    async def _listen(
        self,
        loop: asyncio.AbstractEventLoop,
        stack: contextlib.AsyncExitStack,
        port: int,
        make: Callable[[Card], Session],
    ) -> int:
        server = await loop.create_server(
            lambda: StreamClient(self.card, self.clients, make, self.tell),
            self.options.host,
            port,
            backlog=128,
        )
        stack.callback(server.close)
        return int(server.sockets[0].getsockname()[1])

    def _schedule_force(self) -> None:
        if self.options.force is not None:
            self.card.servo.set_force_schedule(*_force_schedule(self.options.force))

    def tell(self, text: str) -> None:
        """Tell the person at the server; what comes too often is told no more."""
        self._notices += 1
        if self._notices <= _MOST_NOTICES:
            self.notice(text)

    def _announce(self) -> None:
        for client in self.clients:
            client.flush_announcements()
        if self._terminal is not None:
            self._terminal.send(self._terminal.session.pending())


def check_options(options: ServeOptions) -> None:
    """Refuse a speed, a line or a force schedule that cannot be served; raises ConfigError."""
    _ = options.factor
    if options.pty and not hasattr(os, "openpty"):
        raise ConfigError(
            "This system has no pseudo terminals.",
            code="PC-SIM-007",
            hint="Serve --tcp, --udp or --ascii-port instead.",
        )
    if options.force is not None:
        _force_schedule(options.force)


def _force_schedule(path: Path) -> tuple[FloatArray, FloatArray]:
    """Times in s and forces in N of a CSV file; ConfigError where it is none."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        table = np.genfromtxt(lines or ["empty"], delimiter=",", names=True)
        time_s, force_N = np.atleast_1d(table["time_s"]), np.atleast_1d(table["force_N"])
    except (OSError, ValueError, IndexError) as error:
        said = why(error) if isinstance(error, (OSError, UnicodeError)) else "it has other columns"
        raise ConfigError(
            f"The force schedule {path} cannot be used: {said}.",
            code="PC-SIM-004",
            hint="Give a CSV file with the columns time_s,force_N.",
        ) from error
    if not (np.all(np.isfinite(time_s)) and np.all(np.isfinite(force_N))):
        raise ConfigError(
            f"The force schedule {path} holds values that are not finite.",
            code="PC-SIM-005",
            hint="Each row needs a time in s and a force in N.",
        )
    return time_s, force_N


def warm_up(card: Card) -> None:
    """Compile what the first cycles need, so that the first client does not wait for it."""
    card.run_cycles(2)


def serve(
    card: Card,
    options: ServeOptions,
    *,
    ready: Callable[[dict[str, Any]], None],
) -> None:
    """Serve a card until interrupted or terminated.

    Parameters
    ----------
    card : Card
        The card.
    options : ServeOptions
        What to serve.
    ready : callable
        Receives the endpoints once all of them listen.

    Raises
    ------
    ConnectFailed
        A port cannot be opened.
    """

    async def main() -> None:
        stop = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            with contextlib.suppress(NotImplementedError):  # Windows: Ctrl-C ends the loop itself
                loop.add_signal_handler(number, stop.set)

        def announce(endpoints: dict[str, str]) -> None:
            ready({"ready": True, "speed": options.speed, "faults": card.faults, **endpoints})

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
