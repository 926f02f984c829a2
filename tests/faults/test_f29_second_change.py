"""F29, F19: a change while an earlier one, killed on its way, still waits for ``recover``.

Its backup is what stood before it: a change accepted on top would be lost when that is written
back. So it is refused, from the same folder by the journal, from another one by the number of the
change on the controller; and a recovery never writes over what somebody else has put on since.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import (
    ControllerState,
    ForeignChange,
    PmacCompError,
    SafetyRefusal,
)
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change import journals
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.contents.law_bank import Index, LawBlock, LawParameters
from pmac_comp.machine.controller.contents.programs import Program, ProgramKind
from pmac_comp.machine.controller.contents.settings import Settings
from pmac_comp.machine.controller.law import law_upload
from pmac_comp.machine.controller.settings import temporary
from pmac_comp.machine.controller.settings.backup import Backup, read_backup
from pmac_comp.machine.controller.settings.program_upload import upload_program
from pmac_comp.machine.controller.settings.settings_upload import change_settings
from pmac_comp.machine.controller.tables.upload import upload_tables
from pmac_comp.machine.controller.whole import grouping, recovery, rollback, waiting
from pmac_comp.machine.controller.whole.restore import restore
from tests.faults.change_bench import ChangeBench, Scenario, standing
from tests.faults.killed_child import dies_after
from tests.faults.test_f01_f29_every_kind import (
    SCENARIOS,
    thinned,
    whole_route,
    with_table,
)
from tests.faults.test_f20_reset_any_change import differing
from tests.faults.upload_bench import SameIds, new_table, wave
from tests.unit.machine_controller.card_bench import make_plc_bench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
BLOCK = LawBlock()
OTHER_LAW = LawParameters(A0=0.5, JL=1.0, T0=50.0, T_LIMIT=500.0)
MOTOR_2 = replace(new_table(600), motor=2, source=2, target=2)
OTHER_TABLE = replace(new_table(24), entries=wave(24, amplitude_ct16=240.0, phase=0.9))


class Restoring:
    """The restore of a backup that differs from the card in settings, programs and tables."""

    def __init__(self) -> None:
        self._kept: Backup | None = None

    def prepare(self, link: Link, context: Context) -> None:
        with_table(link, context)
        link.command("#1K")
        self._kept = read_backup(link, p_range=(7100, 7110), with_q=False)
        upload_tables(link, context, [new_table(24)])
        upload_program(link, context, Program(ProgramKind.PROG, 710, ("LINEAR", "X2000")))
        link.write_buffer(["I119=0.7", "I122=33", "M7003->Y:$C001"])

    def change(self, link: Link, context: Context) -> None:
        assert self._kept is not None
        restore(link, context, self._kept)


RESTORING = Restoring()
KINDS = [
    *SCENARIOS,
    Scenario("restore", RESTORING.prepare, RESTORING.change),
]


def put_table(link: Link, context: Context) -> None:
    upload_tables(link, context, [OTHER_TABLE])


def put_law(link: Link, context: Context) -> None:
    law_upload.upload_law(link, context, OTHER_LAW)


def put_route(link: Link, context: Context) -> None:
    with grouping.grouped(link, context, "second") as parts:
        upload_tables(link, parts, [OTHER_TABLE])


def put_settings(link: Link, context: Context) -> None:
    change_settings(link, context, Settings({"I119": "0.31"}))


def borrow(link: Link, context: Context) -> None:
    temporary.put_on(link, context, Settings({"I5190": "77"}), motors=(1,))


SECOND = [put_table, put_law, put_route, put_settings, borrow]


@pytest.fixture(params=KINDS, ids=lambda s: s.name)
def rig(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> ChangeBench:
    ids = SameIds()
    monkeypatch.setattr(journals, "secrets", ids)
    return ChangeBench(tmp_path / "here", request.param, ids)


def killed(rig: ChangeBench, n_bytes: int) -> tuple[Context, Context]:
    """Kill the change after so many bytes; contexts of its folder and of another one."""
    rig.restart()
    with dies_after(rig.bench.tap, n_bytes):
        rig.attempt()
    here = rig.fresh().context
    elsewhere = replace(here, store=rig.folder.parent / "elsewhere")
    for path in elsewhere.store.glob("*"):
        path.unlink()
    return here, elsewhere


def changing(rig: ChangeBench) -> list[int]:
    """Byte numbers at which requests end while the change is under way."""
    found: list[int] = []
    rig.restart()

    def note(_n: int) -> None:
        if under_way(rig):
            found.append(rig.bench.tap.sent)

    rig.bench.on_request = note
    rig.scenario.change(rig.bench.link, rig.bench.context)
    return sorted(set(found))


def is_torn(context: Context) -> bool:
    return any(journals.is_torn(j) and not journals.is_temporary(j)
               for j in journals.journals(context))  # fmt: skip


def let_lease_end(rig: ChangeBench) -> None:
    rig.bench.link.command(f"P{BLOCK.p(Index.LEASE) + 1}=0")


def under_way(rig: ChangeBench) -> bool:
    return rig.bench.p(BLOCK.p(Index.CHANGE)) > 0


def test_f29_a_second_change_waits_for_recover(
    *, rig: ChangeBench, exhaustive: bool, count_runs: Count
) -> None:
    """From the same folder and from another one; then the first ends as if nobody had tried."""
    at = thinned(changing(rig), 3, exhaustive=exhaustive)
    refused = 0
    for k, n in enumerate(at):
        here, elsewhere = killed(rig, n)
        left = standing(rig.bench)
        second = SECOND[k % len(SECOND)]
        if is_torn(here):
            with pytest.raises(SafetyRefusal, match="interrupted and is still open") as said:
                second(rig.bench.link, here)
            assert said.value.code == "PC-TXN-010"
            # The parts of an upload are looked at; a change of its own says that nobody did.
            assert (said.value.left is None) is (second is not put_route)
            if said.value.left is ControllerState.OLD and not rig.scenario.undoes:
                assert not differing(left, rig.before), n
            refused += 1
        if under_way(rig):
            for attempt in SECOND[:2]:
                with pytest.raises(SafetyRefusal):
                    attempt(rig.bench.link, elsewhere)
            let_lease_end(rig)
            with pytest.raises(PmacCompError, match="another folder or host") as told:
                SECOND[(k + 1) % 4](rig.bench.link, elsewhere)
            assert told.value.code == "PC-TXN-011"
            with pytest.raises(PmacCompError, match="another folder or host"):
                recovery.recover(rig.bench.link, elsewhere)
        assert not differing(standing(rig.bench), left), n
        rig.recover(resume=n % 2 == 0)
        count_runs(1)
    # What a measurement borrowed is no half-changed compensation: taken off before a change.
    assert refused or rig.scenario.name == "measurement"


def test_f29_nothing_is_written_over_what_somebody_else_put_on_since(
    *, rig: ChangeBench, exhaustive: bool, count_runs: Count
) -> None:
    """Taken over by a person in another folder, who then uploads; the first folder only looks."""
    at = thinned(changing(rig), 2, exhaustive=exhaustive)
    refused = 0
    for n in at:
        here, elsewhere = killed(rig, n)
        if not under_way(rig):
            rig.recover(resume=True)
            continue
        let_lease_end(rig)
        recovery.keep(rig.bench.link, elsewhere)
        put_settings(rig.bench.link, elsewhere)
        theirs = standing(rig.fresh())
        waits = bool(waiting.left_open(here))
        if waits and waiting.waiting(here):
            with pytest.raises(ForeignChange, match="not written back over it"):
                recovery.recover(rig.bench.link, here)
            with pytest.raises(PmacCompError):
                rollback.rollback_last(rig.bench.link, here)
            assert waiting.left_open(here)
            refused += 1
        assert not differing(standing(rig.fresh()), theirs), n
        recovery.keep(rig.bench.link, here)
        assert not differing(standing(rig.fresh()), theirs), n
        assert waiting.left_open(here) == ()
        count_runs(1)
    # A measurement is no change that waits: what it borrowed is taken off before another change.
    assert refused or rig.scenario.name == "measurement"


def test_f19_tables_half_written_elsewhere_never_act(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count_runs: Count
) -> None:
    """Taken over, they may be replaced or restored, but do not act beside somebody's new table."""
    ids = SameIds()
    monkeypatch.setattr(journals, "secrets", ids)

    def both(link: Link, context: Context) -> None:
        upload_tables(link, context, [new_table(24), MOTOR_2])

    rig = ChangeBench(tmp_path / "here", Scenario("tables", with_table, both), ids)
    torn = 0
    for n in changing(rig):
        _, elsewhere = killed(rig, n)
        written = rig.bench.values("COMP", 2)
        if rig.bench.i51 or written is None:
            continue
        let_lease_end(rig)
        recovery.keep(rig.bench.link, elsewhere)
        if written == list(MOTOR_2.entries):
            continue
        with pytest.raises(PmacCompError, match="may be incomplete") as said:
            put_table(rig.bench.link, elsewhere)
        assert said.value.code == "PC-UPL-024"
        assert rig.fresh().i51 == 0
        torn += 1
    count_runs(torn)
    assert torn


def test_f29_a_reset_is_not_taken_for_somebody_else(*, rig: ChangeBench, count_runs: Count) -> None:
    """After ``$$$`` the number that was saved stands, older than the interruption: recovered."""
    for n in thinned(changing(rig), 2, exhaustive=False):
        here, _ = killed(rig, n)
        rig.bench.side_port()("$$$")
        rig.fresh()
        recovery.recover(rig.bench.link, here)
        assert waiting.left_open(here) == ()
        count_runs(1)


def test_f19_a_rollback_is_not_written_over_somebody_elses_upload(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count_runs: Count
) -> None:
    """What a measurement of another folder borrowed meanwhile is no upload, and no obstacle."""
    ids = SameIds()
    monkeypatch.setattr(journals, "secrets", ids)
    rig = ChangeBench(tmp_path / "here", Scenario("law route", with_table, whole_route), ids)
    assert rig.run() is None
    here = rig.fresh().context
    elsewhere = replace(here, store=tmp_path / "elsewhere")
    upload_tables(rig.bench.link, elsewhere, [OTHER_TABLE])
    theirs = standing(rig.fresh())
    with pytest.raises(ForeignChange, match="not written back over it") as said:
        rollback.rollback_last(rig.bench.link, here)
    assert said.value.left is ControllerState.NEW
    assert not differing(standing(rig.fresh()), theirs)
    assert rig.run() is None
    here = rig.fresh().context
    borrow(rig.bench.link, elsewhere)
    temporary.take_off(rig.bench.link, elsewhere)
    rollback.rollback_last(rig.bench.link, here)
    assert not differing(standing(rig.fresh()), rig.before)
    count_runs(2)


def test_f29_what_a_measurement_borrowed_is_given_back_before_an_upload(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count_runs: Count
) -> None:
    """Whole, it is taken off first; half-written, the upload is refused until ``recover`` ran."""
    ids = SameIds()
    monkeypatch.setattr(journals, "secrets", ids)
    measurement = next(s for s in SCENARIOS if s.name == "measurement")
    rig = ChangeBench(tmp_path / "here", measurement, ids)
    ended = set()
    for n in [*changing(rig), 1 << 30]:
        here, _ = killed(rig, n)
        try:
            put_route(rig.bench.link, here)
        except ForeignChange as error:
            ended.add(error.code)
            rig.recover(resume=True)
        else:
            ended.add("taken off")
            assert not waiting.left_open(here)
        found = standing(rig.fresh())
        assert (found.axes, found.variables[-2:]) == (rig.before.axes, rig.before.variables[-2:])
        count_runs(1)
    assert ended - {"PC-TMP-001"} == {"taken off"}


def test_f29_a_recovery_refused_in_place_says_what_stands(
    tmp_path: Path, count_runs: Count
) -> None:
    """Killed with its tables acting where the axis would jump: it was said to be left OLD."""
    bench = make_plc_bench(tmp_path)
    link, context = bench.link, bench.context
    with_table(link, context)
    with suppress(RuntimeError), grouping.grouped(link, context, "law") as parts:
        upload_tables(link, parts, [new_table(24)])
        raise RuntimeError
    link.command("#1J=160000")
    bench.clock.sleep_s(10.0)
    stands = standing(bench)
    told = {refusal.code for refusal in recovery.recovery_refusals(link, context)}
    assert told == {"PC-SAF-004"}
    with pytest.raises(SafetyRefusal) as refused:
        recovery.recover(link, context)
    with pytest.raises(SafetyRefusal) as beside:
        put_route(link, context)
    for error, code in ((refused.value, "PC-SAF-000"), (beside.value, "PC-TXN-010")):
        assert (error.code, error.left) == (code, ControllerState.NEW)
        assert error.context["confirmed"]
        assert "Seen to stand: tables: NEW, the new tables act." in error.hint
    with pytest.raises(SafetyRefusal) as alone:
        put_settings(link, context)
    assert alone.value.left is None
    assert "`pmac-comp status` says what stands" in alone.value.hint
    assert not differing(standing(bench), stands)
    link.command("#1J=0")
    bench.clock.sleep_s(10.0)
    assert recovery.recovery_refusals(link, context) == []
    assert recovery.recover(link, context).verdict is ControllerState.OLD
    count_runs(3)
