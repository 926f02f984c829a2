"""What a measurement borrows: axes, units and a motion program, given back at the end.

A measurement leaves a controller as it found it: what stood there goes into a journalled backup,
and comes back when the session ends, however it ends, or with ``recover``.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from pmac_comp.files.bench import Bench
from pmac_comp.files.resources import DEFAULT_JOURNAL
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.variables import read_many, read_range
from pmac_comp.machine.controller.change.alike import known_in_folder
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journals import own_numbers
from pmac_comp.machine.controller.change.lease import LEASE_s, drop_lease, hold_lease, renew_lease
from pmac_comp.machine.controller.change.transaction import RENEW_SHARE
from pmac_comp.machine.controller.change.verdict import untouched
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.contents.programs import ProgramKind
from pmac_comp.machine.controller.contents.settings import (
    AxisDefinitions,
    Settings,
    plain_axes,
    read_axes,
)
from pmac_comp.machine.controller.settings import temporary
from pmac_comp.machine.controller.settings.settings_upload import texts
from pmac_comp.workflow.bench.scales import Scales
from pmac_comp.workflow.motion.pvt import PROGRAM_NUMBER

UNITS: Final = {"I5190": "1000", "I5113": "0", "I42": "0"}
"""Times of PVT programs in ms, velocities per second (Software Reference Manual, I5x13, I5x90)."""


_GATHERING: Final = (5000, 5051)  # I-variables that a gather plan writes


def default_store() -> Path:
    """Folder of the journal where none is named."""
    return DEFAULT_JOURNAL


@dataclass
class AxisSetup:
    """Axis X of coordinate system 1 for one motor, in counts.

    Parameters
    ----------
    store : Path
        Folder of the journal.
    """

    store: Path = field(default_factory=lambda: default_store())  # noqa: PLW0108 - when made
    _context: Context | None = None
    _held: Context | None = None
    _held_at_s: float = 0.0

    def hold_card(self, link: Link, bench: Bench, controller: str, address: str) -> None:
        """Hold the lease on the card from now on, until ``let_go``.

        Raises
        ------
        LeaseHeld, ForeignChange
            Somebody else changes or measures.
        """
        context = self._context_of(link, bench, controller, address)
        hold_lease(link, context, lambda number: number in own_numbers(context))
        self._held, self._held_at_s = context, link.clock.now_s()

    def hold_on(self, link: Link) -> None:
        """Take the lease anew before a run, if it is held: changes of ours in between gave it back.

        Raises
        ------
        LeaseHeld, ForeignChange
            Somebody else was quicker.
        """
        if (context := self._held) is not None:
            hold_lease(link, context, lambda number: number in own_numbers(context))
            self._held_at_s = link.clock.now_s()

    def keep_on(self, link: Link) -> None:
        """Move the end of the lease in time, if it is held; ForeignChange if it is not ours now."""
        now_s = link.clock.now_s()
        if self._held is not None and now_s - self._held_at_s > RENEW_SHARE * LEASE_s:
            renew_lease(link, self._held)
            self._held_at_s = now_s

    def let_go(self, link: Link) -> None:
        """Give the lease back, if it is held."""
        context, self._held = self._held, None
        if context is not None:
            drop_lease(link, context)

    def put_on(self, link: Link, bench: Bench, controller: str, address: str) -> None:
        """Make the motor axis X in counts, with PVT times in ms and velocities per second.

        Raises
        ------
        SafetyRefusal
            Definitions would have to be put aside while a motor moves.
        """
        motor = bench.encoder.motor_number
        with untouched():
            if self._context is not None and _stands(link, motor):
                return
            goal = borrowed(link, motor)
        self._context = self._context_of(link, bench, controller, address)
        temporary.put_on(link, self._context, goal, motors=(motor,))

    def take_off(self, link: Link) -> tuple[str, ...]:
        """Bring back what was put aside, if anything was; what was done, in words."""
        context, self._context = self._context, None
        return () if context is None else temporary.take_off(link, context)

    def _context_of(self, link: Link, bench: Bench, controller: str, address: str) -> Context:
        scales = Scales.of(bench)
        self.store.mkdir(parents=True, exist_ok=True)
        context = Context(
            block=LawBlock.from_p_block(bench.controller.p_block),
            limits=scales.limits(bench),
            store=self.store,
            servo_period_s=scales.period_s,
            controller=controller or "controller",
        )
        return known_in_folder(link, context, address)


def borrowed(link: Link, motor: int) -> Settings:
    """What a measurement of a motor needs; program and gathering are written by each run."""
    first, last = _GATHERING
    gathering = {
        f"I{n}": value for n, value in enumerate(read_range(link, "I", first, last), start=first)
    }
    return Settings(
        {**UNITS, **texts(gathering)},
        programs={(ProgramKind.PROG, PROGRAM_NUMBER): ()},
        axes=axis_goal(read_axes(link), {motor: "X"}),
    )


def axis_goal(present: AxisDefinitions, ours: dict[int, str]) -> AxisDefinitions:
    """Ours alone in coordinate system 1; definitions of other motors and systems stay."""
    kept = tuple(a for a in present if a[0] != 1 and a[1] not in ours)
    return (*((1, motor, letter) for motor, letter in ours.items()), *kept)


def _stands(link: Link, motor: int) -> bool:
    return plain_axes(read_axes(link, systems=(1,))) == {(1, motor, "X")} and _units_stand(link)


def _units_stand(link: Link) -> bool:
    found = read_many(link, list(UNITS))
    return all(found[name] == float(value) for name, value in UNITS.items())
