"""Every kind of change on one simulated card, cut anywhere, judged by what the card then holds."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path

from pmac_comp.base.errors import ControllerState, PmacCompError
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.transaction import UploadResult
from pmac_comp.machine.controller.contents.law_bank import BANK_VALUES, BankIndex, Index, LawBlock
from pmac_comp.machine.controller.whole import recovery, waiting
from pmac_comp.machine.transport.tap import Fault, FaultKind, Way
from pmac_comp.simulator.card.card import Card
from tests.faults.same_state import stretches
from tests.faults.upload_bench import SameIds, put_back, saved
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

PROGRAM = 710
TIME_MOTOR = tuple(800 + k for k in (0, 1, 2, 3, 4, 8, 11, 15, 19, 20, 22, 24, 30, 31, 32))
WATCHED_I = (5, 8, 30, 42, 51, 105, 106, 107, 119, 122, 129, *TIME_MOTOR, 5113, 5190)
WATCHED_M = (7000, 7001, 7002, 7003, 7004, 7007)


@dataclass(frozen=True)
class Standing:
    """All that a change may touch, in a form that can be compared."""

    variables: tuple[float, ...]
    definitions: tuple[str, ...]
    programs: tuple[tuple[str, int, tuple[str, ...], bool], ...]
    axes: tuple[object, ...]
    law: tuple[float, ...]
    clamp_ct: float
    target: float
    tables: tuple[tuple[int, ...] | None, ...]


def standing(bench: CardBench) -> Standing:
    """What stands on the card, from its own memory and not through the wire."""
    card, block = bench.card, LawBlock()
    bank = int(bench.p(block.p(Index.BANK)))
    values = tuple(bench.p(block.bank(bank, k)) for k in range(BANK_VALUES))
    tables = [bench.values("COMP", motor) for motor in (1, 8)]
    return Standing(
        tuple(float(card.variables.read_i(n)) for n in WATCHED_I),
        tuple(card.variables.definition(n) for n in WATCHED_M),
        tuple(_buffers(card)),
        tuple((n, str(s.axes)) for n, s in card.systems.items() if s.axes),
        values if values[BankIndex.SEALED] else (),
        bench.p(block.p(Index.CLAMP)),
        bench.p(block.p(Index.TARGET)),
        tuple(None if values is None else tuple(values) for values in tables),
    )


def _buffers(card: Card) -> Iterator[tuple[str, int, tuple[str, ...], bool]]:
    """Kind, number, statements and whether it could run, of every buffer with statements."""
    for table in (card.programs.programs, card.programs.plcs):
        for number, program in sorted(table.items()):
            if program.statements:
                whole = program.assembled is not None
                runs = whole and (program.kind != "PLC" or card.plcs.enabled(number))
                yield program.kind, number, tuple(s.long for s in program.statements), runs


@dataclass(frozen=True)
class Scenario:
    """A change, and what has to stand before it."""

    name: str
    prepare: Callable[[Link, Context], None]
    change: Callable[[Link, Context], object]
    undoes: bool = False  # takes back what was prepared: its OLD is what stands after it


class ChangeBench:
    """A card that is put back before each run of a scenario."""

    def __init__(self, folder: Path, scenario: Scenario, ids: SameIds | None = None) -> None:
        folder.mkdir(exist_ok=True)
        self.folder = folder
        self.ids = ids or SameIds()
        self.scenario = scenario
        self.bench = make_plc_bench(folder)
        scenario.prepare(self.bench.link, self.bench.context)
        kept = list(folder.iterdir()) if scenario.undoes else []
        self.files = {path: path.read_bytes() for path in kept}
        self.saved = saved(self.bench)
        self.ids.from_here()
        self.before = standing(self.bench)
        assert self.run() is None
        self.after = standing(self.fresh())
        assert self.after != self.before, "the change changes nothing that is watched"

    def restart(self) -> CardBench:
        """The card as before the change, with an empty folder."""
        put_back(self.bench, self.saved)
        for path in self.folder.iterdir():
            path.unlink()
        for path, text in self.files.items():
            path.write_bytes(text)
        self.ids.again()
        return self.fresh()

    def fresh(self) -> CardBench:
        self.bench.reconnect()
        with suppress(PmacCompError):
            self.bench.link.flush()
        self.bench.tap.sent = self.bench.tap.received = 0
        return self.bench

    def run(self, faults: tuple[Fault, ...] = ()) -> PmacCompError | None:
        """The change from the start, with faults on the link; the error it ended with."""
        self.restart()
        self.bench.tap.schedule(list(faults))
        return self.attempt()

    def attempt(self) -> PmacCompError | None:
        """The change on the card as it is."""
        try:
            self.scenario.change(self.bench.link, self.bench.context)
        except PmacCompError as error:
            return error
        return None

    def recover(self, *, resume: bool) -> UploadResult:
        """Reconnect, recover, and hold the verdict against what stands there."""
        bench = self.fresh()
        if standing(bench) not in (self.before, self.after):
            assert waiting.left_open(bench.context), "half changed, and `status` does not say so"
        result = recovery.recover(bench.link, bench.context, resume=resume)
        assert waiting.left_open(bench.context) == ()
        self.judge(result.verdict)
        assert bench.p(LawBlock().p(Index.LEASE)) == 0
        return result

    def judge_done(self) -> None:
        """The change was carried out."""
        found = standing(self.bench)
        assert found == self.after, difference(found, self.after)

    def judge(self, verdict: ControllerState) -> None:
        found = standing(self.bench)
        as_before = (verdict is ControllerState.OLD) is not self.scenario.undoes
        meant = self.before if as_before else self.after
        assert found == meant, difference(found, meant)
        assert verdict in {ControllerState.OLD, ControllerState.NEW}

    def places(self, way: Way, kind: FaultKind) -> list[range]:
        """Every byte of the change, in stretches in which a fault leaves the same."""

        def change() -> None:
            self.scenario.change(self.bench.link, self.bench.context)

        return stretches(self.restart, change, way, kind=kind)

    def edges(self, way: Way) -> list[int]:
        """Byte numbers at which requests (or their answers) end."""
        found: list[int] = [0]
        self.restart()

        def note(_n: int) -> None:
            found.append(self.bench.tap.sent if way is Way.SEND else self.bench.tap.received)

        self.bench.on_request = note
        self.scenario.change(self.bench.link, self.bench.context)
        note(0)
        return sorted(set(found))


def points(ends: list[int]) -> list[int]:
    """The edge of every packet, and one byte inside the longest."""
    begin, end = max(pairwise(ends), key=lambda pair: pair[1] - pair[0])
    return sorted({*ends[:-1], (begin + end) // 2})


def cut(way: Way, n: int, *, lose: bool = False) -> tuple[Fault, ...]:
    return (Fault(FaultKind.SILENCE if lose else FaultKind.CUT, way, n),)


def difference(found: Standing, meant: Standing) -> str:
    """What differs, in words for the failure."""
    return "; ".join(
        f"{item.name}: {getattr(found, item.name)} instead of {getattr(meant, item.name)}"
        for item in fields(Standing)
        if getattr(found, item.name) != getattr(meant, item.name)
    )
