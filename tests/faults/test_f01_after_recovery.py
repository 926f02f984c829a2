"""F01, F17, F20, F36: what comes after a recovery, and what the damage of a journal hides."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import (
    CommandRefused,
    ControllerState,
    LinkLost,
    PmacCompError,
    SafetyRefusal,
)
from pmac_comp.machine.controller.contents.comp_table import TableKind
from pmac_comp.machine.controller.settings import guard_install
from pmac_comp.machine.controller.tables.upload import remove_tables, upload_tables
from pmac_comp.machine.controller.whole import recovery, rollback, waiting
from pmac_comp.machine.controller.whole.grouping import grouped
from tests.faults.change_bench import difference, standing
from tests.faults.test_f01_f29_every_kind import guarded_table, thinned, with_table
from tests.faults.upload_bench import Left, new_table, old_table
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
N = 24
LAST = 5  # requests with which a recovery says that it has ended


@pytest.fixture
def bench(tmp_path: Path) -> CardBench:
    """The old table acts, watched by the guard."""
    bench = make_plc_bench(tmp_path)
    with_table(bench.link, bench.context)
    guard_install.install_guard(bench.link, bench.context)
    return bench


def acts(bench: CardBench) -> str:
    """Which table acts on the card."""
    known = {tuple(new_table(N).entries): "new", tuple(old_table(N).entries): "old"}
    found = bench.values("COMP", 1)
    return known[tuple(found)] if bench.i51 and found is not None else "none"


def cut_while_off(bench: CardBench, nth: int) -> None:
    """The link is lost in an upload of the new table, at the nth request with the tables off."""
    seen: list[int] = []

    def note(k: int) -> None:
        if not bench.i51:
            seen.append(k)
            if len(seen) == nth:
                raise LinkLost("cut", code="X")

    bench.on_request = note
    with pytest.raises(LinkLost):
        guarded_table(bench.link, bench.context)
    bench.reconnect()


@pytest.mark.parametrize("nth", [1, 3])
def test_f01_what_was_kept_is_not_completed_later(
    bench: CardBench, nth: int, count_runs: Count
) -> None:
    cut_while_off(bench, nth)
    recovery.keep(bench.link, bench.context)
    before = standing(bench)
    recovery.recover(bench.link, bench.context)
    assert standing(bench) == before, difference(standing(bench), before)
    count_runs(1)


def test_f15_an_upload_that_was_refused_is_not_completed_later(
    bench: CardBench, count_runs: Count
) -> None:
    """Its tables stood as before; somebody switches them off; recover brings back those."""
    send = bench.link.write_buffer

    def refuse(lines: list[str]) -> None:
        if any("DELETE COMP" in line for line in lines):
            raise CommandRefused("ERR003", code="X")
        send(lines)

    bench.link.write_buffer = refuse  # type: ignore[method-assign, assignment]
    with pytest.raises(CommandRefused) as told:
        guarded_table(bench.link, bench.context)
    assert told.value.left is ControllerState.OLD
    bench.reconnect()
    assert acts(bench) == "old"
    bench.link.command("I51=0")
    result = recovery.recover(bench.link, bench.context)
    assert result.verdict is ControllerState.OLD
    assert acts(bench) == "old"
    count_runs(1)


@pytest.mark.parametrize("nth", [1, 3])
def test_f17_tables_switched_off_after_a_recovery_act_again_or_are_called_off(
    bench: CardBench, nth: int, count_runs: Count
) -> None:
    cut_while_off(bench, nth)
    recovery.recover(bench.link, bench.context)
    bench.link.command("I51=0")
    result = recovery.recover(bench.link, bench.context)
    assert result.verdict is ControllerState.OLD
    assert acts(bench) == "old"
    count_runs(1)


@pytest.mark.parametrize("undone", [False, True])
def test_f17_what_another_folder_has_removed_since_is_not_written_again(
    bench: CardBench, tmp_path: Path, count_runs: Count, *, undone: bool
) -> None:
    """Nothing waits here: the last upload, or what a rollback brought back, is not ours to mend."""
    guarded_table(bench.link, bench.context)
    if undone:
        rollback.rollback_last(bench.link, bench.context)
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    with grouped(bench.link, replace(bench.context, store=folder), "removal") as parts:
        remove_tables(bench.link, parts, [(TableKind.COMP, 1)])
    before = standing(bench)
    result = recovery.recover(bench.link, bench.context)
    assert "another folder or host has changed" in result.notes[0]
    assert standing(bench) == before
    count_runs(1)


class Torn:
    """An upload that was cut with the tables off, put back before each recovery."""

    def __init__(self, bench: CardBench) -> None:
        self.bench = bench
        cut_while_off(bench, 2)
        self.restart = Left(bench).put_back

    def requests(self) -> int:
        self.restart()
        recovery.recover(self.bench.link, self.bench.context)
        return self.bench.n_requests

    def recover_disturbed(self, at: int, disturb: Callable[[], None]) -> PmacCompError | None:
        self.restart()

        def note(k: int) -> None:
            if k == at:
                disturb()

        self.bench.on_request = note
        try:
            recovery.recover(self.bench.link, self.bench.context)
        except PmacCompError as error:
            return error
        return None


def lose_link() -> None:
    raise LinkLost("cut", code="X")


def test_f01_a_recovery_that_was_cut_claims_nothing_and_leaves_nothing_behind(
    bench: CardBench, *, exhaustive: bool, count_runs: Count
) -> None:
    """At each request: unconfirmed; the next recovery ends, and a new upload is accepted."""
    torn = Torn(bench)
    for at in thinned(range(torn.requests()), 9, exhaustive=exhaustive):
        error = torn.recover_disturbed(at, lose_link)
        assert error is not None
        assert error.left is ControllerState.DISABLED
        assert error.context["confirmed"] is False
        bench.reconnect()
        assert recovery.recover(bench.link, bench.context).verdict is ControllerState.OLD
        assert acts(bench) == "old"
        assert waiting.left_open(bench.context) == ()
        upload_tables(bench.link, bench.context, [old_table(40)])
        count_runs(1)


def test_f17_a_recovery_that_loses_its_lease_says_what_stands(
    bench: CardBench, *, exhaustive: bool, count_runs: Count
) -> None:
    torn = Torn(bench)
    lease = f"P{bench.context.block.first + 78}=0"
    confirmed = 0
    for at in thinned(range(torn.requests()), 9, exhaustive=exhaustive):
        error = torn.recover_disturbed(at, lambda: void(bench.side_port()(lease)))
        if error is not None and error.context.get("confirmed"):
            # Not everything need be as before where the tables are.
            meant = {"old": (ControllerState.OLD, ControllerState.DISABLED)}
            assert error.left in meant.get(acts(bench), (ControllerState.DISABLED,))
            confirmed += 1
        count_runs(1)
    assert confirmed


def test_f17_tables_switched_off_while_they_come_back_are_not_called_old(
    bench: CardBench, *, exhaustive: bool, count_runs: Count
) -> None:
    """Nor is that the end of it: the next recovery switches them on."""
    torn = Torn(bench)
    for at in thinned(range(torn.requests()), 9, exhaustive=exhaustive):
        error = torn.recover_disturbed(at, lambda: void(bench.side_port()("I51=0")))
        if error is None:
            # What lies behind the last look nobody sees.
            assert acts(bench) == "old" or at >= torn.requests() - LAST
        else:
            bench.reconnect()
            assert recovery.recover(bench.link, bench.context).verdict is ControllerState.OLD
            assert acts(bench) == "old"
        count_runs(1)


def void(_answer: bytes) -> None:
    """An answer that nobody needs."""


def test_f20_a_table_that_stood_already_comes_back_after_a_reset(
    bench: CardBench, count_runs: Count
) -> None:
    """An upload that brings what stands: a reset without SAVE takes that all the same."""
    with grouped(bench.link, bench.context, "law") as parts:
        upload_tables(bench.link, parts, [old_table(N)])
    bench.link.command("#1K")
    bench.clock.sleep_s(0.2)
    bench.side_port()("$$$")
    bench.clock.sleep_s(1.0)
    bench.reconnect()
    bench.link.command("#1J/")
    bench.clock.sleep_s(0.2)
    assert acts(bench) == "none"
    result = rollback.rollback_last(bench.link, bench.context)
    assert result.verdict is ControllerState.OLD
    assert acts(bench) == "old"
    count_runs(1)


def test_f36_a_damaged_journal_is_named_and_nothing_is_told_of_the_card(
    bench: CardBench, count_runs: Count
) -> None:
    """Any line of any journal of an interrupted upload; what stands may be kept."""
    torn = Torn(bench)
    torn.restart()
    journals = sorted(bench.folder.glob("*.journal"))
    for path in journals:
        lines = path.read_bytes().splitlines(keepends=True)
        for k, line in enumerate(lines):
            torn.restart()
            bad = bytes([line[0] ^ 1]) + line[1:]
            path.write_bytes(b"".join([*lines[:k], bad, *lines[k + 1 :]]))
            before = standing(bench)
            for act in (recovery.recover, rollback.rollback_last, guarded_table):
                with pytest.raises(SafetyRefusal, match="is damaged") as told:
                    act(bench.link, bench.context)
                assert told.value.left is not ControllerState.OLD
                assert not told.value.context.get("confirmed")
            assert any("damaged" in text for text in waiting.left_open(bench.context))
            assert standing(bench) == before
            recovery.keep(bench.link, bench.context)
            assert waiting.left_open(bench.context) == ()
            count_runs(1)


def test_f38_a_journal_that_the_full_disk_left_empty_is_no_change(
    bench: CardBench, count_runs: Count
) -> None:
    guarded_table(bench.link, bench.context)
    newest = sorted(bench.folder.glob("*.journal"))[-1]
    count = int(newest.name.split("-")[1]) + 1
    name = newest.name.replace(newest.name.split("-")[1], f"{count:06d}", 1)
    (newest.parent / name).touch()
    assert recovery.last_change(bench.context).endswith("done")
    assert recovery.recover(bench.link, bench.context).verdict is ControllerState.NEW
    count_runs(1)
