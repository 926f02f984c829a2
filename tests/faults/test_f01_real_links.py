"""F01 over real links: random cuts of an upload over TCP, a pty and SSH, then recovery."""

import os
import pty
import socket
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import paramiko
import pytest

from pmac_comp.base.clock import Deadline, SystemClock
from pmac_comp.base.errors import ControllerState, LinkError, PmacCompError
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.tables import upload
from pmac_comp.machine.controller.whole import recovery, waiting
from pmac_comp.machine.transport.opening import open_transport
from pmac_comp.machine.transport.tap import Fault, FaultKind, FaultyTransport, Way
from pmac_comp.machine.transport.url import parse_url
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.dialog.sessions import AsciiSession, EthernetSession
from tests.faults.openssh import trusting
from tests.faults.socket_peers import peer
from tests.faults.ssh_gateway import SECRET, USER, Gateway
from tests.faults.upload_bench import new_table, old_table
from tests.unit.machine_controller.card_bench import CardBench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
N = 64
CYCLES = 50  # servo cycles that the card runs with every piece it receives


def serve_packets(card: Card, link: socket.socket) -> None:
    session = EthernetSession(card)
    try:
        while data := link.recv(65536):
            card.run_cycles(CYCLES)
            for answer in session.answers(data):
                link.sendall(answer)
    finally:
        session.close()


def serve_lines(card: Card, master: int) -> None:
    session = AsciiSession(card)
    with suppress(OSError):
        while data := os.read(master, 4096):
            card.run_cycles(CYCLES)
            os.write(master, session.receive(data))
    session.close()


@contextmanager
def on_tcp(card: Card, _folder: Path) -> Iterator[str]:
    with peer(lambda link: serve_packets(card, link)) as server:
        yield f"tcp://127.0.0.1:{server.port}"


@contextmanager
def on_pty(card: Card, _folder: Path) -> Iterator[str]:
    master, slave = pty.openpty()
    tty.setraw(slave)
    thread = threading.Thread(target=serve_lines, args=(card, master), daemon=True)
    thread.start()
    try:
        yield f"serial://{os.ttyname(slave)}?baud=115200"
    finally:
        os.close(slave)
        os.close(master)
        thread.join(2.0)


@contextmanager
def on_ssh(card: Card, folder: Path) -> Iterator[str]:
    with peer(lambda link: serve_packets(card, link)) as server:
        front = Gateway(paramiko.ECDSAKey.generate(), reachable={("127.0.0.1", server.port)})
        known = trusting(folder, front.known_hosts_line)
        options = f"known_hosts={known}&password_env=BENCH_SECRET"
        try:
            yield f"ssh://{USER}@127.0.0.1:{front.port}/127.0.0.1:{server.port}?{options}"
        finally:
            front.close()


LINKS = {"tcp": on_tcp, "pty": on_pty, "ssh": on_ssh}


def connect(url: str) -> tuple[Commander, FaultyTransport]:
    clock = SystemClock()
    tap = FaultyTransport(open_transport(parse_url(url), Deadline.after(clock, 15.0)))
    return Commander(tap, clock=clock, timeout_s=5.0), tap


def state_of(bench: CardBench) -> ControllerState:
    """Verdict by the card's own memory."""
    entries = tuple(bench.values("COMP", 1) or ())
    if not bench.i51:
        return ControllerState.DISABLED
    if entries == old_table(N).entries:
        return ControllerState.OLD
    assert entries == new_table(N).entries, "a table acts that nobody meant"
    return ControllerState.NEW


@pytest.fixture
def prepared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[CardBench, Path]:
    """A card with the old table, and a folder for the keys of an SSH server before it."""
    monkeypatch.setenv("BENCH_SECRET", SECRET)
    store, keys = tmp_path / "store", tmp_path / "keys"
    store.mkdir()
    keys.mkdir()
    bench = CardBench(store)
    upload.upload_tables(bench.link, bench.context, [old_table(N)])
    return bench, keys


@pytest.mark.parametrize("kind", LINKS)
def test_f01_random_cuts_over_real_links(
    *,
    kind: str,
    prepared: tuple[CardBench, Path],
    exhaustive: bool,
    count_runs: Count,
) -> None:
    bench, keys = prepared
    rng = np.random.default_rng(1)
    runs = 200 if exhaustive else 2
    seen = set()
    with LINKS[kind](bench.card, keys) as url:
        for k in range(runs):
            link, tap = connect(url)
            way = Way.SEND if k % 2 else Way.RECEIVE
            start = tap.sent if way is Way.SEND else tap.received
            tap.schedule([Fault(FaultKind.CUT, way, start + int(rng.integers(1, 1500)))])
            goal = old_table(N) if state_of(bench) is ControllerState.NEW else new_table(N)
            with suppress(PmacCompError):
                upload.upload_tables(link, bench.context, [goal])
            with suppress(PmacCompError):
                link.close()
            link, _ = connect(url)
            result = recovery.recover(link, bench.context, resume=bool(k % 2))
            assert result.verdict is not ControllerState.DISABLED
            link.close()
            seen.add(state_of(bench))
            assert seen <= {ControllerState.OLD, ControllerState.NEW}
    count_runs(runs)


class HopCut:
    """The hop behind the SSH gateway ends in the read-back, after so many bytes of its answers."""

    def __init__(self, card: Card, after: int) -> None:
        self.card, self.left = card, after
        self.reading_back = self.done = False

    def serve(self, link: socket.socket) -> None:
        session = EthernetSession(self.card)
        written = False
        try:
            while data := link.recv(65536):
                written |= len(data) > 300
                self.reading_back |= written and b"LIST COMP" in data
                self.card.run_cycles(CYCLES)
                for answer in session.answers(data):
                    link.sendall(self._passed(answer))
                if self.left < 0 and not self.done:
                    self.done = True
                    break
        finally:
            session.close()

    def _passed(self, answer: bytes) -> bytes:
        if not self.reading_back or self.done:
            return answer
        passed, self.left = answer[: max(0, self.left)], self.left - len(answer)
        return passed


@pytest.mark.parametrize("resume", [True, False])
def test_f01_hop_behind_ssh_ends_in_the_read_back(
    *, resume: bool, prepared: tuple[CardBench, Path], count_runs: Count
) -> None:
    """The tables stand whole but nobody has seen it: off, and one command from either end."""
    bench, keys = prepared
    cuts = (0, 12, 20, 120)  # before, in and behind the header; within the entries
    for after in cuts:
        hop = HopCut(bench.card, after)
        goal = old_table(N) if state_of(bench) is ControllerState.NEW else new_table(N)
        start = state_of(bench)
        with peer(hop.serve) as server:
            front = Gateway(paramiko.ECDSAKey.generate(), reachable={("127.0.0.1", server.port)})
            known = trusting(keys, front.known_hosts_line)
            options = f"known_hosts={known}&password_env=BENCH_SECRET"
            url = f"ssh://{USER}@127.0.0.1:{front.port}/127.0.0.1:{server.port}?{options}"
            link, _ = connect(url)
            with pytest.raises(LinkError) as lost:
                upload.upload_tables(link, bench.context, [goal])
            with suppress(PmacCompError):
                link.close()
            assert lost.value.left is state_of(bench) is ControllerState.DISABLED
            assert not lost.value.context["confirmed"]
            assert waiting.left_open(bench.context)
            link, _ = connect(url)
            result = recovery.recover(link, bench.context, resume=resume)
            link.close()
            front.close()
        assert result.verdict is (ControllerState.NEW if resume else ControllerState.OLD)
        ends = {ControllerState.OLD, ControllerState.NEW} - {start}
        assert state_of(bench) is (ends.pop() if resume else start)
        assert waiting.left_open(bench.context) == ()
    count_runs(len(cuts))
