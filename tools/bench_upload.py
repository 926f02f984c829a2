"""Upload of a 1000-entry table against the same requests replayed bare, and request counts.

Run through ``tools/bench``, or by itself: ``python tools/bench_upload.py [--json FILE]``. Both runs
go over TCP on loopback to the simulated card, turn by turn: once as ``pmac-comp sim`` serves it,
and once in the shortest loop there is (no controller answers as fast). Only journal syncs and the
watch after enabling (its requests are not replayed either) are taken out of the upload's time and
given apart; waits in which motors prove that they stand count.

A controller has a processor of its own, and so has the simulated one in the first columns. In the
others host and card run where the system puts them, mostly on one processor: with each request the
card's program then drives the host's out of the processor's caches, which no real card does.
"""

import argparse
import json
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn
from unittest.mock import patch

from pmac_comp.base.clock import Deadline, SystemClock
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.contents.comp_table import CompTable
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.contents.safety import Limits
from pmac_comp.machine.controller.motors.switching import watch as watch_motors
from pmac_comp.machine.controller.tables import upload
from pmac_comp.machine.controller.tables.upload import upload_tables
from pmac_comp.machine.transport.base import Framing, Transport
from pmac_comp.machine.transport.opening import open_transport
from pmac_comp.machine.wire.ethernet import MAX_REPLY, BufferVerdict, RequestCode
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.dialog.sessions import EthernetSession

N_ENTRIES = 1000
ROUNDS = 40


class CountingClock(SystemClock):
    """Adds up how long was slept."""

    slept_s = 0.0

    def sleep_s(self, duration_s: float) -> None:
        start = time.perf_counter()
        super().sleep_s(duration_s)
        self.slept_s += time.perf_counter() - start


class Server:
    """The card in a process of its own behind a loopback socket.

    Servo cycles run a little with every request.
    """

    def __init__(self) -> None:
        self.bench = load_bench("paper")
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        card = Card(self.bench)
        card.run_cycles(100)
        self.child = os.fork()
        if self.child == 0:
            try:
                self._serve(card)
            finally:
                os._exit(1)  # never on into what the parent does

    def _serve(self, card: Card) -> NoReturn:
        while True:
            peer, _ = self.listener.accept()
            peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            session = EthernetSession(card)
            while data := peer.recv(65536):
                card.run_cycles(2)
                for answer in session.answers(data):
                    peer.sendall(answer)
            session.close()

    def stop(self) -> None:
        os.kill(self.child, signal.SIGTERM)
        os.waitpid(self.child, 0)
        self.listener.close()


class Served:
    """``pmac-comp sim`` at real speed, as a user starts it."""

    def __init__(self) -> None:
        self.bench = load_bench("paper")
        command = [sys.executable, "-m", "pmac_comp", "sim", "--bench", "paper", "--tcp", "0"]
        self.child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        ready = self.child.stdout.readline() if self.child.stdout else ""
        self.port = int(json.loads(ready)["tcp"].rpartition(":")[2])

    def stop(self) -> None:
        with self.child:
            self.child.terminate()


@dataclass
class Exchange:
    """What was sent, and how many bytes came back before the next."""

    sent: bytes
    n_received: int = 0


class Recorder:
    """A transport that writes down what was sent and how much came back."""

    def __init__(self, inner: Transport) -> None:
        self._inner = inner
        self.exchanges: list[Exchange] = []

    @property
    def name(self) -> str:
        return self._inner.name

    @property
    def framing(self) -> Framing:
        return self._inner.framing

    def send(self, data: bytes, deadline: Deadline) -> None:
        self.exchanges.append(Exchange(data))
        self._inner.send(data, deadline)

    def receive(self, deadline: Deadline) -> bytes:
        data = self._inner.receive(deadline)
        if self.exchanges:
            self.exchanges[-1].n_received += len(data)
        return data

    def drain(self) -> bytes:
        return self._inner.drain()

    def renew(self) -> None:
        self._inner.renew()

    def close(self) -> None:
        self._inner.close()


class Watch:
    """Takes the place of the upload's watch after enabling: times it, notes its own requests."""

    def __init__(self, clock: CountingClock, exchanges: Sequence[Exchange] = ()) -> None:
        self._clock, self._exchanges = clock, exchanges
        self.requests = range(0)
        self.spent_s = self.slept_s = 0.0

    def __call__(self, link: Link, context: Context, motors: Sequence[int]) -> None:
        first, slept_s = len(self._exchanges), self._clock.slept_s
        start = time.perf_counter()
        watch_motors(link, context, motors)
        self.requests = range(first, len(self._exchanges))
        self.slept_s = self._clock.slept_s - slept_s
        self.spent_s = time.perf_counter() - start - self.slept_s


def upload_watched(link: Commander, context: Context, wanted: CompTable, watch: Watch) -> None:
    with patch.object(upload, "watch", watch):
        upload_tables(link, context, [wanted])
    if not watch.spent_s:
        raise RuntimeError("the upload watched nothing after enabling, or not where it is timed")


def recorded(port: int, context: Context, wanted: CompTable) -> tuple[list[Exchange], int]:
    """Requests of an upload and the sizes of their answers, without the watch; how many with it.

    It is not timed: writing down what is sent takes time of its own.
    """
    clock = CountingClock()
    recorder = Recorder(open_transport(f"tcp://127.0.0.1:{port}", Deadline.after(clock, 3.0)))
    link = Commander(recorder, clock=clock)
    recorder.exchanges.clear()  # of the greeting
    watch = Watch(clock, recorder.exchanges)
    upload_watched(link, context, wanted, watch)
    n_requests = len(recorder.exchanges)
    bare = [r for n, r in enumerate(recorder.exchanges) if n not in watch.requests]
    link.close()
    return bare, n_requests


def table(amplitude: int) -> CompTable:
    values = [((k * 7919) % (2 * amplitude)) - amplitude for k in range(N_ENTRIES - 1)]
    return CompTable(1, (*values, 0), 1_000_000)


def receive_whole(end: socket.socket, request: bytes, size: int) -> None:
    """Take an answer to its end.

    Text ends with ACK or fills its packet, all else has a known size. The sizes of texts differ by
    a digit from run to run (clocks, positions).
    """
    is_text = request[1] in {RequestCode.GETRESPONSE, RequestCode.GETBUFFER}
    got = bytearray()
    while len(got) < size if not is_text else not (got[-1:] == b"\x06" or len(got) >= MAX_REPLY):
        data = end.recv(65536)
        if not data:
            raise ConnectionError("the card closed the connection during the replay")
        got += data
    if request[1] == RequestCode.WRITEBUFFER and BufferVerdict.decode(bytes(got)).refused:
        raise RuntimeError("the card refused a packet in the replay that it took in the upload")


def replay(port: int, requests: Sequence[Exchange]) -> float:
    """Seconds for the same bytes, each sent when the answer before has come."""
    with socket.create_connection(("127.0.0.1", port)) as end:
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        start = time.perf_counter()
        for request in requests:
            end.sendall(request.sent)
            receive_whole(end, request.sent, request.n_received)
        return time.perf_counter() - start


def carries_table(request: Exchange) -> bool:
    """Whether it takes entries of the table to the card, or lists them."""
    is_listing = b"LIST COMP" in request.sent or request.sent[1] == RequestCode.GETBUFFER
    return is_listing or len(request.sent) > 600


def measure(server: Server | Served) -> dict[str, object]:
    limits = Limits(1e5, 1e3, 5.0, -3e5, 3e5, 1.0, 5e5)
    synced = [0.0]
    fsync = os.fsync

    def timed_fsync(fd: int) -> None:
        start = time.perf_counter()
        fsync(fd)
        synced[0] += time.perf_counter() - start

    rows, aside = [], []
    with tempfile.TemporaryDirectory() as folder, patch.object(os, "fsync", timed_fsync):
        context = Context(LawBlock(), limits, Path(folder), server.bench.servo_period_s)
        # The first finds no table to delete: its packets would be refused when replayed.
        for k in range(1 + ROUNDS):
            requests, n_requests = recorded(server.port, context, table(100 + k))
            if not k:
                continue
            clock, wanted = CountingClock(), table(300 + k)
            link = Commander.open(f"tcp://127.0.0.1:{server.port}", clock=clock)
            watch = Watch(clock)
            synced[0], clock.slept_s = 0.0, 0.0
            start = time.perf_counter()
            upload_watched(link, context, wanted, watch)
            total_s = time.perf_counter() - start
            link.close()
            waited_s = clock.slept_s - watch.slept_s
            upload_s = total_s - synced[0] - watch.slept_s - watch.spent_s
            bare_s = statistics.mean(replay(server.port, requests) for _ in range(2))
            carrying = sum(map(carries_table, requests))
            rows.append((total_s, upload_s, bare_s, n_requests, carrying))
            aside.append((synced[0], waited_s, watch.slept_s + watch.spent_s))
    # Neighbours in time see the same load of the machine: their ratio, and the middle of all.
    ratios = sorted(row[1] / row[2] for row in rows)
    middle = statistics.median_low(ratios)
    last = next(row for row in rows if row[1] / row[2] == middle)
    syncs_s, waits_s, watch_s = aside[rows.index(last)]
    return {
        "entries": N_ENTRIES,
        "ratio": round(middle, 3),
        "ratio_10_to_90_percent": [round(ratios[k], 2) for k in (ROUNDS // 10, -ROUNDS // 10)],
        "ratio_of_least_times": round(min(row[1] for row in rows) / min(row[2] for row in rows), 3),
        "total_s": round(last[0], 4),
        "upload_without_syncs_and_watch_s": round(last[1], 4),
        "bare_s": round(last[2], 4),
        "apart_syncs_s": round(syncs_s, 4),
        "apart_watch_s": round(watch_s, 4),
        "standstill_waits_s": round(waits_s, 4),
        "requests": last[3],
        "requests_beyond_the_table": last[3] - last[4],
    }


@contextmanager
def serving(peer: type[Served | Server], *, apart: bool) -> Iterator[Served | Server]:
    """A card that answers, on a processor of its own or where the system puts it."""
    ours = os.sched_getaffinity(0)
    if apart:
        os.sched_setaffinity(0, {max(ours)})  # what the card starts inherits it
    server = peer()
    try:
        if apart:
            os.sched_setaffinity(0, ours - {max(ours)})
        yield server
    finally:
        server.stop()
        os.sched_setaffinity(0, ours)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    peers: dict[str, type[Served | Server]] = {"pmac-comp sim": Served, "shortest loop": Server}
    found = {}
    for apart in (True, False):
        if apart and len(os.sched_getaffinity(0)) == 1:
            print("only one processor: host and card cannot be kept apart")
            continue
        for name, peer in peers.items():
            with serving(peer, apart=apart) as server:
                found[name if apart else f"{name} *"] = measure(server)
    print(f"{'against':<34}" + "".join(f"{name:<20}" for name in found))
    for key in next(iter(found.values())):
        print(f"{key:<34}" + "".join(f"{column[key]!s:<20}" for column in found.values()))
    print("* host and card where the system puts them, else with a processor each")
    print("aims: ratio at most 1.5, at most 40 requests beyond those that carry the table")
    if options.json:
        options.json.write_text(json.dumps(found, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
