"""F20, F21: what is told of a change was seen: of unsaved, kept, lost or damaged states."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import (
    ConfigError,
    ControllerState,
    LinkLost,
    PmacCompError,
    SafetyRefusal,
)
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.controller.change.sealed_json import write_sealed_json
from pmac_comp.machine.controller.contents.programs import ProgramKind
from pmac_comp.machine.controller.contents.settings import Settings, read_settings
from pmac_comp.machine.controller.settings import backup
from pmac_comp.machine.controller.settings.settings_upload import change_settings
from pmac_comp.machine.controller.tables.table_recovery import status_by_journal
from pmac_comp.machine.controller.tables.upload import remove_tables, upload_tables
from pmac_comp.machine.controller.whole import parts, persist, recovery, rollback
from pmac_comp.machine.controller.whole.grouping import grouped
from pmac_comp.simulator.card.card import Card
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import embedded, make_card
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller import safekeeping, upload_flow
from pmac_comp.workflow.controller.deploy import deploy
from tests.faults.change_bench import standing
from tests.faults.upload_bench import Left, new_table, old_table
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench
from tests.unit.workflow.conftest import BENCH
from tests.unit.workflow.controller.test_deploy import LAW, LEAD

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
N = 24
PROGRAM = (ProgramKind.PROG, 704)


def error_of(change: Callable[[], None]) -> PmacCompError | None:
    try:
        change()
    except PmacCompError as error:
        return error
    return None


def put_on(bench: CardBench, table: int) -> None:
    with grouped(bench.link, bench.context, "table") as inner:
        upload_tables(bench.link, inner, [old_table(N) if table == 1 else new_table(N)])


def load(bench: CardBench, *lines: str) -> None:
    with grouped(bench.link, bench.context, "program") as inner:
        change_settings(bench.link, inner, Settings(programs={PROGRAM: lines}))


def save(bench: CardBench) -> None:
    bench.link.command("#1K")
    bench.clock.sleep_s(0.3)
    bench.link.command("SAVE", timeout_s=persist.SAVE_TIMEOUT_s)


def reset(bench: CardBench) -> None:
    bench.session.close()
    bench.card.reset()
    bench.connect()


@pytest.fixture
def with_flash(tmp_path: Path) -> CardBench:
    (tmp_path / "store").mkdir()
    card = Card(load_bench("paper"), flash=tmp_path / "flash.bin")
    return CardBench(tmp_path / "store", card=card)


@pytest.mark.parametrize("stands", ["table", "program"])
def test_f20_a_reset_amid_an_upload_is_told(tmp_path: Path, stands: str, count_runs: Count) -> None:
    """What stood was never saved: OLD of it, confirmed, would be an untruth."""
    bench = make_plc_bench(tmp_path)
    put_on(bench, 1) if stands == "table" else load(bench, "DWELL10")
    left, before, last = Left(bench), standing(bench), 0

    def change() -> None:
        nonlocal last
        put_on(bench, 2)
        last = bench.n_requests

    bench.reconnect()
    change()
    runs = gone = 0
    for k in range(8, last - 1, 3):
        left.put_back()
        bench.reconnect()

        def at(n: int, k: int = k) -> None:
            if n == k:
                bench.card.reset()

        bench.on_request = at
        error = error_of(change)
        sure = error is not None and bool(error.context.get("confirmed"))
        runs += error is not None
        gone += standing(bench) != before
        if error is not None and sure and error.left is ControllerState.OLD:
            assert standing(bench) == before, (k, error.code, error.message)
    assert runs > 3
    # The upload brings back the tables that it replaces; a program beside them went with the reset.
    assert (gone > 3) is (stands == "program")
    count_runs(runs)


def test_f20_half_a_program_that_is_kept_is_not_old(tmp_path: Path, count_runs: Count) -> None:
    bench = CardBench(tmp_path)
    load(bench, *(f"X{k}" for k in range(200)))
    bench.on_request = lambda _n: cut_in_program(bench)
    with pytest.raises(LinkLost):
        load(bench, *(f"X{k + 1}" for k in range(400)))
    bench.reconnect()
    bench.link.command("CLOSE ALL")
    kept = recovery.keep(bench.link, bench.context)
    assert kept.verdict is ControllerState.DISABLED
    assert any("PROG 704" in note for note in kept.notes)
    count_runs(1)


def cut_in_program(bench: CardBench) -> None:
    if bench.card.programs.open_program is not None:
        raise LinkLost("cut", code="X")


@pytest.fixture
def axis() -> Iterator[Axis]:
    with embedded(make_card(BENCH)) as link:
        found = Axis(link, BENCH, "card")
        found.enable()
        yield found


@pytest.mark.parametrize(
    ("act", "said"),
    [
        ("#1DELETE COMP", "switched off, none or incomplete"),
        ("DISABLE PLC 0", "PLC 0 is not enabled"),
        ("P7001=1-P7001", "another law"),
    ],
)
def test_f20_a_law_of_which_something_went_is_not_new(
    axis: Axis, tmp_path: Path, act: str, said: str, count_runs: Count
) -> None:
    context = context_of(axis, tmp_path)
    deploy(axis, Compensation("law", LAW, LEAD), context)
    whole = recovery.recover(axis.link, context)
    assert whole.verdict is ControllerState.NEW
    assert "not armed" not in " ".join(whole.notes)
    axis.link.command("P7002=0")
    axis.link.clock.sleep_s(1.0)
    axis.link.command(act)
    found = recovery.recover(axis.link, context)
    assert found.verdict is not ControllerState.NEW
    assert said in " ".join(found.notes)
    count_runs(1)


def test_f21_a_damaged_flash_stops_everything_but_a_restore(
    with_flash: CardBench, tmp_path: Path, count_runs: Count
) -> None:
    bench = with_flash
    put_on(bench, 1)
    save(bench)
    put_on(bench, 2)
    flash = tmp_path / "flash.bin"
    flash.write_bytes(flash.read_bytes()[: flash.stat().st_size // 2])
    reset(bench)
    before = standing(bench)
    for settle in (recovery.recover, rollback.rollback_last):
        with pytest.raises(SafetyRefusal, match="flash error"):
            settle(bench.link, bench.context)
        assert standing(bench) == before
    count_runs(2)


def test_f20_status_and_recover_say_the_same_after_a_reset(
    with_flash: CardBench, count_runs: Count
) -> None:
    bench = with_flash
    put_on(bench, 1)
    save(bench)
    put_on(bench, 2)
    reset(bench)
    assert status_by_journal(bench.link, bench.context).decision.state is ControllerState.OLD
    assert recovery.recover(bench.link, bench.context).verdict is ControllerState.OLD
    count_runs(1)


def test_f20_tables_that_act_again_out_of_the_flash_are_not_old(
    with_flash: CardBench, count_runs: Count
) -> None:
    bench = with_flash
    put_on(bench, 1)
    save(bench)
    bench.link.command("#1DELETE COMP")
    rollback.rollback_last(bench.link, bench.context)
    reset(bench)
    found = recovery.recover(bench.link, bench.context)
    assert bench.i51
    assert found.verdict is ControllerState.NEW
    assert "acts again" in found.notes[0]
    count_runs(1)


def test_f20_one_misread_listing_is_nobody_s_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count_runs: Count
) -> None:
    bench = CardBench(tmp_path)
    load(bench, "X1", "X2")
    before = standing(bench)
    load(bench, "X3", "X4")
    reads = []

    def misread(link: object, asked: Settings) -> Settings:
        found = read_settings(bench.link, asked)
        reads.append(found)
        programs = {key: ("P1=1", *body) for key, body in found.programs.items()}
        return replace(found, programs=programs) if len(reads) == 1 else found

    monkeypatch.setattr(parts, "read_settings", misread)
    rollback.rollback_last(bench.link, bench.context)
    assert standing(bench) == before
    count_runs(1)


def test_f20_a_reset_before_save_is_told(
    with_flash: CardBench, monkeypatch: pytest.MonkeyPatch, count_runs: Count
) -> None:
    bench = with_flash
    put_on(bench, 1)

    def lost(*_: object) -> None:
        bench.card.reset()
        raise PmacCompError("not saved", code="X")

    monkeypatch.setattr(upload_flow, "save_checked", lost)
    axis = Axis(bench.link, bench.bench, "controller")
    with pytest.raises(PmacCompError, match="not saved") as told:
        upload_flow._save(axis, bench.context, "table")
    assert told.value.left is ControllerState.DISABLED
    assert told.value.context["confirmed"] is False
    count_runs(1)


def test_commands_of_a_file_that_acted_are_owned_up_to(tmp_path: Path) -> None:
    source = tmp_path / "own.pmc"
    source.write_text("UNDEFINE ALL\n&1#2->3Y\nFOO BAR\n", encoding="ascii")
    with pytest.raises(PmacCompError) as told:
        safekeeping.restore_from_file("sim://", "paper", source, journal=tmp_path)
    assert told.value.left is ControllerState.DISABLED
    assert told.value.context["confirmed"] is False


@pytest.mark.parametrize(
    ("kind", "value"), [("p", "1 SAVE"), ("i", "abc"), ("p", "1e999"), ("m", "*\nSAVE")]
)
def test_a_backup_holds_nothing_but_values(tmp_path: Path, kind: str, value: str) -> None:
    bench = CardBench(tmp_path)
    stored = backup.read_backup(bench.link, p_range=(0, 99), with_q=False)
    data = stored.as_dict()
    data[kind] = {**data[kind], "5": value}  # type: ignore[dict-item]
    write_sealed_json(tmp_path / "b.json", data)
    with pytest.raises(ConfigError, match="not understood"):
        backup.load_backup(tmp_path / "b.json")


def test_a_removal_that_a_reset_undid_is_told(with_flash: CardBench) -> None:
    bench = with_flash
    put_on(bench, 1)
    save(bench)
    with grouped(bench.link, bench.context, "remove") as inner:
        remove_tables(bench.link, inner, [(t.kind, t.motor) for t in [old_table(N)]])
    reset(bench)
    assert recovery.recover(bench.link, bench.context).verdict is ControllerState.OLD
