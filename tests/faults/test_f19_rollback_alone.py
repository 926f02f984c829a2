"""F19: a rollback or a recovery is the one writer on the card, as an upload is; then it lets go."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import ControllerState, PmacCompError, SafetyRefusal
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.claim import FREE, read_claim
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.lease import read_change, read_lease
from pmac_comp.machine.controller.contents.law_bank import Index, LawBlock, LawParameters
from pmac_comp.machine.controller.contents.settings import Settings
from pmac_comp.machine.controller.law import law_upload
from pmac_comp.machine.controller.law.law_state import read_bank, read_law_head
from pmac_comp.machine.controller.settings.settings_upload import change_settings
from pmac_comp.machine.controller.tables.upload import upload_tables
from pmac_comp.machine.controller.whole import grouping, recovery, rollback, waiting
from pmac_comp.machine.transport.base import Framing
from pmac_comp.machine.transport.pair import PairTransport
from pmac_comp.machine.transport.tap import Fault, FaultKind, Way
from pmac_comp.simulator.dialog.sessions import EthernetSession
from tests.faults.test_f01_f29_every_kind import thinned, whole_route
from tests.faults.upload_bench import new_table, put_back, saved
from tests.unit.machine_controller.card_bench import REQUEST_CYCLES, CardBench, make_plc_bench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
Change = Callable[[Link, Context], object]
Ended = PmacCompError | None
BLOCKS = [LawBlock(), LawBlock(7200)]
THEIRS = LawParameters(A0=2.5, JL=1.0, T0=150.0, T_LIMIT=500.0)
_WHOLE_CHANGE_s = 30.0
HELD = {"PC-TXN-002", "PC-TXN-011", "PC-TXN-013"}  # lease, number, claim


def another_host(bench: CardBench) -> Link:
    """A conversation of its own with the same card."""
    session = EthernetSession(bench.card)

    def peer(data: bytes) -> bytes:
        if data:
            bench.card.run_cycles(REQUEST_CYCLES)
        return session.receive(data)

    transport = PairTransport(peer, bench.clock, framing=Framing.PACKETS)
    return Commander(transport, clock=bench.clock, timeout_s=1.0)


class TwoHosts:
    """An upload of ours stands, put back before each run; somebody else acts at a request."""

    def __init__(self, folder: Path, theirs: LawBlock) -> None:
        self.ours_in, self.theirs_in = folder / "ours", folder / "theirs"
        self.ours_in.mkdir()
        self.bench = make_plc_bench(self.ours_in)
        self.theirs = replace(self.bench.context, store=self.theirs_in, block=theirs)
        whole_route(self.bench.link, self.bench.context)
        self._card = saved(self.bench)
        self._files = {path: path.read_bytes() for path in self.ours_in.iterdir()}

    def restart(self) -> CardBench:
        put_back(self.bench, self._card)
        self.theirs_in.mkdir(exist_ok=True)
        for path in (*self.ours_in.iterdir(), *self.theirs_in.iterdir()):
            path.unlink()
        for path, text in self._files.items():
            path.write_bytes(text)
        return self.bench

    def requests(self, change: Change, context: Context) -> int:
        """So many requests a change has."""
        bench = self.restart()
        change(bench.link, context)
        return bench.n_requests

    def require_let_go(self) -> None:
        """Nothing on the card keeps anybody out."""
        for context in (self.bench.context, self.theirs):
            assert read_lease(self.bench.link, context).is_free
            assert read_change(self.bench.link, context) <= 0
        assert read_claim(self.bench.link) == FREE


def attempt(change: Change, link: Link, context: Context) -> PmacCompError | None:
    """The error that a change ended with."""
    try:
        change(link, context)
    except PmacCompError as error:
        return error
    return None


def at_request(bench: CardBench, at: int, change: Change, context: Context) -> list[Ended]:
    """Have somebody else change the card at that request; how it ended, once it did."""
    link, told = another_host(bench), list[Ended]()
    bench.link.timeout_s = _WHOLE_CHANGE_s  # all of their change happens within one request of ours

    def act(n: int) -> None:
        if n == at:
            told.append(attempt(change, link, context))

    bench.on_request = act
    return told


def set_gain(link: Link, context: Context) -> None:
    change_settings(link, context, Settings({"I219": "0.7"}))


def gain_and_table(link: Link, context: Context) -> None:
    with grouping.grouped(link, context, "theirs") as parts:
        set_gain(link, parts)
        upload_tables(link, parts, [replace(new_table(24), motor=2, source=2)])


@pytest.mark.parametrize("block", BLOCKS, ids=["same block", "another"])
def test_f19_nobody_changes_the_card_amid_a_rollback(
    *, tmp_path: Path, block: LawBlock, exhaustive: bool, count_runs: Count
) -> None:
    """At any request of it: refused, or accepted before it began, and then it is refused."""
    rig = TwoHosts(tmp_path, block)
    total = rig.requests(rollback.rollback_last, rig.bench.context)
    refused = 0
    for at in thinned(list(range(total)), 30, exhaustive=exhaustive):
        bench = rig.restart()
        held: list[bool] = []

        def theirs(link: Link, context: Context, held: list[bool] = held) -> None:
            held.append(rig.bench.p(LawBlock().p(Index.CHANGE)) > 0)
            set_gain(link, context)

        told = at_request(bench, at, theirs, rig.theirs)
        error = attempt(rollback.rollback_last, bench.link, bench.context)
        bench.on_request = lambda _n: None
        if held[0]:
            assert error is None, at
            assert told[0] is not None, at
            assert told[0].code in HELD
            refused += 1
        elif error is not None:
            assert error.left is ControllerState.NEW
            assert not waiting.left_open(bench.context)
        assert (bench.values("COMP", 1) is None) is (error is None)
        rig.require_let_go()
        count_runs(1)
    assert refused > 20


@pytest.mark.parametrize("block", BLOCKS, ids=["same block", "another"])
def test_f19_a_rollback_amid_somebody_elses_change_is_refused(
    *, tmp_path: Path, block: LawBlock, exhaustive: bool, count_runs: Count
) -> None:
    """In the words that an upload has for it; both go on as if nothing had been."""
    rig = TwoHosts(tmp_path, block)
    total = rig.requests(gain_and_table, rig.theirs)
    codes, states = set(), (ControllerState.DISABLED, ControllerState.NEW)
    for at in thinned(list(range(total)), 30, exhaustive=exhaustive):
        bench = rig.restart()
        acting = list[bool]()

        def ours(link: Link, context: Context, acting: list[bool] = acting) -> None:
            acting.append(bool(rig.bench.i51))
            try:
                rollback.rollback_last(link, context)
            finally:
                acting.append(bool(rig.bench.i51))

        told = at_request(bench, at, ours, bench.context)
        attempt(gain_and_table, bench.link, rig.theirs)
        bench.on_request = lambda _n: None
        if told[0] is not None:
            codes.add(told[0].code)
            # Their upload switches the tables off, perhaps at this very request, and on again with
            # its own beside ours.
            assert told[0].left in {states[acts] for acts in acting}, at
            assert bench.values("COMP", 1) is not None
        assert not waiting.left_open(bench.context)
        rig.require_let_go()
        count_runs(1)
    assert codes & HELD
    assert codes <= {*HELD, "PC-REC-004", "PC-SAF-000"}  # the last: several of them


def test_f19_a_rollback_that_is_refused_keeps_nobody_out(tmp_path: Path, count_runs: Count) -> None:
    """Its motor moves: nothing was taken back, and another host may upload."""
    rig = TwoHosts(tmp_path, LawBlock())
    bench = rig.restart()
    bench.link.command("#1J+")
    bench.clock.sleep_s(0.2)
    with pytest.raises(SafetyRefusal) as refused:
        rollback.rollback_last(bench.link, bench.context)
    assert refused.value.left is ControllerState.NEW
    assert not waiting.left_open(bench.context)
    rig.require_let_go()
    bench.link.command("#1J/")
    bench.clock.sleep_s(0.5)
    change_settings(bench.link, rig.theirs, Settings({"I219": "0.7"}))
    count_runs(1)


def test_f19_a_rollback_that_was_cut_is_seen_elsewhere_until_it_is_recovered(
    *, tmp_path: Path, exhaustive: bool, count_runs: Count
) -> None:
    rig = TwoHosts(tmp_path, LawBlock())
    bench = rig.restart()
    sent: list[int] = []
    bench.on_request = lambda _n: sent.append(bench.tap.sent)
    rollback.rollback_last(bench.link, bench.context)
    torn = 0
    for n in thinned(sent, 12, exhaustive=exhaustive):
        bench = rig.restart()
        bench.tap.schedule([Fault(FaultKind.CUT, Way.SEND, n - sent[0])])
        with suppress(PmacCompError):
            rollback.rollback_last(bench.link, bench.context)
        bench.reconnect()
        bench.link.flush()
        if waiting.left_open(bench.context) and read_change(bench.link, bench.context) > 0:
            with pytest.raises(SafetyRefusal) as refused:
                law_upload.upload_law(bench.link, rig.theirs, THEIRS)
            assert refused.value.code in {*HELD, "PC-SAF-000"}
            torn += 1
        recovery.recover(bench.link, bench.context)
        rig.require_let_go()
        law_upload.upload_law(bench.link, rig.theirs, THEIRS)
        head = read_law_head(bench.link, rig.theirs.block)
        assert read_bank(bench.link, rig.theirs.block, head.bank) == THEIRS
        count_runs(1)
    assert torn
