"""Settings that stand only while something is measured: journalled when put on, taken off after.

The lock and the lease are given back once they stand, because uploads may lie between; the journal
stays open, and so does the claim that keeps bench files of other axes out. After a kill ``recover``
takes them off, and so does the next session that puts the same settings on. Never a part of an
upload: ``recover`` looks at them apart.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from pmac_comp.base.errors import ControllerState, ForeignChange
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.claim import read_claim, release_claim
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journal import Journal
from pmac_comp.machine.controller.change.journals import (
    ROLLED_BACK,
    ChangeKind,
    is_temporary,
    journals,
)
from pmac_comp.machine.controller.change.lease import host_lock
from pmac_comp.machine.controller.change.verdict import untouched
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.contents.settings import Settings, differences, read_settings
from pmac_comp.machine.controller.gather import gather
from pmac_comp.machine.controller.settings.settings_upload import (
    SettingsUpload,
    put_back,
    read_settings_backup,
    running_refusals,
)

_OF_GATHERING: Final = re.compile(r"I50\d\d")


@dataclass(frozen=True)
class Temporary:
    """Settings that were put on for a while, from their journal."""

    journal: Journal
    old: Settings
    new: Settings


def put_on(link: Link, context: Context, goal: Settings, *, motors: tuple[int, ...] = ()) -> None:
    """Bring settings onto the card for a while.

    Nothing is done where those of an earlier session still stand: its journal brings back what
    stood before both. The programs named are the measurement's own from now on, and so are the
    variables of gathering (I5000-I5099), whatever it writes there.

    Raises
    ------
    SafetyRefusal
        A motor moves, or another host holds the lease; nothing was changed.
    """
    with untouched():
        lasting = _lasting(goal)
        if standing(context) and not differences(lasting, read_settings(link, lasting)):
            return
    take_off(link, context)
    with SettingsUpload(
        link, context, goal, route="measurement", motors=motors, temporary=True
    ) as upload:
        upload.write()
        upload.leave_open()


def take_off(link: Link, context: Context, *, whatever_stands: bool = False) -> tuple[str, ...]:
    """Put back what stood before; what was done, in words.

    Parameters
    ----------
    link, context
        Conversation and folder.
    whatever_stands : bool
        Also where something else stands than what was put on, after an interruption.

    Raises
    ------
    ForeignChange
        Somebody else changed these settings meanwhile; they were left alone.
    MotorNotSafe
        A motion program runs; nothing was changed.
    """
    notes: list[str] = []
    for found in standing(context):
        with host_lock(context):
            # What follows would go into a buffer that an interruption left open.
            link.write_buffer(["CLOSE"])
            raise_all(running_refusals(link), "Taking the measurement's settings off")
            gather.stop(link)
            old, new = _lasting(found.old), _lasting(found.new)
            present = read_settings(link, new)
            changed = differences(old, present)
            if changed and differences(new, present) and not whatever_stands:
                raise _foreign(found)
            _put_back(link, found)
            found.journal.write(ROLLED_BACK)
        notes.append("axis definitions, units and motion program are as before the measurement")
    if notes:
        release_claim(link, context, read_claim(link))
    return tuple(notes)


def standing(context: Context) -> tuple[Temporary, ...]:
    """Temporary settings of this controller that were not taken off, newest first."""
    found: list[Temporary] = []
    for journal in reversed(journals(context)):
        if journal.kind != ChangeKind.SETTINGS.value or not journal.is_open:
            continue
        intent = journal.last("intent")
        if intent is not None and is_temporary(journal):
            old = read_settings_backup(context.store / Path(str(intent.data["backup"])).name)
            found.append(Temporary(journal, old, Settings.from_dict(intent.data["new"])))
    return tuple(found)


def _lasting(settings: Settings) -> Settings:
    """What stands unchanged meanwhile: programs and gathering are written by every run."""
    kept = {k: v for k, v in settings.variables.items() if not _OF_GATHERING.fullmatch(k)}
    return replace(settings, variables=kept, programs={})


def _put_back(link: Link, found: Temporary) -> None:
    for (kind, number), lines in found.old.programs.items():
        if not lines:
            # Emptied unread: a long motion takes a serial line half a minute to list.
            programs.delete(link, kind, number)
    if put_back(link, found.old) is not ControllerState.OLD:
        raise ForeignChange(
            "The axis definitions from before the measurement could not be written back.",
            code="PC-TMP-002",
            hint=f"They are in {found.journal.path.stem}.settings.json; see what refuses them.",
            left=ControllerState.DISABLED,
        )


def _foreign(found: Temporary) -> ForeignChange:
    return ForeignChange(
        "Somebody else changed axis definitions during the measurement; they were left alone.",
        code="PC-TMP-001",
        hint="What stood before is in "
        f"{found.journal.path.stem}.settings.json; `pmac-comp recover` writes it back.",
    )
