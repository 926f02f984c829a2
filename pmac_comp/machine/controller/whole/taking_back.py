"""The parts of an upload taken back together, the last one first, whatever lies between.

What lives here: which parts that concerns, in which order, and what a reset meanwhile changes. How
one part is taken back is in ``parts``; who may do it, and when, in ``waiting``.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from pmac_comp.base.errors import ControllerState, ForeignChange, SafetyRefusal
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.context import Context, never
from pmac_comp.machine.controller.change.journal import Journal
from pmac_comp.machine.controller.change.journals import DONE, ROLLED_BACK, open_again
from pmac_comp.machine.controller.law.law_aside import set_going_again
from pmac_comp.machine.controller.whole.parts import (
    Part,
    is_back,
    is_switched_off,
    missing,
    parts_in,
    refuse_foreign,
    replaced_since,
    take_back,
)

RESET: Final = "reset"  # in the end of an upload amid which the controller was reset
RESET_NOTE: Final = (
    "the controller was reset meanwhile: what stood beside the upload and had not been saved (a "
    "law, the motor of a cam) is gone; compare with `pmac-comp doctor --backup`, restore a backup "
    "or upload again"
)
_TAKING_BACK: Final = "taking back"  # of an upload that stood whole
_MOST_LOOKS: Final = 4  # at what was taken back; more than one only where the card was reset


def take_group_back(
    link: Link, context: Context, group: Journal, *, was_reset: bool = False
) -> Sequence[str]:
    """Take back every part, the last one first; may be repeated after an interruption.

    Parameters
    ----------
    link, context
        Conversation and folder.
    group : Journal
        The upload.
    was_reset : bool
        Whether the controller was reset amid it: the parts come back, but not what stood beside
        them and had never been saved.
    """
    alone = replace(context, group=0, stop_requested=never, settling=True)
    notes: list[str] = []
    was_done = not group.is_open
    if was_done:
        # From here on less than all of it may stand: `recover` has to know.
        open_again(context, group, _TAKING_BACK)
    set_going_again(link, alone, group)
    parts = parts_in(context, group.group)[::-1]
    for part in parts:
        if part.closing == ROLLED_BACK and (was_done or is_back(link, alone, part)):
            continue  # a reset in between may have brought it, or taken what stood before
        if part.closing == ROLLED_BACK:
            refuse_foreign(link, alone, part)  # who has begun anew since the reset
        if part.items & replaced_since(context, part):
            notes.append(f"{part.kind.value}: a later upload took its place; it stands")
        else:
            try:
                notes.append(take_back(link, alone, part, was_reset=was_reset))
            except SafetyRefusal as error:
                if was_done and not notes and error.left in {None, ControllerState.OLD}:
                    group.write(DONE)  # nothing was taken back yet
                raise
        part.journal.write(ROLLED_BACK)
    own = [p for p in parts if not p.items & replaced_since(context, p)]
    notes += _what_came_back(link, alone, own)
    if any(is_switched_off(link, alone, part) for part in own):
        raise ForeignChange(
            "The old tables are back, and somebody has switched them off meanwhile.",
            code="PC-REC-012",
            hint="Find out who writes to this controller, then run `pmac-comp recover`: it "
            "switches them on again.",
            left=ControllerState.DISABLED,
            context={"confirmed": True},
        )
    if was_reset:
        notes.append(RESET_NOTE)
    group.write(ROLLED_BACK, {RESET: True} if was_reset else {})
    return tuple(dict.fromkeys(notes))  # several parts may be of one kind


def _what_came_back(link: Link, context: Context, own: Sequence[Part]) -> Sequence[str]:
    """Take back again what a reset meanwhile has brought back, if the upload had been saved."""
    notes: list[str] = []
    watched = list(own)
    for _ in range(_MOST_LOOKS):
        again = [p for p in watched if not missing(link, context, p)]
        for part in again:
            notes.append(take_back(link, context, part))
            part.journal.write(ROLLED_BACK)
            if not missing(link, context, part):
                watched.remove(part)  # it stands as it stood before the upload
        if not again:
            break
    return notes
