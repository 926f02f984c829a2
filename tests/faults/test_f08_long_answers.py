"""F08: answers and downloads that take minutes on a slow line, without a pause and with one."""

from collections.abc import Callable
from pathlib import Path

import pytest

from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import ControllerState, ReplyTimeout
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.change.manifest import CLOCK_PER_s
from pmac_comp.machine.controller.contents.programs import Program, ProgramKind
from pmac_comp.machine.controller.settings.program_upload import upload_program
from pmac_comp.machine.transport.base import Framing
from pmac_comp.machine.transport.pair import PairTransport
from pmac_comp.machine.transport.tap import Fault, FaultKind, Way
from pmac_comp.simulator.dialog.sessions import AsciiSession
from tests.faults.upload_bench import new_table
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
PIECE = 40


class SlowLine(PairTransport):
    """A serial line that hands over 40 bytes in a twentieth of a second."""

    pauses_at = 1 << 30
    handed = 0
    kept = b""

    def receive(self, deadline: Deadline) -> bytes:
        while not self.kept:
            self.kept = super().receive(deadline)
        if self.handed >= self.pauses_at:
            self._clock.sleep_s(deadline.remaining_s() + 0.01)
            raise ReplyTimeout("silence")
        self._clock.sleep_s(PIECE / 800)
        piece, self.kept = self.kept[:PIECE], self.kept[PIECE:]
        self.handed += len(piece)
        return piece


def on_a_slow_line(bench: CardBench) -> tuple[Commander, SlowLine]:
    session = AsciiSession(bench.card)
    line = SlowLine(session.receive, bench.clock, framing=Framing.LINES)
    return Commander(line, clock=bench.clock, timeout_s=2.0), line


def test_a_listing_may_take_longer_than_other_answers(tmp_path: Path, count_runs: Count) -> None:
    bench = make_plc_bench(tmp_path)
    table = new_table(1000)
    bench.link.write_buffer(table.lines)
    link, line = on_a_slow_line(bench)
    start_s = bench.clock.now_s()
    assert len(" ".join(link.query("#1LIST COMP")).split()) == 1000
    assert bench.clock.now_s() - start_s > 4.0
    line.pauses_at = line.handed + 2000
    start_s = bench.clock.now_s()
    with pytest.raises(ReplyTimeout):
        link.query("#1LIST COMP")
    assert bench.clock.now_s() - start_s < 15.0  # two tries, each to its pause, and the marks
    count_runs(2)


def test_a_listing_that_stops_is_not_waited_for(tmp_path: Path, count_runs: Count) -> None:
    """Ten minutes are for an answer that comes; on the packet port, too, a pause ends it."""
    bench = make_plc_bench(tmp_path)
    bench.link.write_buffer(new_table(1000).lines)
    begin = bench.tap.received
    bench.link.query("#1LIST COMP")
    total = bench.tap.received - begin
    places = (1, 700, 1400, 1401, 2100, total - 1)
    for after in places:
        bench.reconnect()
        bench.link.query("I51")
        fault = Fault(FaultKind.SILENCE, Way.RECEIVE, bench.tap.received + after)
        bench.tap.schedule([fault])
        start_s = bench.clock.now_s()
        with pytest.raises(ReplyTimeout):
            bench.link.query("#1LIST COMP")
        assert bench.clock.now_s() - start_s < 10.0, after  # one pause of 1 s, and the marks
    count_runs(len(places))


def test_f19_the_lease_outlives_a_program_of_minutes(tmp_path: Path, count_runs: Count) -> None:
    bench = make_plc_bench(tmp_path)
    lines = tuple(f"X{k}:{k % 90}" for k in range(6000))
    expired: list[float] = []

    def wait(_n: int) -> None:
        if bench.card.programs.open_program is not None:
            bench.clock.sleep_s(3.0)
            left_s = bench.p(7079) / CLOCK_PER_s - bench.clock.now_s()
            if left_s < 0.0:
                expired.append(left_s)

    bench.link.timeout_s = 5.0
    bench.on_request = wait
    start_s = bench.clock.now_s()
    program = Program(ProgramKind.PROG, 710, ("LINEAR", *lines))
    result = upload_program(bench.link, bench.context, program)
    assert result.verdict is ControllerState.NEW
    assert bench.clock.now_s() - start_s > 120.0
    assert not expired
    assert bench.p(7078) == 0
    count_runs(1)
