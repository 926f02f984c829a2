"""Command lines through the dual-ported RAM (I58), as a host writes and reads them."""

import struct

import pytest

from pmac_comp.files.bench import Bench
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.dialog.sessions import EthernetSession

from .conftest import Ask

COMMAND, TEXT, ANSWER = 0x0E9C, 0x0EA0, 0x0F40
SETMEM, SETBIT, GETMEM = 0xB5, 0xBA, 0xB4
CR, ACK, ERROR = 0x0D, 0x06, 0x8000
CMDR, SENDR = 0x0100, 0x0200


class Host:
    """Writes and reads the memory with requests of the packet port."""

    def __init__(self, card: Card) -> None:
        self.card = card
        self.session = EthernetSession(card)

    def _set(self, offset: int, data: bytes) -> None:
        header = struct.pack(">BBHHH", 0x40, SETMEM, offset, 0, len(data))
        assert self.session.receive(header + data) == b"@"

    def take(self) -> tuple[int, str] | None:
        """The word and text of the answer that is there, given free."""
        self.card.run_cycles(20)
        data = self.session.receive(struct.pack(">BBHHH", 0xC0, GETMEM, ANSWER, 0, 260))
        word, length = struct.unpack_from("<HH", data)
        if word == 0:
            return None
        text = data[4:].partition(b"\0")[0].decode()
        assert length in (len(text) + 1, 0)
        self._set(ANSWER, bytes(4))
        return word, text

    def send(self, line: str) -> None:
        self._set(TEXT, line.encode() + b"\0")
        header = struct.pack(">BBHHH", 0xC0, SETBIT, COMMAND, 1, 4)
        assert self.session.receive(header + struct.pack("<I", 1)) == b"@"

    def control(self, letter: str) -> None:
        self._set(COMMAND + 2, bytes([ord(letter) & 31, 0]))

    def answers(self) -> list[tuple[int, str]]:
        found = []
        while (answer := self.take()) is not None:
            found.append(answer)
        return found


@pytest.fixture
def host(card: Card) -> Host:
    return Host(card)


def test_value_several_lines_nothing_and_error(host: Host, ask: Ask) -> None:
    ask("P1=5 P2=-0.25 I3=0")  # I3 has no influence
    host.send("P1,2")
    assert host.answers() == [(CR, "5"), (ACK, "-0.25")]
    host.send("P1=6")
    assert host.answers() == [(ACK, "")]
    assert ask("P1") == "6"
    for wrong, number in (("NONSENSE", 0x003), ("X10", 0x005)):
        host.send(wrong)
        assert host.answers() == [(ERROR | number, "")]


def test_next_line_waits_for_the_host(host: Host, card: Card) -> None:
    host.send("P1..3")
    card.run_cycles(1000)
    assert host.take() == (CR, "0")
    host.send("P4=1")  # what was not read of the answer is dropped
    assert host.answers() == [(ACK, "")]


def test_own_addressing_and_signs_taken_back(host: Host, card: Card, ask: Ask) -> None:
    host.send("#2&3")
    assert host.answers() == [(ACK, "")]
    assert ask("#") == "1"
    host.send("#&")
    assert [text for _, text in host.answers()] == ["2", "3"]
    assert card.memory.read_bytes(COMMAND, 4) == bytes(4)


def test_control_character(host: Host, ask: Ask) -> None:
    host.control("B")
    ((word, text),) = host.answers()
    assert (word, len(text.split())) == (ACK, 8)
    ask("#1J/ J+")
    host.control("A")
    assert host.answers() == []
    host.card.run_cycles(2000)
    assert int(ask("#1?")[:6], 16) & 0x020000 == 0  # moves no more


def test_programs_send_and_command(host: Host, ask: Ask) -> None:
    ask('OPEN PLC 1 CLEAR SENDR"HELLO" CMDR"P9" CMDR"NONSENSE" DISABLE PLC 1 CLOSE')
    ask("P9=7 I5=2 ENABLE PLC 1")
    assert host.answers() == [
        (SENDR | ACK, "HELLO"),
        (CMDR | ACK, "7"),
        (CMDR | ERROR | ACK, "ERR003"),
    ]


def test_i58_follows_the_memory_at_power_up(host: Host, card: Card, bench: Bench, ask: Ask) -> None:
    assert ask("I58") == "1"
    ask("I58=0")
    host.send("P1")
    assert host.answers() == []
    ask("SAVE")
    ask("$$$")
    assert ask("I58") == "1"
    without = Card(bench, dpram="none").port()
    assert without.line("I58") == b"0\r\x06"
