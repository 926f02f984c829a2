"""Upload of a 1000-entry table against the same requests replayed bare, and request counts.

Run through ``tools/bench``, or by itself: ``python tools/bench_upload.py [--json FILE]``. Both runs
go over TCP on loopback to the simulated card, turn by turn: once as ``pmac-comp sim`` serves it,
and once in the shortest loop there is (no controller answers as fast). Only journal syncs and the
watch after enabling (its requests are not replayed either) are taken out of the upload's time and
given apart; waits in which motors prove that they stand count.
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
from pathlib import Path

from pmac_comp.base.clock import SystemClock
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller import upload
from pmac_comp.machine.controller.comp_table import CompTable
from pmac_comp.machine.controller.context import Context
from pmac_comp.machine.controller.law_bank import LawBlock
from pmac_comp.machine.controller.safety import Limits
from pmac_comp.machine.controller.upload import upload_tables
from pmac_comp.machine.wire.ethernet import MAX_REPLY, BufferVerdict, RequestCode
from pmac_comp.simulator.card import Card
from pmac_comp.simulator.sessions import EthernetSession

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
            self._serve(card)

    def _serve(self, card: Card) -> None:
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


class Served:
    """``pmac-comp sim`` at real speed, as a user starts it."""

    def __init__(self) -> None:
        self.bench = load_bench("paper")
        command = [sys.executable, "-m", "pmac_comp", "sim", "--bench", "paper", "--tcp", "0"]
        self.child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        ready = self.child.stdout.readline()  # type: ignore[union-attr]
        self.port = int(json.loads(ready)["tcp"].rpartition(":")[2])

    def stop(self) -> None:
        self.child.terminate()
        self.child.wait()


class Recorder:
    """A transport that writes down what was sent and how much came back."""

    def __init__(self, inner: object) -> None:
        self._inner = inner
        self.requests: list[list[object]] = []

    def __getattr__(self, name: str) -> object:
        return getattr(self._inner, name)

    def send(self, data: bytes, deadline: object) -> None:
        self.requests.append([data, 0])
        self._inner.send(data, deadline)  # type: ignore[attr-defined]

    def receive(self, deadline: object) -> bytes:
        data: bytes = self._inner.receive(deadline)  # type: ignore[attr-defined]
        if self.requests:
            self.requests[-1][1] += len(data)  # type: ignore[operator]
        return data


class Watch:
    """Times the watch after enabling and notes which requests are its own."""

    def __init__(self) -> None:
        self._watch = upload.watch
        upload.watch = self.run  # type: ignore[assignment]
        self.requests = range(0)
        self.recorded: list[list[object]] = []
        self.spent_s = self.slept_s = 0.0

    def listen(self, clock: CountingClock, recorder: Recorder | None = None) -> None:
        self.clock, self.recorded = clock, [] if recorder is None else recorder.requests

    def run(self, *arguments: object) -> None:
        first, slept_s, start = len(self.recorded), self.clock.slept_s, time.perf_counter()
        self._watch(*arguments)  # type: ignore[arg-type]
        self.requests = range(first, len(self.recorded))
        self.slept_s = self.clock.slept_s - slept_s
        self.spent_s = time.perf_counter() - start - self.slept_s


def recorded(
    port: int, context: Context, watch: Watch, wanted: CompTable
) -> tuple[list[list[object]], int]:
    """Requests of an upload and the sizes of their answers, without the watch; how many with it.

    It is not timed: writing down what is sent takes time of its own.
    """
    clock = CountingClock()
    link = Commander.open(f"tcp://127.0.0.1:{port}", clock=clock)
    recorder = Recorder(link._link.transport)  # noqa: SLF001 - the bench listens in
    link._link.transport = recorder  # type: ignore[assignment]  # noqa: SLF001
    watch.listen(clock, recorder)
    upload_tables(link, context, [wanted])
    requests = [r for n, r in enumerate(recorder.requests) if n not in watch.requests]
    link.close()
    return requests, len(recorder.requests)


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


def replay(port: int, requests: list[list[object]]) -> float:
    """Seconds for the same bytes, each sent when the answer before has come."""
    with socket.create_connection(("127.0.0.1", port)) as end:
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        start = time.perf_counter()
        for data, size in requests:
            end.sendall(data)  # type: ignore[arg-type]
            receive_whole(end, bytes(data), int(size))  # type: ignore[call-overload]
        return time.perf_counter() - start


def measure(server: Server | Served) -> dict[str, object]:
    limits = Limits(1e5, 1e3, 5.0, -3e5, 3e5, 1.0)
    synced = [0.0]
    fsync = os.fsync

    def timed_fsync(fd: int) -> None:
        start = time.perf_counter()
        fsync(fd)
        synced[0] += time.perf_counter() - start

    os.fsync = timed_fsync
    watch = Watch()
    rows, aside = [], []
    with tempfile.TemporaryDirectory() as folder:
        context = Context(LawBlock(), limits, Path(folder), server.bench.servo_period_s)
        # The first finds no table to delete: its packets would be refused when replayed.
        for k in range(1 + ROUNDS):
            requests, n_requests = recorded(server.port, context, watch, table(100 + k))
            if not k:
                continue
            clock, wanted = CountingClock(), table(300 + k)
            link = Commander.open(f"tcp://127.0.0.1:{server.port}", clock=clock)
            watch.listen(clock)
            synced[0], clock.slept_s = 0.0, 0.0
            start = time.perf_counter()
            upload_tables(link, context, [wanted])
            total_s = time.perf_counter() - start
            link.close()
            waited_s = clock.slept_s - watch.slept_s
            upload_s = total_s - synced[0] - watch.slept_s - watch.spent_s
            bare_s = statistics.mean(replay(server.port, requests) for _ in range(2))
            carrying = (
                sum(
                    len(bytes(data)) > 600 or b"LIST COMP" in bytes(data)  # type: ignore[call-overload]
                    for data, _ in requests
                )
                + sum(data[1:2] == b"\xc5" for data, _ in requests)
            )  # type: ignore[index]
            rows.append((total_s, upload_s, bare_s, n_requests, carrying))
            aside.append((synced[0], waited_s, watch.slept_s + watch.spent_s))
    os.fsync = fsync
    server.stop()
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    peers = {"pmac-comp sim": Served, "shortest loop": Server}
    found = {name: measure(peer()) for name, peer in peers.items()}
    print(f"{'against':<34}" + "".join(f"{name:<20}" for name in peers))
    for key in next(iter(found.values())):
        print(f"{key:<34}" + "".join(f"{column[key]!s:<20}" for column in found.values()))
    print("aims: ratio at most 1.5, at most 40 requests beyond those that carry the table")
    if options.json:
        options.json.write_text(json.dumps(found, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
