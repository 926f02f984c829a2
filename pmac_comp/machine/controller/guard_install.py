"""The guard PLC on the controller: half-written tables stay off whoever switches them on.

What lives here: whether PLC 1 and its M-variable are free or ours, and putting the guard there.
"""

from dataclasses import replace
from typing import Final

from pmac_comp.base.errors import CommandRefused, ControllerState
from pmac_comp.files.resources import firmware_path
from pmac_comp.machine.controller import programs
from pmac_comp.machine.controller.context import Context
from pmac_comp.machine.controller.law_bank import LawBlock
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.numbers import parse_integer
from pmac_comp.machine.controller.programs import Program, ProgramKind
from pmac_comp.machine.controller.settings import Settings, read_settings
from pmac_comp.machine.controller.settings_upload import change_settings
from pmac_comp.machine.controller.verdict import untouched

GUARD: Final = (ProgramKind.PLC, 1)
GUARD_DEFINITION: Final = 7007
CLOCK: Final = "D:$17"  # what M7007 is: the card's clock, in 1/1024 s

_LOCKED: Final = (
    "a password protects PLC 1 on the controller, so the guard was not installed: tables that "
    "another client enables during an upload are found at its next step only"
)


FOREIGN_GUARD: Final = (
    "PLC 1 holds another program, so the guard was not installed: tables that another client "
    "enables during an upload are found at its next step only"
)


def guard_program(context_block: LawBlock) -> Program:
    """Guard PLC 1 of ``firmware_plc`` for a block."""
    text = firmware_path("comp_guard.plc").read_text(encoding="utf-8")
    return programs.parse_source(programs.render(text, first_p=context_block.first)).program


def is_foreign(found: Settings, place: tuple[ProgramKind, int], ours: Program) -> bool:
    """Whether a program stands there that does not begin as ours of any version does."""
    stands = programs.canonical(found.programs[place])
    return bool(stands) and stands[0] != ours.tokens[0]


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
    if is_foreign(found, GUARD, guard):
        return FOREIGN_GUARD, Settings()
    defined = found.definitions[GUARD_DEFINITION].upper().replace(" ", "")
    if defined not in {"*", asked.definitions[GUARD_DEFINITION]}:
        return (
            f"{definition} is defined as {defined}, so the guard was not installed: it needs "
            f"{asked.definitions[GUARD_DEFINITION]} there"
        ), Settings()
    return "", replace(asked, programs={GUARD: guard.lines}, running=frozenset({1}))
