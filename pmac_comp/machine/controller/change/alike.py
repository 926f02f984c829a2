"""Which card it is: two of a kind answer alike about themselves.

A card without an ID module says model, firmware and memory, and so does the one of the machine
beside it. In a folder that both use, what was done to one must not be written back to the other:
the files of a card have its address in their names. Where one card is reached in two ways, the
number of its last change tells: it is random, and no other card has it.
"""

import os
import re
from dataclasses import replace
from typing import Final

from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journals import is_temporary, is_torn, journals
from pmac_comp.machine.controller.change.lease import NO_FILE_NAME, read_change

_LONGEST: Final = 64  # of an address in a file name


def known_in_folder(link: Link, context: Context, address: str) -> Context:
    """The context under the name by which its folder knows a card.

    Parameters
    ----------
    link : Link
        Conversation; asked only where the folder knows a card that answers alike.
    context : Context
        Its ``controller`` is what the card answers about itself.
    address : str
        Where it is; empty for one that nothing else answers like.
    """
    if not address:
        return context
    kind = context.controller
    own = f"{kind}-{NO_FILE_NAME.sub('_', address)[-_LONGEST:]}"
    name = own
    if _names(context, kind) - {own}:
        number = abs(read_change(link, context))
        name = next(iter(_names(context, kind, f"{number:010d}")), own)
    return replace(context, controller=name, alike=kind)


def left_open_alike(context: Context) -> str:
    """Cards that answer alike and have a change left open in the folder, in words; else empty."""
    others = _names(context, context.alike) - {context.controller} if context.alike else set()
    waits = [name for name in sorted(others) if _waits(replace(context, controller=name))]
    if not waits:
        return ""
    places = ", ".join(name.removeprefix(f"{context.alike}-") for name in waits)
    return (
        f"this folder holds a change left open of a card that answers alike, reached as {places}: "
        "if this is that card, reach it so"
    )


def _waits(context: Context) -> bool:
    return any(is_torn(journal) and not is_temporary(journal) for journal in journals(context))


def _names(context: Context, kind: str, number: str = ".{10}") -> set[str]:
    """Names of cards of a kind whose journals a folder has, all or that of a number."""
    pattern = re.compile(rf"({re.escape(kind)}(?:-.+)?)-.{{6}}-{number}\.journal")
    found = os.listdir(context.store) if context.store.is_dir() else ()  # noqa: PTH208 - fast
    return {match[1] for match in map(pattern.fullmatch, found) if match}
