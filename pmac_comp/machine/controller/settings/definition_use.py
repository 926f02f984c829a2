"""Which M-variables the programs on the card use: taken away, they would read nothing.

What lives here: looking through the texts of programs. What may not: deciding what is taken off.
"""

import re
from collections.abc import Collection
from typing import Final

from pmac_comp.base.errors import CommandRefused
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.settings import Buffer
from pmac_comp.machine.controller.settings.backup import stored_buffers

_NAMED: Final = re.compile(r"M(\d+)")


def definitions_in_use(
    link: Link, wanted: Collection[int], without: Collection[Buffer]
) -> frozenset[int]:
    """Those of the wanted M-variables that a program names, but for programs that go.

    Parameters
    ----------
    link : Link
        Conversation.
    wanted : Collection of int
        Numbers to look for.
    without : Collection of (ProgramKind, int)
        Programs that are not looked at.

    Returns
    -------
    frozenset of int
        All of them where a password hides a program: it may name any.
    """
    used: set[int] = set()
    for kind, number in stored_buffers(link):
        if (kind, number) in without or used >= set(wanted):
            continue
        try:
            text = "\n".join(programs.listing(link, kind, number) or ())
        except CommandRefused as error:
            if programs.explain_protection(error):
                return frozenset(wanted)
            raise
        used |= {int(found) for found in _NAMED.findall(text.upper())}
    return frozenset(used & set(wanted))
