"""What somebody else has set since an upload stays at a rollback; PLCs run or stand as before."""

from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import ControllerState
from pmac_comp.machine.controller.contents.law_bank import LawParameters
from pmac_comp.machine.controller.contents.programs import ProgramKind
from pmac_comp.machine.controller.contents.settings import (
    Settings,
    plc_runs,
    read_settings,
    set_by_others,
)
from pmac_comp.machine.controller.law import law_arming, law_install, law_state, law_upload
from pmac_comp.machine.controller.settings import guard_install
from pmac_comp.machine.controller.settings.backup import read_backup
from pmac_comp.machine.controller.settings.settings_upload import change_settings
from pmac_comp.machine.controller.tables import upload
from pmac_comp.machine.controller.whole import grouping, rollback, waiting
from pmac_comp.machine.controller.whole.restore import restore
from tests.faults.upload_bench import new_table, old_table
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

LAW = LawParameters(A0=1.5, JL=1.0, T0=100.0, T_LIMIT=500.0)
PLC_5 = (ProgramKind.PLC, 5)
THEIRS = ["OPEN PLC 0 CLEAR", "P90=P90+1", "CLOSE", "ENABLE PLC 0"]


def put_law_on(bench: CardBench, *, armed: bool = False) -> None:
    with grouping.grouped(bench.link, bench.context, "law") as parts:
        law_install.install_law(bench.link, parts, 1, every_cycles=2)
        law_upload.upload_law(bench.link, parts, LAW)
        if armed:
            law_arming.arm(bench.link, parts)


def test_a_rollback_leaves_the_program_and_variables_of_somebody_else(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    before = bench.link.query("I105I106I107M7003->")
    put_law_on(bench)
    bench.link.write_buffer([*THEIRS, "I8=3"])
    result = rollback.rollback_last(bench.link, bench.context)
    assert result.verdict is ControllerState.OLD
    assert any("but for I8, PLC 0: somebody else" in note for note in result.notes)
    assert bench.link.query("LIST PLC 0") == ["P90=P90+1", "RET"]
    assert bench.link.query("I8") == ["3"]
    assert plc_runs(bench.link, 0)
    assert bench.link.query("I105I106I107M7003->") == before
    assert waiting.left_open(bench.context) == ()


def test_removing_a_law_leaves_the_program_that_took_its_place(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    put_law_on(bench, armed=True)
    bench.link.write_buffer(THEIRS)
    elsewhere = replace(bench.context, store=tmp_path / "elsewhere")
    law_install.remove_law(bench.link, elsewhere)
    assert bench.link.query("LIST PLC 0") == ["P90=P90+1", "RET"]
    assert plc_runs(bench.link, 0)
    assert bench.link.query("I106I129RX$10F8") == ["0", "0", "0"]


def test_what_an_interruption_wrote_of_a_program_is_nobody_elses() -> None:
    old = Settings({"I8": "0"}, {7: "*"}, {PLC_5: ("P1=1", "P2=2")})
    new = Settings({"I8": "1"}, {7: "X:$0,24"}, {PLC_5: ("P3=3", "P4=4")})
    for body in ((), ("P1=1",), ("P3=3",), ("P3=3", "P4=4"), ("P1=1", "P2=2")):
        assert set_by_others(old, new, replace(new, programs={PLC_5: body})) == []
    for body in (("P5=5",), ("P1=1", "P2=2", "P3=3"), ("P3=3", "P4=5")):
        assert set_by_others(old, new, replace(new, programs={PLC_5: body})) == ["PLC 5"]
    theirs = replace(old, variables={"I8": "2"}, definitions={7: "X:$1,24"})
    assert set_by_others(old, new, theirs) == ["I8", "M7"]


def test_a_guard_that_somebody_stopped_stands_still_after_a_rollback(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    bench.link.command("I5=2")
    for table, stopped in ((old_table(8), False), (new_table(8), True)):
        if stopped:
            bench.link.command("DISABLE PLC 1")
        with grouping.grouped(bench.link, bench.context, "table") as parts:
            guard_install.install_guard(bench.link, parts)
            upload.upload_tables(bench.link, parts, [table])
        assert plc_runs(bench.link, 1)
    result = rollback.rollback_last(bench.link, bench.context)
    assert result.verdict is ControllerState.OLD
    assert not plc_runs(bench.link, 1)
    assert bench.link.query("LIST PLC 1")


def test_a_law_that_was_stopped_is_faded_before_it_stops_again(tmp_path: Path) -> None:
    """Its outputs would stay as they are: a torque that nobody takes off."""
    bench = make_plc_bench(tmp_path)
    put_law_on(bench, armed=True)
    stored = read_backup(bench.link, p_range=(7000, 7199), with_q=False)
    bench.link.write_buffer(["#1K", "DISABLE PLC 0"])
    restore(bench.link, bench.context, stored)
    bench.link.command("#1J/")
    bench.clock.sleep_s(1.0)
    assert float(bench.link.query("I129")[0]) == 100.0
    rollback.rollback_last(bench.link, bench.context)
    assert not plc_runs(bench.link, 0)
    assert bench.link.query("I129RX$10F8") == ["0", "0"]
    assert not law_state.read_law_head(bench.link, bench.context.block).is_armed


@pytest.mark.parametrize("runs", [False, True])
def test_a_restore_lets_a_plc_run_or_stand_as_in_the_backup(*, tmp_path: Path, runs: bool) -> None:
    bench = CardBench(tmp_path)
    ways = ("DISABLE PLC 5", "ENABLE PLC 5")
    bench.link.write_buffer(["OPEN PLC 5 CLEAR", "P100=P100+1", "CLOSE", "I5=2", ways[runs]])
    stored = read_backup(bench.link, p_range=(7000, 7299), with_q=False)
    bench.link.command(ways[not runs])
    _, differing = restore(bench.link, bench.context, stored)
    assert differing == ()
    before = bench.p(100)
    bench.clock.sleep_s(0.2)
    assert (bench.p(100) > before) is runs
    rollback.rollback_last(bench.link, bench.context)
    assert plc_runs(bench.link, 5) is not runs


def test_a_rollback_of_a_restore_leaves_a_program_that_came_since(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    bench.link.write_buffer(["OPEN PLC 5 CLEAR", "P100=1", "CLOSE"])
    stored = read_backup(bench.link, p_range=(7000, 7299), with_q=False)
    bench.link.write_buffer(["OPEN PLC 5 CLEAR", "P100=2", "CLOSE"])
    restore(bench.link, bench.context, stored)
    bench.link.write_buffer(["OPEN PLC 5 CLEAR", "P100=3", "CLOSE"])
    result = rollback.rollback_last(bench.link, bench.context)
    assert any("but for PLC 5" in note for note in result.notes)
    assert bench.link.query("LIST PLC 5") == ["P100=3", "RET"]


def test_a_restore_says_what_its_own_programs_switch_on(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    bench.link.write_buffer(["OPEN PLC 5 CLEAR", "P100=P100+1", "CLOSE", "DISABLE PLC 5", "I5=2"])
    starter = ["OPEN PLC 6 CLEAR", "ENABLE PLC 5", "CLOSE", "ENABLE PLC 6"]
    bench.link.write_buffer(starter)
    bench.clock.sleep_s(0.1)
    stored = read_backup(bench.link, p_range=(7000, 7299), with_q=False)
    stored = replace(stored, running=stored.running - {5})
    _, differing = restore(bench.link, bench.context, stored)
    assert [d.item for d in differing] == ["PLC 5 enabled"]


def test_a_program_file_says_nothing_of_whether_its_plc_runs(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    goal = Settings(programs={PLC_5: ("P100=P100+1",)})
    change_settings(bench.link, bench.context, goal)
    bench.link.command("ENABLE PLC 5")
    change_settings(bench.link, bench.context, goal)
    assert plc_runs(bench.link, 5)
    found = read_settings(bench.link, goal)
    assert (found.running, found.stopped) == (frozenset({5}), frozenset())
    assert Settings.from_dict(found.as_dict()) == found
