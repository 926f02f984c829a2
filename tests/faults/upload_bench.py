"""Uploads on the simulated card with one thing going wrong, judged by the card's own memory."""

import math
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pmac_comp.base.errors import ControllerState, PmacCompError
from pmac_comp.machine.controller.contents.comp_table import CompTable
from pmac_comp.machine.controller.tables import upload
from pmac_comp.machine.controller.whole import recovery
from pmac_comp.machine.transport.tap import FaultKind, Way
from tests.faults.card_state import SavedState
from tests.faults.same_state import stretches
from tests.unit.machine_controller.card_bench import CardBench

SPAN_CT = 640000


def wave(n: int, *, amplitude_ct16: float, phase: float = 0.0) -> tuple[int, ...]:
    """Smooth closed table of n entries that is small near position zero."""
    values = [
        round(
            amplitude_ct16 * math.sin(2 * math.pi * 3 * k / n + phase) * math.sin(math.pi * k / n)
        )
        for k in range(1, n)
    ]
    return (*values, 0)


def old_table(n: int) -> CompTable:
    return CompTable(1, wave(n, amplitude_ct16=320.0), SPAN_CT, by_desired=True)


def new_table(n: int) -> CompTable:
    return CompTable(1, wave(n, amplitude_ct16=480.0, phase=0.4), SPAN_CT, by_desired=True)


@dataclass(frozen=True)
class Truth:
    """What the card really holds."""

    entries: tuple[int, ...] | None
    i51: int


class Left:
    """Card and folder of a bench as they stand now, to be put back before each run."""

    def __init__(self, bench: CardBench) -> None:
        self._bench = bench
        self._card = saved(bench)
        self._files = {path: path.read_bytes() for path in bench.folder.iterdir()}

    def put_back(self) -> None:
        put_back(self._bench, self._card)
        for path in self._bench.folder.iterdir():
            path.unlink()
        for path, text in self._files.items():
            path.write_bytes(text)


class SameIds:
    """Stands in for ``secrets``, so that every run of a change says the same.

    To be put in place of the module in ``transaction``.
    """

    def __init__(self) -> None:
        self.first = self.n = 1_000_000_000

    def from_here(self) -> None:
        """Runs begin with the numbers behind those that were given until now."""
        self.first = self.n

    def again(self) -> None:
        self.n = self.first

    def randbelow(self, _end: int) -> int:
        self.n += 1
        return self.n


class UploadBench:
    """One card that is put back to the same start before each run.

    Its start: motor 1 in closed loop at zero, an old table acting.
    """

    def __init__(self, folder: Path, *, n: int = 64, ids: SameIds | None = None) -> None:
        self.n = n
        self.ids = ids or SameIds()
        self.folder = folder
        self.old, self.new = old_table(n), new_table(n)
        self.bench = CardBench(folder)
        self.bench.link.command("#1J/")
        self.bench.clock.sleep_s(0.05)
        upload.upload_tables(self.bench.link, self.bench.context, [self.old])
        self.save()
        self.runs = 0

    def save(self) -> None:
        """What stands now is where runs start from."""
        self.saved = saved(self.bench)
        self.ids.from_here()

    def restart(self) -> CardBench:
        """The card as at the start, with a fresh conversation and an empty folder."""
        put_back(self.bench, self.saved)
        for path in self.folder.iterdir():
            path.unlink() if path.is_file() else shutil.rmtree(path)
        self.bench.tap.sent = self.bench.tap.received = 0
        self.ids.again()
        self.runs += 1
        return self.bench

    @property
    def truth(self) -> Truth:
        values = self.bench.values("COMP", 1)
        return Truth(None if values is None else tuple(values), self.bench.i51)

    @property
    def state(self) -> ControllerState:
        """Verdict by the truth; an acting table that is neither old nor new is a broken promise."""
        truth = self.truth
        if not truth.i51:
            return ControllerState.DISABLED
        if truth.entries == self.old.entries:
            return ControllerState.OLD
        assert truth.entries == self.new.entries, "a table acts that nobody meant"
        return ControllerState.NEW

    def places(self, way: Way, kind: FaultKind) -> list[range]:
        """Every byte of the upload, in stretches in which a fault leaves the same."""
        return stretches(self.restart, self.upload, way, kind=kind)

    def upload(self) -> None:
        upload.upload_tables(self.bench.link, self.bench.context, [self.new])

    def upload_with(self, prepare: Callable[[CardBench], None]) -> PmacCompError | None:
        """Upload from the start with a fault installed; the error it ended with."""
        bench = self.restart()
        prepare(bench)
        try:
            self.upload()
        except PmacCompError as error:
            return error
        return None

    def recover_once(self) -> None:
        """Recovery over the present conversation, whatever it meets."""
        recovery.recover(self.bench.link, self.bench.context)

    def recover(self, *, resume: bool = True) -> ControllerState:
        """Reconnect and recover; the verdict is held against the truth."""
        self.bench.reconnect()
        with suppress(PmacCompError):
            self.bench.link.flush()
        result = recovery.recover(self.bench.link, self.bench.context, resume=resume)
        assert self.state is result.verdict, (self.state, result)
        assert result.verdict in {ControllerState.OLD, ControllerState.NEW}
        return result.verdict


def saved(bench: CardBench) -> SavedState:
    """Card and time of a bench; conversations are no part of it."""
    bench.session.close()
    state = SavedState(bench.card, bench.clock)
    bench.connect()
    return state


def put_back(bench: CardBench, state: SavedState) -> None:
    """The card as it was saved, with a fresh conversation."""
    bench.session.close()
    state.put_back()
    bench.connect()
