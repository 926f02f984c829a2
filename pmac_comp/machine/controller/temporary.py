"""Settings that stand only while something is measured: journalled when put on, taken off after.

The lock and the lease are given back once they stand, because uploads may lie between; the journal
stays open. After a kill ``recover`` takes them off, and so does the next session that puts the
same settings on. Never a part of an upload: ``recover`` looks at them apart.
"""

from dataclasses import dataclass

from pmac_comp.base.errors import ControllerState, ForeignChange
from pmac_comp.machine.controller.context import Context
from pmac_comp.machine.controller.journal import Journal
from pmac_comp.machine.controller.lease import host_lock
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.safety import raise_all
from pmac_comp.machine.controller.settings import Settings, differences, read_settings
from pmac_comp.machine.controller.settings_upload import (
    SettingsUpload,
    put_back,
    read_settings_backup,
    running_refusals,
)
from pmac_comp.machine.controller.transaction import (
    ROLLED_BACK,
    ChangeKind,
    is_temporary,
    journals,
    untouched,
)


@dataclass(frozen=True)
class Temporary:
    """Settings that were put on for a while, from their journal."""

    journal: Journal
    old: Settings
    new: Settings


def put_on(link: Link, context: Context, goal: Settings, *, motors: tuple[int, ...] = ()) -> None:
    """Bring settings onto the card for a while; nothing is done where they stand already.

    Raises
    ------
    SafetyRefusal
        A motor moves, or another host holds the lease; nothing was changed.
    """
    with untouched():
        if not differences(goal, read_settings(link, goal)):
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
            raise_all(running_refusals(link), "Taking the measurement's settings off")
            present = read_settings(link, found.new)
            if differences(found.old, present):
                if differences(found.new, present) and not whatever_stands:
                    raise _foreign(found)
                _put_back(link, found)
            found.journal.write(ROLLED_BACK)
        notes.append("axis definitions and units are as before the measurement")
    return tuple(notes)


def standing(context: Context) -> tuple[Temporary, ...]:
    """Temporary settings of this controller that were not taken off, newest first."""
    found: list[Temporary] = []
    for journal in reversed(journals(context)):
        if journal.kind != ChangeKind.SETTINGS.value or not journal.is_open:
            continue
        intent = journal.last("intent")
        if intent is not None and is_temporary(journal):
            old = read_settings_backup(context.store / str(intent.data["backup"]))
            found.append(Temporary(journal, old, Settings.from_dict(intent.data["new"])))
    return tuple(found)


def _put_back(link: Link, found: Temporary) -> None:
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
