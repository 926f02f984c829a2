"""Link faults F03 to F06, F08: cut, silent, late, talkative and slow peers, in virtual time."""

import random
from contextlib import suppress

import pytest

from pmac_comp.base.errors import LinkError, PmacCompError, ReplyTimeout
from pmac_comp.machine.transport.base import Framing
from pmac_comp.machine.transport.tap import Fault, FaultKind, Way
from pmac_comp.machine.wire.dialog import format_reply, format_unsolicited
from pmac_comp.machine.wire.replies import ReplyReader
from tests.contract.scripted_card import ScriptedCard
from tests.faults.link_bench import LinkBench, TIMEOUT_s

pytestmark = pytest.mark.faults
FRAMINGS = [Framing.PACKETS, Framing.LINES]

# (what is called, what it gives) for each kind of answer
CALLS = {
    "value": (lambda c: c.query("P7"), ["77"]),
    "values": (lambda c: c.query("P0..20"), [str(11 * k) for k in range(21)]),
    "acknowledgement": (lambda c: c.command("P500=1"), []),
    "version": (lambda c: c.query("ver"), ["1.947  "]),
    "report": (lambda c: c.control("F"), "0.5 7.2"),
}
PACKET_CALLS = {
    "memory": (lambda c: c.get_memory(0x400, 64), bytes(64)),
    "verdict": (lambda c: c.write_buffer(["P501=1", "P502=2"]), None),
}


def tagged_card() -> ScriptedCard:
    card = ScriptedCard()
    card.variables.update({f"P{k}": str(11 * k) for k in range(100)})
    return card


def calls_of(framing):
    return CALLS | (PACKET_CALLS if framing is Framing.PACKETS else {})


CASES = [(framing, name) for framing in FRAMINGS for name in calls_of(framing)]


def answer_size(framing, call) -> int:
    bench = LinkBench(framing, card=tagged_card())
    before = bench.tap.received
    call(bench.commander)
    return bench.tap.received - before


@pytest.mark.parametrize(("framing", "name"), CASES)
def test_f03_split_answers_give_the_same(framing, name):
    call, wanted = calls_of(framing)[name]
    for size in range(1, answer_size(framing, call) + 1):
        bench = LinkBench(framing, card=tagged_card())
        bench.break_link([Fault(FaultKind.SPLIT, way, argument=size) for way in Way])
        assert call(bench.commander) == wanted


def test_f03_random_splits_of_glued_answers(exhaustive):
    rng = random.Random(3)
    for _ in range(10_000 if exhaustive else 2_000):
        lines = [str(rng.randrange(10**6)) for _ in range(rng.randrange(5))]
        data = format_reply(lines, i3=2, error=rng.choice([None, None, 3]))
        edges = sorted(rng.sample(range(len(data) + 1), min(3, len(data))))
        reader = ReplyReader()
        for start, end in zip([0, *edges], [*edges, len(data)], strict=True):
            reader.receive(data[start:end])
        assert reader.done
        assert reader.reply.lines == tuple(lines)


@pytest.mark.parametrize(("framing", "name"), CASES)
def test_f04_silence_after_every_prefix_ends_at_the_deadline(framing, name):
    call, _ = calls_of(framing)[name]
    for size in range(answer_size(framing, call)):
        bench = LinkBench(framing, card=tagged_card())
        bench.break_link([Fault(FaultKind.SILENCE, Way.RECEIVE, at=size)])
        start_s = bench.clock.now_s()
        with pytest.raises(ReplyTimeout):
            call(bench.commander)
        assert bench.clock.now_s() - start_s == pytest.approx(TIMEOUT_s, abs=0.05)
        # The link is not simply used again: as long as no mark is seen, nothing is answered.
        for _ in range(2):
            with pytest.raises(LinkError):
                bench.commander.query("P7")


@pytest.mark.parametrize("framing", FRAMINGS)
@pytest.mark.parametrize("late_s", [0.4 * TIMEOUT_s, 0.7 * TIMEOUT_s, 1.5 * TIMEOUT_s, 50.0])
def test_f05_a_late_answer_never_answers_another_question(framing, late_s, exhaustive):
    n_questions = 20
    total = answer_size(framing, lambda c: [c.query(f"P{k}") for k in range(n_questions)])
    mixed, answered = 0, 0
    for at in range(0, total, 1 if exhaustive else 3):
        bench = LinkBench(framing, card=tagged_card())
        bench.break_link([Fault(FaultKind.DELAY, Way.RECEIVE, at=at, argument=late_s)])
        for k in range(n_questions):
            try:
                value = bench.commander.query(f"P{k}")
            except PmacCompError:
                continue
            answered += 1
            mixed += value != [str(11 * k)]
    assert mixed == 0
    assert answered > 0


@pytest.mark.parametrize("framing", FRAMINGS)
@pytest.mark.parametrize("late_s", [0.3, 0.49, 0.501, 0.52, 0.6, 0.9])
def test_f05_a_conversation_opens_though_the_first_answer_is_late(framing, late_s):
    late = Fault(FaultKind.DELAY, Way.RECEIVE, at=0, argument=late_s)
    bench = LinkBench(framing, card=tagged_card(), at_opening=[late])
    assert [bench.commander.query(f"P{k}") for k in range(3)] == [["0"], ["11"], ["22"]]


@pytest.mark.parametrize("framing", FRAMINGS)
@pytest.mark.parametrize("noise", [b"@", b"\x40\x40", b"garbage", b"7\r\x06"])
def test_f06_a_conversation_opens_though_something_stands_before_the_first_answer(framing, noise):
    at = {Framing.PACKETS: 1, Framing.LINES: 0}[framing]  # FLUSH is answered by one byte
    stray = Fault(FaultKind.INJECT, Way.RECEIVE, at=at, data=noise)
    bench = LinkBench(framing, card=tagged_card(), at_opening=[stray])
    assert [bench.commander.query(f"P{k}") for k in range(3)] == [["0"], ["11"], ["22"]]


@pytest.mark.parametrize("framing", FRAMINGS)
def test_f05_writes_are_sent_once_whatever_comes_back(framing):
    size = answer_size(framing, lambda c: c.command("P500=1"))
    for at in range(size):
        for late_s in (0.4 * TIMEOUT_s, 1.5 * TIMEOUT_s, 100.0):
            bench = LinkBench(framing)
            bench.break_link([Fault(FaultKind.DELAY, Way.RECEIVE, at=at, argument=late_s)])
            with suppress(PmacCompError):
                bench.commander.command("P500=7")
            with suppress(PmacCompError):
                bench.commander.query("P1")
            assert bench.card.executed.count("P500=7") == 1


@pytest.mark.parametrize("framing", FRAMINGS)
@pytest.mark.parametrize(
    "noise", [b"\r\n", b"\n", b"\r", b"\x00", format_unsolicited("MOVE DONE"), b"\x18\r\n\n"]
)
def test_f06_stray_text_before_an_answer_never_shifts_it(framing, noise):
    questions = [f"P{k}" for k in range(6)]
    sizes = [answer_size(framing, lambda c, q=q: c.query(q)) for q in questions]
    for boundary in range(len(questions)):
        bench = LinkBench(framing, card=tagged_card())
        at = sum(sizes[:boundary])
        bench.break_link([Fault(FaultKind.INJECT, Way.RECEIVE, at=at, data=noise)])
        assert [bench.commander.query(q) for q in questions] == [[str(11 * k)] for k in range(6)]


@pytest.mark.parametrize("framing", FRAMINGS)
def test_f06_a_whole_stray_answer_is_flagged(framing):
    bench = LinkBench(framing, card=tagged_card())
    bench.break_link([Fault(FaultKind.INJECT, Way.RECEIVE, at=0, data=b"999\r\x06")])
    assert bench.commander.query("P5") == ["55"]
    assert bench.commander.statistics.retries == 1
    assert bench.commander.statistics.stray_bytes > 0


def test_f06_text_of_programs_is_kept():
    bench = LinkBench(Framing.LINES, card=tagged_card())
    speech = format_unsolicited("MOVE DONE")
    bench.break_link([Fault(FaultKind.INJECT, Way.RECEIVE, at=2, data=speech)])
    assert bench.commander.query("P55") == ["605"]
    assert bench.commander.take_unsolicited() == ["MOVE DONE"]
    assert bench.commander.take_unsolicited() == []


@pytest.mark.parametrize("framing", FRAMINGS)
def test_f06_text_of_programs_glued_behind_an_answer_is_no_fault(framing):
    size = answer_size(framing, lambda c: c.query("P5"))
    bench = LinkBench(framing, card=tagged_card())
    speech = format_unsolicited("MOVE DONE")
    peer = bench.tap.receive

    def glued(deadline):
        data = peer(deadline)
        return data + speech if len(data) == size else data

    bench.tap.receive = glued
    assert bench.commander.query("P5") == ["55"]
    assert bench.commander.take_unsolicited() == ["MOVE DONE"]
    assert bench.commander.statistics.retries == 0
    assert bench.commander.statistics.resynchronisations == 0


@pytest.mark.parametrize("framing", FRAMINGS)
def test_f08_a_slow_peer_meets_the_total_deadline(framing):
    bench = LinkBench(framing, card=tagged_card())
    bench.break_link([Fault(FaultKind.SLOW, Way.RECEIVE, argument=1.0)])
    start_s = bench.clock.now_s()
    with pytest.raises(ReplyTimeout):
        bench.commander.query("P0..20")
    assert bench.clock.now_s() - start_s == pytest.approx(TIMEOUT_s, abs=0.05)


@pytest.mark.parametrize("framing", FRAMINGS)
def test_f08_a_slow_peer_is_waited_for_where_time_allows(framing):
    bench = LinkBench(framing, card=tagged_card())
    bench.break_link([Fault(FaultKind.SLOW, Way.RECEIVE, argument=1.0)])
    assert bench.commander.query("P5", timeout_s=60.0) == ["55"]
