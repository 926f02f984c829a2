"""F17, F19, F29: a restore beside other clients, and a backup of another bench file."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import (
    ConfigError,
    ControllerState,
    ForeignChange,
    LeaseHeld,
    MotorNotSafe,
    PmacCompError,
)
from pmac_comp.machine.controller.contents.law_bank import Index, LawBlock, LawParameters
from pmac_comp.machine.controller.law import law_arming, law_install, law_upload
from pmac_comp.machine.controller.settings import backup
from pmac_comp.machine.controller.tables import upload
from pmac_comp.machine.controller.tables.table_status import read_head
from pmac_comp.machine.controller.whole import grouping, recovery, restore, rollback, waiting
from tests.faults.upload_bench import new_table, old_table
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
P_RANGE = (7070, 7090)
ACTIONS = ("I51=1", "#1DELETE COMP", "#2DEFINE COMP 2,#2,#2,1000", "P7078=4711")


def restorable(folder: Path) -> tuple[CardBench, backup.Backup]:
    """A card with one table, and a backup of it with another."""
    bench = CardBench(folder)
    upload.upload_tables(bench.link, bench.context, [new_table(40)])
    stored = backup.read_backup(bench.link, p_range=P_RANGE, with_q=False)
    upload.upload_tables(bench.link, bench.context, [old_table(40)])
    bench.link.write_buffer(["I130=1234", "M500->*"])
    bench.reconnect()
    return bench, stored


def changing(bench: CardBench, stored: backup.Backup) -> range:
    """Numbers of the requests during which a restore holds the lease."""
    held: list[int] = []
    bench.on_request = lambda n: held.append(n) if bench.p(7078) else None
    restore.restore(bench.link, bench.context, stored)
    bench.reconnect()
    assert rollback.rollback_last(bench.link, bench.context).verdict is ControllerState.OLD
    bench.reconnect()
    return range(held[0], held[-1] + 1)


def entries(bench: CardBench, motor: int = 1) -> tuple[int, ...]:
    return tuple(bench.values("COMP", motor) or ())


def test_f19_nobody_else_writes_during_a_restore(tmp_path: Path, count_runs: Count) -> None:
    """A second `pmac-comp` on another host is refused wherever the restore is."""
    bench, stored = restorable(tmp_path / "here")
    inside = changing(bench, stored)
    at = set(inside[:: max(1, len(inside) // 12)])
    second = CardBench(tmp_path / "there", card=bench.card)
    refused: list[int] = []

    def act(n: int) -> None:
        if n in at and bench.p(7078):
            with pytest.raises(LeaseHeld):
                upload.upload_tables(second.link, second.context, [replace(old_table(40), motor=2)])
            refused.append(n)

    bench.on_request = act
    result, _ = restore.restore(bench.link, bench.context, stored)
    assert result.verdict is ControllerState.NEW
    assert entries(bench) == new_table(40).entries
    assert bench.values("COMP", 2) is None
    assert len(refused) > len(at) // 2
    count_runs(len(refused))


@pytest.mark.parametrize("line", ACTIONS)
def test_f17_another_client_acts_during_a_restore(
    *, tmp_path: Path, line: str, exhaustive: bool, count_runs: Count
) -> None:
    """What somebody types meanwhile is found or swept away; nothing stays open in the end."""
    bench, stored = restorable(tmp_path)
    before = backup.read_backup(bench.link, p_range=P_RANGE, with_q=False)
    inside = changing(bench, stored)
    at = inside if exhaustive else inside[:: max(1, len(inside) // 5)]
    for k in at:
        other = bench.side_port()
        bench.on_request = lambda n, k=k, other=other: other(line) if n == k else None
        failed, left = attempt(bench, stored)
        if failed is None:
            # What came behind the last look of the upload is told as a difference that remains.
            assert (entries(bench) == new_table(40).entries and bench.i51) or left, k
        else:
            assert failed.left is not None, (k, failed)
            if failed.context.get("confirmed") and failed.left is ControllerState.OLD:
                assert entries(bench) in {old_table(40).entries, ()}, (k, failed)
        bench.reconnect()
        bench.link.write_buffer(["P7078=0"])
        settle(bench)
        bench.reconnect()
        # The backup puts foreign tables away too.
        restore.restore(bench.link, bench.context, before)
        assert entries(bench) == old_table(40).entries
        assert bench.values("COMP", 2) is None
        bench.reconnect()
    count_runs(len(at))


def attempt(
    bench: CardBench, stored: backup.Backup
) -> tuple[PmacCompError | None, tuple[backup.Difference, ...]]:
    """The error that a restore ended with, or what it says that differs; then it says NEW."""
    try:
        result, left = restore.restore(bench.link, bench.context, stored)
    except PmacCompError as error:
        return error, ()
    assert result.verdict is ControllerState.NEW
    return None, left


def settle(bench: CardBench) -> None:
    """What a person does until nothing is open."""
    try:
        recovery.recover(bench.link, bench.context)
    except ForeignChange:
        recovery.recover(bench.link, bench.context)
    assert waiting.left_open(bench.context) == ()


def test_f29_backup_of_another_bench_file(tmp_path: Path, count_runs: Count) -> None:
    """Its manifest and its lease lie in a block that the bench file of today does not use."""
    bench = CardBench(tmp_path)
    block = LawBlock(6000)
    then = replace(bench.context, block=block)
    upload.upload_tables(bench.link, then, [new_table(40)])
    # Taken while somebody else was writing there.
    lease = block.p(Index.LEASE)
    bench.link.write_buffer([f"P{lease}=4711", f"P{lease + 1}=900000"])
    stored = backup.read_backup(bench.link, p_range=(6000, 7199), with_q=False)
    bench.link.write_buffer([f"P{lease}=0"])
    upload.upload_tables(bench.link, bench.context, [old_table(40)])
    inside = changing(bench, stored)
    points = range(0, len(inside) - 8, len(inside) // 6)
    for k in points:
        held: list[int] = []

        def stop(n: int, k: int = k, held: list[int] = held) -> None:
            held += [n] if bench.p(7078) else []
            if len(held) > k:
                raise ConnectionResetError

        bench.on_request = stop
        with pytest.raises(ConnectionResetError):
            restore.restore(bench.link, bench.context, stored)
        bench.reconnect()
        assert recovery.recover(bench.link, bench.context).verdict is ControllerState.OLD
        assert entries(bench) == old_table(40).entries
        bench.reconnect()
    count_runs(len(points))
    result, _ = restore.restore(bench.link, bench.context, stored)
    assert (result.verdict, bench.i51) == (ControllerState.NEW, 1)
    assert entries(bench) == new_table(40).entries
    # No lease of the past came back, and nobody is kept out by one.
    for context in (bench.context, then):
        assert read_head(bench.link, context).lease.owner == 0
        upload.upload_tables(bench.link, context, [replace(old_table(40), motor=2)])


def test_what_a_law_sends_is_no_setting_of_a_backup(tmp_path: Path) -> None:
    """Its torque was written back, where it would push the axis, and told to differ afterwards."""
    bench = make_plc_bench(tmp_path)
    law_install.install_law(bench.link, bench.context, 1)
    law_upload.upload_law(bench.link, bench.context, LawParameters(T0=300.0, T_LIMIT=4000.0))
    law_arming.arm(bench.link, bench.context)
    bench.clock.sleep_s(0.5)
    stored = backup.read_backup(bench.link, p_range=(7000, 7199), with_q=False)
    assert stored.ivariables[129] == "300"
    assert "I129" in backup.live_variables(stored)
    bench.link.command("#1K")
    law_install.remove_law(bench.link, bench.context)
    bare = backup.read_backup(bench.link, p_range=(7000, 7199), with_q=False)
    _, left = restore.restore(bench.link, bench.context, stored)
    assert left == ()
    assert bench.link.query("I129") == ["0"]
    # Without a program that writes it an offset is a setting like any other.
    offset = replace(bare, ivariables={**bare.ivariables, 129: "-40"})
    _, left = restore.restore(bench.link, bench.context, offset)
    assert left == ()
    assert bench.link.query("I129") == ["-40"]


def test_f29_a_refused_restore_keeps_the_undo_of_the_upload_before(
    tmp_path: Path, count_runs: Count
) -> None:
    """It changed nothing, and was taken for the last upload, taken back already."""
    bench, stored = restorable(tmp_path)
    with grouping.grouped(bench.link, bench.context, "table") as parts:
        upload.upload_tables(bench.link, parts, [new_table(40)])
    files = {path.name for path in tmp_path.iterdir()}
    bench.link.command("#1J/")
    bench.clock.sleep_s(0.1)
    with pytest.raises(MotorNotSafe, match="all motors killed") as refused:
        restore.restore(bench.link, bench.context, stored)
    assert refused.value.left is ControllerState.OLD
    assert {path.name for path in tmp_path.iterdir()} == files
    # Refused later, by what only an upload itself looks at, it leaves an empty journal.
    with pytest.raises(MotorNotSafe), grouping.grouped(bench.link, bench.context, "next"):
        raise MotorNotSafe("no")
    assert recovery.last_change(bench.context) == "table: done"
    group, (part,) = rollback.upload_to_take_back(bench.context)
    assert part.journal.group == group.group
    assert rollback.rollback_last(bench.link, bench.context).verdict is ControllerState.OLD
    assert entries(bench) == old_table(40).entries
    with pytest.raises(ConfigError, match="taken back already"):
        rollback.rollback_last(bench.link, bench.context)
    count_runs(2)
