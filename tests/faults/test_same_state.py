"""What lets one byte stand for many: it must tell bytes apart that leave something else."""

from pathlib import Path

import pytest

from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import CommandRefused
from pmac_comp.machine.client.packet_link import PacketLink
from pmac_comp.machine.transport.tap import FaultKind, Way
from pmac_comp.machine.wire.ethernet import Malformed, Request, RequestReader
from pmac_comp.machine.wire.replies import Reply
from tests.faults.card_state import SavedState, digest
from tests.faults.same_state import stand_ins, stretches
from tests.faults.upload_bench import put_back, saved
from tests.unit.machine_controller.card_bench import CardBench

QUESTION = "I100,10"
LINES = ("P7300=1", "P7301=2")


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> CardBench:
    return CardBench(tmp_path_factory.mktemp("same"))


@pytest.fixture
def start(bench: CardBench) -> SavedState:
    return saved(bench)


def found(
    bench: CardBench, start: SavedState, way: Way, kind: FaultKind = FaultKind.CUT
) -> list[range]:
    """Stretches of a change that writes two variables and reads ten."""

    def again() -> CardBench:
        put_back(bench, start)
        bench.tap.sent = bench.tap.received = 0
        return bench

    def change() -> None:
        bench.link.write_buffer(list(LINES))
        bench.link.query(QUESTION)

    return stretches(again, change, way, kind=kind)


def test_a_packet_is_nothing_until_it_is_whole(bench: CardBench, start: SavedState) -> None:
    sizes = [len(r) for r in found(bench, start, Way.SEND)]
    assert sizes[::2] == [1, 1]
    assert sum(sizes) == bench.tap.sent


def test_a_card_that_acts_on_half_a_packet_is_found(
    bench: CardBench, start: SavedState, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = RequestReader.receive

    def hasty(self: RequestReader, data: bytes) -> list[Request | Malformed]:
        if b"P7300" in data:
            bench.card.variables.write("P", 7300, 5.0)
        return plain(self, data)

    monkeypatch.setattr(RequestReader, "receive", hasty)
    with pytest.raises(AssertionError):
        found(bench, start, Way.SEND)


@pytest.mark.parametrize("kind", [FaultKind.CUT, FaultKind.SILENCE])
def test_a_host_that_acts_on_half_an_answer_has_a_stretch_for_it(
    bench: CardBench, start: SavedState, kind: FaultKind, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = found(bench, start, Way.RECEIVE, kind)
    plain = PacketLink.exchange

    def hasty(self: PacketLink, command: bytes, deadline: Deadline) -> Reply:
        receive = self._receive

        def look(deadline: Deadline) -> bytes:
            data = receive(deadline)
            if len(data) == 9:
                raise CommandRefused("enough")
            return data

        if command == QUESTION.encode():
            monkeypatch.setattr(self, "_receive", look)
        return plain(self, command, deadline)

    monkeypatch.setattr(PacketLink, "exchange", hasty)
    after = found(bench, start, Way.RECEIVE, kind)
    assert len(after) > len(before)
    assert any(len(r) == 1 for r in after)


def test_both_ends_of_every_stretch_are_run() -> None:
    assert stand_ins([range(3), range(3, 4)]) == [(0, True), (2, False), (3, True), (3, False)]


def test_a_card_comes_back_whole(bench: CardBench, start: SavedState) -> None:
    bench.session.close()
    start.put_back()
    before = digest(bench.card)
    bench.connect()
    bench.link.write_buffer([*LINES, "OPEN PROG 9 CLEAR", "X1", "CLOSE", "#1J+", "I5=3"])
    bench.clock.sleep_s(0.2)
    bench.session.close()
    assert digest(bench.card) != before
    start.put_back()
    assert digest(bench.card) == before
    bench.connect()


def test_what_cannot_be_seen_is_refused() -> None:
    with pytest.raises(TypeError, match="cannot be seen"):
        digest(k for k in range(3))


def test_every_value_counts(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    bench.session.close()
    before = digest(bench.card)
    for change in (("memory", "x"), ("memory", "y")):
        words = getattr(getattr(bench.card, change[0]), change[1])
        words[12345] += 1
        assert digest(bench.card) != before
        words[12345] -= 1
    assert digest(bench.card) == before
