"""F01: a second fault: recovery or rollback that is cut itself, foreign tables, another card."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import (
    ControllerState,
    ForeignChange,
    LinkLost,
    PmacCompError,
    SafetyRefusal,
)
from pmac_comp.machine.controller.change import journals
from pmac_comp.machine.controller.change.manifest import end_lines
from pmac_comp.machine.controller.contents.comp_table import CompTable
from pmac_comp.machine.controller.tables import upload
from pmac_comp.machine.controller.tables.table_files import read_table_backup
from pmac_comp.machine.controller.whole import recovery, rollback, waiting
from pmac_comp.machine.controller.whole.grouping import grouped
from pmac_comp.machine.transport.tap import Fault, FaultKind, Way
from tests.fault_table import all_of
from tests.faults.change_bench import ChangeBench, Scenario, cut
from tests.faults.same_state import stand_ins, stretches
from tests.faults.test_f01_f29_every_kind import SCENARIOS, thinned
from tests.faults.upload_bench import (
    SPAN_CT,
    Left,
    SameIds,
    UploadBench,
    new_table,
    old_table,
)
from tests.unit.machine_controller.card_bench import CardBench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]


class TornBench:
    """A change that was cut at a byte, put back as it was left before each recovery."""

    def __init__(self, rig: ChangeBench, at: int) -> None:
        self.rig = rig
        rig.run(cut(Way.SEND, at))
        self._left = Left(rig.fresh())
        self._number = rig.ids.n

    def start(self) -> CardBench:
        """The same card, folder and numbers each time, with a fresh conversation."""
        self._left.put_back()
        self.rig.ids.n = self._number
        return self.rig.fresh()

    def recover(self) -> None:
        bench = self.rig.bench
        recovery.recover(bench.link, bench.context)

    def requests(self) -> list[int]:
        """Byte numbers at which requests of the recovery begin."""
        bench = self.start()
        ends: list[int] = []
        bench.on_request = lambda _n: ends.append(bench.tap.sent)
        self.recover()
        return ends

    def cut_and_recover(self, way: Way, n: int, *, resume: bool) -> None:
        """Cut the recovery at a byte; the next one settles it."""
        self.start().tap.schedule([Fault(FaultKind.CUT, way, n)])
        with suppress(PmacCompError):
            self.recover()
        self.rig.recover(resume=resume)


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_f01_recovery_of_any_change_may_be_cut(
    *,
    scenario: Scenario,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    exhaustive: bool,
    count_runs: Count,
    count_places: Count,
) -> None:
    """At every byte, both ways, of the recovery of changes that were cut early, amid and late."""
    ids = SameIds()
    monkeypatch.setattr(journals, "secrets", ids)
    rig = ChangeBench(tmp_path, scenario, ids)
    edges = rig.edges(Way.SEND)
    for share in (0.33, 0.67, 0.95) if exhaustive else (0.67,):
        torn = TornBench(rig, edges[int(share * len(edges))])
        if not exhaustive:
            for n in thinned(torn.requests(), 5, exhaustive=False):
                torn.cut_and_recover(Way.SEND, n, resume=True)
                count_runs(1)
            continue
        for way in (Way.SEND, Way.RECEIVE):
            places = stretches(torn.start, torn.recover, way, kind=FaultKind.CUT)
            count_places(sum(map(len, places)))
            at = all_of(stand_ins(places))
            for n, resume in at:
                torn.cut_and_recover(way, n, resume=resume)
            count_runs(len(at))


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
    rollback.rollback_last(bench.link, bench.context)
    total = bench.tap.sent
    seen = set()
    for n in all_of(range(total)) if exhaustive else range(0, total, total // 24):
        bench = uploaded(rig)
        bench.tap.sent = 0
        bench.tap.schedule([Fault(FaultKind.CUT, Way.SEND, n)])
        try:
            rollback.rollback_last(bench.link, bench.context)
        except PmacCompError:
            pass
        else:
            assert n >= bench.tap.sent  # random numbers of this run have fewer digits
        seen.add(rig.recover())
        if rig.state is ControllerState.NEW:
            rollback.rollback_last(rig.bench.link, rig.bench.context)
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
    rollback.rollback_last(bench.link, bench.context)
    assert rig.state is ControllerState.OLD
    backups = [read_table_backup(path)[0] for path in bench.folder.glob("*.tables.json")]
    assert any(foreign in tables for tables in backups)
    count_runs(1)


def test_f20_rollback_after_a_reset_does_not_delete_what_somebody_defined_since(
    tmp_path: Path, count_runs: Count
) -> None:
    """The upload is gone with the reset; another tool has begun with an axis of its own."""
    bench = CardBench(tmp_path)
    with grouped(bench.link, bench.context, "table") as parts:
        upload.upload_tables(bench.link, parts, [old_table(24)])
    bench.side_port()("$$$")
    bench.clock.sleep_s(0.5)
    bench.reconnect()
    bench.link.flush()
    theirs = replace(new_table(24), motor=2, source=2)
    bench.link.write_buffer(["I51=0", *theirs.lines, "I51=1"])
    for _ in range(2):
        with pytest.raises(ForeignChange, match="COMP of motor #2") as told:
            rollback.rollback_last(bench.link, bench.context)
        assert told.value.left is ControllerState.DISABLED
        assert bench.values("COMP", 2) == list(theirs.entries)
        assert bench.i51 == 1
        assert waiting.left_open(bench.context) == ()
    count_runs(1)


@pytest.mark.parametrize("whole_upload", [False, True])
@pytest.mark.parametrize("acting", [True, False])
def test_f01_i30_is_as_before_after_a_cut(
    *, tmp_path: Path, whole_upload: bool, acting: bool, count_runs: Count
) -> None:
    """I30 tells how the next table of any tool is loaded; the upload sets it while it writes."""
    rig = UploadBench(tmp_path, n=24)
    block = rig.bench.context.block
    rig.bench.link.write_buffer(["I30=1", f"I51={int(acting)}", *end_lines(block, 0)])
    if not acting and not whole_upload:
        rig.bench.link.command("#1DELETE COMP")  # it would begin to act with ours: refused
    rig.save()
    own = CompTable(2, new_table(400).entries, SPAN_CT)

    def change(bench: CardBench) -> None:
        if whole_upload:
            with grouped(bench.link, bench.context, "table") as parts:
                upload.upload_tables(bench.link, parts, [rig.new, own])
        else:
            upload.upload_tables(bench.link, bench.context, [own])

    bench = rig.restart()
    sent: list[int] = []
    bench.on_request = lambda _n: sent.append(bench.tap.sent)
    change(bench)
    halfway = 0
    for n in sorted({*sent, *range(sent[0], sent[-1], 200)}):
        bench = rig.restart()
        bench.tap.schedule([Fault(FaultKind.CUT, Way.SEND, n)])
        with suppress(PmacCompError):
            change(bench)
        halfway += not int(bench.card.variables.read_i(30))
        for fault in ((Fault(FaultKind.CUT, Way.SEND, 1200),), ()):
            bench.reconnect()
            bench.link.flush()
            bench.tap.sent = 0
            bench.tap.schedule(list(fault))
            with suppress(LinkLost):
                recovery.recover(bench.link, bench.context, resume=False)
        assert int(bench.card.variables.read_i(30)) == 1, n
        count_runs(1)
    assert halfway


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
