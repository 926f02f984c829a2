"""F07 (lost connections leave nothing behind) and F09 (what is no PMAC is refused) on loopback."""

import os
import socket
import threading
import time

import pytest

from pmac_comp.base.errors import (
    ConfigError,
    ConnectFailed,
    LinkError,
    LinkLost,
    LocalProtocolError,
    ReplyTimeout,
)
from pmac_comp.machine.client.commander import Commander
from tests.contract.scripted_card import LinePort, PacketPort, ScriptedCard
from tests.faults.socket_peers import (
    card_handler,
    datagram_handler,
    echoing,
    peer,
    resetting,
    saying,
)

pytestmark = pytest.mark.faults


def open_descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208


def test_a_scripted_card_over_tcp_and_as_an_ascii_port():
    for port, option in ((PacketPort, ""), (LinePort, "?dialog=ascii")):
        card = ScriptedCard(I3=1, I4=1)
        with peer(card_handler(card, port)) as server:
            with Commander.open(f"tcp://127.0.0.1:{server.port}{option}") as commander:
                assert commander.query("ver") == ["1.947  "]
                assert len(commander.query("P0..999")) == 1000
                commander.write_buffer([f"P{k}={k}" for k in range(200)])
                assert commander.query("P199") == ["199"]
            assert (card.mode("I3"), card.mode("I4")) == (1, 1)


def test_an_ascii_port_has_no_memory():
    with (
        peer(card_handler(ScriptedCard(), LinePort)) as server,
        Commander.open(f"tcp://127.0.0.1:{server.port}?dialog=ascii") as commander,
        pytest.raises(LocalProtocolError, match="packet port"),
    ):
        commander.get_memory(0, 4)


def test_udp_reads_survive_lost_datagrams_and_writes_are_not_repeated():
    card = ScriptedCard(P1=5)
    lost = {6, 9, 14}
    with peer(datagram_handler(card, lost), socket.SOCK_DGRAM) as server:
        with Commander.open(f"udp://127.0.0.1:{server.port}", timeout_s=1.0) as commander:
            failed = 0
            for k in range(12):
                try:
                    if k % 2:
                        commander.command(f"P{100 + k}=1")
                    else:
                        assert commander.query("P1") == ["5"]
                except ReplyTimeout:
                    failed += 1
        assert failed <= len(lost)
        assert all(card.executed.count(f"P{100 + k}=1") <= 1 for k in range(1, 12, 2))


def test_f07_lost_connections_leave_no_descriptor_and_no_thread(exhaustive):
    cycles = 1000 if exhaustive else 60

    def closing(link: socket.socket) -> None:
        link.recv(4096)

    for handler in (closing, resetting):
        with peer(handler) as server:
            before = open_descriptors(), threading.active_count()
            for _ in range(cycles):
                start_s = time.monotonic()
                with pytest.raises(LinkError):
                    Commander.open(f"tcp://127.0.0.1:{server.port}", timeout_s=2.0)
                assert time.monotonic() - start_s < 2.2
            deadline_s = time.monotonic() + 2.0
            while open_descriptors() > before[0] and time.monotonic() < deadline_s:
                time.sleep(0.01)  # the peer's side closes a moment later
            assert (open_descriptors(), threading.active_count()) == before


def test_f07_a_connection_lost_in_use_says_so_and_can_be_opened_again():
    card = ScriptedCard(P1=5)
    served = 0

    def handle(link: socket.socket) -> None:
        nonlocal served
        served += 1
        if served > 1:
            card_handler(card, PacketPort)(link)
            return
        port = PacketPort(card)
        for _ in range(4):
            link.sendall(port(link.recv(4096)))

    with (
        peer(handle) as server,
        Commander.open(f"tcp://127.0.0.1:{server.port}", timeout_s=2.0) as commander,
    ):
        assert commander.query("P1") == ["5"]
        assert commander.query("P1") == ["5"]
        with pytest.raises(LinkLost):
            commander.query("P1")
        with pytest.raises(LinkLost, match="closed"):
            commander.query("P1")
        commander.reconnect()
        assert commander.query("P1") == ["5"]


def test_f07_a_dead_peer_is_noticed_at_the_deadline():
    with peer(saying(b"", hold_s=5.0)) as server:
        start_s = time.monotonic()
        with pytest.raises(ConnectFailed):
            Commander.open(f"tcp://127.0.0.1:{server.port}", timeout_s=0.3)
        assert time.monotonic() - start_s < 0.6


@pytest.mark.parametrize(
    "text", [b"HTTP/1.1 400 Bad Request\r\n\r\n", b"SSH-2.0-OpenSSH_9.7\r\n", b"login: ", b""]
)
@pytest.mark.parametrize("option", ["", "?dialog=ascii"])
def test_f09_another_machine_is_refused_and_nothing_is_written(text, option):
    record = bytearray()
    with peer(saying(text, record=record)) as server:
        with pytest.raises(ConnectFailed) as caught:
            Commander.open(f"tcp://127.0.0.1:{server.port}{option}", timeout_s=0.5)
        assert caught.value.hint
        assert caught.value.exit_code == 3
    assert b"=" not in record


def test_f09_an_echo_is_no_pmac():
    with peer(echoing) as server, pytest.raises(ConnectFailed):
        Commander.open(f"tcp://127.0.0.1:{server.port}?dialog=ascii", timeout_s=0.5)


def test_f09_an_ascii_port_is_not_taken_for_a_packet_port():
    card = ScriptedCard()
    with peer(card_handler(card, LinePort)) as server, pytest.raises(ConnectFailed):
        Commander.open(f"tcp://127.0.0.1:{server.port}", timeout_s=0.5)
    assert not any("=" in line for line in card.executed)


def unused_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("tcp://no-such-host.invalid", "name 'no-such-host.invalid'"),
        ("udp://no-such-host.invalid", "name 'no-such-host.invalid'"),
        ("tcp://127.0.0.1:{port}", "no connection"),
        ("udp://127.0.0.1:{port}", "does not answer as a PMAC"),
        ("serial:///dev/no-such-device", "cannot be opened"),
    ],
)
def test_f09_nobody_there(url, text):
    with pytest.raises(ConnectFailed, match=text):
        Commander.open(url.format(port=unused_port()), timeout_s=1.0)


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("192.6.94.5", "no scheme"),
        ("tpc://host", "did you mean 'tcp'"),
        ("tcp://", "needs a host"),
        ("tcp://host:99999", "no valid port"),
        ("tcp://host/path", "takes no path"),
        ("tcp://host?baud=1", "knows no option 'baud'"),
        ("tcp://me@host", "no login"),
        ("tcp://host?dialog=latin", "neither ascii nor packets"),
        ("serial://", "needs a device"),
        ("serial:///dev/x?baud=fast", "no whole number"),
        ("serial:///dev/x?rtscts=maybe", "neither yes nor no"),
        ("serial:///dev/x?parity=Q", "none of N, E, O"),
        ("ssh://gateway", "controller behind the gateway"),
        ("ssh://gateway/pmac/x", "controller behind the gateway"),
        ("ssh://gateway/pmac:0x", "no valid port"),
        ("sim://host", "takes no host"),
        ("sim://", "together with the simulated card"),
        ("gpascii://host", "Power PMAC"),
    ],
)
def test_f09_addresses_that_cannot_be_meant(url, text):
    with pytest.raises(ConfigError, match=text):
        Commander.open(url)


def test_f45_a_password_in_an_address_is_refused_and_not_repeated():
    with pytest.raises(ConfigError) as caught:
        Commander.open("ssh://me:canary-7f3@gateway/pmac")
    assert "canary-7f3" not in str(caught.value)


def test_a_session_can_be_recorded_by_its_address(tmp_path):
    path = tmp_path / "session.jsonl"
    with peer(card_handler(ScriptedCard(), PacketPort)) as server:
        with Commander.open(f"tcp://127.0.0.1:{server.port}?record={path}") as commander:
            assert commander.query("cid") == ["603382"]
        lines = path.read_text().splitlines()
        assert b"cid".hex() in "".join(lines)
        assert b"603382\r\x06".hex() in "".join(lines)
        with pytest.raises(ConfigError, match="cannot be recorded"):
            Commander.open(f"tcp://127.0.0.1:{server.port}?record={path}")
