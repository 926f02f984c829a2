"""F41 and F43: whatever a client sends, the simulated card answers, refuses or closes.

Each example is a client of its own on one shared card; afterwards a second client must still be
served as before. Nothing may raise, and nothing may grow without bound.
"""

import struct
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmac_comp.files.bench import load_bench
from pmac_comp.machine.wire import ethernet, ethernet_requests
from pmac_comp.machine.wire.ethernet import encode
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.dialog.sessions import AsciiSession, EthernetSession

pytestmark = pytest.mark.faults
MAX_ANSWER = 2_000_000
WITNESS = encode(ethernet_requests.get_response(b"ver"))

WORDS = [
    "I", "P", "Q", "M", "1", "130", "8191", "9999", "$", "$78000", "=", "..", ",", "(", ")", "->",
    "*", "+", "-", "/", "%", "&", "|", "^", "#1", "#33", "&1", "&17", "?", "??", "???", "J+", "J/",
    "J=", "K", "O", "HM", "A", "R", "S", "LIST", "COMP", "PLC", "PROG", "GATHER", "DEFINE",
    "DELETE", "BLCOMP", "TCOMP", "ROT", "OPEN", "CLOSE", "CLEAR", "ENABLE", "DISABLE", "X", "Y:",
    "D:", "L:", "F:", "W", "RHX", "RX", "SIN(", "SQRT(", "1E5", "0.5", "-1", " ", "CMD\"", "\"",
    "WHILE(", "ENDW", "IF(", "ENDIF", "ELSE", "GOTO", "CALL", "DWELL", "LINEAR", "PVT", "SAVE",
    "$$$", "BUFFER", "UNDEFINE ALL", "SIZE", "TYPE", "CID", "I5=3", "P1=P1+1", "ADDRESS", "LOCK",
]  # fmt: skip

words = st.lists(st.sampled_from(WORDS), max_size=14).map(lambda parts: "".join(parts).encode())
lines = st.one_of(words, st.binary(max_size=300))
raw_requests = st.builds(
    lambda kind, code, value, index, length, tail: (
        struct.pack(">BBHHH", kind, code, value, index, length) + tail
    ),
    st.sampled_from([0x40, 0xC0, 0x41, 0]),
    st.one_of(st.sampled_from([int(code) for code in ethernet.RequestCode]), st.integers(0, 255)),
    st.integers(0, 0xFFFF),
    st.integers(0, 0xFFFF),
    st.one_of(st.integers(0, 16), st.integers(0, 0xFFFF)),
    st.binary(max_size=64),
)
packets = st.one_of(
    lines.map(
        lambda text: struct.pack(">BBHHH", 0x40, 0xBF, 0, 0, len(text)) + text,
    ),
    st.lists(words, min_size=1, max_size=4).map(
        lambda many: (
            struct.pack(">BBHHH", 0x40, 0xC6, 0, 0, sum(len(x) + 1 for x in many))
            + b"".join(x + b"\0" for x in many)
        )
    ),
    raw_requests,
    st.binary(max_size=200),
    st.just(encode(ethernet_requests.get_buffer())),
    st.integers(1, 31).map(lambda code: encode(ethernet_requests.control_response(code))),
)


class Bed:
    """A card that is made anew when a client has left it in a state others cannot use."""

    def __init__(self) -> None:
        self.bench = load_bench("paper")
        self.card = Card(self.bench)

    def witness_is_served(self) -> bool:
        """Whether a second client gets the version within 50 ms."""
        witness = EthernetSession(self.card)
        witness.receive(encode(ethernet_requests.get_response(b"I3=2I4=0I6=1I9=2I5=0")))
        witness.receive(
            encode(ethernet_requests.send_control(1))
        )  # programs of one example end with it
        answers, took_s = set(), []
        for _ in range(3):  # the best of three: this machine may be busy with something else
            start_s = time.perf_counter()
            answers.add(witness.receive(WITNESS))
            took_s.append(time.perf_counter() - start_s)
        witness.close()
        return all(b"1.947" in answer for answer in answers) and min(took_s) < 0.05


@pytest.fixture(scope="module")
def bed():
    return Bed()


def restore(bed: Bed) -> None:
    # A client may legally reset the card, start programs or save nonsense: begin afresh then.
    bed.card.run_cycles(500)
    if not bed.witness_is_served():
        bed.card.run_cycles(4000)
        assert bed.witness_is_served()


@given(sent=st.lists(packets, max_size=12))
def test_f41_hostile_packets_are_answered_refused_or_closed(bed, sent):
    session = EthernetSession(bed.card)
    for data in sent:
        answer = session.receive(data)
        assert len(answer) < MAX_ANSWER
        bed.card.run_cycles(20)
        if session.closed:
            assert session.reason
            assert session.receive(WITNESS) == b""
            break
    session.close()
    restore(bed)


@given(sent=st.lists(st.tuples(lines, st.sampled_from([b"\r", b"\n", b"", b"\x18"])), max_size=12))
def test_f41_hostile_lines_are_answered_or_refused(bed, sent):
    session = AsciiSession(bed.card)
    for text, end in sent:
        assert len(session.receive(text + end)) < MAX_ANSWER
        bed.card.run_cycles(20)
    session.close()
    restore(bed)


ENDLESS = [
    ["OPEN PLC 1 CLEAR", "WHILE(1=1)", "P1=P1+1", "ENDW", "CLOSE", "I5=3", "ENABLE PLC 1"],
    ["OPEN PLC 0 CLEAR", "WHILE(1=1)", "P1=P1+1", "ENDW", "CLOSE", "I5=3", "ENABLE PLC 0"],
    ["OPEN PLC 2 CLEAR", "ENABLE PLC 2", "CLOSE", "I5=3", "ENABLE PLC 2"],
    ["OPEN PLC 3 CLEAR", "CMD\"ENABLE PLC 3\"", "CLOSE", "I5=3", "ENABLE PLC 3"],
    ["OPEN PLC 4 CLEAR", "SEND\"AGAIN\"", "CLOSE", "I5=3", "ENABLE PLC 4"],
    ["OPEN PROG 1 CLEAR", "N10 GOTO 10", "CLOSE", "#1->2000X", "&1B1R"],
    ["OPEN PROG 2 CLEAR", "CALL 2", "CLOSE", "#1->2000X", "&1B2R"],
    ["OPEN PROG 3 CLEAR", "WHILE(1=1)", "ENDW", "CLOSE", "#1->2000X", "&1B3R"],
    ["OPEN PROG 4 CLEAR", "WHILE(1=1)", "P1=P1+1", "ENDW", "CLOSE", "#1->2000X", "&1B4R"],
    ["P1=" + "(" * 120 + "1" + ")" * 120],
    ["P1=" + "SIN(" * 48 + "1" + ")" * 48],
    ["P1=" + "-" * 250],
    ["P1..8191=1"] * 5,
]  # fmt: skip


@pytest.mark.parametrize("program", ENDLESS, ids=lambda lines: lines[0][:12] + lines[-1][:14])
def test_f43_endless_programs_do_not_stop_the_card(program):
    card = Card(load_bench("paper"))
    session = EthernetSession(card)
    for line in program:
        start_s = time.perf_counter()
        session.receive(encode(ethernet_requests.get_response(line.encode())))
        assert time.perf_counter() - start_s < 2.0
    start_s = time.perf_counter()
    card.run_cycles(2000)
    assert time.perf_counter() - start_s < 20.0
    witness = EthernetSession(card)
    assert b"1.947" in witness.receive(WITNESS)
    witness.receive(encode(ethernet_requests.send_control(1)))
    witness.receive(encode(ethernet_requests.send_control(4)))
    witness.receive(encode(ethernet_requests.get_response(b"I5=0")))
    card.run_cycles(100)
    assert card.cycles >= 2100
