"""F20: the card is reset after any packet of any kind of change; what was saved comes back."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import ControllerState, PmacCompError
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.controller.whole import persist, recovery
from pmac_comp.simulator.card.card import Card
from tests.faults.change_bench import (
    WATCHED_I,
    Scenario,
    Standing,
    difference,
    standing,
)
from tests.faults.test_f01_f29_every_kind import SCENARIOS, thinned
from tests.unit.machine_controller.card_bench import CardBench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]


class ResetBench:
    """A card with a flash that holds what stood before the change."""

    def __init__(self, folder: Path, scenario: Scenario) -> None:
        self.scenario = scenario
        self.store = folder / "store"
        self.store.mkdir()
        self.card = Card(load_bench("paper"), flash=folder / "flash.bin")
        bench = self.awake()
        scenario.prepare(bench.link, bench.context)
        bench.link.command("#1K")
        bench.clock.sleep_s(0.5)
        bench.link.command("SAVE", timeout_s=persist.SAVE_TIMEOUT_s)
        kept = self.store.iterdir() if scenario.undoes else ()
        self.files = {path: path.read_bytes() for path in kept}
        bench.session.close()
        self.before = standing(self.fresh())

    def awake(self) -> CardBench:
        """A conversation with the motor in closed loop."""
        bench = CardBench(self.store, card=self.card)
        bench.link.command("#1J/")
        bench.clock.sleep_s(0.1)
        return bench

    def fresh(self) -> CardBench:
        """The card as it comes up, the folder empty."""
        for path in self.store.iterdir():
            path.unlink()
        for path, text in self.files.items():
            path.write_bytes(text)
        self.card.reset()
        return self.awake()

    def run(self, act: Callable[[int], None]) -> CardBench:
        """The change from the start; ``act`` is called with every request."""
        bench = self.fresh()
        bench.on_request = act
        with suppress(PmacCompError):
            self.scenario.change(bench.link, bench.context)
        bench.on_request = lambda _n: None
        return bench


def differing(found: Standing, meant: Standing) -> list[str]:
    """Items that differ; the torque that an armed law writes each cycle (I129) does not count."""
    live = WATCHED_I.index(129)
    same = meant.variables[live : live + 1]
    calm = found.variables[:live] + same + found.variables[live + 1 :]
    found = replace(found, variables=calm)
    return [f.name for f in fields(found) if getattr(found, f.name) != getattr(meant, f.name)]


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_f20_reset_after_any_packet_of_any_change(
    *, scenario: Scenario, tmp_path: Path, exhaustive: bool, count_runs: Count
) -> None:
    rig = ResetBench(tmp_path, scenario)
    asked: list[int] = []
    after = standing(rig.run(asked.append))
    assert after != rig.before
    for k in thinned(asked, 6, exhaustive=exhaustive):
        judge_reset(rig, after, k)
        count_runs(1)


def test_f20_a_reset_between_the_parts_of_a_rollback_brings_nothing_back(
    tmp_path: Path, count_runs: Count
) -> None:
    """What SAVE kept of the upload comes up again, parts that were taken back before included."""
    (scenario,) = (s for s in SCENARIOS if s.undoes)
    rig = ResetBench(tmp_path, scenario)
    asked: list[int] = []
    after = standing(rig.run(asked.append))
    for k in asked[len(asked) // 2 :: 4]:
        judge_reset(rig, after, k)
        count_runs(1)


def judge_reset(rig: ResetBench, after: Standing, k: int) -> None:
    """Reset at the k-th request of the change; what ``recover`` says is what stands."""
    bench = rig.run(lambda n: rig.card.reset() if n == k else None)
    bench.session.close()
    bench = rig.awake()
    result = recovery.recover(bench.link, bench.context)
    found = standing(bench)
    as_meant = (result.verdict is ControllerState.NEW) is not rig.scenario.undoes
    meant = after if as_meant else rig.before
    wrong = differing(found, meant)
    if result.verdict is ControllerState.DISABLED:
        # Reset after the last look: what was there before stands, which had no tables.
        assert "reset without SAVE" in str(result.notes), (k, result)
        assert not wrong, (k, difference(found, meant))
    assert not wrong, (k, result, difference(found, meant))
    bench.session.close()
