"""Which state of the controller an error tells: ``OLD``, ``NEW``, ``DISABLED``, or unconfirmed."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from pmac_comp.base.errors import (
    ControllerState,
    LinkError,
    LocalProtocolError,
    PmacCompError,
    ProtocolError,
)

_UNCONFIRMED: Final = (
    "The state is unconfirmed: run `pmac-comp recover` as soon as the controller answers."
)


@contextmanager
def untouched() -> Iterator[None]:
    """Errors of looking, before anything was changed, leave with OLD on them.

    But not those that tell of a change which waits: what that one left is something else.
    """
    try:
        yield
    except PmacCompError as error:
        if not is_told(error):
            mark_left(error, ControllerState.OLD, confirmed=True)
            error.context["untouched"] = True
        raise


def is_told(error: PmacCompError) -> bool:
    """Whether an error says what was left, or that nobody has looked at it."""
    return error.left is not None or error.context.get("confirmed") is False


def link_is_lost(error: PmacCompError) -> bool:
    """Whether nobody can tell what the controller did, nor tell it anything.

    What could not be put in words for it was never sent, and the link lives.
    """
    if isinstance(error, LocalProtocolError):
        return False
    return isinstance(error, LinkError | ProtocolError)


def mark_left(error: PmacCompError, left: ControllerState, *, confirmed: bool) -> None:
    """Say on an error in which state the controller was left."""
    error.left = left
    error.context["confirmed"] = confirmed
    if not confirmed and _UNCONFIRMED not in error.hint:
        error.hint = f"{error.hint} {_UNCONFIRMED}".strip()
