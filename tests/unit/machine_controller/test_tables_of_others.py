"""Tables that are not of this change: off they stay off, and they come back as they were."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import AmplitudeExceeded, ControllerState, SafetyRefusal, VerifyMismatch
from pmac_comp.machine.controller.change.manifest import Manifest, ManifestState
from pmac_comp.machine.controller.contents.comp_table import CompTable, TableKind
from pmac_comp.machine.controller.tables import upload
from pmac_comp.machine.controller.tables.table_status import read_head
from pmac_comp.machine.controller.tables.upload_checks import acted
from pmac_comp.machine.controller.whole import grouping, recovery, rollback
from tests.unit.machine_controller.card_bench import CardBench

NEW = CompTable(1, (16, 32, 16, 0), 640000, by_desired=True)
FOREIGN = ["I30=0", "#3DEFINE COMP 4,#3,#3,640000", "8000 16000 8000 0"]
ENTRIES = [8000, 16000, 8000, 0]


def test_an_upload_does_not_switch_on_what_was_off(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    bench.link.write_buffer([*FOREIGN, "I51=0"])
    with pytest.raises(SafetyRefusal, match="COMP of motor #3 would begin to act") as refused:
        upload.upload_tables(bench.link, bench.context, [NEW])
    assert (refused.value.code, refused.value.left) == ("PC-UPL-070", ControllerState.OLD)
    assert (bench.i51, bench.values("COMP", 1)) == (0, None)
    bench.link.command("I51=1")
    result = upload.upload_tables(bench.link, bench.context, [NEW])
    assert (result.verdict, bench.i51) == (ControllerState.NEW, 1)


@pytest.mark.parametrize("on", [0, 1])
def test_a_removal_leaves_others_on_or_off(tmp_path: Path, on: int) -> None:
    bench = CardBench(tmp_path)
    bench.link.write_buffer([*FOREIGN, *NEW.lines, f"I51={on}"])
    with grouping.grouped(bench.link, bench.context, "remove") as parts:
        upload.remove_tables(bench.link, parts, [(TableKind.COMP, 1)])
    assert (bench.i51, bench.values("COMP", 1), bench.values("COMP", 3)) == (on, None, ENTRIES)
    assert recovery.recover(bench.link, bench.context).verdict is ControllerState.NEW
    assert bench.i51 == on
    rollback.rollback_last(bench.link, bench.context)
    assert bench.i51 == on
    assert tuple(bench.values("COMP", 1) or ()) == NEW.entries


def test_what_an_interrupted_upload_switched_off_did_act(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    manifest = Manifest(ManifestState.WRITING, 4711, 4, 1, 2, enabled_old=1)
    bench.link.write_buffer(manifest.lines(bench.context.block))
    assert acted(read_head(bench.link, bench.context))
    sealed = replace(manifest, state=ManifestState.VALID)
    bench.link.write_buffer(sealed.lines(bench.context.block))
    assert not acted(read_head(bench.link, bench.context))


def at_zero(bench: CardBench) -> int:
    """Compensation register of motor 1, whose position is 0."""
    bench.clock.sleep_s(0.1)
    return int(bench.link.query("RL$90")[0])


@pytest.mark.parametrize("i30", [0, 1])
@pytest.mark.parametrize("last", [80, -80])
def test_a_table_that_does_not_end_with_0_comes_back_as_it_was(
    tmp_path: Path, i30: int, last: int
) -> None:
    """Its listing does not tell whether it was loaded with I30; #2 lies below it in the stack."""
    bench = CardBench(tmp_path)
    bench.link.write_buffer(
        [f"I30={i30}", "#1DEFINE COMP 4,#1,#1,640000", f"80 {last} 80 {last}", "I30=0", "I51=1"]
    )
    before = at_zero(bench)
    assert bool(before) is bool(i30)
    with grouping.grouped(bench.link, bench.context, "table") as parts:
        result = upload.upload_tables(bench.link, parts, [replace(NEW, motor=2, source=2)])
    assert (at_zero(bench), result.notes) == (before, ())
    rollback.rollback_last(bench.link, bench.context)
    assert at_zero(bench) == before
    with grouping.grouped(bench.link, bench.context, "table") as parts:
        upload.upload_tables(bench.link, parts, [NEW])
    assert at_zero(bench) == 0
    rollback.rollback_last(bench.link, bench.context)
    assert at_zero(bench) == before


def test_a_card_that_keeps_tables_elsewhere_is_told_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = CardBench(tmp_path)
    bench.link.write_buffer(["I30=1", "#1DEFINE COMP 2,#1,#1,640000", "16 16", "I30=0", "I51=1"])
    before = at_zero(bench)
    query = bench.link.query

    def elsewhere(text: str, **options: object) -> list[str]:
        lines = query(text, **options)  # type: ignore[arg-type]
        return [str(int(v) + 3) for v in lines] if text.startswith("RY$3192") else lines

    monkeypatch.setattr(bench.link, "query", elsewhere)
    result = upload.upload_tables(bench.link, bench.context, [replace(NEW, motor=2, source=2)])
    assert result.verdict is ControllerState.NEW
    assert "COMP of motor #1 holds at position 0 cannot be read" in result.notes[0]
    assert at_zero(bench) == before


def header_of(bench: CardBench) -> str:
    """Definition of the table of motor 1, as the simulated card has it."""
    return bench.side_port()("#1LIST COMP DEF").decode().strip("\r\n\x06")


def put(bench: CardBench, *entries: int, by_desired: bool = True) -> None:
    table = CompTable(1, entries, 640000, by_desired=by_desired)
    with grouping.grouped(bench.link, bench.context, "table") as parts:
        upload.upload_tables(bench.link, parts, [table])


@pytest.mark.parametrize("by_desired", [True, False])
def test_a_table_with_the_same_entries_is_looked_up_as_meant(
    tmp_path: Path,
    by_desired: bool,  # noqa: FBT001
) -> None:
    bench = CardBench(tmp_path)
    d, other = ("", "D") if by_desired else ("D", "")
    bench.link.write_buffer(["I30=0", f"#1DEFINE COMP 4,#1{d},#1,640000", "16 32 16 0", "I51=1"])
    put(bench, 16, 32, 16, 0, by_desired=by_desired)
    assert header_of(bench) == f"4,#1{other},#1,640000"
    rollback.rollback_last(bench.link, bench.context)
    assert header_of(bench) == f"4,#1{d},#1,640000"


@pytest.mark.parametrize("d", ["", "D"])
def test_a_rollback_brings_the_lookup_back(tmp_path: Path, d: str) -> None:
    bench = CardBench(tmp_path)
    bench.link.write_buffer(["I30=0", f"#1DEFINE COMP 4,#1{d},#1,640000", "16 32 16 0", "I51=1"])
    put(bench, 16, 48, 16, 0, by_desired=not d)
    rollback.rollback_last(bench.link, bench.context)
    assert header_of(bench) == f"4,#1{d},#1,640000"


def test_on_a_card_that_does_not_list_it_the_journal_knows_the_lookup(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = CardBench(tmp_path)
    query = bench.link.query

    def without_d(text: str, **options: object) -> list[str]:
        lines = query(text, **options)  # type: ignore[arg-type]
        return [line.replace("D", "") for line in lines] if text.endswith("DEF") else lines

    monkeypatch.setattr(bench.link, "query", without_d)
    put(bench, 16, 32, 16, 0)
    put(bench, 16, 48, 16, 0)
    rollback.rollback_last(bench.link, bench.context)
    assert (header_of(bench), bench.values("COMP", 1)) == ("4,#1D,#1,640000", [16, 32, 16, 0])


def test_a_lookup_that_did_not_arrive_is_found(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    bench.link.write_buffer(["I30=0", "#2DEFINE COMP 4,#2D,#2,640000", "16 32 16 0", "I51=1"])
    write = bench.link.write_buffer

    def lost(lines: Sequence[str], **options: object) -> None:
        write([line.replace("#1D,", "#1,") for line in lines], **options)  # type: ignore[arg-type]

    bench.link.write_buffer = lost  # type: ignore[method-assign]
    with pytest.raises(VerifyMismatch, match="selects its entries by another position"):
        upload.upload_tables(bench.link, bench.context, [NEW])


def test_tables_that_correct_one_motor_share_its_limit(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    first = CompTable(1, (480, 944, 480, 0), 640000)
    upload.upload_tables(bench.link, bench.context, [first])
    second = replace(first, motor=2, source=1, target=1)
    with pytest.raises(AmplitudeExceeded, match="together by up to 118 um"):
        upload.upload_tables(bench.link, bench.context, [second])
    upload.upload_tables(bench.link, bench.context, [replace(second, target=2)])
