"""Every kind of change on one simulated card, cut anywhere, judged by what the card then holds."""

import copy
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from pmac_comp.base.errors import ControllerState, PmacCompError
from pmac_comp.machine.controller import law_state, recovery, settings
from pmac_comp.machine.controller.context import Context
from pmac_comp.machine.controller.law_bank import Index, LawBlock
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.programs import ProgramKind
from pmac_comp.machine.controller.settings import Settings
from pmac_comp.machine.controller.transaction import UploadResult
from pmac_comp.machine.transport.tap import Fault, FaultKind, Way
from pmac_comp.simulator.card import Card
from tests.faults.upload_bench import restore, snapshot
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

PROGRAM = 710
WATCHED = Settings(
    variables=dict.fromkeys(("I105", "I106", "I107", "I119", "I122", "I51", "I30"), "0"),
    definitions=dict.fromkeys((7000, 7001, 7002, 7003, 7004, 7007), ""),
    programs={
        (ProgramKind.PLC, 0): (),
        (ProgramKind.PLC, 1): (),
        (ProgramKind.PLC, 5): (),
        (ProgramKind.PROG, PROGRAM): (),
    },
    axes=(),
)


@dataclass(frozen=True)
class Standing:
    """All that a change may touch, in a form that can be compared."""

    settings: Settings
    law: int
    clamp_ct: float
    target: float
    tables: tuple[int, ...] | None


def standing(bench: CardBench) -> Standing:
    """What stands on the card, asked over a fresh conversation."""
    link = bench.link
    head = law_state.read_law_head(link, LawBlock())
    law = law_state.read_bank(link, LawBlock(), head.bank)
    values = bench.values("COMP", 1)
    return Standing(
        settings.read_settings(link, WATCHED),
        0 if law is None else law.digest,
        head.clamp_ct,
        head.target,
        None if values is None else tuple(values),
    )


@dataclass(frozen=True)
class Scenario:
    """A change, and what has to stand before it."""

    name: str
    prepare: Callable[[Link, Context], None]
    change: Callable[[Link, Context], object]


class ChangeBench:
    """A card that is put back before each run of a scenario."""

    def __init__(self, folder: Path, scenario: Scenario) -> None:
        self.folder = folder
        self.scenario = scenario
        self.bench = make_plc_bench(folder)
        scenario.prepare(self.bench.link, self.bench.context)
        self.saved, self.programs = snapshot(self.bench.card), stored(self.bench.card)
        self.before = standing(self.bench)
        assert self.run() is None
        self.after = standing(self.fresh())
        assert self.after != self.before, "the change changes nothing that is watched"

    def restart(self) -> None:
        """The card as before the change, with an empty folder."""
        restore(self.bench.card, self.saved)
        put_programs(self.bench.card, self.programs)
        for path in self.folder.iterdir():
            path.unlink()
        self.fresh()

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
        result = recovery.recover(bench.link, bench.context, resume=resume)
        self.judge(result.verdict)
        assert bench.p(LawBlock().p(Index.LEASE)) == 0
        return result

    def judge(self, verdict: ControllerState) -> None:
        found = standing(self.bench)
        meant = self.before if verdict is ControllerState.OLD else self.after
        assert found == meant, difference(found, meant)
        assert verdict in {ControllerState.OLD, ControllerState.NEW}

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


def points(ends: list[int], *, exhaustive: bool) -> Iterator[int]:
    """Every byte, or three of every packet."""
    if exhaustive:
        yield from range(ends[-1])
        return
    for begin, end in pairwise(ends):
        yield from sorted({begin, (begin + end) // 2, max(begin, end - 1)})


def cut(way: Way, n: int, *, lose: bool = False) -> tuple[Fault, ...]:
    return (Fault(FaultKind.SILENCE if lose else FaultKind.CUT, way, n),)


def difference(found: Standing, meant: Standing) -> str:
    """What differs, in words for the failure."""
    out = settings.differences(meant.settings, found.settings)
    out += [
        f"{name}: {getattr(found, name)} instead of {getattr(meant, name)}"
        for name in ("law", "clamp_ct", "target", "tables")
        if getattr(found, name) != getattr(meant, name)
    ]
    if found.settings.running != meant.settings.running:
        out.append(f"PLCs {set(found.settings.running)} run, not {set(meant.settings.running)}")
    return "; ".join(out) or "the spelling differs"


Buffers = tuple[dict[int, object], dict[int, object], dict[int, dict[int, object]]]


def stored(card: Card) -> Buffers:
    """Copies of all program buffers and axis definitions."""
    store = card.programs
    return (
        {n: _twin(p) for n, p in store.programs.items()},
        {n: _twin(p) for n, p in store.plcs.items()},
        {n: dict(system.axes) for n, system in card.systems.items()},
    )


def put_programs(card: Card, saved: Buffers) -> None:
    store = card.programs
    motion, plcs, axes = saved
    for n, system in card.systems.items():
        system.axes = dict(axes[n])  # type: ignore[assignment]
    store.programs = {n: _twin(p) for n, p in motion.items()}  # type: ignore[misc]
    store.plcs = {n: _twin(p) for n, p in plcs.items()}  # type: ignore[misc]
    store.open_program = store.open_owner = None
    for number in range(32):
        card.plcs.reload(number)


def _twin(program: object) -> object:
    twin = copy.copy(program)
    twin.statements = list(program.statements)  # type: ignore[attr-defined]
    return twin
