"""What the commander sends, repeats and reports."""

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmac_comp.base.clock import VirtualClock
from pmac_comp.base.errors import (
    CommandRefused,
    LinkLost,
    LocalProtocolError,
    RemoteProtocolError,
    ReplyTimeout,
)
from pmac_comp.machine.client.batches import buffer_batches, line_batches, merged_runs
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.client.modes import Modes, read_modes
from pmac_comp.machine.client.reads import is_read
from pmac_comp.machine.client.terminal import terminal_of
from pmac_comp.machine.transport.base import Framing
from pmac_comp.machine.transport.pair import PairTransport
from tests.contract.scripted_card import LinePort, PacketPort, ScriptedCard

PORTS = {Framing.PACKETS: PacketPort, Framing.LINES: LinePort}


def conversation(framing=Framing.PACKETS, card=None, port=None) -> Commander:
    clock = VirtualClock()
    peer = port or PORTS[framing](card or ScriptedCard())
    return Commander(PairTransport(peer, clock, framing=framing), clock=clock)


@pytest.mark.parametrize(
    "text",
    [
        "ver", "CID", "type", "P1", "P1..9", "p1,5", "I130", "I130 I131", "Q80,4,1", "M162->",
        "M1..9->", "i65???&1??%#1?PVF m190 p99#2?PVF", "#1P #2P", "#", "&1#1", "LIST COMP",
        "LIST GATHER", "list plc 1,0,80", "LIST PROGRAM 5", "RHX:$78000", "RX$000010,4", "???",
        "&1%", "$78000"[:0] + "I$10", "DATE", "SIZE", "list", "LIST BLCOMP", "LIST PROG1,2,3",
    ],
)  # fmt: skip
def test_questions(text):
    assert is_read(text)


@pytest.mark.parametrize(
    "text",
    [
        "", "P1=2", "P1..9=0", "M162->*", "M162->X:$88,0,24", "J+", "#1J/", "K", "A", "O10", "5",
        "-5", "0.5", "$$$", "$$$***", "SAVE", "I130=2000", "&1B1R", "OPEN PLC 1", "CLEAR", "CLOSE",
        "DELETE GATHER", "DEFINE COMP 10", "WX:$10,5", "&1%100", "HOME", "#1HM", "GATHER", "ENDG",
        "ENABLE PLC 1", "P1 J+", "LIST COMP P1=1", "#1->X", "#1->0", "CMD\"J+\"", "P1=P1+1",
        "I130 =5", "UNDEFINE ALL", "R", "S", "H", "Q", "F=1", "I5111=(1)", "LOCK0", "X10",
        "P(1)=2", "&1F100",
    ],
)  # fmt: skip
def test_commands_are_never_taken_for_questions(text):
    assert not is_read(text)


PIECES = st.text(alphabet="PQMI0123456789=.,+-#&JK/ RW$*?", max_size=8)


@given(PIECES, st.sampled_from("=JKW"), PIECES)
def test_no_line_with_an_assignment_or_a_jog_is_a_question(before, acting, after):
    assert not is_read(before + acting + after)


names = st.one_of(
    st.builds("{}{}".format, st.sampled_from("IPQM"), st.integers(0, 40)),
    st.sampled_from(["#1P", "RX$10", "ver", "?"]),
)


@given(st.lists(names, max_size=120))
def test_bulk_questions_keep_their_order_within_the_line_limit(questions):
    asked = [item for batch in line_batches(merged_runs(questions)) for item in batch]
    spelt = []
    for text, count in asked:
        first, _, last = text.partition("..")
        run = [f"{text[0]}{k}" for k in range(int(first[1:]), int(last) + 1)] if last else [text]
        assert len(run) == count
        spelt += run
    assert spelt == questions
    for batch in line_batches(merged_runs(questions)):
        assert sum(len(text) for text, _ in batch) <= 250


def test_long_runs_are_asked_in_pieces():
    runs = list(merged_runs(f"P{k}" for k in range(1200)))
    assert runs == [("P0..511", 512), ("P512..1023", 512), ("P1024..1199", 176)]
    assert [len(batch) for batch in line_batches(runs)] == [1, 1, 1]


@given(st.lists(st.binary(min_size=1, max_size=255), max_size=60), st.booleans())
def test_downloads_keep_their_order_within_the_packet_limit(lines, single):
    batches = list(buffer_batches(lines, single=single))
    assert [line for batch in batches for line in batch] == lines
    assert all(sum(len(line) + 1 for line in batch) <= 1024 for batch in batches)
    if single:
        assert all(len(batch) == 1 for batch in batches)


@pytest.mark.parametrize("framing", PORTS)
def test_bulk_reads_cost_few_requests(framing):
    card = ScriptedCard()
    card.variables.update({f"P{k}": str(k * k) for k in range(400)})
    commander = conversation(framing, card)
    before = commander.statistics.requests
    values = commander.query_many(f"P{k}" for k in range(400))
    assert values == [str(k * k) for k in range(400)]
    assert commander.statistics.requests - before <= 8


def test_a_bulk_read_with_a_missing_line_is_refused():
    commander = conversation()
    with pytest.raises(RemoteProtocolError, match="2 questions gave 3 lines"):
        commander.query_many(["P1", "P2..3"])


@pytest.mark.parametrize("framing", PORTS)
def test_a_refused_line_of_a_download_is_named(framing):
    card = ScriptedCard()
    commander = conversation(framing, card)
    lines = [f"P{k}=1" for k in range(200)]
    lines[150] = "NONSENSE"
    with pytest.raises(CommandRefused, match="NONSENSE") as caught:
        commander.write_buffer(lines)
    context = caught.value.context
    assert context["error"] == 3
    assert 150 in context["candidates"]
    assert context["lines_accepted"] <= 150
    assert caught.value.code == "ERR003"
    assert len(card.executed) == len(set(card.executed) - {"I3I4I6I9"}) + 1  # no line went twice


@pytest.mark.parametrize("framing", PORTS)
@pytest.mark.parametrize("place", [0, 1, 2])
def test_the_first_and_the_last_refused_line_are_candidates(framing, place):
    lines = ["P1=1", "P2=2", "P3=3"]
    lines[place] = "NONSENSE"
    with pytest.raises(CommandRefused, match="NONSENSE") as caught:
        conversation(framing).write_buffer(lines)
    candidates = caught.value.context["candidates"]
    assert place in candidates
    assert len(candidates) <= 2
    if place == 2:  # only one line can be meant, whatever the count starts from
        assert caught.value.context["line_index"] in {2, None}


def test_downloads_report_progress():
    seen = []
    conversation().write_buffer(
        [f"P{k}=1" for k in range(300)], progress=lambda *at: seen.append(at)
    )
    assert seen[-1] == (300, 300)
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)


def test_memory_goes_in_pieces_and_comes_back():
    commander = conversation()
    data = bytes(k * 7 % 256 for k in range(5000))
    commander.set_memory(0x400, data)
    assert commander.get_memory(0x400, 5000) == data
    commander.set_bits(0x400, set_mask=0x8000_0000, clear_mask=0x1)
    word = int.from_bytes(commander.get_memory(0x400, 4), "little")
    assert word == (int.from_bytes(data[:4], "little") | 0x8000_0000) & ~1


@pytest.mark.parametrize("framing", PORTS)
def test_control_characters(framing):
    card = ScriptedCard()
    commander = conversation(framing, card)
    assert commander.control("F") == "0.5 7.2"
    assert commander.control("K") == ""
    assert commander.control(1) == ""
    assert card.controls == [11, 1]
    assert commander.query("ver") == ["1.947  "]
    for wrong in ("", "1", 0, 32):
        with pytest.raises((LocalProtocolError, TypeError)):
            commander.control(wrong)


@pytest.mark.parametrize("text", ["P1=1\rP2=2", "P1\x0b", "P1=\xb5", "x" * 256, "P1\n"])
def test_lines_that_cannot_be_sent_are_refused_before_they_are(text):
    card = ScriptedCard()
    commander = conversation(card=card)
    before = len(card.executed)
    for call in (commander.query, commander.command, lambda t: commander.write_buffer(["P1=1", t])):
        with pytest.raises(LocalProtocolError):
            call(text)
    assert len(card.executed) == before


def test_a_refusal_tells_what_and_why():
    with pytest.raises(CommandRefused) as caught:
        conversation().command("P1 P2 XYZ")
    error = caught.value
    assert error.context["lines"] == ["0", "0"]
    assert error.exit_code == 5
    assert "unrecognised command" in error.message


def test_a_busy_card_is_waited_for():
    port = PacketPort(ScriptedCard(P1=5))
    waits = 0

    def busy(data: bytes) -> bytes:
        nonlocal waits
        answer = port(data)
        if data[1:2] == b"\xbf" and b"P1" in data:
            waits = 40
            busy.answer = answer
            return b"\x00"
        if data[1:2] == b"\xc5" and waits:
            waits -= 1
            return b"\x00" if waits else busy.answer
        return answer

    commander = conversation(port=busy)
    start_s = commander.clock.now_s()
    assert commander.query("P1") == ["5"]
    assert commander.clock.now_s() > start_s


def test_short_parts_are_asked_for_again():
    card = ScriptedCard()
    commander = conversation(port=PacketPort(card, part=100))
    assert len(commander.query("P0..199", timeout_s=60.0)) == 200
    assert commander.query("ver") == ["1.947  "]


def test_threads_share_a_conversation():
    card = ScriptedCard()
    card.variables.update({f"P{k}": str(k) for k in range(100)})
    commander = conversation(card=card)
    wrong = []

    def ask(start: int) -> None:
        for k in range(start, start + 25):
            if commander.query(f"P{k}") != [str(k)]:
                wrong.append(k)

    threads = [threading.Thread(target=ask, args=(25 * k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_a_closed_conversation_says_so():
    commander = conversation()
    commander.close()
    commander.close()
    with pytest.raises(LinkLost, match="closed"):
        commander.query("P1")
    with pytest.raises(LinkLost, match="opened by its owner"):
        commander.reconnect()


@pytest.mark.parametrize(
    ("data", "modes"),
    [
        (b"2\r0\r1\r2\r\x06", Modes(2, 0, 1, 2)),
        (b"I3=2\rI4=0\rI6=1\rI9=3\r\x06", Modes(2, 0, 1, 3)),
        (b"0\r0\r1\r2\r", Modes(0, 0, 1, 2)),
        (b"\n1\r\n0\r\n1\r\n2\r\n", Modes(1, 0, 1, 2)),
        (b"\n3\r\n2\r\n1\r\n2\r\x06", Modes(3, 2, 1, 2)),
        (b"2\r\x3f1\r\x3e1\r\x3e2\r\x3f\x06\xe7", Modes(2, 1, 1, 2)),
        (b"1\r0\r1\r2\r\x06", None),  # says I3=1, but is not written so
        (b"2\r0\r1\r\x06", None),
        (b"2\r0\r1\r9\r\x06", None),
        (b"", None),
    ],
)
def test_modes_are_read_from_an_answer_written_in_them(data, modes):
    assert read_modes(data) == modes


def test_a_terminal_shows_refusals_and_goes_on():
    card = ScriptedCard(P1=5)
    ask = terminal_of(conversation(card=card))
    assert ask("P1") == ["5"]
    assert ask("P1 XYZ") == ["5", "ERR003: data error or unrecognised command"]
    assert ask("^F") == ["0.5 7.2"]
    assert ask("^K") == []
    assert ask("  ") == []
    assert card.controls == [11]


@pytest.mark.parametrize("line", ["$$$", "$$$***", "SAVE"])
def test_a_terminal_waits_for_no_acknowledge_of_a_reset(monkeypatch, line):
    """No card gives one (SRM p. 273); a command that is not answered is an error as before."""
    commander = conversation()

    def silent(_line):
        raise ReplyTimeout("the card did not answer in time")

    monkeypatch.setattr(commander, "command", silent)
    if line == "SAVE":
        with pytest.raises(ReplyTimeout):
            terminal_of(commander)(line)
        return
    answer = terminal_of(commander)(line)
    assert not answer.is_refusal
    assert "acknowledges" in answer[0]


def test_limits_are_reached_and_not_passed():
    commander = conversation()
    longest = "P1" * 127 + " "
    assert len(longest) == 255
    assert len(commander.query(longest)) == 127
    lines = [b"x" * 255] * 12
    assert [len(batch) for batch in buffer_batches(lines, single=False)] == [4, 4, 4]
    assert [len(batch) for batch in buffer_batches([*lines[:4], b""], single=False)] == [4, 1]


def test_a_quiet_session_counts_no_trouble():
    commander = conversation()
    assert commander.query("ver") == ["1.947  "]
    counts = commander.statistics
    assert (counts.retries, counts.resynchronisations, counts.stray_bytes) == (0, 0, 0)
    assert counts.requests == 3  # FLUSH, the modes, the question
    assert counts.bytes_sent == 8 + (8 + 8) + (8 + 3)
    assert counts.bytes_received == 1 + 9 + 9
