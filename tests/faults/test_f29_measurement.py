"""F29: a measurement borrows coordinate system 1; what stood there comes back whatever happens."""

from collections.abc import Callable
from pathlib import Path

import pytest

from pmac_comp.base.errors import ForeignChange, LinkError, PmacCompError
from pmac_comp.machine.controller.contents.settings import plain_axes, read_axes
from pmac_comp.machine.controller.settings import temporary
from pmac_comp.machine.controller.whole import recovery
from pmac_comp.machine.transport.tap import Fault, FaultKind, Way
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.axis_setup import AxisSetup, borrowed
from tests.fault_table import all_of
from tests.faults.same_state import stand_ins, stretches
from tests.faults.upload_bench import put_back, saved
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
FOREIGN = ((1, 1, "500X"), (1, 8, "4W"), (2, 3, "7Z"))


@pytest.fixture
def bench(tmp_path: Path) -> CardBench:
    found = make_plc_bench(tmp_path)
    found.link.write_buffer(["UNDEFINE ALL", *(f"&{c}#{m}->{t}" for c, m, t in FOREIGN)])
    found.link.write_buffer(["I5190=500"])
    return found


def as_before(bench: CardBench) -> bool:
    """Definitions and units by a conversation of its own."""
    bench.reconnect()
    axes = plain_axes(read_axes(bench.link))
    return axes == plain_axes(FOREIGN) and bench.card.variables.read_i(5190) == 500


def axis_on(bench: CardBench) -> Axis:
    return Axis(bench.link, bench.bench, "controller", setup=AxisSetup(bench.folder))


def put_on(bench: CardBench) -> None:
    temporary.put_on(bench.link, bench.context, borrowed(bench.link, 1), motors=(1,))


def test_definitions_come_back_after_a_session(bench: CardBench) -> None:
    axis = axis_on(bench)
    axis.define_axis()
    assert plain_axes(read_axes(bench.link)) == {(1, 1, "X"), (2, 3, "7Z")}
    axis.define_axis()  # stands: nothing more is written
    assert len(temporary.standing(bench.context)) == 1
    axis.release_axis()
    assert as_before(bench)
    assert not temporary.standing(bench.context)


def test_nothing_is_left_where_nothing_stood(bench: CardBench) -> None:
    bench.link.write_buffer(["UNDEFINE ALL", "&2#3->7Z", "I5190=1000", "I5113=0", "I42=0"])
    axis = axis_on(bench)
    axis.define_axis()
    assert plain_axes(read_axes(bench.link)) == {(1, 1, "X"), (2, 3, "7Z")}
    axis.release_axis()
    assert plain_axes(read_axes(bench.link)) == {(2, 3, "7Z")}


def test_f29_left_by_a_kill_it_is_taken_off_by_recover_or_the_next_session(
    bench: CardBench, count_runs: Count
) -> None:
    put_on(bench)
    bench.reconnect()
    assert "as before the measurement" in str(recovery.recover(bench.link, bench.context).notes)
    assert as_before(bench)
    put_on(bench)
    bench.reconnect()
    bench.link.write_buffer(["&1#8->X"])
    axis = axis_on(bench)
    with pytest.raises(ForeignChange, match="left alone"):
        axis.define_axis()
    bench.link.write_buffer(["&1#8->0"])
    axis.define_axis()
    temporary.take_off(bench.link, bench.context)
    assert as_before(bench)
    count_runs(2)


@pytest.mark.parametrize("way", [Way.SEND, Way.RECEIVE])
def test_f01_cut_while_it_is_taken_off(
    *, bench: CardBench, way: Way, exhaustive: bool, count_runs: Count, count_places: Count
) -> None:
    put_on(bench)
    state = saved(bench)
    files = {path: path.read_bytes() for path in bench.folder.iterdir() if path.is_file()}

    def start() -> CardBench:
        put_back(bench, state)
        for path in bench.folder.iterdir():
            path.unlink()
        for path, text in files.items():
            path.write_bytes(text)
        bench.tap.sent = bench.tap.received = 0
        return bench

    def change() -> None:
        temporary.take_off(bench.link, bench.context)

    if exhaustive:
        places = stretches(start, change, way, kind=FaultKind.CUT)
        at = all_of(stand_ins(places))
        count_places(sum(map(len, places)))
    else:
        start()
        change()
        total = bench.tap.sent if way is Way.SEND else bench.tap.received
        at = [(n, n % 2 == 0) for n in range(0, total, max(1, total // 12))]
    for n, resume in at:
        start().tap.schedule([Fault(FaultKind.CUT, way, n)])
        with pytest.raises(LinkError):
            change()
        bench.reconnect()
        recovery.recover(bench.link, bench.context, resume=resume)
        assert as_before(bench), n
    count_runs(len(at))


def test_f22_nothing_is_put_aside_while_the_axis_moves(bench: CardBench) -> None:
    bench.link.command("#1J+")
    bench.clock.sleep_s(0.1)
    with pytest.raises(PmacCompError, match="executing a move"):
        axis_on(bench).define_axis()
    assert as_before(bench)
