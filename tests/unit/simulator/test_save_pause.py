"""SAVE of a served card: acknowledged when it is over, and everybody else goes on (SRM p. 394)."""

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from pmac_comp.files.bench import Bench
from pmac_comp.machine.wire.ethernet_requests import command_packet
from pmac_comp.simulator.card.card import Card, SAVE_TIME_s
from pmac_comp.simulator.serving.server import ServeOptions, running_server

SPEED = 4.0
ACK = b"\x06"


@pytest.fixture
def card(bench: Bench) -> Card:
    return Card(bench)


@pytest.fixture
def endpoints(card: Card) -> Iterator[dict[str, str]]:
    options = ServeOptions(tcp=0, udp=0, ascii_port=0, pty=hasattr(os, "openpty"), speed=f"{SPEED}")
    with running_server(card, options) as found:
        yield found


def packet(text: str) -> bytes:
    return command_packet(text.encode())


class Clients:
    """Connections to a served card, closed at the end."""

    def __init__(self, endpoints: dict[str, str], stack: ExitStack) -> None:
        self.endpoints = endpoints
        self.stack = stack

    def stream(self, kind: str) -> socket.socket:
        host, port = self.endpoints[kind].split("//")[1].split("?")[0].split(":")
        form = socket.SOCK_DGRAM if kind == "udp" else socket.SOCK_STREAM
        line = self.stack.enter_context(socket.socket(socket.AF_INET, form))
        line.connect((host, int(port)))
        line.settimeout(20.0)
        return line

    def terminal(self) -> Callable[[str], bytes]:
        path = self.endpoints["pty"].removeprefix("serial://")
        line = os.open(path, os.O_RDWR | os.O_NOCTTY)
        self.stack.callback(os.close, line)

        def ask(text: str) -> bytes:
            os.write(line, text.encode() + b"\r")
            said = b""
            while not said.endswith(ACK):
                said += os.read(line, 100)
            return said

        return ask

    def asker(self, kind: str) -> Callable[[str], bytes]:
        """What asks one question on a new connection of that kind."""
        if kind == "pty":
            return self.terminal()
        client = self.stream(kind)

        def ask(text: str) -> bytes:
            client.sendall(text.encode() + b"\r" if kind == "ascii" else packet(text))
            return client.recv(1000)

        return ask


@pytest.fixture
def clients(endpoints: dict[str, str]) -> Iterator[Clients]:
    with ExitStack() as stack:
        yield Clients(endpoints, stack)


@pytest.mark.parametrize("kind", ["tcp", "udp", "ascii", "pty"])
def test_acknowledged_when_the_pause_is_over(card: Card, clients: Clients, kind: str) -> None:
    if kind not in clients.endpoints:
        pytest.skip("no pseudo terminals here")
    ask = clients.asker(kind)
    assert ask("P1=7").endswith(ACK)
    wall_s, card_s = time.perf_counter(), card.time_s
    assert ask("SAVE") == ACK
    assert card.time_s - card_s >= SAVE_TIME_s
    assert time.perf_counter() - wall_s >= 0.8 * SAVE_TIME_s / SPEED
    assert ask("P1") == b"7\r" + ACK
    assert card.flash.written


def test_others_are_answered_and_background_stands(card: Card, clients: Clients) -> None:
    saver, other = clients.stream("tcp"), clients.asker("tcp")
    for line in ("I5=2", "OPEN PLC 1 CLEAR P9=P9+1 CLOSE", "ENABLE PLC 1", "#1J/"):
        assert other(line) == ACK
    saver.sendall(packet("SAVE") + packet("P1"))
    while not card.is_saving:
        time.sleep(0.001)
    scans, counters = other("P9"), []
    while card.is_saving:
        counters.append(card.time_s)
        assert other("P9") == scans or not card.is_saving
    assert len(set(counters)) > 2  # servo cycles went by
    said = b""
    while said.count(ACK) < 2:
        said += saver.recv(100)
    assert said == ACK + b"0\r" + ACK


def test_a_client_that_leaves_meanwhile_harms_nobody(card: Card, clients: Clients) -> None:
    saver = clients.stream("tcp")
    saver.sendall(packet("SAVE"))
    while not card.saves:
        time.sleep(0.001)
    saver.close()
    ask = clients.asker("ascii")
    assert ask("P1=3 P1") == b"3\r" + ACK
    assert ask("SAVE") == ACK


def test_in_process_the_time_passes_at_once(card: Card) -> None:
    port = card.port()
    before_s = card.time_s
    assert port.line("SAVE") == ACK
    assert card.time_s - before_s == pytest.approx(SAVE_TIME_s, abs=1e-3)
    assert not card.is_saving


def test_a_save_that_a_program_commands_stops_the_background_too(card: Card) -> None:
    port = card.port()
    card.saves_aside = True
    for line in ("I5=2", 'OPEN PLC 1 CLEAR P9=P9+1 IF(P9=3) CMD"SAVE" ENDIF CLOSE', "ENABLE PLC 1"):
        assert port.line(line) == ACK
    while not card.is_saving:
        card.run_cycles(1)
    scans = port.line("P9")
    card.run_cycles(round(0.9 * SAVE_TIME_s / card.bench.servo_period_s))
    assert (card.is_saving, port.line("P9")) == (True, scans)
    card.run_cycles(round(0.2 * SAVE_TIME_s / card.bench.servo_period_s))
    assert not card.is_saving
    assert port.line("P9") != scans
