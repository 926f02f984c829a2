"""Taking the last upload back whole, if nobody has changed the controller since."""

from collections.abc import Sequence
from dataclasses import replace

from pmac_comp.base.errors import (
    ChangeInterrupted,
    ConfigError,
    ControllerState,
    PmacCompError,
    SafetyRefusal,
)
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journal import Journal
from pmac_comp.machine.controller.change.journals import (
    DONE,
    KEPT,
    ROLLED_BACK,
    damage_refusals,
    own_numbers,
    require_own_block,
)
from pmac_comp.machine.controller.change.lease import read_change, release_lease
from pmac_comp.machine.controller.change.transaction import UploadResult
from pmac_comp.machine.controller.change.verdict import link_is_lost, mark_left
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.law.law_checks import beside_another_law
from pmac_comp.machine.controller.settings.settings_upload import lease_refusals
from pmac_comp.machine.controller.tables.table_recovery import FOREIGN_TABLES
from pmac_comp.machine.controller.tables.table_status import read_head
from pmac_comp.machine.controller.tables.upload_checks import flash_refusals
from pmac_comp.machine.controller.whole.parts import (
    Part,
    refuse_foreign,
    settings_before,
    standing_parts,
    unsettled,
    uploads,
)
from pmac_comp.machine.controller.whole.taking_back import take_group_back
from pmac_comp.machine.controller.whole.waiting import (
    changed_elsewhere,
    end_change,
    number_since_ours,
    one_at_a_time,
    reset_since,
    take_over,
    tell_what_stands,
    waiting_refusals,
)


def rollback_last(link: Link, context: Context) -> UploadResult:
    """Take the last upload back, all parts of it.

    Raises
    ------
    ConfigError
        There is none in this folder, or it was taken back already.
    """
    with one_at_a_time(context):
        raise_all(damage_refusals(context), "The rollback")
        group, _ = upload_to_take_back(context)
        notes = _rolled_back(link, replace(context, settling=True), group)
    return UploadResult(ControllerState.OLD, "upload", 0, 0, journal=group.path, notes=tuple(notes))


def _rolled_back(link: Link, context: Context, group: Journal) -> Sequence[str]:
    """Take an upload back; an error says of all of it what stands, not of one part."""
    found: int | None = None
    try:
        raise_all(rollback_refusals(link, context, group), "The rollback")
        found = take_over(link, context, group)
        # One that was cut has taken its own tables away already.
        for part in () if group.is_open else standing_parts(context, group):
            refuse_foreign(link, context, part)
        notes = take_group_back(link, context, group, was_reset=reset_since(context, group, found))
        end_change(link, context)
    except KeyboardInterrupt as stop:
        left, certain = _left_by_rollback(group)
        error = ChangeInterrupted(
            "The rollback was stopped on request.",
            code="PC-REC-009",
            hint="`pmac-comp recover` ends it."
            if not certain or left is ControllerState.OLD
            else "The upload stands as it was.",
            left=left,
            context={"confirmed": certain},
        )
        _let_go_after(link, context, group, found, error)
        raise error from stop
    except PmacCompError as error:
        if error.code != FOREIGN_TABLES:  # it has looked at what stands
            left, certain = _left_by_rollback(group)
            mark_left(error, left, confirmed=certain)
            if left is ControllerState.NEW and not link_is_lost(error):
                tell_what_stands(link, context, error, standing_parts(context, group))
        _let_go_after(link, context, group, found, error)
        raise
    return notes


def _let_go_after(
    link: Link, context: Context, group: Journal, found: int | None, error: PmacCompError
) -> None:
    """A rollback that took nothing back keeps nobody out; one that is open waits for `recover`.

    Parameters
    ----------
    link, context, group
        Conversation, folder, upload.
    found : int or None
        Number that stood on the controller before, None if it still does.
    error : PmacCompError
        What ended it.
    """
    if found is None or group.is_open or link_is_lost(error):
        return
    try:
        if read_change(link, context) in own_numbers(context):
            release_lease(link, context, number=-abs(found))
    except PmacCompError as second:
        error.add_note(f"The end of the rollback could not be noted: {second.message}")


def _left_by_rollback(group: Journal) -> tuple[ControllerState, bool]:
    """What a rollback that stopped has left of an upload, and whether that is certain."""
    if group.is_open:
        return ControllerState.DISABLED, False
    taken = group.last_step == ROLLED_BACK  # only its end is not noted on the controller
    return (ControllerState.OLD if taken else ControllerState.NEW), True


def upload_to_take_back(context: Context) -> tuple[Journal, tuple[Part, ...]]:
    """The last upload and its parts that still stand, the last one first; ConfigError if none.

    One that failed and was taken back then never stood: what stands is of the upload before it.
    """
    groups = [group for group in uploads(context) if not _never_stood(group)]
    if groups and any(groups[-1].last(step) is not None for step in (ROLLED_BACK, KEPT)):
        raise ConfigError(
            "The last upload was taken back already; what stands now was there before it.",
            code="PC-REC-007",
            hint="`pmac-comp remove` takes off what compensates this axis.",
            context={"journal": str(groups[-1].path)},
        )
    if not groups:
        raise ConfigError(
            f"There is no upload in {context.store} that could be taken back.",
            code="PC-REC-001",
            hint="Name the folder of the upload with --journal. A card that answers as another one "
            "does is known by its address: reach it as the upload did.",
        )
    require_own_block(context, groups[-1:])
    return groups[-1], standing_parts(context, groups[-1])


def _never_stood(group: Journal) -> bool:
    """Whether an upload was taken back before it was whole."""
    return group.last(DONE) is None and group.last_step == ROLLED_BACK


def refuse_rollback(link: Link, context: Context, others: Sequence[SafetyRefusal] = ()) -> None:
    """Raise what forbids a rollback, and ``others``, with what stands; nothing is changed."""
    raise_all(damage_refusals(context), "The rollback")
    group, parts = upload_to_take_back(context)
    try:
        raise_all([*rollback_refusals(link, context, group), *others], "The rollback")
    except SafetyRefusal as error:
        tell_what_stands(link, context, error, parts)
        raise


def rollback_refusals(link: Link, context: Context, group: Journal) -> list[SafetyRefusal]:
    """Refusals because an upload was not the last change, or a later one waits to be settled."""
    newer = [p for p in unsettled(context) if p.journal.group != group.group]
    refusals = [
        SafetyRefusal(
            f"A change of {part.kind.value} after the upload was interrupted and is still open.",
            code="PC-TXN-010",
            hint="Run `pmac-comp recover` first, then take the upload back.",
        )
        for part in newer[:1]
    ]
    settling = replace(context, settling=True)
    refusals += [*lease_refusals(link, context), *waiting_refusals(link, settling)]
    refusals += flash_refusals(read_head(link, context))
    refusals += beside_another_law(link, context, settings_before(context, group))
    since = number_since_ours(link, context)
    return [changed_elsewhere(since)] if since and not refusals else refusals
