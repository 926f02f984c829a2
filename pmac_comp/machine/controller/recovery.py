"""After an interruption: bring every kind of change to OLD or NEW, or take an upload back.

What lives here: which changes still matter, and the parts of an upload as one thing. How one part
is judged and settled is in ``parts``.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

from pmac_comp.base.errors import (
    ChangeInterrupted,
    ConfigError,
    ControllerState,
    LinkError,
    PmacCompError,
    ProtocolError,
    StorageFull,
    VerifyMismatch,
)
from pmac_comp.machine.controller.context import Context, never
from pmac_comp.machine.controller.journal import Journal
from pmac_comp.machine.controller.lease import release_lease
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.parts import (
    Part,
    how_it_stands,
    missing,
    parts_of,
    settle,
    take_back,
    unsettled,
)
from pmac_comp.machine.controller.safety import raise_all
from pmac_comp.machine.controller.settings_upload import lease_refusals
from pmac_comp.machine.controller.table_recovery import recover_tables
from pmac_comp.machine.controller.temporary import standing, take_off
from pmac_comp.machine.controller.transaction import (
    DONE,
    ROLLED_BACK,
    ChangeKind,
    UploadResult,
    journals,
    mark_left,
    open_group,
    untouched,
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
    with untouched():
        journal, inner = open_group(context, name)
    with _whole_or_taken_back(link, context, journal):
        yield inner
        _require_whole(link, context, journal.group)
    try:
        journal.write(DONE)
    except StorageFull as error:
        mark_left(error, ControllerState.NEW, confirmed=True)
        error.hint = (
            "All of the upload stands, but is not noted: `pmac-comp recover` takes it back."
        )
        raise


@contextmanager
def _whole_or_taken_back(link: Link, context: Context, group: Journal) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt as stop:
        error = ChangeInterrupted(
            "Stopped on request between the parts of the upload.", code="PC-REC-002"
        )
        _take_back_after(link, context, group, error)
        raise error from stop
    except PmacCompError as error:
        if not isinstance(error, LinkError | ProtocolError):
            _take_back_after(link, context, group, error)
        elif error.left is None or _done_before(context, group):
            # What a part says of itself is not true of an upload whose first parts stand.
            mark_left(error, ControllerState.DISABLED, confirmed=False)
        raise


def _done_before(context: Context, group: Journal) -> bool:
    return any(p.journal.group == group.group and p.closing == DONE for p in parts_of(context))


def _require_whole(link: Link, context: Context, group: int) -> None:
    """Every part still stands at the end: a reset in between takes the first ones away."""
    touched: set[object] = set()
    for part in reversed([p for p in parts_of(context) if p.journal.group == group]):
        # Some parts an upload can do without; such a one was taken back.
        if part.closing == DONE and not part.items & touched:
            wrong = missing(link, context, part)
            if wrong:
                raise VerifyMismatch(
                    f"A part of the upload does not stand at its end: {wrong}.",
                    code="PC-REC-003",
                    hint="Was the controller reset, or does somebody else write to it?",
                )
        touched |= part.items


def _take_back_after(link: Link, context: Context, group: Journal, error: PmacCompError) -> None:
    try:
        notes = _take_group_back(link, context, group)
    except PmacCompError as second:
        error.add_note(f"The parts before could not be taken back: {second.message}")
        mark_left(error, ControllerState.DISABLED, confirmed=False)
        return
    mark_left(error, ControllerState.OLD, confirmed=True)
    for note in notes:
        error.add_note(note)


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
        Tables act that nobody announced; they were switched off.
    """
    try:
        return _recover(link, context, resume=resume)
    except PmacCompError as error:
        if error.left is None:
            lost = isinstance(error, LinkError | ProtocolError)
            mark_left(error, ControllerState.DISABLED, confirmed=not lost)
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


def _recover(link: Link, context: Context, *, resume: bool) -> UploadResult:
    raise_all(lease_refusals(link, context), "The recovery")
    notes = take_off(link, context, whatever_stands=True)
    torn = [j for j in journals(context) if j.kind == ChangeKind.GROUP.value and j.is_open]
    if torn:
        result = _recover_group(link, context, torn)
    else:
        result = _recover_changes(link, context, resume=resume)
    release_lease(link, context)
    return replace(result, notes=(*result.notes, *notes))


def _recover_group(link: Link, context: Context, torn: Sequence[Journal]) -> UploadResult:
    """Take the torn upload back; with none of its parts begun there is nothing to do."""
    notes = _take_group_back(link, context, torn[-1])
    for older in torn[:-1]:
        older.write(ROLLED_BACK)
    note = notes or ("no part of the upload was begun",)
    return UploadResult(
        ControllerState.OLD, "upload", 0, 0, journal=torn[-1].path, notes=tuple(note)
    )


def _recover_changes(link: Link, context: Context, *, resume: bool) -> UploadResult:
    """Settle what is open of every kind; with nothing open say how the last change stands."""
    parts = [p for p in unsettled(context) if p.kind is not ChangeKind.TABLES]
    settled = [settle(link, context, part, resume=resume) for part in parts]
    known = parts_of(context)
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
    group, _ = upload_to_take_back(context)
    notes = _take_group_back(link, context, group)
    return UploadResult(ControllerState.OLD, "upload", 0, 0, journal=group.path, notes=tuple(notes))


def upload_to_take_back(context: Context) -> tuple[Journal, tuple[Part, ...]]:
    """The last upload and its parts that still stand, the last one first; ConfigError if none."""
    groups = [j for j in journals(context) if j.kind == ChangeKind.GROUP.value]
    if not groups or groups[-1].last(ROLLED_BACK) is not None:
        raise ConfigError(
            f"There is no upload in {context.store} that could be taken back.",
            code="PC-REC-001",
            hint="Name the folder of the upload with --journal.",
        )
    return groups[-1], _standing_parts(context, groups[-1])


def _standing_parts(context: Context, group: Journal) -> tuple[Part, ...]:
    parts = [p for p in parts_of(context) if p.journal.group == group.group]
    return tuple(p for p in reversed(parts) if p.closing != ROLLED_BACK)


def _take_group_back(link: Link, context: Context, group: Journal) -> Sequence[str]:
    """Take back every part, the last one first; may be repeated after an interruption."""
    alone = replace(context, group=0, stop_requested=never)
    notes: list[str] = []
    for part in _standing_parts(context, group):
        notes.append(take_back(link, alone, part))
        part.journal.write(ROLLED_BACK)
    group.write(ROLLED_BACK)
    return tuple(dict.fromkeys(notes))  # several parts may be of one kind
