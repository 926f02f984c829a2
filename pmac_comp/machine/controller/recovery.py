"""After an interruption: bring every kind of change to OLD or NEW, or take an upload back.

What lives here: which journals still matter, and the parts of an upload as one thing. How each
kind is settled lives with it (``table_recovery``, ``law_upload``, ``settings_upload``).
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

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
from pmac_comp.machine.controller.journal import Entry, Journal
from pmac_comp.machine.controller.law_bank import BLOCK_SIZE, LawParameters
from pmac_comp.machine.controller.law_state import read_bank, read_law_head
from pmac_comp.machine.controller.law_upload import decide_law, read_law_backup, restore_law
from pmac_comp.machine.controller.lease import host_lock, release_lease
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.programs import ProgramKind
from pmac_comp.machine.controller.safety import raise_all
from pmac_comp.machine.controller.settings import Settings, differences, read_settings
from pmac_comp.machine.controller.settings_upload import (
    TEMPORARY,
    finish_settings,
    lease_refusals,
    put_back,
    read_settings_backup,
    running_refusals,
    settings_state,
)
from pmac_comp.machine.controller.table_recovery import (
    recover_tables,
    rollback_tables,
    tables_state,
)
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


@dataclass(frozen=True)
class Part:
    """A change that got as far as its intent."""

    journal: Journal
    kind: ChangeKind
    intent: Entry

    @property
    def closing(self) -> str:
        """Last step of the journal."""
        return self.journal.entries()[-1].step

    @property
    def new_settings(self) -> Settings:
        """What a change of settings meant."""
        return Settings.from_dict(self.intent.data["new"])

    @property
    def crc_of_law(self) -> int:
        """Checksum of the law that was meant, 0 for none."""
        values = self.intent.data["values"]
        if not isinstance(values, list):
            return 0
        return LawParameters.from_values([float(v) for v in values]).digest

    @property
    def items(self) -> set[object]:
        """What it touches: two changes with a common item exclude each other."""
        if self.kind is not ChangeKind.SETTINGS:
            return {self.kind}
        new = self.new_settings
        return {*new.variables, *new.definitions, *new.programs} | (
            {"axes"} if new.axes is not None else set()
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
    return any(p.journal.group == group.group and p.closing == DONE for p in _parts(context))


def _require_whole(link: Link, context: Context, group: int) -> None:
    """Every part still stands at the end: a reset in between takes the first ones away."""
    touched: set[object] = set()
    for part in reversed([p for p in _parts(context) if p.journal.group == group]):
        # Some parts an upload can do without; such a one was taken back.
        if part.closing == DONE and not part.items & touched:
            wrong = _missing(link, context, part)
            if wrong:
                raise VerifyMismatch(
                    f"A part of the upload does not stand at its end: {wrong}.",
                    code="PC-REC-003",
                    hint="Was the controller reset, or does somebody else write to it?",
                )
        touched |= part.items


def _missing(link: Link, context: Context, part: Part) -> str:
    """What of a part does not stand, in words; empty if all of it does."""
    if part.kind is ChangeKind.TABLES:
        state, reason = tables_state(link, context, part.journal)
        return "" if state is ControllerState.NEW else reason
    if part.kind is ChangeKind.LAW:
        law = read_bank(link, context.block, read_law_head(link, context.block).bank)
        same = (0 if law is None else law.digest) == part.crc_of_law
        return "" if same else "the bank in use holds another law"
    new = part.new_settings
    if part.intent.data["skip_refused"]:
        # Of a backup of another firmware not everything can stand.
        new = replace(new, variables={}, definitions={}, axes=None)
    # Our own block is state: parts that follow change it, and so does the law itself.
    first = context.block.first
    ours = {f"P{n}" for n in range(first, first + BLOCK_SIZE)}
    kept = {name: text for name, text in new.variables.items() if name not in ours}
    new = replace(new, variables=kept)
    return "; ".join(differences(new, read_settings(link, new))[:3])


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
    open_parts = [f"a change of {p.kind.value} was interrupted" for p in _unsettled(context)]
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
    parts = [p for p in _unsettled(context) if p.kind is not ChangeKind.TABLES]
    settled = [_settle_part(link, context, part, resume=resume) for part in parts]
    known = _parts(context)
    last = next(iter(reversed(known)), None)
    together = [p for p in known if last is not None and p.journal.group == last.journal.group]
    alone = last is None or not last.journal.group or len(together) == 1
    tables = recover_tables(link, context, resume=resume, alone=alone)
    if settled and tables.verdict is not ControllerState.DISABLED:
        return replace(settled[0], notes=tuple(n for part in settled for n in part.notes))
    if last is not None and last.kind is not ChangeKind.TABLES and last.closing == DONE:
        return _standing(link, context, last)
    return tables


def _standing(link: Link, context: Context, part: Part) -> UploadResult:
    """How a finished change stands now: a reset without SAVE may have taken it away."""
    state, reason, crc_old, crc_new = _judge(link, context, part)
    if state is ControllerState.DISABLED:
        reason = f"something changed since the last upload: {reason}"
    return UploadResult(
        state, part.kind.value, crc_old, crc_new, journal=part.journal.path, notes=(reason,)
    )


def _parts(context: Context) -> list[Part]:
    """Changes with an intent, oldest first."""
    found = []
    for journal in journals(context):
        intent = journal.last("intent")
        lasting = intent is not None and not intent.data.get(TEMPORARY)
        if intent is not None and lasting and journal.kind != ChangeKind.GROUP.value:
            found.append(Part(journal, ChangeKind(journal.kind), intent))
    return found


def _unsettled(context: Context) -> list[Part]:
    """Open changes, newest first, that no later change of the same items has replaced."""
    found: list[Part] = []
    touched: set[object] = set()
    for part in reversed(_parts(context)):
        if part.journal.is_open and not part.items & touched:
            found.append(part)
        touched |= part.items
    return found


def _settle_part(link: Link, context: Context, part: Part, *, resume: bool) -> UploadResult:
    with host_lock(context):
        if part.kind is ChangeKind.LAW:
            return _settle_law(link, context, part, resume=resume)
        return _settle_settings(link, context, part, resume=resume)


def _judge(link: Link, context: Context, part: Part) -> tuple[ControllerState, str, int, int]:
    """State of a law or of settings, why, and both checksums."""
    backup = _backup(context, part)
    if part.kind is ChangeKind.LAW:
        old = read_law_backup(backup)
        crc_new = part.crc_of_law
        head = read_law_head(link, context.block)
        law = read_bank(link, context.block, head.bank)
        state = decide_law(0 if law is None else law.digest, old.crc, crc_new)
        return state, _LAW_REASONS[state], old.crc, crc_new
    before, new = read_settings_backup(backup), part.new_settings
    state, reason = settings_state(link, before, new)
    return state, reason, before.crc, new.crc


_LAW_REASONS = {
    ControllerState.OLD: "the old law is in use",
    ControllerState.NEW: "the new law is in use; arm it when the axis is ready",
    ControllerState.DISABLED: "the bank in use holds neither the old nor the new law",
}


def _settle_law(link: Link, context: Context, part: Part, *, resume: bool) -> UploadResult:
    state, reason, crc_old, crc_new = _judge(link, context, part)
    if not (state is ControllerState.NEW and resume):
        restore_law(link, context, read_law_backup(_backup(context, part)))
        state, reason = ControllerState.OLD, _LAW_REASONS[ControllerState.OLD]
    part.journal.write(DONE if state is ControllerState.NEW else ROLLED_BACK)
    return UploadResult(state, "law", crc_old, crc_new, journal=part.journal.path, notes=(reason,))


def _backup(context: Context, part: Part) -> Path:
    return context.store / Path(str(part.intent.data["backup"])).name


def _settle_settings(link: Link, context: Context, part: Part, *, resume: bool) -> UploadResult:
    new, tolerant = part.new_settings, bool(part.intent.data["skip_refused"])
    if any(kind is ProgramKind.PROG for kind, _ in new.programs):
        raise_all(running_refusals(link), "The recovery")
    # What follows would go into a buffer that the interruption left open.
    link.write_buffer(["CLOSE"])
    state, reason, crc_old, crc_new = _judge(link, context, part)
    if state is ControllerState.NEW and resume:
        finish_settings(link, new)
    else:
        old = read_settings_backup(_backup(context, part))
        state = put_back(link, old, skip_refused=tolerant)
        reason = "the old settings are back"
        if state is ControllerState.DISABLED:
            reason = "the old settings could not be written; the programs concerned are empty"
    part.journal.write(DONE if state is ControllerState.NEW else ROLLED_BACK)
    return UploadResult(
        state, "settings", crc_old, crc_new, journal=part.journal.path, notes=(reason,)
    )


# Taking a whole upload back -----------------------------------------------------------------------


def rollback_last(link: Link, context: Context) -> UploadResult:
    """Take the last upload back, all parts of it.

    Raises
    ------
    ConfigError
        There is none in this folder, or it was taken back already.
    """
    groups = [j for j in journals(context) if j.kind == ChangeKind.GROUP.value]
    if not groups or groups[-1].last(ROLLED_BACK) is not None:
        raise ConfigError(
            f"There is no upload in {context.store} that could be taken back.",
            code="PC-REC-001",
            hint="Name the folder of the upload with --journal.",
        )
    notes = _take_group_back(link, context, groups[-1])
    return UploadResult(
        ControllerState.OLD, "upload", 0, 0, journal=groups[-1].path, notes=tuple(notes)
    )


def _take_group_back(link: Link, context: Context, group: Journal) -> Sequence[str]:
    """Take back every part, the last one first; may be repeated after an interruption."""
    number = group.group
    alone = replace(context, group=0, stop_requested=never)
    notes: list[str] = []
    for part in reversed([p for p in _parts(context) if p.journal.group == number]):
        if part.closing == ROLLED_BACK:
            continue
        notes.append(_take_part_back(link, alone, part))
        part.journal.write(ROLLED_BACK)
    group.write(ROLLED_BACK)
    return tuple(dict.fromkeys(notes))  # several parts may be of one kind


def _take_part_back(link: Link, context: Context, part: Part) -> str:
    backup = _backup(context, part)
    if part.kind is ChangeKind.TABLES:
        rollback_tables(link, context, backup)
        return "the old tables are back"
    if part.kind is ChangeKind.LAW:
        with host_lock(context):
            restore_law(link, context, read_law_backup(backup))
        return "the old law is back"
    _settle_part(link, context, part, resume=False)
    return "the old settings and programs are back"
