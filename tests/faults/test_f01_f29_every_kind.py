"""F01, F02, F15, F29: every kind of change cut, refused and killed anywhere; never half-changed."""

import os
import signal
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import pytest

from pmac_comp.base.errors import ControllerState
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change import journals
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.verdict import untouched
from pmac_comp.machine.controller.contents.law_bank import LawParameters
from pmac_comp.machine.controller.contents.programs import Program, ProgramKind
from pmac_comp.machine.controller.contents.settings import Settings, read_axes
from pmac_comp.machine.controller.law import law_arming, law_install, law_upload
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.settings import guard_install, temporary
from pmac_comp.machine.controller.settings.program_upload import upload_program
from pmac_comp.machine.controller.settings.settings_upload import change_settings
from pmac_comp.machine.controller.tables.upload import upload_tables
from pmac_comp.machine.controller.whole import rollback
from pmac_comp.machine.controller.whole.grouping import grouped
from pmac_comp.machine.transport.tap import FaultKind, Way
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.axis_setup import borrowed
from pmac_comp.workflow.compensation.cam import CAM_PROGRAM, cam_settings
from pmac_comp.workflow.controller.commissioning import set_up_axis, settable_variables
from tests.fault_table import all_of
from tests.faults.change_bench import PROGRAM, ChangeBench, Scenario, cut, points
from tests.faults.killed_child import dies_after, serve_child
from tests.faults.same_state import stand_ins
from tests.faults.test_f15_f22_controller import LineFault
from tests.faults.upload_bench import SameIds, new_table, old_table

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
T = TypeVar("T")
OLD = LawParameters(A0=1.5, JL=1.0, T0=100.0, T_LIMIT=500.0)
NEW = LawParameters(A0=2.5, JL=1.0, T0=150.0, T_LIMIT=500.0)
OLD_PROGRAM = Program(ProgramKind.PROG, PROGRAM, ("LINEAR", "X1000", "DWELL5"))
NEW_PROGRAM = Program(ProgramKind.PROG, PROGRAM, ("LINEAR", "X2000", "X3000", "DWELL5"))
TIME_PROGRAM = Program(ProgramKind.PROG, CAM_PROGRAM, ("INC(Y)", "X0:0Y100:10", "DWELL5"))
BENCH = load_bench("paper")
COUNTER = Program(ProgramKind.PLC, 5, ("P100=P100+1",))


def nothing(link: Link, context: Context) -> None:
    del link, context


def installed(link: Link, context: Context) -> None:
    law_install.install_law(link, context, 1)


def loaded(link: Link, context: Context) -> None:
    installed(link, context)
    law_upload.upload_law(link, context, OLD)


def armed(link: Link, context: Context) -> None:
    loaded(link, context)
    law_arming.arm(link, context)


def with_program(link: Link, context: Context) -> None:
    upload_program(link, context, OLD_PROGRAM)


def with_plc(link: Link, context: Context) -> None:
    upload_program(link, context, COUNTER)
    link.write_buffer(["I5=3", "ENABLE PLC 5"])


def with_table(link: Link, context: Context) -> None:
    upload_tables(link, context, [old_table(24)])


def whole_route(link: Link, context: Context) -> None:
    """Table, PLC 0 and law as parts of one upload."""
    with grouped(link, context, "law") as parts:
        upload_tables(link, parts, [new_table(24)])
        law_install.install_law(link, parts, 1)
        law_upload.upload_law(link, parts, NEW)
        law_arming.arm(link, parts)


def cam_route(link: Link, context: Context) -> None:
    """Axes and program, then a table, as parts of one upload."""
    goal = Settings(
        {"I119": "0.5", "I122": "40"},
        programs={(ProgramKind.PROG, PROGRAM): NEW_PROGRAM.lines},
        axes=((1, 1, "X"),),
    )
    with grouped(link, context, "cam") as parts:
        change_settings(link, parts, goal, route="cam", motors=[1])
        upload_tables(link, parts, [new_table(24)])


def time_motor(link: Link, context: Context) -> None:
    """The route ``cam`` as it is: time motor, both axes and program, then the table over time."""
    table = replace(new_table(24), motor=8, source=8)
    with grouped(link, context, "cam") as parts:
        with untouched():
            goal = cam_settings(BENCH, TIME_PROGRAM, read_axes(link))
        change_settings(link, parts, goal, route="cam", motors=[1])
        motors.enable(link, 8)
        upload_tables(link, parts, [table])


def guarded_table(link: Link, context: Context) -> None:
    """The route ``table``: the guard PLC, then the tables."""
    with grouped(link, context, "table") as parts:
        guard_install.install_guard(link, parts)
        upload_tables(link, parts, [new_table(24)])


def under_guard(link: Link, context: Context) -> None:
    with_table(link, context)
    guard_install.install_guard(link, context)


def with_axes(link: Link, context: Context) -> None:
    del context
    link.write_buffer(["UNDEFINE ALL", "&1#1->500X", "&2#3->7Z", "&1#8->4W", "I5190=500"])


def borrowed_axis(link: Link, context: Context) -> None:
    """What a measurement puts on for a while."""
    with untouched():
        goal = borrowed(link, 1)
    temporary.put_on(link, context, goal, motors=(1,))


def unlike_the_bench(link: Link, context: Context) -> None:
    del context
    link.write_buffer(["#1K", "I119=0.77", "I122=33", "I130=1234"])


def set_up(link: Link, context: Context) -> None:
    assert isinstance(link, Commander)
    axis = Axis(link, BENCH, "controller")
    with untouched():
        link.command("#1K")
        link.clock.sleep_s(0.2)
        differing = settable_variables(axis)
    set_up_axis(axis, context, differing)


def route_standing(link: Link, context: Context) -> None:
    with_table(link, context)
    whole_route(link, context)


SCENARIOS = [
    Scenario("first law", installed, lambda k, c: law_upload.upload_law(k, c, NEW)),
    Scenario("law", armed, lambda k, c: law_upload.upload_law(k, c, NEW)),
    Scenario("clamp", loaded, lambda k, c: law_upload.upload_law(k, c, NEW, clamp_ct=20.0)),
    Scenario("first program", nothing, lambda k, c: upload_program(k, c, NEW_PROGRAM)),
    Scenario("program", with_program, lambda k, c: upload_program(k, c, NEW_PROGRAM)),
    Scenario(
        "plc",
        with_plc,
        lambda k, c: change_settings(
            k,
            c,
            Settings(programs={(ProgramKind.PLC, 5): ("P100=P100+2",)}, running=frozenset({5})),
        ),
    ),
    Scenario("install", nothing, lambda k, c: law_install.install_law(k, c, 1)),
    Scenario("remove law", loaded, law_install.remove_law),
    Scenario("law route", with_table, whole_route),
    Scenario("cam route", with_program, cam_route),
    Scenario("guarded table", with_table, guarded_table),
    Scenario("table under guard", under_guard, lambda k, c: upload_tables(k, c, [new_table(24)])),
    Scenario("time motor", with_axes, time_motor),
    Scenario("measurement", with_axes, borrowed_axis),
    Scenario("setup", unlike_the_bench, set_up),
    Scenario("rollback", route_standing, rollback.rollback_last, undoes=True),
]


def thinned(at: Sequence[T], n: int, *, exhaustive: bool) -> Sequence[T]:
    """All of them, or about n of them including the last."""
    if exhaustive or len(at) <= n:
        return all_of(at) if exhaustive else at
    return sorted({*at[:: 1 + len(at) // n], at[-1]})


@pytest.fixture(params=SCENARIOS, ids=lambda s: s.name)
def rig(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> ChangeBench:
    ids = SameIds()
    monkeypatch.setattr(journals, "secrets", ids)
    return ChangeBench(tmp_path, request.param, ids)


def chosen(
    rig: ChangeBench, way: Way, kind: FaultKind, count_places: Count, *, exhaustive: bool
) -> Sequence[tuple[int, bool]]:
    """Bytes where to put a fault, and whether to resume then: for every byte, or every packet."""
    if not exhaustive:
        return [(n, n % 2 == 0) for n in points(rig.edges(way))]
    places = rig.places(way, kind)
    count_places(sum(map(len, places)))
    return all_of(stand_ins(places))


@pytest.mark.parametrize("way", [Way.SEND, Way.RECEIVE])
def test_f01_cut_in_any_change(
    *, rig: ChangeBench, way: Way, exhaustive: bool, count_runs: Count, count_places: Count
) -> None:
    at = chosen(rig, way, FaultKind.CUT, count_places, exhaustive=exhaustive)
    for n, resume in at:
        error = rig.run(cut(way, n))
        if error is None:
            rig.judge_done()
            continue
        assert error.left is not None, n
        rig.recover(resume=resume)
    count_runs(len(at))


def test_f02_silence_in_any_change(
    *, rig: ChangeBench, exhaustive: bool, count_runs: Count, count_places: Count
) -> None:
    at = chosen(rig, Way.RECEIVE, FaultKind.SILENCE, count_places, exhaustive=exhaustive)
    if not exhaustive:
        at = thinned(at, 3, exhaustive=False)
    for n, resume in at:
        if rig.run(cut(Way.RECEIVE, n, lose=True)) is not None:
            rig.recover(resume=resume)
    count_runs(len(at))


@pytest.mark.parametrize("kind", ["refuse", "drop", "double"])
def test_f15_f16_any_line_of_any_change(
    *, rig: ChangeBench, kind: str, exhaustive: bool, count_runs: Count
) -> None:
    rig.restart()
    counter = LineFault(rig.bench, -1, "none")
    rig.scenario.change(rig.bench.link, rig.bench.context)
    lines = thinned(range(counter.seen), 8, exhaustive=exhaustive)
    for k in lines:
        rig.restart()
        LineFault(rig.bench, k, kind)
        error = rig.attempt()
        if error is None:
            rig.fresh()
            rig.judge_done()
            continue
        assert error.left is not None, k
        if error.left is ControllerState.OLD and error.context.get("confirmed"):
            rig.fresh()
            rig.judge(ControllerState.OLD)
        rig.recover(resume=bool(k % 2))
    count_runs(len(lines))


def killed_change(rig: ChangeBench, kill_after: int) -> tuple[int, int]:
    """The change, killed after so many bytes: exit status and bytes."""

    def work(link: Commander) -> None:
        rig.scenario.change(link, rig.bench.context)

    return serve_child(rig.bench.card, work, kill_after, timeout_s=5.0, cycles=200)


def test_f29_sigkill_in_any_change(
    *, rig: ChangeBench, exhaustive: bool, count_runs: Count
) -> None:
    rig.restart()
    status, total = killed_change(rig, 1 << 30)
    assert status == 0
    rig.fresh()
    rig.judge_done()
    every = range(total - 200)
    for n in every[:: max(1, total // (20 if exhaustive else 2))]:
        rig.restart()
        status, _ = killed_change(rig, n)
        if not os.WIFSIGNALED(status):
            continue  # waits are shorter or longer: this one asked less often than the first
        assert os.WTERMSIG(status) == signal.SIGKILL
        rig.recover(resume=n % 2 == 0)
        count_runs(1)


def test_f29_death_in_any_change(
    *, rig: ChangeBench, exhaustive: bool, count_runs: Count, count_places: Count
) -> None:
    """The same without a process for each case: nothing of the host acts any more after a byte."""
    at = chosen(rig, Way.SEND, FaultKind.CUT, count_places, exhaustive=exhaustive)
    if not exhaustive:
        at = at[1 :: max(1, len(at) // 4)]
    for n, resume in at:
        rig.restart()
        with dies_after(rig.bench.tap, n):
            rig.attempt()
        rig.recover(resume=resume)
    count_runs(len(at))
