"""Framing by I3, I4 and I6, control characters, and every request of the packet port."""

import struct

import pytest

from pmac_comp.machine.wire import ethernet as wire
from pmac_comp.machine.wire import ethernet_requests
from pmac_comp.machine.wire.dialog import format_line, format_reply, line_sum
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.dialog.sessions import AsciiSession, EthernetSession


@pytest.mark.parametrize("i3", range(4))
@pytest.mark.parametrize("i4", range(2))
@pytest.mark.parametrize("i6", range(4))
def test_every_mode_frames_values_and_errors(card: Card, i3: int, i4: int, i6: int) -> None:
    session = AsciiSession(card)
    session.receive(f"I3={i3}I4={i4}I6={i6}P1=5\r".encode())
    lead = {0: b"", 1: b"\n", 2: b"", 3: b"\n"}[i3]
    end = {0: b"", 1: b"\n", 2: b"\x06", 3: b"\x06"}[i3]
    data = lead + b"5\r"
    sums = (bytes([sum(data) & 0xFF]), bytes([sum(b"P1") & 0xFF])) if i4 else (b"", b"")
    assert session.receive(b"P1\r") == data + sums[0] + end + sums[1]
    error = {0: b"\x07", 1: b"\x07" + lead + b"ERR003\r", 2: b"\x07"}.get(
        i6, b"\x07\r" + lead + b"ERR003\r"
    )
    assert session.receive(b"XYZZY\r") == error


def test_line_arrives_in_any_pieces_with_backspace_and_line_feeds(card: Card) -> None:
    session = AsciiSession(card)
    answers = b"".join(session.receive(bytes([c])) for c in b"\nP1=4\x082 p1\r\n")
    assert answers == b"2\r\x06"


def test_reporting_control_characters_answer_without_acknowledge(card: Card) -> None:
    session = AsciiSession(card)
    card.run_cycles(20)
    assert session.receive(b"\x02").count(b" ") == 7
    assert len(session.receive(b"\x02")) == 8 * 13
    assert len(session.receive(b"\x03")) == 16 * 13
    assert session.receive(b"\x07") == b"000001010800\r"
    assert session.receive(b"\x10") == b"0 0 0 0 0 0 0 0\r"
    assert session.receive(b"\x06") == b"0 0 0 0 0 0 0 0\r"
    assert session.receive(b"\x16") == b"0 0 0 0 0 0 0 0\r"
    session.receive(b"##1\r")
    assert session.receive(b"\x02").startswith(b"0")


def test_control_character_inside_a_line_acts_at_once(card: Card) -> None:
    session = AsciiSession(card)
    session.receive(b"#1J/\r")
    card.run_cycles(10)
    assert session.receive(b"P1=\x0b7 P1\r") == b"7\r\x06"
    assert card.servo.is_killed(1)


def test_control_a_k_e_d(card: Card) -> None:
    session = AsciiSession(card)
    card.run_cycles(10)
    for text in (b"OPEN PLC 5 CLEAR\r", b"P1=1\r", b"CLOSE\r", b"ENABLE PLC 5\r"):
        session.receive(text)
    assert card.plcs.enabled(5)
    session.receive(b"\x04")
    assert not card.plcs.enabled(5)
    session.receive(b"\x01")
    assert not card.servo.is_open_loop(1)  # I36 = 0: killed motors are enabled
    session.receive(b"\x0b")
    assert card.servo.is_killed(1)
    session.receive(b"I36=1\r\x01")
    assert card.servo.is_killed(1)
    session.receive(b"\x05")
    assert not card.servo.is_killed(1)


def test_control_x_empties_the_line_and_echoes(card: Card) -> None:
    session = AsciiSession(card)
    assert session.receive(b"GARBAGE\x18P1=3 P1\r") == b"\x183\r\x06"
    session.receive(b"I63=0\r")
    assert session.receive(b"GARBAGE\x18P1\r") == b"3\r\x06"


def test_tab_repeats_and_control_n_sums(card: Card) -> None:
    session = AsciiSession(card)
    session.receive(b"P1=P1+1 P1\r")
    assert session.receive(b"\t") == b"2\r\x06"
    assert session.receive(b"P1\x0e") == bytes([(ord("P") + ord("1")) & 0xFF])


def test_eight_bit_characters_are_err004(card: Card) -> None:
    assert AsciiSession(card).receive(b"P1=\xff\r") == b"\x07ERR004\r"


def test_text_of_programs_reaches_its_port(card: Card) -> None:
    serial, packets = AsciiSession(card), EthernetSession(card)
    for text in (
        b"OPEN PLC 5 CLEAR\r",
        b'SENDS"hello"\r',
        b'SENDP"packet"\r',
        b'CMDS"P1=7 P1"\r',
        b"DISABLE PLC 5\r",
        b"CLOSE\r",
        b"I5=2\r",
        b"ENABLE PLC 5\r",
    ):
        serial.receive(text)
    card.run_cycles(30)
    assert serial.pending() == b"\x02hello\r\x027\r"
    assert packets.receive(wire.encode(ethernet_requests.get_buffer())) == b"\x02packet\r"


def ask(session: EthernetSession, request: wire.Request) -> bytes:
    return session.receive(wire.encode(request))


def test_what_a_program_says_comes_apart_from_the_answer(card: Card) -> None:
    s = EthernetSession(card)
    run, more = ethernet_requests.get_response, ethernet_requests.get_buffer()
    for line in (b"OPEN PLC 4 CLEAR", b'SENDP"packet"', b"DISABLE PLC 4", b"CLOSE", b"I5=2"):
        assert ask(s, run(line)) == b"\x06"
    ask(s, ethernet_requests.send_line(b"ENABLE PLC 4 P1"))
    card.run_cycles(20)
    assert [ask(s, more) for _ in range(3)] == [b"0\r\x06", b"\x02packet\r", b"\x00"]
    # A program that the line itself starts speaks behind its acknowledgement.
    for line in (b"&1#1->X #1J/ OPEN PROG 1 CLEAR", b'SENDP"said"', b"CLOSE"):
        assert ask(s, run(line)) == b"\x06"
    card.run_cycles(20)
    assert ask(s, run(b"&1B1R")) == b"\x06"
    card.run_cycles(20)
    assert ask(s, more) == b"\x02said\r"


def test_what_a_program_says_to_a_client_that_never_asks_is_bounded(card: Card) -> None:
    s = EthernetSession(card)
    for _ in range(20_000):
        card.interpreter.announce("P", "still here")
    said = 0
    while ask(s, ethernet_requests.read_ready())[0]:
        said += len(ask(s, ethernet_requests.get_buffer()))
    assert 60_000 < said < 70_000
    assert ask(s, ethernet_requests.get_response(b"P1=4 P1")) == b"4\r\x06"


def test_requests_of_the_packet_port(card: Card) -> None:
    s = EthernetSession(card)
    assert ask(s, ethernet_requests.get_response(b"i6=1 i3=2 ver")) == b"1.947  \r\x06"
    assert ask(s, ethernet_requests.send_line(b"P1=5 P1 P1")) == b"\x40"
    assert ask(s, ethernet_requests.read_ready())[0]
    assert ask(s, ethernet_requests.get_line()) == b"5\r"
    assert ask(s, ethernet_requests.get_buffer()) == b"5\r\x06"
    assert ask(s, ethernet_requests.read_ready()) == b"\0\0"
    assert ask(s, ethernet_requests.get_buffer()) == b"\0"
    assert ask(s, ethernet_requests.send_line(b"P1")) == b"\x40"
    assert ask(s, ethernet_requests.flush()) == b"\x40"
    assert ask(s, ethernet_requests.read_ready()) == b"\0\0"
    assert ask(s, ethernet_requests.set_memory(0x1140, b"\1\2\3\4")) == b"\x40"
    assert ask(s, ethernet_requests.get_memory(0x1140, 4)) == b"\1\2\3\4"
    assert ask(s, ethernet_requests.get_response(b"RX$60450RY$60450")) == b"1027\r513\r\x06"
    assert ask(s, ethernet_requests.or_bits(0x1140, 0xF0)) == b"\x40"
    assert ask(s, ethernet_requests.and_bits(0x1140, 0xFFFFFF0F)) == b"\x40"
    assert ask(s, ethernet_requests.set_bits(0x1140, 0x80, 0x200)) == b"\x40"
    assert ask(s, ethernet_requests.get_memory(0x1140, 4)) == struct.pack("<I", 0x04030081)
    assert ask(s, ethernet_requests.control_response(0x07)) == b"000001010800\r"
    assert ask(s, ethernet_requests.send_control(0x0B)) == b"\x40"
    assert ask(s, ethernet_requests.get_address()) == bytes((192, 6, 94, 5))
    assert ask(s, ethernet_requests.write_buffer([b"P1=1", b"P2=2"])) == b"\0\0\0\0"
    assert ask(s, ethernet_requests.write_buffer([b"P1=1", b"NONSENSE", b"P2=3"])) == b"\2\0\3\x80"
    assert ask(s, ethernet_requests.get_response(b"P2")) == b"2\r\x06"
    assert ask(s, ethernet_requests.get_response(b"\x0b")) == b"\x06"
    assert ask(s, ethernet_requests.get_response(b"\n")) == b"\x06"
    assert ask(s, ethernet_requests.get_response(b"$$$")) == b"\0"
    assert not s.closed


def test_a_downloaded_line_is_taken_as_a_typed_one(card: Card) -> None:
    s = EthernetSession(card)
    lines = [b"OPEN PLC 9 CLEAR\r", b"P1=1\r\n", b"", b"IF(P1=1)\tP2=1", b"ENDIF\r", b"CLOSE\r"]
    assert ask(s, ethernet_requests.write_buffer(lines)) == b"\0\0\0\0"
    assert ask(s, ethernet_requests.get_response(b"LIST PLC 9")).startswith(b"P1=1\rIF(P1=1)\r")
    assert ask(s, ethernet_requests.write_buffer([b"P1=1", b"P1=2\rNONSENSE\r", b"P1=3"])) == (
        b"\2\0\3\x80"
    )
    assert ask(s, ethernet_requests.get_response(b"P1")) == b"2\r\x06"
    assert ask(s, ethernet_requests.write_buffer([b"#1J/\x0b"])) == b"\0\0\0\0"


def test_client_that_vanishes_leaves_no_open_buffer(card: Card) -> None:
    gone, stays = EthernetSession(card), EthernetSession(card)
    ask(gone, ethernet_requests.get_response(b"OPEN PLC 7 CLEAR"))
    ask(gone, ethernet_requests.get_response(b"IF(P1=1)"))
    assert ask(stays, ethernet_requests.get_response(b"OPEN PLC 8")) == b"\x07ERR007\r"
    gone.close()
    assert ask(stays, ethernet_requests.get_response(b"OPEN PLC 8 CLOSE")) == b"\x06"
    ask(stays, ethernet_requests.get_response(b"ENABLE PLC 7"))
    assert not card.plcs.enabled(7)


def test_long_answers_come_in_packets_of_exactly_1400_bytes(card: Card) -> None:
    s = EthernetSession(card)
    whole = card.port().line("I0..999")
    parts = [ask(s, ethernet_requests.get_response(b"I0..999"))]
    while not parts[-1].endswith(b"\x06"):
        parts.append(ask(s, ethernet_requests.get_buffer()))
    assert b"".join(parts) == whole
    assert {len(p) for p in parts[:-1]} == {1400}


@pytest.mark.parametrize(
    "data",
    [
        bytes((0x40, 0xCB, 0, 1, 0, 0, 0, 1, 0)),  # firmware download
        bytes((0xC0, 0xE4, 0, 0, 0, 0, 0, 0)),  # a name without a description
        bytes((0x12, 0x34, 0, 0, 0, 0, 0, 0)),
        wire.encode(ethernet_requests.get_memory(0xFFFC, 16)),  # beyond the end
    ],
)
def test_what_is_not_supported_closes_the_connection(card: Card, data: bytes) -> None:
    s = EthernetSession(card)
    assert s.receive(data) == b""
    assert s.closed


def test_no_dual_ported_ram_means_no_window(bench) -> None:
    s = EthernetSession(Card(bench, dpram="none"))
    assert ask(s, ethernet_requests.get_memory(0, 4)) == b""
    assert s.closed


def test_format_helpers_agree_with_the_wire() -> None:
    assert format_reply(["1"], i3=2) == b"1\r\x06"
    assert line_sum(format_line("1")) == (0x31 + 0x0D) & 0xFF
