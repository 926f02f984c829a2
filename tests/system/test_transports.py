"""Every way to reach a controller, against the simulated card served for real."""

import getpass
import os
import socket
import struct
import threading
import time
from contextlib import suppress
from pathlib import Path

import paramiko
import pytest

from pmac_comp.base.errors import CommandRefused, ConnectFailed, LocalProtocolError
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.client.terminal import open_terminal
from pmac_comp.machine.wire import ethernet_requests
from pmac_comp.machine.wire.ethernet import encode
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.serving.server import ServeOptions, running_server
from tests.faults.openssh import openssh_server, trusting
from tests.faults.ssh_gateway import SECRET, USER, Gateway

pytestmark = pytest.mark.system
KINDS = ["tcp", "udp", "ascii", "pty", "ssh"]
PLC = ["OPEN PLC 7 CLEAR", *(f"P{700 + k}=P{700 + k}+{k}" for k in range(60)), "CLOSE"]


@pytest.fixture(scope="module")
def card():
    return Card(load_bench("paper"))


@pytest.fixture(scope="module")
def endpoints(card):
    options = ServeOptions(tcp=0, udp=0, ascii_port=0, pty=True, speed="real")
    with running_server(card, options) as found:
        yield found


@pytest.fixture
def url_of(endpoints, tmp_path, monkeypatch):
    gateways = []

    def make(kind: str) -> str:
        if kind != "ssh":
            return endpoints[kind]
        port = int(endpoints["tcp"].rsplit(":", 1)[1])
        gateway = Gateway(paramiko.ECDSAKey.generate(), reachable={("127.0.0.1", port)})
        gateways.append(gateway)
        known = trusting(tmp_path, gateway.known_hosts_line)
        monkeypatch.setenv("BENCH_SECRET", SECRET)
        return (
            f"ssh://{USER}@127.0.0.1:{gateway.port}/127.0.0.1:{port}"
            f"?known_hosts={known}&password_env=BENCH_SECRET"
        )

    yield make
    for gateway in gateways:
        gateway.close()


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_conversation_over_every_transport(url_of, kind):
    with Commander.open(url_of(kind), timeout_s=10.0) as commander:
        assert commander.query("VERSION")[0].startswith("1.947")
        assert commander.query("CID") == ["603382"]
        commander.write_buffer([f"P{k}={k * k}" for k in range(300)])
        assert commander.query_many(f"P{k}" for k in range(300)) == [str(k * k) for k in range(300)]
        commander.write_buffer(PLC)
        assert len(commander.query("LIST PLC 7")) > 10
        with pytest.raises(CommandRefused, match="ERR003"):
            commander.command("XYZZY")
        assert len(commander.control("P").split()) == 8
        commander.flush()
        assert commander.query("I3I6I9") == ["2", "1", "2"]
        if commander.capabilities.memory:
            commander.set_memory(0x3000, b"\x01\x02\x03\x00")
            assert commander.get_memory(0x3000, 4) == b"\x01\x02\x03\x00"
        else:
            with pytest.raises(LocalProtocolError):
                commander.get_memory(0x3000, 4)


@pytest.mark.parametrize("kind", KINDS)
def test_long_listings_come_whole(url_of, kind):
    with Commander.open(url_of(kind), timeout_s=20.0) as commander:
        lines = commander.query("P0..4000")
        assert len(lines) == 4001
        assert commander.query("CID") == ["603382"]


@pytest.mark.parametrize("kind", ["tcp", "ascii", "pty"])
def test_a_refused_line_of_a_download_is_named(url_of, kind):
    with Commander.open(url_of(kind), timeout_s=10.0) as commander:
        lines = [f"P{k}=1" for k in range(150)]
        lines[120] = "NONSENSE"
        with pytest.raises(CommandRefused, match="NONSENSE") as caught:
            commander.write_buffer(lines)
        assert 120 in caught.value.context["candidates"]


def test_modes_of_the_card_come_back(url_of, card):
    card.port().line("I9=3I6=3")
    try:
        with Commander.open(url_of("tcp")) as commander:
            assert (commander.found_modes.i9, commander.found_modes.i6) == (3, 3)
            assert commander.query("I9") == ["2"]
        assert (card.variables.int_i(9), card.variables.int_i(6)) == (3, 3)
    finally:
        card.port().line("I9=2I6=1")


def test_serial_sums_are_on_for_the_session_only(url_of, card):
    with Commander.open(url_of("pty"), timeout_s=10.0) as commander:
        assert card.variables.int_i(4) == 1
        assert commander.query("I4") == ["1"]
        with pytest.raises(ConnectFailed):
            Commander.open(url_of("pty"))
    assert card.variables.int_i(4) == 0


def test_programs_speak_to_an_ascii_port(url_of):
    with Commander.open(url_of("ascii"), timeout_s=10.0) as commander:
        commander.write_buffer(
            ["OPEN PLC 9 CLEAR", 'SENDS"AT TARGET"', "DISABLE PLC 9", "CLOSE", "I5=3"]
        )
        commander.command("ENABLE PLC 9")
        said: list[str] = []
        deadline_s = time.monotonic() + 5.0
        while not said and time.monotonic() < deadline_s:
            assert commander.query("CID") == ["603382"]
            said = commander.take_unsolicited()
        assert said == ["AT TARGET"]


def test_a_terminal_over_tcp(url_of):
    with open_terminal(url_of("tcp")) as ask:
        assert ask("CID") == ["603382"]
        assert ask("XYZZY") == ["ERR003: data error or unrecognised command"]


def test_behind_a_real_openssh_server(endpoints, tmp_path):
    port = int(endpoints["tcp"].rsplit(":", 1)[1])
    with openssh_server(tmp_path) as (gateway, known, identity):
        url = (
            f"ssh://{getpass.getuser()}@127.0.0.1:{gateway}/127.0.0.1:{port}"
            f"?known_hosts={known}&identity={identity}"
        )
        with Commander.open(url, timeout_s=10.0) as commander:
            assert commander.query("CID") == ["603382"]
            assert len(commander.query("P0..4000")) == 4001


def test_clients_do_not_disturb_each_other(url_of):
    wrong: list[object] = []

    def work(number: int) -> None:
        kind = ("tcp", "udp", "ascii")[number % 3]
        with Commander.open(url_of(kind), timeout_s=20.0) as commander:
            for k in range(40):
                name = f"P{1000 + 50 * number + k}"
                commander.command(f"{name}={number * 1000 + k}")
                value = commander.query(name)
                if value != [str(number * 1000 + k)]:
                    wrong.append((number, k, value))

    threads = [threading.Thread(target=work, args=(k,)) for k in range(9)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    assert wrong == []


# F42: load ----------------------------------------------------------------------------------------


def connect(endpoint: str) -> socket.socket:
    host, port = endpoint.removeprefix("tcp://").split("?")[0].split(":")
    return socket.create_connection((host, int(port)), 5.0)


def served(endpoint: str) -> bool:
    start_s = time.monotonic()
    with Commander.open(endpoint, timeout_s=5.0) as commander:
        good = commander.query("CID") == ["603382"]
    return good and time.monotonic() - start_s < 2.0


def resident_MB() -> float:
    """Memory of this process, in which the server runs."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.mark.faults
def test_f42_many_connections_are_limited_and_leave_nothing(endpoints, exhaustive):
    links = []
    before_MB = resident_MB()
    for _ in range(1000 if exhaustive else 150):
        links.append(connect(endpoints["tcp"]))
        links[-1].sendall(b"\x40")  # a request that never comes whole
    assert resident_MB() - before_MB < 100.0
    for link in links:
        link.close()
    deadline_s = time.monotonic() + 5.0
    while time.monotonic() < deadline_s:
        try:
            assert served(endpoints["tcp"])
            break
        except ConnectFailed:
            time.sleep(0.05)
    else:
        pytest.fail("the server did not recover")


def flood(link: socket.socket, data: bytes, limit_s: float) -> None:
    """Send without reading until the other side has had enough."""
    until_s = time.monotonic() + limit_s
    while time.monotonic() < until_s:
        link.sendall(data)


@pytest.mark.faults
def test_f42_a_client_that_never_reads_is_dropped(endpoints, card):
    before, before_MB = card.cycles, resident_MB()
    with connect(endpoints["tcp"]) as link:
        link.settimeout(20.0)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
        request = encode(ethernet_requests.get_memory(0, 1400))
        thread = threading.Thread(target=served, args=(endpoints["tcp"],))
        thread.start()
        with pytest.raises(OSError):  # noqa: PT011 - reset or broken pipe
            flood(link, request * 1000, 20.0)
        thread.join(5.0)
        assert served(endpoints["tcp"])
    assert card.cycles > before
    assert resident_MB() - before_MB < 100.0


@pytest.mark.faults
def test_f42_a_client_that_never_reads_what_programs_say_is_dropped(endpoints, card):
    with connect(endpoints["ascii"]) as link:
        link.settimeout(20.0)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
        link.sendall(b"P1\r")
        assert link.recv(1024)  # it is a client by now
        for _ in range(20):
            card.interpreter.announce("S", "x" * 1_000_000)
            time.sleep(0.05)
        assert served(endpoints["tcp"])
        received = 0
        with suppress(ConnectionResetError):
            while received < 20_000_000 and (data := link.recv(65536)):
                received += len(data)
        assert received < 15_000_000


@pytest.mark.faults
def test_f42_half_requests_do_not_hold_others_up(endpoints):
    half = struct.pack(">BBHHH", 0x40, 0xBF, 0, 0, 200) + b"P1"
    links = [connect(endpoints["tcp"]) for _ in range(8)]
    for link in links:
        link.sendall(half)
    assert served(endpoints["tcp"])
    for link in links:
        link.close()
