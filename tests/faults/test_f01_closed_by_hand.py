"""F01: a motion program cut while it is written, closed by hand and run, moves nothing."""

from collections.abc import Callable
from pathlib import Path

import pytest

from pmac_comp.base.errors import CommandRefused, ControllerState, LinkError
from pmac_comp.machine.controller.contents.programs import sealed_motion
from pmac_comp.machine.controller.settings.program_upload import upload_program
from pmac_comp.machine.controller.whole import recovery
from pmac_comp.machine.transport.tap import Way
from tests.faults.change_bench import PROGRAM, cut
from tests.faults.upload_bench import put_back, saved
from tests.unit.machine_controller.card_bench import AXIS_LINES, CardBench, make_plc_bench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
MOVES = ("ABS", "LINEAR", "TA20", "TM40", *(f"X{100 * k}" for k in range(1, 400)), "X0")
SEALED = sealed_motion(PROGRAM, MOVES, motor=1)
MISSING_LABEL = 6  # run-time error, Y:$2014


def run_by_hand(bench: CardBench) -> float:
    """CLOSE and run, as a person at a terminal would; the largest way of motor 1 in counts."""
    start = float(bench.link.query("#1P")[0])
    for line in ("CLOSE", f"&1B{PROGRAM}R"):
        try:
            bench.link.command(line)
        except CommandRefused:
            continue
    largest = 0.0
    for _ in range(10):
        bench.clock.sleep_s(0.03)
        largest = max(largest, abs(float(bench.link.query("#1P")[0]) - start))
    return largest


def test_f01_half_a_program_closed_by_hand_moves_nothing(tmp_path: Path, count_runs: Count) -> None:
    bench = make_plc_bench(tmp_path)
    bench.link.write_buffer(list(AXIS_LINES))
    start = saved(bench)
    bench.tap.sent = 0
    written: list[int] = []
    bench.on_request = lambda _n: written.append(bench.tap.sent)
    upload_program(bench.link, bench.context, SEALED)
    assert run_by_hand(bench) > 50.0, "the whole program moves"
    bench.link.command("&1A")
    half = 0
    for n in written:
        put_back(bench, start)
        for path in tmp_path.iterdir():
            path.unlink()
        bench.tap.sent = 0
        bench.tap.schedule(list(cut(Way.SEND, n)))
        try:
            upload_program(bench.link, bench.context, SEALED)
        except LinkError:
            pass
        else:
            continue
        bench.reconnect()
        stored = bench.card.programs.programs.get(PROGRAM)
        there = 0 if stored is None else len(stored.statements)
        if 0 < there < len(SEALED.lines):
            half += 1
            assert run_by_hand(bench) < 2.0, n
            error = bench.link.query("RY$2014")[0]
            assert error == str(MISSING_LABEL), (n, error)
        result = recovery.recover(bench.link, bench.context)
        assert result.verdict in {ControllerState.OLD, ControllerState.NEW}
    assert half >= 1
    count_runs(half)
