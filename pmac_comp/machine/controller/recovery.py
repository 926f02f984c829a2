"""After an interruption: bring every kind of change to OLD or NEW, or take an upload back.

What lives here: which changes still matter, who may settle them, and when. How one part is judged
and settled is in ``parts``, how the parts of an upload are taken back together in ``taking_back``.
"""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace

from pmac_comp.base.errors import (
    ChangeInterrupted,
    ConfigError,
    ControllerState,
    ForeignChange,
    PmacCompError,
    SafetyRefusal,
    StorageFull,
    VerifyMismatch,
)
from pmac_comp.machine.controller.claim import claim_refusal, read_claim, release_claim
from pmac_comp.machine.controller.context import Context
from pmac_comp.machine.controller.journal import Journal
from pmac_comp.machine.controller.journals import (
    DONE,
    KEPT,
    ROLLED_BACK,
    ChangeKind,
    is_of_block,
    is_temporary,
    is_torn,
    journals,
    number_of,
    open_group,
    own_numbers,
    require_own_block,
    torn_refusals,
)
from pmac_comp.machine.controller.lease import (
    begun_elsewhere,
    give_back,
    host_lock,
    read_change,
    read_change_and_claim,
    read_lease,
    release_lease,
    take_lease,
)
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.parts import (
    Part,
    how_it_stands,
    missing,
    parts_of,
    refusals_to_take_back,
    refuse_foreign,
    replaced_since,
    settle,
    standing_parts,
    unsettled,
    uploads,
    what_stands,
)
from pmac_comp.machine.controller.safety import raise_all
from pmac_comp.machine.controller.settings_upload import lease_refusals
from pmac_comp.machine.controller.table_recovery import FOREIGN_TABLES, recover_tables
from pmac_comp.machine.controller.table_status import table_status
from pmac_comp.machine.controller.taking_back import take_group_back
from pmac_comp.machine.controller.temporary import standing, take_off
from pmac_comp.machine.controller.transaction import FOUND, UploadResult
from pmac_comp.machine.controller.verdict import link_is_lost, mark_left, untouched


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
    with _one_at_a_time(context):
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


def _one_at_a_time(context: Context) -> AbstractContextManager[None]:
    """Between the parts of an upload, too, nobody else of this folder may upload or recover."""
    return host_lock(context, ".upload")


def _begin(link: Link, context: Context, name: str) -> tuple[Journal, Context]:
    for refusal in waiting_refusals(link, context):
        raise refusal
    take_off(link, context)  # what a measurement borrowed must not become part of an upload
    return open_group(context, name)


def waiting_refusals(link: Link, context: Context) -> list[SafetyRefusal]:
    """Refusals of a change while another one, of this folder or elsewhere, has not ended."""
    number, claimed = read_change_and_claim(link, context)
    elsewhere = _of_elsewhere(number, context)
    other = claim_refusal(claimed, context)
    torn = torn_refusals(context)
    for refusal in torn:
        _tell_what_stands(link, context, refusal)
    return [
        *torn,
        *([begun_elsewhere(elsewhere)] if elsewhere else []),
        *([other] if other else []),
    ]


def _tell_what_stands(
    link: Link, context: Context, error: PmacCompError, upload: Sequence[Part] = ()
) -> None:
    """Say on an error what was seen of the changes that wait, else of an upload or the tables."""
    torn = {group.group for group in _torn_groups(context)}
    parts = [p for p in parts_of(context) if p.journal.group in torn]
    parts += [p for p in unsettled(context) if p.journal.group not in torn]
    try:
        if parts or torn or upload:
            state, words = what_stands(link, context, parts or upload)
        else:
            decision = table_status(link, context).decision
            state, words = decision.state, f"tables: {decision.state.value}, {decision.reason}"
    except PmacCompError as second:
        error.add_note(f"What stands could not be read: {second.message}")
        mark_left(error, error.left or ControllerState.DISABLED, confirmed=False)
        return
    mark_left(error, state, confirmed=True)
    error.context["stands"] = words
    error.hint = f"{error.advice} Seen to stand: {words}.".strip()


def open_elsewhere(link: Link, context: Context) -> int:
    """Number of a change that another folder or host began and did not end, 0 for none."""
    return _of_elsewhere(read_change(link, context), context)


def _of_elsewhere(number: int, context: Context) -> int:
    return number if number > 0 and number not in own_numbers(context) else 0


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
    return any(p.journal.group == group.group and p.closing == DONE for p in parts_of(context))


def _require_whole(link: Link, context: Context, group: int) -> None:
    """Every part still stands at the end: a reset in between takes the first ones away.

    What was put on last is looked at last: who touches a bank switches the law off with it.
    """
    touched: set[object] = set()
    standing: list[Part] = []
    for part in reversed([p for p in parts_of(context) if p.journal.group == group]):
        # Some parts an upload can do without; such a one was taken back.
        if part.closing == DONE and not part.items & touched:
            standing.append(part)
        touched |= part.items
    for part in reversed(standing):
        wrong = missing(link, context, part)
        if wrong:
            raise VerifyMismatch(
                f"A part of the upload does not stand at its end: {wrong}.",
                code="PC-REC-003",
                hint="Was the controller reset, or does somebody else write to it?",
            )


def _take_back_after(link: Link, context: Context, group: Journal, error: PmacCompError) -> None:
    try:
        notes = take_group_back(link, context, group)
    except PmacCompError as second:
        error.add_note(f"The parts before could not be taken back: {second.message}")
        mark_left(error, ControllerState.DISABLED, confirmed=False)
        return
    mark_left(error, ControllerState.OLD, confirmed=True)
    for note in notes:
        error.add_note(note)
    try:
        if read_lease(link, context).owner in {0, context.owner}:
            _end(link, context)
    except PmacCompError as second:
        error.add_note(f"The end of the upload could not be noted: {second.message}")


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
        with _one_at_a_time(context):
            return _recover(link, replace(context, settling=True), resume=resume)
    except PmacCompError as error:
        if error.left in {None, ControllerState.OLD} and not link_is_lost(error):
            # What did not touch anything has not brought back what stood before either.
            _tell_what_stands(link, context, error)
        elif error.left is None:
            mark_left(error, ControllerState.DISABLED, confirmed=False)
        raise


def left_open(context: Context) -> tuple[str, ...]:
    """Changes of this folder that began and did not end, in words; ``recover`` settles them."""
    torn = [j for j in journals(context) if j.kind == ChangeKind.GROUP.value and j.is_open]
    if torn:
        begin = torn[-1].first()
        name = "" if begin is None else begin.data.get("name", "")
        return (f"an upload ({name}) was interrupted",)
    open_parts = [f"a change of {p.kind.value} was interrupted" for p in unsettled(context)]
    if standing(context):
        open_parts.append("axis definitions of a measurement stand")
    return tuple(open_parts)


def last_change(context: Context) -> str:
    """What this folder did last to the controller and how it ended, in words; empty for nothing."""
    told = [j for j in journals(context) if not is_temporary(j)]
    begun = uploads(context)
    whole = [j for j in told if j in begun or not j.group]
    if not whole:
        return ""
    first, last = whole[-1].entries()[0], whole[-1].entries()[-1].step
    name = first.data.get("name") or first.data.get("route") or first.data.get("kind")
    ends = {DONE: "done", ROLLED_BACK: "taken back", KEPT: "closed without writing"}
    return f"{name}: {ends.get(last, 'interrupted')}"


def _recover(link: Link, context: Context, *, resume: bool) -> UploadResult:
    raise_all(_forbidden(link, context), "The recovery")
    since = number_since_ours(link, context)
    torn, waits = _torn_groups(context), waiting(context)
    require_own_block(context, waits)
    if waits:
        _take_over(link, context, torn[-1] if torn else waits[0])
    # What a measurement borrowed is given back if nobody else has written it since.
    notes = list(take_off(link, context, whatever_stands=not since))
    for group in reversed(torn):
        notes += take_group_back(link, context, group)
    if not torn or unsettled(context):
        result = _recover_changes(link, context, resume=resume)
    else:
        if not notes:
            notes.append("no part of the upload was begun")
        result = UploadResult(ControllerState.OLD, "upload", 0, 0, journal=torn[-1].path)
    _end(link, context)
    return replace(result, notes=tuple(dict.fromkeys((*result.notes, *notes))))


def _forbidden(link: Link, context: Context) -> list[SafetyRefusal]:
    """What of other writers forbids a recovery."""
    refusals = lease_refusals(link, context)
    since = number_since_ours(link, context)
    if since and waiting_parts(context):
        return [*refusals, _changed_elsewhere(since)]
    return refusals + waiting_refusals(link, context)


def recovery_refusals(link: Link, context: Context) -> list[SafetyRefusal]:
    """What forbids ``recover`` as controller and motors stand now; nothing is changed."""
    context = replace(context, settling=True)
    require_own_block(context, waiting(context))
    refusals = _forbidden(link, context)
    torn = {group.group for group in _torn_groups(context)}
    for part in reversed(waiting_parts(context)):
        # Tables of their own may be finished instead: only that recovery knows how they stand.
        taken_back = part.journal.group in torn or part.kind is not ChangeKind.TABLES
        if taken_back and not part.items & replaced_since(context, part):
            refusals += refusals_to_take_back(link, context, part)
    return list({refusal.message: refusal for refusal in refusals}.values())


def _end(link: Link, context: Context) -> None:
    """Give the lease back, and say on the controller that our last change has ended."""
    number = read_change(link, context)
    if number in own_numbers(context):
        release_lease(link, context, number=-number)
    else:  # killed before the number was written
        give_back(link, context)
        release_claim(link, context, read_claim(link))


def _torn_groups(context: Context) -> list[Journal]:
    return [j for j in journals(context) if j.kind == ChangeKind.GROUP.value and j.is_open]


def waiting(context: Context) -> list[Journal]:
    """Journals of what a recovery would write back."""
    return [part.journal for part in waiting_parts(context)]


def waiting_parts(context: Context) -> list[Part]:
    """What a recovery would write back: parts of torn uploads, and changes of their own."""
    groups = {group.group for group in _torn_groups(context)}
    parts = [p for p in parts_of(context) if p.journal.group in groups and p.closing != ROLLED_BACK]
    return [*parts, *(p for p in unsettled(context) if p.journal.group not in groups)]


def _take_over(link: Link, context: Context, journal: Journal) -> int:
    """Number and claim of what is written back, as between the parts of an upload.

    Returns
    -------
    int
        Number that stood there.

    Raises
    ------
    LeaseHeld, ForeignChange
        Somebody else changes the controller, or has changed it since; nothing was changed.
    """
    number = journal.group or number_of(journal)
    _, found = take_lease(link, context, number, lambda n: n in own_numbers(context))
    since = _since_ours(found, context)
    release_lease(link, context, number=found if since else None)
    if since:
        raise _changed_elsewhere(since)
    return found


def number_since_ours(link: Link, context: Context) -> int:
    """Number of a change that another folder or host made since ours, 0 for none."""
    return _since_ours(read_change(link, context), context)


def _since_ours(last: int, context: Context) -> int:
    """Number of a change that another folder or host made since ours, 0 for none.

    Otherwise a change of this folder was the last, or, after a reset, the number on the controller
    is an older one that stood there before them.
    """
    number = abs(last)
    seen = {abs(int(str(e.data.get(FOUND, 0)))) for j in journals(context) for e in j.entries()}
    return 0 if number in own_numbers(context) | seen else number


def _changed_elsewhere(number: int) -> ForeignChange:
    return ForeignChange(
        f"Another folder or host has changed this controller (number {number}) since; what stood "
        "before is not written back over it.",
        code="PC-REC-004",
        hint="Look at what stands (`pmac-comp status`, `backup`). `pmac-comp recover --keep` takes "
        "it as it is and closes what was left open here; `pmac-comp remove` takes it off.",
        context={"number": number},
    )


def keep(link: Link, context: Context) -> UploadResult:
    """Take what stands as it is: close what this folder left open, write nothing back.

    Raises
    ------
    LeaseHeld
        Another host changes the controller now.
    """
    with untouched(), _one_at_a_time(context):
        raise_all(lease_refusals(link, context), "Keeping what stands")
        still_open = [j for j in journals(context) if is_torn(j)]
        for journal in reversed(still_open):
            journal.write(KEPT)
        release_lease(link, context, number=-abs(read_change(link, context)))
        status = table_status(link, context)
    note = f"what stands was kept; {len(still_open)} open change(s) of this folder closed"
    return UploadResult(
        status.decision.state,
        "kept",
        0,
        status.tables.crc,
        notes=(note, f"tables: {status.decision.reason}"),
    )


def _recover_changes(link: Link, context: Context, *, resume: bool) -> UploadResult:
    """Settle what is open of every kind; with nothing open say how the last change stands."""
    parts = [p for p in unsettled(context) if p.kind is not ChangeKind.TABLES]
    settled = [settle(link, context, part, resume=resume) for part in parts]
    known = [part for part in parts_of(context) if is_of_block(context, part.journal)]
    last = next(iter(reversed(known)), None)
    together = [p for p in known if last is not None and p.journal.group == last.journal.group]
    alone = last is None or not last.journal.group or len(together) == 1
    tables = recover_tables(link, context, resume=resume, alone=alone)
    if settled and tables.verdict is not ControllerState.DISABLED:
        return replace(settled[0], notes=tuple(n for part in settled for n in part.notes))
    if last is not None and last.kind is not ChangeKind.TABLES and last.closing == DONE:
        return how_it_stands(link, context, last)
    return tables


# Taking a whole upload back -----------------------------------------------------------------------


def rollback_last(link: Link, context: Context) -> UploadResult:
    """Take the last upload back, all parts of it.

    Raises
    ------
    ConfigError
        There is none in this folder, or it was taken back already.
    """
    with _one_at_a_time(context):
        group, _ = upload_to_take_back(context)
        notes = _rolled_back(link, replace(context, settling=True), group)
    return UploadResult(ControllerState.OLD, "upload", 0, 0, journal=group.path, notes=tuple(notes))


def _rolled_back(link: Link, context: Context, group: Journal) -> Sequence[str]:
    """Take an upload back; an error says of all of it what stands, not of one part."""
    found: int | None = None
    try:
        raise_all(rollback_refusals(link, context, group), "The rollback")
        found = _take_over(link, context, group)
        # One that was cut has taken its own tables away already.
        for part in () if group.is_open else standing_parts(context, group):
            refuse_foreign(link, context, part)
        notes = take_group_back(link, context, group)
        _end(link, context)
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
                _tell_what_stands(link, context, error, standing_parts(context, group))
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
    taken = group.entries()[-1].step == ROLLED_BACK  # only its end is not noted on the controller
    return (ControllerState.OLD if taken else ControllerState.NEW), True


def upload_to_take_back(context: Context) -> tuple[Journal, tuple[Part, ...]]:
    """The last upload and its parts that still stand, the last one first; ConfigError if none."""
    groups = uploads(context)
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
            hint="Name the folder of the upload with --journal.",
        )
    require_own_block(context, groups[-1:])
    return groups[-1], standing_parts(context, groups[-1])


def refuse_rollback(link: Link, context: Context, others: Sequence[SafetyRefusal] = ()) -> None:
    """Raise what forbids a rollback, and ``others``, with what stands; nothing is changed."""
    group, parts = upload_to_take_back(context)
    try:
        raise_all([*rollback_refusals(link, context, group), *others], "The rollback")
    except SafetyRefusal as error:
        _tell_what_stands(link, context, error, parts)
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
    since = number_since_ours(link, context)
    return [_changed_elsewhere(since)] if since and not refusals else refusals
