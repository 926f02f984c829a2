"""F19 to F21: SAVE takes its place among the writers; the flash keeps no trace of a change."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import (
    CommandRefused,
    ControllerState,
    ForeignChange,
    MotorNotSafe,
    PmacCompError,
    SafetyRefusal,
)
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.change.claim import FREE, read_claim
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journals import journals
from pmac_comp.machine.controller.change.lease import read_clock, renew_lease
from pmac_comp.machine.controller.change.manifest import CLOCK_PER_s, Lease, LONGEST_LEASE_s
from pmac_comp.machine.controller.contents.law_bank import Index, LawBlock
from pmac_comp.machine.controller.tables import upload
from pmac_comp.machine.controller.tables.table_status import read_head
from pmac_comp.machine.controller.whole import persist, recovery, waiting
from pmac_comp.machine.transport.base import Framing
from pmac_comp.machine.transport.pair import PairTransport
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.dialog.sessions import EthernetSession
from pmac_comp.workflow.controller.inspect import lease_text
from tests.faults.upload_bench import new_table, old_table
from tests.unit.machine_controller.card_bench import REQUEST_CYCLES, CardBench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
BLOCK = LawBlock()
OWNER, NUMBER = BLOCK.p(Index.LEASE), BLOCK.p(Index.CHANGE)


@pytest.fixture
def bench(tmp_path: Path) -> CardBench:
    """All motors killed, with a flash."""
    return CardBench(tmp_path / "store", card=Card(load_bench("paper"), flash=tmp_path / "flash"))


def other_host(bench: CardBench) -> Commander:
    """A second conversation with the same card."""
    session = EthernetSession(bench.card)

    def peer(data: bytes) -> bytes:
        bench.card.run_cycles(REQUEST_CYCLES if data else 0)
        return session.receive(data)

    pair = PairTransport(peer, bench.clock, framing=Framing.PACKETS)
    return Commander(pair, clock=bench.clock, timeout_s=1.0)


def elsewhere(bench: CardBench, first_p: int) -> Context:
    """Another folder, with the block of the same bench file or of another."""
    folder = bench.folder.parent / f"other{first_p}"
    return replace(bench.context, store=folder, block=LawBlock(first_p))


@pytest.mark.parametrize("first_p", [7000, 7200])
def test_f19_save_amid_the_upload_of_somebody_else_is_refused(
    *, bench: CardBench, first_p: int, count_runs: Count
) -> None:
    link, context = other_host(bench), elsewhere(bench, first_p)
    done: list[int] = []
    refused: list[PmacCompError] = []

    def save(n: int) -> None:
        if bench.p(OWNER) and n > len(done):
            done.append(n)
            with pytest.raises(SafetyRefusal) as told:
                persist.persist(link, context)
            refused.append(told.value)

    bench.on_request = save
    result = upload.upload_tables(bench.link, bench.context, [new_table(40)])
    assert result.verdict is ControllerState.NEW
    assert len(refused) >= 5
    assert {error.code for error in refused} == {"PC-TXN-002" if first_p == 7000 else "PC-TXN-013"}
    bench.card.reset()
    assert bench.values("COMP", 1) is None
    count_runs(len(refused))


def test_f20_the_flash_holds_neither_lease_nor_open_change(bench: CardBench) -> None:
    upload.upload_tables(bench.link, bench.context, [old_table(40)])
    persist.persist(bench.link, bench.context)
    assert read_claim(bench.link) == FREE
    assert bench.p(OWNER) == 0
    assert bench.p(NUMBER) < 0
    bench.card.reset()
    bench.reconnect()
    assert bench.p(OWNER) == 0
    assert bench.p(NUMBER) < 0
    assert tuple(bench.values("COMP", 1) or ()) == old_table(40).entries
    for first_p in (7000, 7200):
        context = elsewhere(bench, first_p)
        result = upload.upload_tables(bench.link, context, [replace(new_table(8), motor=2)])
        assert result.verdict is ControllerState.NEW


def test_f19_a_change_that_comes_between_is_told(bench: CardBench) -> None:
    """Somebody who does not look at the lease begins while the card saves."""
    upload.upload_tables(bench.link, bench.context, [old_table(40)])
    change = bench.session.receive

    def receive(data: bytes) -> bytes:
        answer = change(data)
        if b"SAVE" in data:
            bench.card.variables.write("P", NUMBER, -4711.0)
        return answer

    bench.session.receive = receive  # type: ignore[method-assign]
    with pytest.raises(ForeignChange) as told:
        persist.persist(bench.link, bench.context)
    assert told.value.code == "PC-TXN-060"
    assert bench.p(OWNER) == 0
    assert read_claim(bench.link) == FREE


def test_f19_save_refuses_beside_an_interrupted_change(bench: CardBench) -> None:
    upload.upload_tables(bench.link, bench.context, [old_table(40)])

    def cut(_n: int) -> None:
        if bench.p(BLOCK.p(Index.MANIFEST) + 1) == 1:
            raise ConnectionResetError

    bench.on_request = cut
    with pytest.raises(ConnectionResetError):
        upload.upload_tables(bench.link, bench.context, [new_table(40)])
    bench.reconnect()
    with pytest.raises(SafetyRefusal) as told:
        persist.persist(bench.link, bench.context)
    assert told.value.code == "PC-TXN-010"
    recovery.recover(bench.link, bench.context)
    persist.persist(bench.link, bench.context)


@pytest.mark.parametrize("why", ["enabled", "refused"])
def test_f21_a_save_that_is_refused_holds_nobody_up(bench: CardBench, why: str) -> None:
    upload.upload_tables(bench.link, bench.context, [old_table(40)])
    if why == "enabled":
        bench.link.command("#1J/")
    else:
        bench.filter = lambda _n, data: data.replace(b"SAVE", b"SAFE")
    with pytest.raises(MotorNotSafe if why == "enabled" else CommandRefused):
        persist.persist(bench.link, bench.context)
    assert read_claim(bench.link) == FREE
    assert read_head(bench.link, bench.context).lease.is_free
    assert bench.p(NUMBER) < 0
    bench.card.reset()
    assert bench.values("COMP", 1) is None


@pytest.mark.parametrize("lost", ["before", "after"])
def test_f21_a_link_lost_at_save_needs_no_recovery(
    *, bench: CardBench, lost: str, count_runs: Count
) -> None:
    upload.upload_tables(bench.link, bench.context, [old_table(40)])
    receive = bench.session.receive

    def cut(data: bytes) -> bytes:
        if b"SAVE" not in data:
            return receive(data)
        if lost == "after":
            receive(data)
        raise ConnectionResetError

    bench.session.receive = cut  # type: ignore[method-assign]
    with pytest.raises((PmacCompError, ConnectionResetError)):
        persist.persist(bench.link, bench.context)
    bench.card.reset()
    bench.reconnect()
    assert bench.p(OWNER) == 0
    assert len(journals(bench.context)) == 2
    assert waiting.left_open(bench.context) == ()
    result = upload.upload_tables(bench.link, bench.context, [new_table(40)])
    assert result.verdict is ControllerState.NEW
    count_runs(1)


def test_f19_a_lease_of_another_time_holds_nobody_up(bench: CardBench) -> None:
    """Its end lies where no lease ends: the card's clock began anew, the P-variables came back."""
    bench.link.write_buffer([f"P7079={30 * 86400 * 1024}", "P7078=4711"])
    lease = read_head(bench.link, bench.context).lease
    now = read_clock(bench.link)
    assert lease_text(lease, now) == "left behind by owner 4711, expired"
    result = upload.upload_tables(bench.link, bench.context, [new_table(40)])
    assert result.verdict is ControllerState.NEW
    longest = int(LONGEST_LEASE_s * CLOCK_PER_s)
    assert Lease(1, now + longest).is_held_against(2, now)
    assert not Lease(1, now + longest + 1).is_held_against(2, now)
    # None of ours is longer.
    bench.link.command(f"P7078={bench.context.owner}")
    lease = renew_lease(bench.link, bench.context, 1e6)
    assert lease.is_held_against(2, read_clock(bench.link))
