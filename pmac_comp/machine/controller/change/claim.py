"""Which block of P-variables a change under way uses, in a place that all bench files share.

Lease and number of the last change stand in the block of a bench file (``p_block``): bench files of
one card with two blocks do not see each other's there. So a change also writes the first variable
of its block into one of the open registers, and takes it away when it has ended. What lives here:
that register. What may not: who holds a block (``lease``).

A register that holds something else is somebody else's: it is left alone, and two blocks then keep
each other out by their files and locks on one host only. It is 0 after power-up or a reset, with
which a change under way is lost as well. Source: Software Reference Manual p. 403, 503.
"""

from typing import Final

from pmac_comp.base.errors import ControllerState, ForeignChange
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.change.context import Context

REGISTER: Final = 0x10FF  # X and Y, the last of the open ones
_MARK: Final = 0x504B43  # X
_X_BITS: Final = 24
_LONG_MASK: Final = (1 << 48) - 1
CLAIM_TEXT: Final = f"RL${REGISTER:X}"
FREE: Final = -1
FOREIGN: Final = -2


def read_claim(link: Link) -> int:
    """First P-variable of the block that a change under way uses, ``FREE`` or ``FOREIGN``."""
    return parse_claim(link.query(CLAIM_TEXT)[0])


def parse_claim(text: str) -> int:
    """The same of the answer to ``CLAIM_TEXT``."""
    word = parse_integer(text) & _LONG_MASK
    if word == 0:
        return FREE
    return word & (1 << _X_BITS) - 1 if word >> _X_BITS == _MARK else FOREIGN


def claim_refusal(found: int, context: Context) -> ForeignChange | None:
    """Refusal where a change with another block is under way, or was interrupted.

    Parameters
    ----------
    found : int
        What ``read_claim`` gave.
    context : Context
        With the block of this bench file.
    """
    if found in {FREE, FOREIGN, context.block.first}:
        return None
    return ForeignChange(
        f"A change or measurement with the bench file of another axis (p_block from P{found}) is "
        "under way on this controller, or was interrupted.",
        code="PC-TXN-013",
        hint="Wait for it; if it was interrupted run `pmac-comp recover` with that bench file "
        "where it was started. If that folder is lost, `pmac-comp recover --keep` with that bench "
        "file takes what stands as it is.",
        context={"first_p": found},
    )


def claim(link: Link, context: Context, found: int) -> None:
    """Write our block into a free register, and read it back.

    Parameters
    ----------
    link, context
        Conversation and block.
    found : int
        What stands there; anything but ``FREE`` is left as it is.

    Raises
    ------
    ForeignChange
        One with another block came at the same moment.
    """
    if found != FREE:
        return
    link.command(f"WL${REGISTER:X},${_MARK:06X}{context.block.first:06X}")
    refusal = claim_refusal(read_claim(link), context)
    if refusal is not None:
        refusal.left = ControllerState.OLD
        raise refusal


def release_claim(link: Link, context: Context, found: int) -> None:
    """Take our block away; another one and what is somebody else's are left alone."""
    if found == context.block.first:
        link.command(f"WL${REGISTER:X},0")
