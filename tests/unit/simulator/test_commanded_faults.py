"""Faults that tests may command: off by default, and each does what it says."""

import pytest

from pmac_comp.files.bench import Bench
from pmac_comp.machine.wire import ethernet as wire
from pmac_comp.simulator.card import Card
from pmac_comp.simulator.sessions import EthernetSession

from .conftest import Ask


def test_off_unless_the_card_was_made_for_it(ask: Ask) -> None:
    assert ask('FAULT"POWER"') == "ERR003"


@pytest.fixture
def session(bench: Bench) -> EthernetSession:
    return EthernetSession(Card(bench, faults=True))


def ask_packet(session: EthernetSession, text: bytes) -> bytes:
    return session.receive(wire.encode(wire.get_response(text)))


def test_link_faults_spoil_the_next_answer_only(session: EthernetSession) -> None:
    good = b"1.947  \r\x06"
    assert ask_packet(session, b'FAULT"SILENT 2"') == b"\0"
    assert ask_packet(session, b"VER") == b"\0"
    assert ask_packet(session, b"VER") == good
    assert ask_packet(session, b'FAULT"CUT 3"') == b"\x06"
    session.card.link_faults.cut = 3
    assert ask_packet(session, b"VER") == good[:3]
    session.card.link_faults.garble = 0
    assert ask_packet(session, b"VER") == b"!" + good[1:]
    assert ask_packet(session, b"VER") == good
    assert ask_packet(session, b'FAULT"DROP"') == b""
    assert session.closed


def test_amplifier_fault_kills_and_stops_the_program(session: EthernetSession) -> None:
    card = session.card
    for line in ("&1#1->X", "OPEN PROG 1 CLEAR", "LINEAR INC TM1000 X1000", "CLOSE", "#1J/"):
        ask_packet(session, line.encode())
    card.run_cycles(50)
    ask_packet(session, b"&1B1R")
    card.run_cycles(500)
    assert card.systems[1].running
    ask_packet(session, b'FAULT"AMPLIFIER 1"')
    card.run_cycles(20)
    assert card.servo.is_killed(1)
    assert not card.systems[1].running
    assert int(ask_packet(session, b"#1?")[6:12], 16) & 8


def test_power_failure_and_spoiled_flash(session: EthernetSession) -> None:
    ask_packet(session, b"I130=5 SAVE")
    ask_packet(session, b"I130=6")
    ask_packet(session, b'FAULT"POWER"')
    assert ask_packet(session, b"I130") == b"5\r\x06"
    ask_packet(session, b'FAULT"FLASH"')
    ask_packet(session, b"$$$")
    assert b"2000" in ask_packet(session, b"I130")


def test_flag_and_unknown_words(session: EthernetSession) -> None:
    ask_packet(session, b'FAULT"FLAG $800"')
    assert int(ask_packet(session, b"???")[:6], 16) & 0x800
    for text in (b'FAULT""', b'FAULT"TEAPOT"', b'FAULT"CUT X"', b'FAULT"AMPLIFIER 99"'):
        assert ask_packet(session, text) == b"\x07ERR003\r"
