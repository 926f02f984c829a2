"""F19: two cards of a kind and one folder; one card by two ways."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import ConfigError, ControllerState, LinkLost
from pmac_comp.machine.controller.card import identity
from pmac_comp.machine.controller.change.alike import known_in_folder, left_open_alike
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.contents.comp_table import CompTable
from pmac_comp.machine.controller.tables.upload import upload_tables
from pmac_comp.machine.controller.whole import recovery, rollback
from pmac_comp.machine.controller.whole.grouping import grouped
from tests.faults.change_bench import standing
from tests.faults.upload_bench import new_table, old_table
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
N = 24
HERE, THERE = "mill-a:1025", "mill-b:1025"


@pytest.fixture
def one(tmp_path: Path) -> CardBench:
    return make_plc_bench(tmp_path / "one")


@pytest.fixture
def other(tmp_path: Path) -> CardBench:
    return make_plc_bench(tmp_path / "other")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "journal").mkdir()
    return tmp_path / "journal"


def known(bench: CardBench, folder: Path, address: str) -> Context:
    context = replace(bench.context, store=folder, controller="322c0f2ed6d20dad")
    return known_in_folder(bench.link, context, address)


def put_on(bench: CardBench, context: Context, table: CompTable) -> None:
    with grouped(bench.link, context, "table") as parts:
        upload_tables(bench.link, parts, [table])


def cut(bench: CardBench, context: Context, table: CompTable) -> None:
    """The link is lost while the tables are off."""

    def off(_n: int) -> None:
        if not bench.i51:
            raise LinkLost("cut", code="X")

    bench.on_request = off
    with pytest.raises(LinkLost):
        put_on(bench, context, table)
    bench.reconnect()


def test_f19_a_rollback_takes_the_upload_of_its_own_card_back(
    one: CardBench, other: CardBench, folder: Path, count_runs: Count
) -> None:
    put_on(one, known(one, folder, HERE), old_table(N))
    put_on(other, known(other, folder, THERE), old_table(N))
    put_on(one, known(one, folder, HERE), new_table(N))
    put_on(other, known(other, folder, THERE), new_table(N + 1))
    rollback.rollback_last(one.link, known(one, folder, HERE))
    assert one.values("COMP", 1) == list(old_table(N).entries)
    assert other.values("COMP", 1) == list(new_table(N + 1).entries)
    rollback.rollback_last(other.link, known(other, folder, THERE))
    assert other.values("COMP", 1) == list(old_table(N).entries)
    count_runs(2)


def test_f19_what_was_cut_on_one_card_is_not_written_to_the_other(
    one: CardBench, other: CardBench, folder: Path, count_runs: Count
) -> None:
    put_on(one, known(one, folder, HERE), old_table(N))
    cut(one, known(one, folder, HERE), new_table(N))
    before = standing(other)
    there = known(other, folder, THERE)
    result = recovery.recover(other.link, there)
    assert standing(other) == before
    assert result.verdict is ControllerState.OLD
    assert any("answers alike, reached as mill-a_1025" in note for note in result.notes)
    with pytest.raises(ConfigError, match="no upload"):
        rollback.rollback_last(other.link, there)
    put_on(other, known(other, folder, THERE), new_table(N))  # nor does it wait for the first
    assert recovery.recover(one.link, known(one, folder, HERE)).verdict is ControllerState.OLD
    assert one.values("COMP", 1) == list(old_table(N).entries)
    assert one.i51
    assert not left_open_alike(known(other, folder, THERE))
    count_runs(2)


@pytest.mark.parametrize("by", ["mill-a:1025", "10.0.0.5:1025", "/dev/ttyUSB0"])
def test_f19_one_card_by_two_ways_is_one(
    one: CardBench, folder: Path, by: str, count_runs: Count
) -> None:
    put_on(one, known(one, folder, HERE), old_table(N))
    cut(one, known(one, folder, HERE), new_table(N))
    assert recovery.recover(one.link, known(one, folder, by)).verdict is ControllerState.OLD
    assert one.values("COMP", 1) == list(old_table(N).entries)
    put_on(one, known(one, folder, by), new_table(N))
    rollback.rollback_last(one.link, known(one, folder, HERE))
    assert one.values("COMP", 1) == list(old_table(N).entries)
    count_runs(2)


def test_f19_cards_that_changed_places_are_known_by_their_numbers(
    one: CardBench, other: CardBench, folder: Path, count_runs: Count
) -> None:
    put_on(one, known(one, folder, HERE), old_table(N))
    put_on(other, known(other, folder, THERE), new_table(N))
    rollback.rollback_last(other.link, known(other, folder, HERE))
    assert other.values("COMP", 1) is None
    assert one.values("COMP", 1) == list(old_table(N).entries)
    count_runs(1)


def test_a_card_with_an_id_module_is_alone(one: CardBench, monkeypatch: pytest.MonkeyPatch) -> None:
    simulated = identity.read_identity(one.link)
    assert simulated.is_simulated
    assert not simulated.is_alone
    query = one.link.query

    def with_module(text: str) -> list[str]:
        return ["374A256E9014D101"] if text == "SID" else query(text)

    monkeypatch.setattr(one.link, "query", with_module)
    found = identity.read_identity(one.link)
    assert found.is_alone
    assert found.fingerprint != simulated.fingerprint
