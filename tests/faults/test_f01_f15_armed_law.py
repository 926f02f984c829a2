"""F01, F15 for an armed law: what acts is the old law or the new one in every servo cycle."""

from collections.abc import Callable

import pytest

from pmac_comp.base.errors import ControllerState, PmacCompError
from pmac_comp.machine.controller.contents.law_bank import LawBlock, LawParameters
from pmac_comp.machine.controller.law import law_arming, law_install, law_state, law_upload
from pmac_comp.machine.transport.tap import Fault, FaultKind, Way
from tests.fault_table import all_of
from tests.faults.card_state import SavedState
from tests.faults.test_f15_f22_controller import LineFault
from tests.faults.upload_bench import put_back, saved
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
OLD = LawParameters(A0=1.5, JL=1.0, T0=100.0, T_LIMIT=500.0)
NEW = LawParameters(A0=2.5, JL=1.0, T0=150.0, T_LIMIT=500.0)


@pytest.fixture(scope="module")
def armed(tmp_path_factory: pytest.TempPathFactory) -> tuple[CardBench, SavedState]:
    bench = make_plc_bench(tmp_path_factory.mktemp("law"))
    law_install.install_law(bench.link, bench.context, 1)
    law_upload.upload_law(bench.link, bench.context, OLD)
    law_arming.arm(bench.link, bench.context)
    return bench, saved(bench)


def in_use(bench: CardBench) -> LawParameters | None:
    bench.reconnect()
    head = law_state.read_law_head(bench.link, LawBlock())
    assert head.gain == 1.0
    assert head.bank_in_use == head.bank
    return law_state.read_bank(bench.link, LawBlock(), head.bank)


def attempt(bench: CardBench, law: LawParameters) -> PmacCompError | None:
    try:
        law_upload.upload_law(bench.link, bench.context, law)
    except PmacCompError as error:
        return error
    return None


def test_f01_law_is_old_or_new_at_every_cut(
    *, armed: tuple[CardBench, SavedState], exhaustive: bool, count_runs: Count
) -> None:
    bench, start = armed
    put_back(bench, start)
    bench.tap.sent = 0
    assert attempt(bench, NEW) is None
    total = bench.tap.sent
    assert in_use(bench) == NEW
    points = all_of(range(total)) if exhaustive else range(0, total, 29)
    seen, confirmed = set(), 0
    for n in points:
        put_back(bench, start)
        bench.tap.sent = 0
        bench.tap.schedule([Fault(FaultKind.CUT, Way.SEND, n)])
        error = attempt(bench, NEW)
        assert error is not None
        torques = set()
        for _ in range(20):
            bench.card.run_cycles(1)
            torques.add(bench.card.variables.read_i(129))
        assert torques <= {100, 150}, n
        found = in_use(bench)
        assert found in {OLD, NEW}, n
        state = ControllerState.NEW if found == NEW else ControllerState.OLD
        if error.context.get("confirmed"):
            assert error.left is state
            confirmed += 1
        seen.add(state)
        bench.link.command("P7078=0")
    assert ControllerState.OLD in seen
    assert confirmed
    count_runs(len(points))


@pytest.mark.parametrize("kind", ["refuse", "drop", "double"])
def test_f15_f16_law_lines(
    *, armed: tuple[CardBench, SavedState], kind: str, count_runs: Count
) -> None:
    bench, start = armed
    runs = 0
    for k in range(38):
        put_back(bench, start)
        LineFault(bench, k, kind)
        error = attempt(bench, NEW)
        found = in_use(bench)
        assert found in {OLD, NEW}, (k, error)
        assert (error is None) <= (found == NEW), k
        runs += 1
    count_runs(runs)
