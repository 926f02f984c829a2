"""F01: a second fault: recovery or rollback that is cut itself, foreign tables, another card."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import ControllerState, ForeignChange, PmacCompError, SafetyRefusal
from pmac_comp.machine.controller import recovery, upload
from pmac_comp.machine.controller.comp_table import CompTable
from pmac_comp.machine.controller.recovery import grouped
from pmac_comp.machine.transport.tap import Fault, FaultKind, Way
from tests.fault_table import all_of
from tests.faults.change_bench import ChangeBench, Scenario, cut
from tests.faults.test_f01_f29_every_kind import SCENARIOS, thinned
from tests.faults.upload_bench import SPAN_CT, UploadBench
from tests.unit.machine_controller.card_bench import CardBench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_f01_recovery_of_any_change_may_be_cut(
    *, scenario: Scenario, tmp_path: Path, exhaustive: bool, count_runs: Count
) -> None:
    rig = ChangeBench(tmp_path, scenario)
    edges = rig.edges(Way.SEND)
    middle = edges[2 * len(edges) // 3]

    def torn() -> CardBench:
        rig.run(cut(Way.SEND, middle))
        return rig.fresh()

    bench = torn()
    bench.tap.sent = 0
    ends: list[int] = []
    bench.on_request = lambda _n: ends.append(bench.tap.sent)
    recovery.recover(bench.link, bench.context)
    for n in thinned(ends, 5, exhaustive=exhaustive):
        bench = torn()
        bench.tap.sent = 0
        bench.tap.schedule([Fault(FaultKind.CUT, Way.SEND, n)])
        with suppress(PmacCompError):
            recovery.recover(bench.link, bench.context)
        rig.recover(resume=True)
        count_runs(1)


def uploaded(rig: UploadBench) -> CardBench:
    """The new table as the only part of an upload that was done."""
    bench = rig.restart()
    with grouped(bench.link, bench.context, "table") as parts:
        upload.upload_tables(bench.link, parts, [rig.new])
    return bench


def test_f01_rollback_may_be_cut(*, tmp_path: Path, exhaustive: bool, count_runs: Count) -> None:
    """The verdict of a recovery after it is that of the table that acts; it can be repeated."""
    rig = UploadBench(tmp_path, n=24)
    bench = uploaded(rig)
    bench.tap.sent = 0
    recovery.rollback_last(bench.link, bench.context)
    total = bench.tap.sent
    seen = set()
    for n in all_of(range(total)) if exhaustive else range(0, total, total // 24):
        bench = uploaded(rig)
        bench.tap.sent = 0
        bench.tap.schedule([Fault(FaultKind.CUT, Way.SEND, n)])
        with pytest.raises(PmacCompError):
            recovery.rollback_last(bench.link, bench.context)
        seen.add(rig.recover())
        if rig.state is ControllerState.NEW:
            recovery.rollback_last(rig.bench.link, rig.bench.context)
        assert rig.state is ControllerState.OLD
        count_runs(1)
    assert seen == {ControllerState.OLD, ControllerState.NEW}


STEEP = CompTable(1, (800,) * 39 + (0,), SPAN_CT, wrap=False)


def by_hand(bench: CardBench, table: CompTable) -> None:
    """Another program defines a table and switches it on."""
    line = bench.side_port()
    for text in ("I51=0", "#1DELETE COMP", *table.lines, "I51=1"):
        line(text)


def test_f17_foreign_tables_are_not_switched_off_under_a_moving_axis(
    tmp_path: Path, count_runs: Count
) -> None:
    rig = UploadBench(tmp_path, n=24)
    bench = uploaded(rig)
    by_hand(bench, STEEP)
    bench.link.command("#1J+")
    bench.clock.sleep_s(0.2)
    with pytest.raises(SafetyRefusal, match="executing a move"):
        recovery.recover(bench.link, bench.context)
    assert bench.i51 == 1
    bench.link.command("#1J/")
    bench.clock.sleep_s(0.5)
    with pytest.raises(SafetyRefusal, match="would move motor") as refused:
        recovery.recover(bench.link, bench.context)
    assert bench.i51 == 1
    assert not refused.value.context["confirmed"]
    bench.link.command("#1K")
    bench.clock.sleep_s(1.0)
    with pytest.raises(ForeignChange) as told:
        recovery.recover(bench.link, bench.context)
    assert bench.i51 == 0
    assert told.value.left is ControllerState.DISABLED
    count_runs(3)


def test_f17_rollback_after_a_foreign_change_says_what_it_replaced(
    tmp_path: Path, count_runs: Count
) -> None:
    """The foreign table goes into a backup before the old one comes back."""
    rig = UploadBench(tmp_path, n=24)
    bench = uploaded(rig)
    foreign = replace(rig.new, entries=tuple(v // 2 for v in rig.new.entries))
    by_hand(bench, foreign)
    recovery.rollback_last(bench.link, bench.context)
    assert rig.state is ControllerState.OLD
    backups = [p.read_text(encoding="utf-8") for p in bench.folder.glob("*.tables.json")]
    assert any(str(list(foreign.entries))[1:40] in text for text in backups)
    count_runs(1)


def test_f19_journals_of_another_card_are_left_alone(tmp_path: Path, count_runs: Count) -> None:
    """A card of another identity in the same folder: nothing of it is touched."""
    rig = UploadBench(tmp_path, n=24)
    rig.upload_with(lambda b: b.tap.schedule([Fault(FaultKind.CUT, Way.SEND, 900)]))
    other = CardBench(tmp_path)
    other.link.command("#1J/")
    other.clock.sleep_s(0.05)
    upload.upload_tables(other.link, replace(other.context, store=tmp_path / "own"), [rig.old])
    context = replace(other.context, controller="another")
    result = recovery.recover(other.link, context)
    assert result.verdict in {ControllerState.OLD, ControllerState.NEW}
    assert tuple(other.values("COMP", 1) or ()) == rig.old.entries
    assert other.i51 == 1
    assert rig.recover() in {ControllerState.OLD, ControllerState.NEW}
    count_runs(1)
