"""Faults that tests may command: off by default, and each does what it says."""

import time

import numpy as np
import pytest

from pmac_comp.files.bench import Bench
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.wire import ethernet as wire
from pmac_comp.machine.wire import ethernet_requests
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.dialog.sessions import EthernetSession
from pmac_comp.simulator.serving.server import ServeOptions, running_server

from .conftest import Ask


def test_off_unless_the_card_was_made_for_it(ask: Ask) -> None:
    assert ask('FAULT"POWER"') == "ERR003"


@pytest.fixture
def session(bench: Bench) -> EthernetSession:
    return EthernetSession(Card(bench, faults=True))


def ask_packet(session: EthernetSession, text: bytes) -> bytes:
    return session.receive(wire.encode(ethernet_requests.get_response(text)))


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
    for text in (
        b'FAULT""',
        b'FAULT"TEAPOT"',
        b'FAULT"CUT X"',
        b'FAULT"AMPLIFIER 99"',
        b'FAULT"LIMIT 2"',
        b'FAULT"NOISE NAN"',
        b'FAULT"NOISE -1"',
        b'FAULT"DELAY 1E9"',
    ):
        assert ask_packet(session, text) == b"\x07ERR003\r"


def moving(session: EthernetSession) -> Card:
    """Card whose motor 1 jogs at 10 mm/s."""
    card = session.card
    ask_packet(session, b"#1J/I122=10")
    card.run_cycles(100)
    ask_packet(session, b"J+")
    card.run_cycles(1000)
    return card


@pytest.mark.parametrize("ix24", ["$1", "$400001"])
@pytest.mark.parametrize("moves", ["LINEAR INC TM200" + " X100" * 8, "INC PVT1000 X2:0 X-2:0 X2:0"])
def test_a_fault_of_another_motor_that_kills_its_own_stops_a_program(
    session: EthernetSession, ix24: str, moves: str
) -> None:
    """A program was left running for ever that no motor follows any more, and took no command."""
    card, runs = session.card, ix24 == "$400001"  # only its own motor is killed
    for line in ("&1#1->X", f"OPEN PROG 1 CLEAR {moves} CLOSE", f"I200=1 I224={ix24}", "#1J/#2J/"):
        ask_packet(session, line.encode())
    card.run_cycles(50)
    ask_packet(session, b"&1B1R")
    card.run_cycles(500)
    assert card.systems[1].running
    ask_packet(session, b'FAULT"AMPLIFIER 2"')
    card.run_cycles(20)
    assert (card.servo.is_killed(1), card.systems[1].running) == (not runs, runs)
    if not runs:
        assert ask_packet(session, b"#1J/") == b"\x06"
        card.run_cycles(50)
        assert ask_packet(session, b"R") == b"\x06"


def test_lost_encoder_ends_in_a_fatal_following_error(session: EthernetSession) -> None:
    card = moving(session)
    before = card.servo.position(1)
    ask_packet(session, b'FAULT"ENCODER"')
    card.run_cycles(1)
    assert card.servo.position(1) == pytest.approx(before, abs=5.0)
    table_m = card.servo.plant.reading()[1]  # type: ignore[attr-defined]
    for _ in range(1000):
        if not card.servo.is_killed(1):
            card.run_cycles(2)
    # The loop pushes against a counter that does not move until the error limit trips.
    assert card.servo.is_killed(1)
    assert int(ask_packet(session, b"#1?")[6:12], 16) & 4
    assert card.servo.plant.reading()[1] > table_m + 1e-3  # type: ignore[attr-defined]


def test_stuck_and_noisy_scale(session: EthernetSession) -> None:
    card = moving(session)
    ask_packet(session, b'FAULT"SCALE"')
    card.run_cycles(1)
    stuck = card.servo.position(2)
    card.run_cycles(500)
    assert card.servo.position(2) == stuck
    ask_packet(session, b'FAULT"HEAL"')
    ask_packet(session, b"#1K")
    card.run_cycles(5000)
    rest = [noisy_position(card) for _ in range(200)]
    assert np.ptp(rest) < 2.0
    ask_packet(session, b'FAULT"NOISE 0.5"')
    noisy = [noisy_position(card) for _ in range(2000)]
    # 0.5 um are four counts of 0.125 um.
    assert np.std(noisy) == pytest.approx(4.0, rel=0.08)
    assert np.mean(noisy) == pytest.approx(np.mean(rest), abs=0.8)


def noisy_position(card: Card) -> float:
    card.run_cycles(1)
    return card.servo.position(2)


def test_forced_limit_switch_stops_motion_to_its_side(session: EthernetSession) -> None:
    ask_packet(session, b"I124=1")
    card = moving(session)
    ask_packet(session, b'FAULT"LIMIT 1"')
    card.run_cycles(2000)
    word1, word2 = (int(ask_packet(session, b"#1?")[k : k + 6], 16) for k in (0, 6))
    assert word1 & 1 << 21
    assert word2 & 1 << 11
    assert card.servo.velocity(1) == pytest.approx(0.0, abs=0.1)
    assert not card.servo.is_killed(1)


def test_late_answers_are_late_and_whole(bench: Bench) -> None:
    card = Card(bench, faults=True)
    with (
        running_server(card, ServeOptions(tcp=0)) as endpoints,
        Commander.open(endpoints["tcp"], timeout_s=5.0) as link,
    ):
        card.link_faults.delay_s = 0.15
        start = time.perf_counter()
        assert link.query("VER") == ["1.947  "]
        assert 0.14 < time.perf_counter() - start < 2.0
        card.link_faults.delay_s = 0.0
