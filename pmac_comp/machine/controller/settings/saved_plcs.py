"""Background PLCs that a SAVE would keep, and that then run at every power-up.

What lives here: which of them are not of this tool, and saying so. What may not: SAVE itself
(``persist``).
"""

from typing import Final

from pmac_comp.base.errors import CommandRefused
from pmac_comp.files.resources import firmware_path
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.variables import read_one
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.contents.programs import Program
from pmac_comp.machine.controller.settings.guard_install import guard_program

_BACKGROUND: Final = range(1, 32)
_BACKGROUND_RUN: Final = 2  # bit of I5 (Software Reference Manual, I5)
_NO_PROGRAM: Final = 3  # ERR003
_HOMING_TIME: Final = 199  # of the block; what starts homing.plc
_STARTS_NOTHING: Final = 1.0  # the most that motion programs leave there


def homing_program(block: LawBlock, motor: int) -> Program:
    """Homing PLC of ``firmware_plc`` for a motor and a block; it starts on purpose only."""
    text = firmware_path("homing.plc").read_text(encoding="utf-8")
    return programs.parse_source(programs.render(text, motor=motor, first_p=block.first)).program


def power_up_remarks(link: Link, block: LawBlock, motor: int) -> tuple[str, ...]:
    """What SAVE makes run at power-up beside what is of this tool, for a person.

    Every PLC in memory is enabled at power-up, whether it is now or not, and what it commands then
    nobody has asked for (Software Reference Manual p. 39).
    """
    if not int(read_one(link, "I5")) & _BACKGROUND_RUN:
        return ()
    stand = _standing(link)
    if stand is None:
        return ("a password hides PLCs: which of them SAVE makes run at power-up is not known",)
    homing = homing_program(block, motor)
    ours = {p.number: p for p in (guard_program(block), homing)}
    others = [n for n in stand if n not in ours or not programs.is_present(link, ours[n])]
    told = []
    if others:
        names = ", ".join(f"PLC {n}" for n in others)
        told.append(
            f"SAVE keeps {names} as well: every PLC in memory runs at power-up, enabled now or "
            "not; what enables or moves a motor should be off the controller before"
        )
    start = f"P{block.p(_HOMING_TIME)}"
    if homing.number in {*stand} - {*others} and read_one(link, start) > _STARTS_NOTHING:
        told.append(
            f"SAVE keeps {start}, the start of the homing search (PLC {homing.number}): it would "
            f"run at power-up; set {start} = 0 before"
        )
    return tuple(told)


def _standing(link: Link) -> list[int] | None:
    """Background PLCs in memory; None where a password hides one of them (p. 384)."""
    try:
        return [n for n in _BACKGROUND if _stands(link, n)]
    except CommandRefused as error:
        if programs.explain_protection(error):
            return None
        raise


def _stands(link: Link, number: int) -> bool:
    """Whether a PLC stands in memory, by its first line: a whole one takes seconds to list."""
    try:
        return bool(programs.canonical(link.query(f"LIST PLC {number},0,1")))
    except CommandRefused as error:
        if error.context.get("error") == _NO_PROGRAM:
            return False
        raise
