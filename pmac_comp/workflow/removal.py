"""Compensation of an axis taken off a controller, whoever put it on: no journal of it is needed.

What lives here: what of this tool stands on the card for an axis, and taking all of it off as one
upload that ``rollback`` brings back. What may not: the transactions (``machine.controller``).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pmac_comp.machine.controller import law_arming, law_install, law_state, temporary
from pmac_comp.machine.controller.context import Context
from pmac_comp.machine.controller.law_state import LawForm
from pmac_comp.machine.controller.recovery import grouped, waiting_refusals
from pmac_comp.machine.controller.safety import raise_all
from pmac_comp.machine.controller.table_set import Key, read_tables
from pmac_comp.machine.controller.transaction import UploadResult, untouched
from pmac_comp.machine.controller.upload import remove_tables
from pmac_comp.workflow.at_work import at_work
from pmac_comp.workflow.axis import Axis
from pmac_comp.workflow.cam import rest_time_motor
from pmac_comp.workflow.deploy import Progress, context_of, stand_at_zero
from pmac_comp.workflow.session import open_axis
from pmac_comp.workflow.upload_flow import rollback_command


@dataclass(frozen=True)
class Standing:
    """What compensates an axis now: tables by kind and motor, and the form of the law."""

    tables: tuple[Key, ...]
    law: LawForm

    @property
    def is_empty(self) -> bool:
        """Whether nothing stands."""
        return not self.tables and self.law is LawForm.NONE

    def lines(self) -> list[str]:
        """For people."""
        said = [f"table {kind.value} of motor #{motor}" for kind, motor in self.tables]
        if self.law is LawForm.PLC:
            said.append("the law in PLC 0, with following and torque offset of its motor")
        if self.law is LawForm.SERVO:
            said.append("the law in the open servo: faded out; the servo itself stays (Ixx59)")
        return said or ["nothing of a compensation stands for this axis"]


def standing_on(axis: Axis) -> Standing:
    """Tables of the bench's motors and the law of its motor; nothing is changed."""
    ours = {axis.motor, axis.bench.controller.cam_motor_number}
    tables = tuple((t.kind, t.motor) for t in read_tables(axis.link) if t.motor in ours)
    return Standing(tables, _form_of_law(axis))


def _form_of_law(axis: Axis) -> LawForm:
    """Form of the law for the axis' motor; a PLC 0 that was stopped has left its outputs standing.

    What is left of one, too: a motor that follows the master word.
    """
    link, context = axis.link, context_of(axis)
    head = law_state.read_law_head(link, context.block)
    if head.motor != axis.motor:
        return LawForm.NONE
    if law_install.law_stands(link, context) or law_install.follows(link, axis.motor):
        return LawForm.PLC
    return law_state.running_form(link, head)


def plan_removal(url: str, bench: str) -> dict[str, Any]:
    """What ``remove_compensation`` would take off."""
    with open_axis(url, bench) as axis:
        found = standing_on(axis)
    return {"would_remove": [] if found.is_empty else found.lines()}


def remove_compensation(
    url: str, bench: str, journal: Path, *, progress: Progress | None = None
) -> dict[str, Any]:
    """Take tables and law of an axis off, verified; ``rollback`` brings them back."""
    with open_axis(url, bench) as axis:
        context = context_of(axis, journal, progress)
        with at_work(axis, url):
            temporary.take_off(axis.link, context)
            found = standing_on(axis)
            results = remove_from(axis, context, found) if not found.is_empty else ()
    return {
        "removed": [] if found.is_empty else found.lines(),
        "parts": [result.as_dict() for result in results],
        "next": f"Bring it back: {rollback_command(url, bench, journal)}",
    }


def remove_from(axis: Axis, context: Context, found: Standing) -> tuple[UploadResult, ...]:
    """The same on a connected axis, as one upload: at zero, where tables correct nothing."""
    with untouched():  # before the axis moves for it
        raise_all(waiting_refusals(axis.link, context), "The removal")
    rest_time_motor(axis)
    stand_at_zero(axis)
    results: list[UploadResult] = []
    with grouped(axis.link, context, "remove") as inner:
        if found.law is LawForm.PLC:
            results.append(law_install.remove_law(axis.link, inner))
        if found.law is LawForm.SERVO:
            law_arming.disarm(axis.link, inner)
        if found.tables:
            results.append(remove_tables(axis.link, inner, found.tables))
    return tuple(results)
