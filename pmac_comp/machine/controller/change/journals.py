"""The journals of a controller in a folder: which changes were made, and which wait.

Each change has a journal (``journal``); its number stands in the name and, while it is under way,
on the controller. Several changes that only make sense together are a group: ``recover`` takes a
torn group back whole.
"""

import os
import re
import secrets
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import Final

from pmac_comp.base.atomic import sync_folder
from pmac_comp.base.errors import ConfigError, ControllerState, SafetyRefusal
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journal import Journal
from pmac_comp.machine.controller.change.lease import host_lock

DONE: Final = "done"
ROLLED_BACK: Final = "rolled back"
KEPT: Final = "kept"  # closed without writing: somebody else has changed the controller since
TEMPORARY: Final = "temporary"  # mark of an intent that is always taken back
FIRST_P: Final = "first P-variable"  # in a beginning: of the block that the change is made with
DAMAGED: Final = "PC-JRN-003"
_READ_AGAIN: Final = 4  # so many settled journals are read by each change before a mark is moved


class ChangeKind(Enum):
    """What a journal is about, as its first entry says."""

    TABLES = "tables"
    LAW = "law"
    SETTINGS = "settings"
    SAVE = "save"
    GROUP = "group"


def open_group(context: Context, name: str) -> tuple[Journal, Context]:
    """Begin an upload of several parts; its journal, and the context for the parts.

    Raises
    ------
    SafetyRefusal
        An earlier change of this folder was interrupted and waits for ``recover``.
    """
    with host_lock(context):
        require_settled(context)
        number = new_transaction_id()
        journal = next_journal(context, journal_names(context), number)
        data = {"kind": ChangeKind.GROUP.value, "group": number, "name": name}
        journal.write("begin", {**data, FIRST_P: context.block.first})
    return journal, replace(context, group=number)


def new_transaction_id() -> int:
    """Random number below 2^31, never 0; wall clocks may jump, this does not repeat."""
    return secrets.randbelow((1 << 31) - 1) + 1


def journals(context: Context) -> list[Journal]:
    """Journals of this controller in this folder, oldest first."""
    return _journals(context, journal_names(context))


def _journals(context: Context, names: Sequence[str]) -> list[Journal]:
    return [Journal(context.store / name) for name in names]


def own_numbers(context: Context) -> set[int]:
    """Numbers of the changes that were begun from this folder."""
    return {number_in(name) for name in journal_names(context)}


def number_of(journal: Journal) -> int:
    """Number of a change that is no part of an upload."""
    return number_in(journal.path.name)


def number_in(name: str) -> int:
    """Number of a change in the name of its journal."""
    return int(name.rsplit("-", 1)[1].removesuffix(".journal"))


def is_torn(journal: Journal) -> bool:
    """Whether a change, or an upload of several, got far enough to need settling and was not."""
    if not journal.is_open:
        return False
    entries = journal.entries()
    begun = entries[0].data.get("kind") == ChangeKind.GROUP.value
    return begun or any(entry.step == "intent" for entry in entries)


def is_of_block(context: Context, journal: Journal) -> bool:
    """Whether a change was made with the block of this bench file, as far as its journal tells."""
    begin = journal.first()
    return begin is None or begin.data.get(FIRST_P, context.block.first) == context.block.first


def require_own_block(context: Context, changes: Sequence[Journal]) -> None:
    """Refuse to settle what was changed with another block: law and manifest would be sought here.

    Raises
    ------
    ConfigError
        One of the changes was made with the bench file of another axis.
    """
    other = next((j for j in changes if not is_of_block(context, j)), None)
    begin = None if other is None else other.first()
    if other is None or begin is None:
        return
    raise ConfigError(
        f"The change was made with a bench file whose p_block begins at P{begin.data[FIRST_P]}; "
        f"this one's begins at P{context.block.first}.",
        code="PC-TXN-012",
        hint="Name the bench file of that upload with --bench; each axis is best given a folder of "
        "its own with --journal.",
        context={"journal": str(other.path), "untouched": True},
        left=ControllerState.OLD,
    )


def require_settled(context: Context) -> None:
    """Refuse a change while an interrupted one of this folder waits; see ``torn_refusals``.

    Raises
    ------
    SafetyRefusal
        There is one.
    """
    for refusal in torn_refusals(context):
        raise refusal


def torn_refusals(context: Context, before: Sequence[str] | None = None) -> list[SafetyRefusal]:
    """Refusal of a change while an interrupted one of this folder waits for ``recover``.

    Its backup is what stood before: a change on top would be lost when that is written back.
    What a measurement borrowed stands open without being half-changed, and is taken off apart.
    What the interrupted one has left is not looked at here: the refusal does not say OLD of it.

    Parameters
    ----------
    context : Context
        Folder and name of the controller.
    before : sequence of str, optional
        Names of the journals, oldest first, if they have been listed already.
    """
    if context.settling:
        return []
    names = _not_known_settled(context, journal_names(context) if before is None else before)
    damaged = _damage_refusals(_journals(context, names))
    if damaged:
        return damaged
    torn = [j for j in _journals(context, names) if is_torn(j)]
    if not torn and len(names) > _READ_AGAIN:
        with suppress(OSError):  # it only saves time
            _mark(context).write_text(names[-1], encoding="ascii")
    torn = [j for j in torn if not is_temporary(j)]
    if not torn:
        return []
    begin = torn[-1].first()
    data = {} if begin is None else begin.data
    name = data.get("name") or data.get("route") or data.get("kind")
    return [
        SafetyRefusal(
            f"An earlier change of this controller ({name}) was interrupted and is still open.",
            code="PC-TXN-010",
            hint="Run `pmac-comp recover` first: it ends the earlier one as it was before or as "
            "it was meant. Then try again; nothing was changed now, and `pmac-comp status` says "
            "what stands.",
            context={"journal": str(torn[-1].path), "confirmed": False},
        )
    ]


def damage_refusals(context: Context) -> list[SafetyRefusal]:
    """Refusal of what would trust a journal that was damaged; it may tell of an open change."""
    return _damage_refusals(_journals(context, _not_known_settled(context, journal_names(context))))


def _damage_refusals(found: Sequence[Journal]) -> list[SafetyRefusal]:
    damaged = [journal for journal in found if journal.is_damaged]
    if not damaged:
        return []
    return [
        SafetyRefusal(
            f"The journal {damaged[-1].path} is damaged: which change it tells of, and whether "
            "that ended, cannot be read.",
            code=DAMAGED,
            hint="Nothing was changed now. Look at what stands (`pmac-comp status`, `backup`): "
            "`pmac-comp recover --keep` takes it as it is and closes the journal, `pmac-comp "
            "restore` writes an earlier backup back.",
            left=ControllerState.DISABLED,
            context={"journal": str(damaged[-1].path), "confirmed": False},
        )
    ]


def _mark(context: Context) -> Path:
    """File that names a journal: it and all before it were found settled.

    Else each change would read all journals that were ever written. Half written it names none, and
    a journal that goes on after it was closed takes it away.
    """
    return context.store / f"{context.controller}.settled"


def take_mark_away(context: Context) -> None:
    """Have the next change read all journals: one that was closed goes on."""
    mark = _mark(context)
    if mark.exists():
        mark.unlink()
        sync_folder(context.store)  # else it stands again after a power failure


def open_again(context: Context, journal: Journal, step: str) -> None:
    """Let a journal that was closed go on with a step; no change passes it over from then on."""
    with host_lock(context):  # nobody else moves the mark meanwhile
        take_mark_away(context)
        journal.write(step)


def _not_known_settled(context: Context, names: Sequence[str]) -> Sequence[str]:
    """The names behind the mark; all of them without one that stands among them."""
    try:
        name = _mark(context).read_bytes().decode("ascii", "replace")
    except OSError:
        return names
    return names[names.index(name) + 1 :] if name in names else names


def is_temporary(journal: Journal) -> bool:
    """Whether a change stands only while something is measured."""
    intent = journal.last("intent")
    return intent is not None and bool(intent.data.get(TEMPORARY))


def journal_names(context: Context) -> list[str]:
    """Names of the journals of this controller in its folder, oldest first."""
    # The count comes first in the name: a clock that jumps cannot change the order.
    name = re.compile(re.escape(context.controller) + r"-.{6}-.{10}\.journal")
    found = os.listdir(context.store) if context.store.is_dir() else ()  # noqa: PTH208 - fast
    return sorted(filter(name.fullmatch, found))


def next_journal(context: Context, before: Sequence[str], transaction: int) -> Journal:
    """The journal of a new change behind those of these names; nothing is written."""
    count = int(before[-1].rsplit("-", 2)[1]) + 1 if before else 1
    name = f"{context.controller}-{count:06d}-{transaction:010d}.journal"
    return Journal(context.store / name)
