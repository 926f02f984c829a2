"""What uploads of a folder put on a card beside tables and banks, and what stood there before.

What lives here: settings that bring back what stood, of all that still stands as the uploads left
it. What may not: tables and laws (they go first), putting the settings on. What a person asked for
by itself (setup, restore, a program file) is no part of an upload and stays.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journals import DONE, ChangeKind, is_of_block, journals
from pmac_comp.machine.controller.contents.settings import (
    AxisDefinitions,
    Settings,
    differences,
    plain_axes,
    read_axes,
    read_settings,
    single_items,
    stands,
)
from pmac_comp.machine.controller.settings.settings_upload import read_settings_backup
from pmac_comp.machine.controller.whole.parts import Part, parts_of

REMOVAL: Final = "remove"
UPLOADS: Final = frozenset({"table", "law", "servo", "cam", "program", REMOVAL})


@dataclass(frozen=True)
class _Item:
    """One setting as it was before the first upload, and as the last one left it."""

    before: Settings
    left: Settings


def before_uploads(link: Link, context: Context) -> Settings:
    """What to write so that nothing of the uploads of this folder is left but tables and laws.

    Parameters
    ----------
    link, context
        Conversation, folder and block.

    Returns
    -------
    Settings
        Empty where nothing is known or nothing is left; what was switched on last comes first.
    """
    groups = _groups(context)
    changes: list[tuple[Settings, Settings]] = []
    items: dict[str, _Item] = {}
    for part in _of_uploads(context, groups):
        old, new = read_settings_backup(_backup(context, part)), part.new_settings
        changes.append((old, new))
        befores = dict(single_items(old))
        for name, left in single_items(new):
            known = items.get(name)
            if known is None and groups[part.journal.group] == REMOVAL:
                continue  # what it took off was an upload's of another folder
            # What somebody else has set between two uploads is what stood before the second.
            goes_on = known is not None and stands(known.left, befores[name])
            before = known.before if known is not None and goes_on else befores[name]
            items[name] = _Item(before, left)
    goal = Settings(axes=_axes_before(link, changes))
    for item in reversed(items.values()):
        found = read_settings(link, item.left)
        if stands(item.left, found) and differences(item.before, found):
            goal = merged(goal, item.before)
    return goal


def known_definitions(context: Context) -> frozenset[int]:
    """M-variables of which the uploads of this folder tell what stood before them."""
    groups = _groups(context)
    parts = [p for p in _of_uploads(context, groups) if groups[p.journal.group] != REMOVAL]
    return frozenset(n for part in parts for n in part.new_settings.definitions)


def merged(first: Settings, second: Settings) -> Settings:
    """Items of both, those of the second where both have one."""
    return Settings(
        {**first.variables, **second.variables},
        {**first.definitions, **second.definitions},
        {**first.programs, **second.programs},
        first.axes if second.axes is None else second.axes,
        first.running - second.stopped | second.running,
        first.stopped - second.running | second.stopped,
    )


def _groups(context: Context) -> dict[int, str]:
    """Numbers and routes of the uploads of this folder; a program file has another name."""
    begun = [(j, j.first()) for j in journals(context) if j.kind == ChangeKind.GROUP.value]
    names = {j.group: str(begin.data.get("name")) for j, begin in begun if begin is not None}
    return {number: name for number, name in names.items() if name in UPLOADS}


def _of_uploads(context: Context, groups: Mapping[int, str]) -> Iterator[Part]:
    """Settings that finished parts of uploads wrote, oldest first."""
    for part in parts_of(context):
        ours = part.journal.group in groups and is_of_block(context, part.journal)
        done = part.kind is ChangeKind.SETTINGS and part.closing == DONE
        if ours and done and _backup(context, part).is_file():
            yield part


def _backup(context: Context, part: Part) -> Path:
    return context.store / Path(str(part.intent.data["backup"])).name


def _axes_before(link: Link, changes: list[tuple[Settings, Settings]]) -> AxisDefinitions | None:
    """Axis definitions without those that uploads made, with those that they put aside."""
    pairs = [(a.axes, b.axes) for a, b in changes if a.axes is not None and b.axes is not None]
    if not pairs:
        return None
    made = {axis for old, new in pairs for axis in plain_axes(new) - plain_axes(old)}
    present = read_axes(link)
    kept = tuple(axis for axis in present if not plain_axes((axis,)) & made)
    if kept == present:
        return None
    free = {motor for _, motor, _ in pairs[0][0]} - {motor for _, motor, _ in kept}
    back = tuple(axis for axis in pairs[0][0] if axis[1] in free and axis not in kept)
    return (*kept, *back)
