"""Two axes of one card, each with a bench file and a block of its own: none undoes the other's."""

from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import ConfigError, ControllerState, ForeignChange, LinkLost
from pmac_comp.machine.controller.change import journals
from pmac_comp.machine.controller.change.claim import FOREIGN, FREE, REGISTER, read_claim
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.lease import read_lease
from pmac_comp.machine.controller.contents.comp_table import CompTable, TableKind
from pmac_comp.machine.controller.contents.law_bank import Index, LawBlock, LawParameters
from pmac_comp.machine.controller.contents.settings import Settings
from pmac_comp.machine.controller.law import (
    block_use,
    law_checks,
    law_install,
    law_state,
    law_upload,
)
from pmac_comp.machine.controller.settings import guard_install, temporary
from pmac_comp.machine.controller.settings.settings_upload import change_settings
from pmac_comp.machine.controller.tables.table_status import table_status
from pmac_comp.machine.controller.tables.upload import remove_tables, upload_tables
from pmac_comp.machine.controller.whole import grouping, recovery, rollback, waiting
from pmac_comp.machine.transport.tap import Fault, FaultKind, Way
from tests.unit.machine_controller.card_bench import CardBench

ENTRIES = (16, 32, 16, 0)


def table_of(motor: int, factor: int = 1) -> CompTable:
    return CompTable(motor, tuple(factor * k for k in ENTRIES), 640000, by_desired=True)


def axis_of(bench: CardBench, folder: str, first_p: int) -> Context:
    (bench.folder / folder).mkdir(exist_ok=True)
    return replace(bench.context, block=LawBlock(first_p), store=bench.folder / folder)


def put_table(bench: CardBench, context: Context, motor: int, factor: int = 1) -> None:
    with grouping.grouped(bench.link, context, "table") as parts:
        upload_tables(bench.link, parts, [table_of(motor, factor)])


def standing(bench: CardBench) -> tuple[int, list[int] | None, list[int] | None]:
    return bench.i51, bench.values("COMP", 1), bench.values("COMP", 2)


@pytest.mark.parametrize("before", [0, 2], ids=["none before", "another before"])
def test_rollback_leaves_the_tables_of_another_axis(tmp_path: Path, before: int) -> None:
    bench = CardBench(tmp_path)
    first, second = axis_of(bench, "first", 7000), axis_of(bench, "second", 7200)
    if before:
        put_table(bench, first, 1, before)
    put_table(bench, first, 1)
    put_table(bench, second, 2)
    rollback.rollback_last(bench.link, first)
    old = [before * k for k in ENTRIES] if before else None
    assert standing(bench) == (1, old, list(ENTRIES))


def test_a_removal_that_is_taken_back_leaves_them_too(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    first, second = axis_of(bench, "first", 7000), axis_of(bench, "second", 7200)
    put_table(bench, first, 1)
    with grouping.grouped(bench.link, first, "remove") as parts:
        remove_tables(bench.link, parts, [(TableKind.COMP, 1)])
    put_table(bench, second, 2)
    rollback.rollback_last(bench.link, first)
    assert standing(bench) == (1, list(ENTRIES), list(ENTRIES))


def afresh(bench: CardBench, *faults: Fault) -> None:
    """A new conversation, whose bytes are counted from here."""
    bench.reconnect()
    bench.link.flush()
    bench.tap.sent = bench.tap.received = 0
    bench.tap.schedule(list(faults))


def test_a_rollback_that_is_cut_anywhere_leaves_them_too(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    second = axis_of(bench, "second", 7200)
    cut, ended = 0, False
    while not ended:
        first = axis_of(bench, f"first{cut}", 7000)
        put_table(bench, first, 1)
        put_table(bench, second, 2, 1 + cut % 3)
        afresh(bench, Fault(FaultKind.CUT, Way.SEND, cut))
        try:
            rollback.rollback_last(bench.link, first)
            ended = True
        except LinkLost:
            afresh(bench)
            verdict = recovery.recover(bench.link, first).verdict
            if verdict is ControllerState.NEW:  # the rollback had not begun
                rollback.rollback_last(bench.link, first)
        assert standing(bench) == (1, None, [(1 + cut % 3) * k for k in ENTRIES]), cut
        cut += 40
    assert cut > 600


def test_an_upload_is_not_taken_back_with_the_bench_file_of_another_axis(tmp_path: Path) -> None:
    """Its law would be sought, and the old one written, in the other axis' block."""
    bench = CardBench(tmp_path)
    first, second = axis_of(bench, "both", 7000), axis_of(bench, "both", 7200)
    law_install.install_law(bench.link, first, 1)
    for factor in (1.0, 2.0):
        with grouping.grouped(bench.link, first, "law") as parts:
            law_upload.upload_law(bench.link, parts, LawParameters(V0=factor))
    with pytest.raises(ConfigError, match="p_block begins at P7000") as refused:
        rollback.rollback_last(bench.link, second)
    assert "The controller was left: OLD, as before this command." in str(refused.value)
    assert all(bench.p(n) == 0.0 for n in range(7200, 7270))
    rollback.rollback_last(bench.link, first)
    bank = law_state.read_law_head(bench.link, first.block).bank
    assert law_state.read_bank(bench.link, first.block, bank) == LawParameters(V0=1.0)


def test_a_torn_upload_is_settled_with_its_own_bench_file(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    first, second = axis_of(bench, "both", 7000), axis_of(bench, "both", 7200)
    afresh(bench, Fault(FaultKind.CUT, Way.SEND, 700))
    with pytest.raises(LinkLost):
        put_table(bench, first, 1)
    afresh(bench)
    with pytest.raises(ForeignChange, match="p_block from P7000"):
        recovery.recover(bench.link, second)
    assert recovery.recover(bench.link, first).verdict is ControllerState.OLD
    assert standing(bench) == (0, None, None)


def test_tables_that_another_bench_file_put_on_are_not_foreign(tmp_path: Path) -> None:
    """A recovery with nothing open switched both axes' tables off."""
    bench = CardBench(tmp_path)
    first, second = axis_of(bench, "first", 7000), axis_of(bench, "second", 7200)
    put_table(bench, first, 1)
    put_table(bench, second, 2)
    told = recovery.recover(bench.link, first)
    assert told.verdict is ControllerState.NEW
    assert "p_block at P7200" in told.notes[0]
    assert standing(bench) == (1, list(ENTRIES), list(ENTRIES))
    bench.link.write_buffer(["I51=0", "#1DELETE COMP", "I51=1"])  # nobody announced that
    with pytest.raises(ForeignChange):
        recovery.recover(bench.link, first)
    assert bench.i51 == 0


@pytest.mark.parametrize("torn", [False, True], ids=["taken back", "torn"])
def test_what_one_axis_took_back_is_not_foreign_to_the_other(*, tmp_path: Path, torn: bool) -> None:
    """The manifest of the one whose tables stay tells of a time when both stood."""
    bench = CardBench(tmp_path)
    first, second = axis_of(bench, "first", 7000), axis_of(bench, "second", 7200)
    if torn:
        put_table(bench, second, 2)
        put_table(bench, first, 1)
        afresh(bench, Fault(FaultKind.CUT, Way.SEND, 700))
        with pytest.raises(LinkLost):
            put_table(bench, first, 1, 2)
        afresh(bench)
        assert recovery.recover(bench.link, first).verdict is ControllerState.OLD
    else:
        put_table(bench, first, 1)
        put_table(bench, second, 2)
        rollback.rollback_last(bench.link, first)
    stood = standing(bench)
    assert stood == (1, list(ENTRIES) if torn else None, list(ENTRIES))
    told = recovery.recover(bench.link, second)
    assert told.verdict is ControllerState.NEW
    assert "p_block at P7000 that was taken back left them" in told.notes[0]
    assert standing(bench) == stood
    assert table_status(bench.link, first).decision.reason == "no upload is under way"
    gone = ["#1DELETE COMP"] if torn else []
    bench.link.write_buffer(["I51=0", *gone, *table_of(1, 3).lines, "I51=1"])  # unannounced
    with pytest.raises(ForeignChange):
        recovery.recover(bench.link, second)


def claimed(bench: CardBench) -> int:
    return read_claim(bench.link)


def test_a_change_with_another_block_is_seen_while_it_is_under_way(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    first, second = axis_of(bench, "first", 7000), axis_of(bench, "second", 7200)
    with grouping.grouped(bench.link, first, "table") as parts:
        upload_tables(bench.link, parts, [table_of(1)])
        # Between the parts too, where the lease is given back.
        with pytest.raises(ForeignChange, match="p_block from P7000") as refused:
            put_table(bench, second, 2)
        assert refused.value.left is ControllerState.OLD
        assert [r.code for r in waiting.waiting_refusals(bench.link, second)] == ["PC-TXN-013"]
        with pytest.raises(ForeignChange, match="p_block from P7000"):
            upload_tables(bench.link, second, [table_of(2)])
    assert claimed(bench) == FREE
    put_table(bench, second, 2)
    assert standing(bench) == (1, list(ENTRIES), list(ENTRIES))
    assert claimed(bench) == FREE


def test_one_that_was_interrupted_anywhere_is_seen_until_it_is_settled(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    second = axis_of(bench, "second", 7200)
    cut, seen, ended = 0, 0, False
    while not ended:
        first = axis_of(bench, f"first{cut}", 7000)
        afresh(bench, Fault(FaultKind.CUT, Way.SEND, cut))
        try:
            put_table(bench, first, 1, 1 + cut % 3)
            ended = True
        except LinkLost:
            afresh(bench)
            if claimed(bench) == first.block.first:
                seen += 1
                with pytest.raises(ForeignChange, match="p_block from P7000"):
                    put_table(bench, second, 2)
            recovery.recover(bench.link, first)
        afresh(bench)
        assert claimed(bench) == FREE, cut
        put_table(bench, second, 2)
        cut += 60
    assert seen > 5


def test_one_whose_folder_is_lost_is_taken_as_it_stands(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    first, second = axis_of(bench, "first", 7000), axis_of(bench, "second", 7200)
    afresh(bench, Fault(FaultKind.CUT, Way.SEND, 1100))
    with pytest.raises(LinkLost):
        put_table(bench, first, 1)
    afresh(bench)
    recovery.keep(bench.link, second)  # says nothing about the other's
    with pytest.raises(ForeignChange, match="p_block from P7000"):
        put_table(bench, second, 2)
    recovery.keep(bench.link, axis_of(bench, "elsewhere", 7000))
    put_table(bench, second, 2)


def test_a_block_that_comes_at_the_same_moment_is_told_at_the_end(tmp_path: Path) -> None:
    """Both read a free register; the later one's block stands in it."""
    bench = CardBench(tmp_path)
    memory = bench.card.memory

    def written_over(_: int) -> None:
        if memory.y[REGISTER] == 7000:
            memory.y[REGISTER] = 7200

    bench.on_request = written_over
    with pytest.raises(ForeignChange):
        put_table(bench, axis_of(bench, "first", 7000), 1)
    assert bench.i51 == 0


def test_a_register_of_somebody_else_is_left_alone(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    bench.link.command("WL$10FF,$000000123456")
    put_table(bench, axis_of(bench, "first", 7000), 1)
    assert claimed(bench) == FOREIGN
    assert bench.link.query("RL$10FF") == [str(0x123456)]


def test_a_measurement_of_another_axis_keeps_changes_and_measurements_out(tmp_path: Path) -> None:
    """Coordinate system 1, its motion program and gathering are of the whole card."""
    bench = CardBench(tmp_path)
    first, second = axis_of(bench, "first", 7000), axis_of(bench, "second", 7200)
    borrowed = Settings({"I5113": "7"}, axes=((1, 1, "X"),))
    temporary.put_on(bench.link, first, borrowed)
    assert read_lease(bench.link, first).is_free
    for act in (
        lambda: put_table(bench, second, 2),
        lambda: temporary.put_on(bench.link, second, Settings(axes=((1, 2, "X"),))),
    ):
        with pytest.raises(ForeignChange, match="p_block from P7000"):
            act()
    put_table(bench, first, 1)  # of the same axis it takes what was borrowed off first
    assert claimed(bench) == FREE
    temporary.put_on(bench.link, first, borrowed)
    temporary.take_off(bench.link, first)
    assert claimed(bench) == FREE
    put_table(bench, second, 2)


def test_a_journal_names_no_backup_outside_its_folder(tmp_path: Path) -> None:
    """As after a move of the folder, or where somebody wrote a path into it."""
    bench = CardBench(tmp_path)
    first = axis_of(bench, "first", 7000)
    temporary.put_on(bench.link, first, Settings({"I5190": "77"}))
    journal = journals.journals(first)[-1]
    entries = journal.entries()
    journal.path.unlink()
    for entry in entries:
        away = {"backup": f"../{entry.data['backup']}"} if "backup" in entry.data else {}
        journal.write(entry.step, {**entry.data, **away})
    assert temporary.take_off(bench.link, first)
    assert not temporary.standing(first)


def test_law_and_guard_of_another_axis_are_called_so(tmp_path: Path) -> None:
    """They were a program that is not ours, to be moved to another PLC: that would break them."""
    bench = CardBench(tmp_path)
    first, second = axis_of(bench, "first", 7000), axis_of(bench, "second", 7200)
    law_install.install_law(bench.link, first, 2)
    (told,) = law_checks.owner_refusals(bench.link, second, 1)
    assert told.code == "PC-LAW-054"
    assert "law of another bench file, whose p_block begins at P7000" in told.message
    assert "`pmac-comp remove` with its bench file" in told.hint
    assert guard_install.install_guard(bench.link, second)[0].startswith(
        "PLC 1 holds the guard of the p_block from P7000, so"
    )
    assert law_checks.owner_refusals(bench.link, first, 1) == []
    # A removal and `status` by the other bench file say what stays.
    assert law_checks.law_elsewhere(bench.link, second, 1) == 7000
    assert law_checks.law_elsewhere(bench.link, first, 1) is None


@pytest.mark.parametrize("first_p", [7100, 6900])
@pytest.mark.parametrize("has_law", [False, True], ids=["tables", "law"])
def test_a_block_that_overlaps_that_of_another_axis_is_not_to_be_zeroed(
    tmp_path: Path, first_p: int, *, has_law: bool
) -> None:
    bench = CardBench(tmp_path)
    if has_law:
        law_install.install_law(bench.link, bench.context, 1)
    else:
        put_table(bench, axis_of(bench, "first", 7000), 1)
    change = LawBlock(first_p).p(Index.CHANGE)
    for marked in (0, 7):  # by a change of ours before the other came: both would be at work
        bench.link.command(f"P{change}={marked}")
        (told,) = block_use.block_refusals(bench.link, LawBlock(first_p))
        assert told.code == "PC-COM-011"
        assert "overlaps P7000..7199" in told.message
        assert "=0" not in told.hint
    bench.link.command(f"P{change}=0")
    assert block_use.block_refusals(bench.link, LawBlock(7000)) == []
    assert block_use.block_refusals(bench.link, LawBlock(7200)) == []
    bench.link.command("P7600=3")
    (told,) = block_use.block_refusals(bench.link, LawBlock(7500))
    assert "'P7500..7689=0'" in told.hint


@pytest.mark.parametrize("first_p", [7100, 6900])
def test_nothing_is_written_into_a_block_that_the_law_of_another_reaches_into(
    tmp_path: Path, first_p: int
) -> None:
    """A removal wrote its manifest over coefficients of an armed law: the motor ran away."""
    bench = CardBench(tmp_path)
    put_table(bench, axis_of(bench, "second", first_p), 3)
    assert block_use.law_over_refusals(bench.link, LawBlock(7000)) == []
    law_install.install_law(bench.link, bench.context, 1)
    (told,) = block_use.law_over_refusals(bench.link, LawBlock(first_p))
    assert told.code == "PC-COM-012"
    assert "p_block from P7000" in told.hint
    assert block_use.law_over_refusals(bench.link, LawBlock(7000)) == []
    assert block_use.law_over_refusals(bench.link, LawBlock(7200)) == []
    law_install.remove_law(bench.link, bench.context)
    assert block_use.law_over_refusals(bench.link, LawBlock(first_p)) == []


def test_a_law_that_was_taken_off_hinders_no_other_in_plc_0(tmp_path: Path) -> None:
    """It was taken for the law that runs there by now: every change of that axis was refused."""
    bench = CardBench(tmp_path)
    other = axis_of(bench, "second", 6900)
    law_install.install_law(bench.link, other, 3)
    law_install.remove_law(bench.link, other)
    bench.link.command("P7000..7189=0")  # as the refusal says, where that file is used no more
    law_install.install_law(bench.link, bench.context, 1)
    assert block_use.law_over_refusals(bench.link, LawBlock(7000)) == []
    assert block_use.block_refusals(bench.link, LawBlock(7000)) == []
    (told,) = block_use.law_over_refusals(bench.link, LawBlock(6900))
    assert "p_block from P7000" in told.hint


def test_a_block_whose_tables_are_gone_hinders_nobody(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    other = axis_of(bench, "second", 7100)
    put_table(bench, other, 3)
    (told,) = block_use.block_refusals(bench.link, LawBlock(7000))
    assert told.code == "PC-COM-011"
    remove_tables(bench.link, other, [(TableKind.COMP, 3)])
    assert not [r for r in block_use.block_refusals(bench.link, LawBlock(7000)) if
                r.code == "PC-COM-011"]  # fmt: skip


@pytest.mark.parametrize("first_p", [7100, 7050])
@pytest.mark.parametrize("change", ["setup", "remove"])
def test_what_changes_with_another_block_leave_is_called_so(
    tmp_path: Path, change: str, first_p: int
) -> None:
    """A set-up leaves its number and the end of its lease: it was "a program of the machine"."""
    bench = CardBench(tmp_path)
    other = axis_of(bench, "second", first_p)
    if change == "setup":
        with grouping.grouped(bench.link, other, "setup") as parts:
            change_settings(bench.link, parts, Settings({"I330": "90000"}), route="setup")
    else:
        law_install.install_law(bench.link, other, 1)
        law_install.remove_law(bench.link, other)
    (told,) = block_use.block_refusals(bench.link, LawBlock(7000))
    assert told.code == "PC-COM-010"
    assert "of the machine" not in told.message
    assert f"Its p_block P{first_p}..{first_p + 199} overlaps" in told.message
    assert "block apart" in told.hint
    bench.link.command("P7012=3")  # and this is of neither
    (told,) = block_use.block_refusals(bench.link, LawBlock(7000))
    assert "P7012 = 3, " in told.message
    assert "A program of the machine may use them" in told.message


def test_tables_that_another_axis_put_beside_a_law_take_nothing_of_its_upload(
    tmp_path: Path,
) -> None:
    """`recover` called the first axis' upload not whole, and pointed to `rollback`."""
    bench = CardBench(tmp_path)
    first, second = axis_of(bench, "first", 7000), axis_of(bench, "second", 7200)
    with grouping.grouped(bench.link, first, "law") as parts:
        upload_tables(bench.link, parts, [table_of(1)])
        law_install.install_law(bench.link, parts, 1)
        law_upload.upload_law(bench.link, parts, LawParameters(V0=0.1))
    put_table(bench, second, 2)
    assert recovery.recover(bench.link, first).verdict is ControllerState.NEW
    bench.link.command("I51=0")
    assert recovery.recover(bench.link, first).verdict is ControllerState.DISABLED
    bench.link.command("I51=1")
    # With a table of the first axis gone it is not whole, whoever announced what stands.
    with grouping.grouped(bench.link, axis_of(bench, "third", 7400), "remove") as parts:
        remove_tables(bench.link, parts, [(TableKind.COMP, 1)])
    assert recovery.recover(bench.link, first).verdict is ControllerState.DISABLED
    assert standing(bench) == (1, None, list(ENTRIES))
