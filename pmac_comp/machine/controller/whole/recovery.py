"""After an interruption: bring every kind of change to OLD or NEW.

Which changes still matter is in ``waiting``, how one part is judged and settled in ``parts``, how
the parts of an upload are taken back together in ``taking_back``.
"""

from dataclasses import replace

from pmac_comp.base.errors import ControllerState, PmacCompError, SafetyRefusal
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.alike import left_open_alike
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journals import (
    DONE,
    KEPT,
    ROLLED_BACK,
    ChangeKind,
    damage_refusals,
    is_of_block,
    is_temporary,
    is_torn,
    journals,
    require_own_block,
)
from pmac_comp.machine.controller.change.lease import read_change, release_lease
from pmac_comp.machine.controller.change.transaction import UploadResult
from pmac_comp.machine.controller.change.verdict import link_is_lost, mark_left, untouched
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.settings.settings_upload import lease_refusals
from pmac_comp.machine.controller.settings.temporary import take_off
from pmac_comp.machine.controller.tables.table_recovery import recover_tables
from pmac_comp.machine.controller.tables.table_status import read_head, table_status
from pmac_comp.machine.controller.tables.upload_checks import flash_refusals
from pmac_comp.machine.controller.whole.parts import (
    Part,
    first_missing,
    how_it_stands,
    parts_in,
    parts_of,
    refusals_to_take_back,
    replaced_since,
    settle,
    unsettled,
    uploads,
    what_stands,
)
from pmac_comp.machine.controller.whole.taking_back import RESET, take_group_back
from pmac_comp.machine.controller.whole.waiting import (
    changed_elsewhere,
    end_change,
    number_since_ours,
    one_at_a_time,
    reset_since,
    take_over,
    tell_what_stands,
    torn_groups,
    waiting,
    waiting_parts,
    waiting_refusals,
)


def recover(link: Link, context: Context, *, resume: bool = True) -> UploadResult:
    """Bring whatever was interrupted to OLD or NEW.

    Parameters
    ----------
    link, context
        Conversation and limits.
    resume : bool
        Finish what stands whole; otherwise write the old back. An upload of several parts that
        was torn is always taken back: only the whole of it makes sense.

    Returns
    -------
    UploadResult
        OLD or NEW; DISABLED only if the old state was "no tables".

    Raises
    ------
    ForeignChange
        Tables act that nobody announced; they were switched off. Or somebody else has changed the
        controller since the interruption; nothing was written over it.
    """
    try:
        with one_at_a_time(context):
            return _recover(link, replace(context, settling=True), resume=resume)
    except PmacCompError as error:
        # A part speaks of itself: OLD of one that wrote the old back is what was torn before it.
        if link_is_lost(error):
            mark_left(error, ControllerState.DISABLED, confirmed=False)
        elif error.left is not ControllerState.DISABLED or error.context.get("confirmed"):
            tell_what_stands(link, context, error)
        raise


def last_change(context: Context) -> str:
    """What this folder did last to the controller and how it ended, in words; empty for nothing."""
    told = [j for j in journals(context) if j.first() is not None and not is_temporary(j)]
    begun = uploads(context)
    whole = [j for j in told if j in begun or not j.group]
    if not whole:
        return ""
    first, last = whole[-1].entries()[0], whole[-1].last_step
    name = first.data.get("name") or first.data.get("route") or first.data.get("kind")
    ends = {DONE: "done", ROLLED_BACK: "taken back", KEPT: "closed without writing"}
    end = begun[-1].last(ROLLED_BACK) if begun else None
    amid = ", the controller was reset amid it" if end is not None and RESET in end.data else ""
    return f"{name}: {ends.get(last, 'interrupted')}{amid}"


def _recover(link: Link, context: Context, *, resume: bool) -> UploadResult:
    raise_all(damage_refusals(context), "The recovery")
    raise_all(_forbidden(link, context), "The recovery")
    since = number_since_ours(link, context)
    torn, waits = torn_groups(context), waiting(context)
    require_own_block(context, waits)
    found = 0
    if waits:
        found = take_over(link, context, torn[-1] if torn else waits[0])
    # What a measurement borrowed is given back if nobody else has written it since.
    notes = list(take_off(link, context, whatever_stands=not since))
    for group in reversed(torn):
        begun = bool(parts_in(context, group.group))
        reset = group is torn[-1] and begun and reset_since(context, group, found)
        notes += take_group_back(link, context, group, was_reset=reset)
    if not torn or unsettled(context):
        result = _recover_changes(link, context, resume=resume, since=since)
    else:
        if not notes:
            notes.append("no part of the upload was begun")
        result = UploadResult(ControllerState.OLD, "upload", 0, 0, journal=torn[-1].path)
    last = "" if torn or waits else last_change(context)
    if last:
        notes.append(f"nothing was left open; the last change of this folder was {last}")
    if not (torn or waits) and (alike := left_open_alike(context)):
        notes.append(alike)
    _close_replaced(context)
    end_change(link, context)
    return replace(result, notes=tuple(dict.fromkeys((*result.notes, *notes))))


def _close_replaced(context: Context) -> None:
    """Close what still stands open of changes that a later one has replaced.

    That is a recovery or a rollback which was cut itself: the next one writes the old back with a
    journal of its own, and the first would forbid every change from then on.
    """
    waits = {part.journal.path for part in unsettled(context)}
    for part in parts_of(context):
        if part.journal.is_open and part.journal.path not in waits:
            part.journal.write(KEPT)


def _forbidden(link: Link, context: Context) -> list[SafetyRefusal]:
    """What of other writers forbids a recovery."""
    refusals = lease_refusals(link, context) + flash_refusals(read_head(link, context))
    since = number_since_ours(link, context)
    if since and waiting_parts(context):
        return [*refusals, changed_elsewhere(since)]
    return refusals + waiting_refusals(link, context)


def recovery_refusals(link: Link, context: Context) -> list[SafetyRefusal]:
    """What forbids ``recover`` as controller and motors stand now; nothing is changed."""
    context = replace(context, settling=True)
    damaged = damage_refusals(context)
    if damaged:
        return damaged
    require_own_block(context, waiting(context))
    refusals = _forbidden(link, context)
    torn = {group.group for group in torn_groups(context)}
    for part in reversed(waiting_parts(context)):
        # Tables of their own may be finished instead: only that recovery knows how they stand.
        taken_back = part.journal.group in torn or part.kind is not ChangeKind.TABLES
        if taken_back and not part.items & replaced_since(context, part):
            refusals += refusals_to_take_back(link, context, part)
    return list({refusal.message: refusal for refusal in refusals}.values())


def keep(link: Link, context: Context) -> UploadResult:
    """Take what stands as it is: close what this folder left open, write nothing back.

    Raises
    ------
    LeaseHeld
        Another host changes the controller now.
    """
    with untouched(), one_at_a_time(context):
        raise_all(lease_refusals(link, context), "Keeping what stands")
        seen = _seen_of_waiting(link, context)
        still_open = [j for j in journals(context) if is_torn(j) or j.is_damaged]
        for journal in reversed(still_open):
            journal.write(KEPT)
        release_lease(link, context, number=-abs(read_change(link, context)))
        status = table_status(link, context)
    state, words = seen or (status.decision.state, f"tables: {status.decision.reason}")
    note = f"what stands was kept; {len(still_open)} open change(s) of this folder closed"
    return UploadResult(state, "kept", 0, status.tables.crc, notes=(note, words))


def _seen_of_waiting(link: Link, context: Context) -> tuple[ControllerState, str] | None:
    """State of what waits, and in words that of each part; None where nothing does or can tell."""
    parts = waiting_parts(context)
    try:
        return what_stands(link, context, parts) if parts else None
    except (PmacCompError, OSError):  # of a damaged journal or a backup that is lost
        return None


def _recover_changes(link: Link, context: Context, *, resume: bool, since: int) -> UploadResult:
    """Settle what is open of every kind; with nothing open say how the last change stands.

    ``since`` is the number of a change of another folder or host behind ours, 0 for none.
    """
    parts = [p for p in unsettled(context) if p.kind is not ChangeKind.TABLES]
    settled = [settle(link, context, part, resume=resume) for part in parts]
    known = [part for part in parts_of(context) if is_of_block(context, part.journal)]
    last = next(iter(reversed(known)), None)
    together = [p for p in known if last is not None and p.journal.group == last.journal.group]
    alone = last is None or not last.journal.group or len(together) == 1
    tables = recover_tables(link, context, resume=resume, alone=alone, since=since)
    if settled and tables.verdict is not ControllerState.DISABLED:
        return replace(settled[0], notes=tuple(n for part in settled for n in part.notes))
    if last is not None and last.kind is not ChangeKind.TABLES and last.closing == DONE:
        return _how_upload_stands(link, context, last)
    return tables


def _how_upload_stands(link: Link, context: Context, last: Part) -> UploadResult:
    """How the last upload stands: whole, or something of it went since."""
    result = how_it_stands(link, context, last)
    group = last.journal.group
    wrong = first_missing(link, context, group) if group else ""
    if not wrong:
        return result
    parts = [part for part in parts_in(context, group) if part.closing == DONE]
    state, words = what_stands(link, context, parts)
    if state is ControllerState.OLD:
        return replace(result, verdict=state, notes=(f"the last upload is gone: {words}",))
    gone = "something of the last upload does not stand any more"
    note = f"{gone} (a reset without SAVE, or somebody else's change): {wrong}"
    return replace(result, verdict=ControllerState.DISABLED, notes=(note,))
