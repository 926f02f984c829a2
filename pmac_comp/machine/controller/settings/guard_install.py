"""The guard PLC on the controller: half-written tables stay off whoever switches them on.

What lives here: whether PLC 1 and its M-variable are free or ours, and putting the guard there.
"""

import re
from dataclasses import replace
from typing import Final

from pmac_comp.base.errors import CommandRefused, ControllerState
from pmac_comp.files.resources import firmware_path
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.verdict import untouched
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.contents.programs import Program, ProgramKind
from pmac_comp.machine.controller.contents.settings import Settings, read_settings
from pmac_comp.machine.controller.settings.settings_upload import change_settings

GUARD: Final = (ProgramKind.PLC, 1)
GUARD_DEFINITION: Final = 7007
CLOCK: Final = "D:$17"  # what M7007 is: the card's clock, in 1/1024 s

_LOCKED: Final = (
    "a password protects PLC 1 on the controller, so the guard was not installed: tables that "
    "another client enables during an upload are found at its next step only"
)


_P_VARIABLE: Final = re.compile(r"\bP(\d+)")
_TELLING: Final = 2  # statements of a program that tell whether it is ours
_NOT_GUARDED: Final = (
    "so the guard was not installed: tables that another client enables during an upload are found "
    "at its next step only"
)


def guard_program(context_block: LawBlock) -> Program:
    """Guard PLC 1 of ``firmware_plc`` for a block."""
    text = firmware_path("comp_guard.plc").read_text(encoding="utf-8")
    return programs.parse_source(programs.render(text, first_p=context_block.first)).program


def is_foreign(found: Settings, place: tuple[ProgramKind, int], ours: Program) -> bool:
    """Whether a program stands there that does not begin as ours of any version does."""
    stands = programs.canonical(found.programs[place])
    return bool(stands) and stands[0] != ours.tokens[0]


def block_elsewhere(
    found: Settings, place: tuple[ProgramKind, int], ours: Program, block: LawBlock
) -> int | None:
    """First P-variable of another block for which a program of ours stands there, if one does.

    It begins as ours for ``block`` does, of any version, with all P-variables moved alike.
    """
    stands = programs.canonical(found.programs[place])[:_TELLING]
    told, own = (_P_VARIABLE.search("\n".join(lines)) for lines in (stands, ours.tokens))
    if told is None or own is None:
        return None
    move = int(told[1]) - int(own[1])
    moved = tuple(
        _P_VARIABLE.sub(lambda m: f"P{int(m[1]) + move}", line) for line in ours.tokens[:_TELLING]
    )
    return block.first + move if move and stands == moved else None


def foreign_guard(found: Settings, block: LawBlock) -> str:
    """Why the guard does not go onto a card where PLC 1 stands as ``found``; empty if it may."""
    guard = guard_program(block)
    if not is_foreign(found, GUARD, guard):
        return ""
    other = block_elsewhere(found, GUARD, guard, block)
    whose = "another program" if other is None else f"the guard of the p_block from P{other}"
    return f"PLC 1 holds {whose}, {_NOT_GUARDED}"


def install_guard(link: Link, context: Context) -> tuple[str, ...]:
    """Put the guard PLC beside tables, so that the card itself keeps half-written ones off.

    A PLC 1 of somebody else stays; without the guard tables that another client enables during an
    upload act until the upload's next step finds them.

    Returns
    -------
    tuple of str
        What was done, or why not, for a person.

    Raises
    ------
    VerifyMismatch
        It does not list back as sent; what stood before was put back.
    """
    with untouched():
        refusal, goal = guard_settings(link, context)
    if refusal or goal.is_empty:
        return (refusal,) if refusal else ()
    try:
        change_settings(link, context, goal, route="guard")
    except CommandRefused as error:
        if programs.explain_protection(error) and error.left is ControllerState.OLD:
            return (_LOCKED,)
        raise
    i5 = parse_integer(link.query("I5")[0])
    held = "" if i5 & 2 else f", but I5 = {i5} holds background PLCs: it does not run"
    return (f"the guard (PLC 1) was written and listed back{held}",)


def guard_settings(link: Link, context: Context) -> tuple[str, Settings]:
    """Why the guard does not go onto the card, and what is missing of it; nothing is changed."""
    guard, definition = guard_program(context.block), f"M{GUARD_DEFINITION}"
    asked = Settings({}, {GUARD_DEFINITION: CLOCK}, {GUARD: ()})
    try:
        found = read_settings(link, asked)
    except CommandRefused as error:
        if programs.explain_protection(error):
            return _LOCKED, Settings()
        raise
    stands = programs.canonical(found.programs[GUARD])
    if stands == guard.tokens and 1 in found.running:
        return "", Settings()
    if foreign := foreign_guard(found, context.block):
        return foreign, Settings()
    defined = found.definitions[GUARD_DEFINITION].upper().replace(" ", "")
    if defined not in {"*", asked.definitions[GUARD_DEFINITION]}:
        return (
            f"{definition} is defined as {defined}, so the guard was not installed: it needs "
            f"{asked.definitions[GUARD_DEFINITION]} there"
        ), Settings()
    return "", replace(asked, programs={GUARD: guard.lines}, running=frozenset({1}))
