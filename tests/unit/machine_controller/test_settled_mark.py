"""Settled journals are not read by every change again, and no torn one is ever passed over."""

from pathlib import Path

import pytest

from pmac_comp.base.errors import ControllerState, LinkLost, SafetyRefusal
from pmac_comp.machine.controller.change import journals
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journal import Journal
from pmac_comp.machine.controller.change.journals import ChangeKind, torn_refusals
from pmac_comp.machine.controller.change.transaction import Change
from pmac_comp.machine.controller.contents.settings import Settings
from pmac_comp.machine.controller.settings import temporary
from pmac_comp.machine.controller.tables.upload import upload_tables
from pmac_comp.machine.controller.whole import grouping, recovery, rollback, taking_back, waiting
from tests.faults.upload_bench import new_table, old_table
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

N_MANY = 40


@pytest.fixture
def context(tmp_path: Path) -> Context:
    return CardBench(tmp_path).context


def written(context: Context, count: int, *steps: str) -> Journal:
    journal = Journal(context.store / f"{context.controller}-{count:06d}-{count:010d}.journal")
    for step in steps:
        journal.write(step, {"kind": "tables"})
    return journal


def settled(context: Context, n: int = N_MANY) -> list[Journal]:
    return [written(context, k, "begin", "intent", "done") for k in range(1, n + 1)]


def n_read(context: Context, monkeypatch: pytest.MonkeyPatch) -> int:
    """Journals that one more change reads."""
    seen: list[Journal] = []
    plain = journals.is_torn
    with monkeypatch.context() as patch:
        patch.setattr(journals, "is_torn", lambda j: bool(seen.append(j)) or plain(j))
        assert not torn_refusals(context)
    return len(seen)


def test_settled_journals_are_read_once(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    settled(context)
    assert n_read(context, monkeypatch) == N_MANY
    assert n_read(context, monkeypatch) == 0
    written(context, N_MANY + 1, "begin", "intent", "done")
    assert n_read(context, monkeypatch) == 1


def test_a_torn_journal_is_found_behind_the_mark_and_keeps_it_from_moving(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    settled(context)
    assert not torn_refusals(context)
    torn = written(context, N_MANY + 1, "begin", "intent")
    for k in range(N_MANY + 2, 2 * N_MANY):
        written(context, k, "begin", "intent", "done")
    for _ in range(2):
        assert [r.context["journal"] for r in torn_refusals(context)] == [str(torn.path)]


def test_a_settled_journal_that_is_opened_again_is_found(context: Context) -> None:
    journals = settled(context)
    assert not torn_refusals(context)
    # As a recovery does that finishes what a reset took: the old journal goes on.
    bench = CardBench(context.store)
    with Change(bench.link, context, ChangeKind.TABLES, journals[3]) as change:
        change.step("intent")
    assert [r.context["journal"] for r in torn_refusals(context)] == [str(journals[3].path)]


def test_an_upload_whose_rollback_was_cut_off_is_found_behind_the_mark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a measurement borrows and gives back moves the mark past the upload."""
    bench = make_plc_bench(tmp_path)
    link, context = bench.link, bench.context
    with grouping.grouped(link, context, "table") as parts:
        upload_tables(link, parts, [old_table(8)])
    mark = context.store / f"{context.controller}.settled"
    while not mark.exists():
        temporary.put_on(link, context, Settings({"I5190": "1000"}))
        temporary.take_off(link, context)

    def killed(*_: object, **__: object) -> str:
        raise LinkLost("killed")

    with monkeypatch.context() as patch:
        patch.setattr(taking_back, "take_back", killed)
        with pytest.raises(LinkLost):
            rollback.rollback_last(link, context)
    assert waiting.left_open(context)
    assert [r.code for r in torn_refusals(context)] == ["PC-TXN-010"]
    with pytest.raises(SafetyRefusal, match="interrupted and is still open"):
        upload_tables(link, context, [new_table(8)])
    assert recovery.recover(link, context).verdict is ControllerState.OLD
    assert not torn_refusals(context)
    assert bench.values("COMP", 1) is None


@pytest.mark.parametrize("what", ["cut", "empty", "not text", "of another folder", "gone"])
def test_a_mark_that_names_no_journal_of_the_folder_says_nothing(
    context: Context, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    settled(context)
    assert not torn_refusals(context)
    mark = context.store / f"{context.controller}.settled"
    whole = mark.read_bytes()
    if what == "gone":
        mark.unlink()
    else:
        mark.write_bytes(
            {
                "cut": whole[:-9],
                "empty": b"",
                "not text": b"\xff\x00",
                "of another folder": whole.replace(b"0040.j", b"0041.j"),
            }[what]
        )
    assert n_read(context, monkeypatch) == N_MANY


def test_journals_that_begin_anew_are_not_behind_an_old_mark(context: Context) -> None:
    for journal in settled(context):
        assert not torn_refusals(context)
        journal.path.unlink()
    torn = written(context, 2, "begin", "intent")
    assert [r.context["journal"] for r in torn_refusals(context)] == [str(torn.path)]


def test_without_room_for_the_mark_all_are_read(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    settled(context)

    def full(*_: object, **__: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    for _ in range(2):
        assert n_read(context, monkeypatch) == N_MANY
