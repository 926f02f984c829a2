"""An upload of several parts: all of them end as ``NEW``, or none."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from pmac_comp.base.errors import (
    ChangeInterrupted,
    ControllerState,
    PmacCompError,
    StorageFull,
    VerifyMismatch,
)
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journal import Journal
from pmac_comp.machine.controller.change.journals import DONE, open_group
from pmac_comp.machine.controller.change.lease import (
    read_change,
    read_change_and_claim,
    read_lease,
    release_lease,
)
from pmac_comp.machine.controller.change.transaction import RESET_AMID
from pmac_comp.machine.controller.change.verdict import link_is_lost, mark_left, untouched
from pmac_comp.machine.controller.settings.temporary import take_off
from pmac_comp.machine.controller.whole.parts import first_missing, parts_in, what_stands
from pmac_comp.machine.controller.whole.taking_back import take_group_back
from pmac_comp.machine.controller.whole.waiting import (
    end_change,
    one_at_a_time,
    reset_since,
    waiting_refusals,
)


@contextmanager
def grouped(link: Link, context: Context, name: str) -> Iterator[Context]:
    """Hold the parts of an upload together: all of them end as NEW, or none.

    A part that fails while the link lives has the parts before it taken back at once; after a
    lost link or a kill ``recover`` does it.

    Parameters
    ----------
    link, context
        Conversation, limits and folder.
    name : str
        What the upload is, for people.

    Yields
    ------
    Context
        To be used for the parts.
    """
    with one_at_a_time(context):
        with untouched():
            journal, inner = _begin(link, context, name)
        with _whole_or_taken_back(link, context, journal):
            yield inner
            _require_whole(link, context, journal.group)
            release_lease(link, context, number=-journal.group)
        try:
            journal.write(DONE)
        except StorageFull as error:
            mark_left(error, ControllerState.NEW, confirmed=True)
            error.hint = (
                "All of the upload stands, but is not noted: `pmac-comp recover` takes it back."
            )
            raise


def _begin(link: Link, context: Context, name: str) -> tuple[Journal, Context]:
    found = read_change_and_claim(link, context)
    for refusal in waiting_refusals(link, context, found):
        raise refusal
    take_off(link, context)  # what a measurement borrowed must not become part of an upload
    journal, inner = open_group(context, name)
    return journal, replace(inner, number_before=found[0])


@contextmanager
def _whole_or_taken_back(link: Link, context: Context, group: Journal) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt as stop:
        error = ChangeInterrupted(
            "Stopped on request between the parts of the upload.",
            code="PC-REC-002",
            hint="The parts before were taken back; `pmac-comp status` shows what stands.",
        )
        _take_back_after(link, context, group, error)
        raise error from stop
    except PmacCompError as error:
        if not link_is_lost(error):
            _take_back_after(link, context, group, error)
        elif error.left is None or _done_before(context, group):
            # What a part says of itself is not true of an upload whose first parts stand.
            mark_left(error, ControllerState.DISABLED, confirmed=False)
        raise


def _done_before(context: Context, group: Journal) -> bool:
    return any(part.closing == DONE for part in parts_in(context, group.group))


def _require_whole(link: Link, context: Context, group: int) -> None:
    """Every part still stands at the end: a reset in between takes the first ones away."""
    wrong = first_missing(link, context, group)
    if wrong:
        raise VerifyMismatch(
            f"A part of the upload does not stand at its end: {wrong}.",
            code="PC-REC-003",
            hint="Was the controller reset, or does somebody else write to it?",
        )


def _take_back_after(link: Link, context: Context, group: Journal, error: PmacCompError) -> None:
    try:
        begun = bool(parts_in(context, group.group))
        reset = error.code == RESET_AMID or (
            begun and reset_since(context, group, read_change(link, context))
        )
        notes = take_group_back(link, context, group, was_reset=reset)
    except PmacCompError as second:
        error.add_note(f"The parts before could not be taken back: {second.message}")
        mark_left(error, ControllerState.DISABLED, confirmed=False)
        if not link_is_lost(second):
            _tell_what_acts(link, context, group, error)
        return
    mark_left(error, ControllerState.OLD, confirmed=not reset)
    for note in notes:
        error.add_note(note)
    try:
        if read_lease(link, context).owner in {0, context.owner}:
            end_change(link, context)
    except PmacCompError as second:
        error.add_note(f"The end of the upload could not be noted: {second.message}")


def _tell_what_acts(link: Link, context: Context, group: Journal, error: PmacCompError) -> None:
    """Note what is seen of an upload that could not be taken back, as on a full disk."""
    try:
        _, words = what_stands(link, context, parts_in(context, group.group))
    except PmacCompError as second:
        error.add_note(f"What stands could not be read: {second.message}")
        return
    error.add_note(f"The upload is left open: `pmac-comp recover` takes it back. Stands: {words}.")
