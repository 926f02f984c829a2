"""Tables after an interruption: to OLD or NEW, or back to a backup."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from pmac_comp.base.errors import (
    ConfigError,
    ControllerState,
    ForeignChange,
    SafetyRefusal,
    UploadIncomplete,
)
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journal import Journal
from pmac_comp.machine.controller.change.journals import (
    DONE,
    KEPT,
    ROLLED_BACK,
    ChangeKind,
    journals,
)
from pmac_comp.machine.controller.change.lease import (
    host_lock,
    read_clock,
    refuse_foreign_lease,
    release_lease,
)
from pmac_comp.machine.controller.change.manifest import Action, Manifest, ManifestState, end_lines
from pmac_comp.machine.controller.change.transaction import UploadResult
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.contents.table_set import Key, TableSet, read_tables
from pmac_comp.machine.controller.tables.bumpless import switch_refusals
from pmac_comp.machine.controller.tables.table_files import read_table_backup, table_from_json
from pmac_comp.machine.controller.tables.table_status import (
    TableStatus,
    announced_elsewhere,
    read_head,
    table_status,
)
from pmac_comp.machine.controller.tables.upload import Origin, TableUpload

FOREIGN_TABLES: Final = "PC-UPL-060"


@dataclass(frozen=True)
class Uploaded:
    """What stood after an upload, whole, and which of it the upload was asked for.

    A table that was asked for and stood already came with it all the same: a reset that took the
    upload took that, too.
    """

    tables: TableSet
    asked: tuple[Key, ...] = ()

    def changed(self, old: TableSet) -> set[Key]:
        """Which tables the upload put on, put others in the place of, or took off."""
        keys = {(t.kind, t.motor) for t in (*old, *self.tables)}
        return {key for key in keys if old.get(*key) != self.tables.get(*key)}


@dataclass(frozen=True)
class Unfinished:
    """A transaction that was begun and not finished, from its journal."""

    journal: Journal
    manifest: Manifest
    backup: Path
    new: TableSet
    enable_after: bool
    old: TableSet
    is_rollback: bool
    i30: int | None  # before it; not known of an older version's journal

    @property
    def is_undoing(self) -> bool:
        """Whether it only brings back what stood before itself."""
        return self.manifest.crc_old == self.manifest.crc_new

    @property
    def was_taken_back(self) -> bool:
        """Whether this upload ended with what stood before it."""
        return not self.is_rollback and self.journal.last_step == ROLLED_BACK

    @property
    def was_kept(self) -> bool:
        """Whether somebody closed it as it stood."""
        return self.journal.last_step == KEPT

    @property
    def expected(self) -> Manifest:
        """Manifest as it should stand on the card; a finished upload was sealed."""
        if self.journal.is_open:
            return self.manifest
        return replace(self.manifest, state=ManifestState.VALID)


def latest_journal(context: Context) -> Journal | None:
    """Journal of the last upload of tables to this controller from this folder."""
    found = (j for j in reversed(journals(context)) if j.kind == ChangeKind.TABLES.value)
    return next(found, None)


def last_upload(context: Context) -> Unfinished | None:
    """The last upload of tables that got as far as its intent, ended or not."""
    journal = latest_journal(context)
    if journal is None or journal.last("intent") is None:
        return None
    return _unfinished(context, journal)


def _damaged(journal: Journal, what: str) -> ConfigError:
    return ConfigError(
        f"{journal.path} holds no {what}.",
        code="PC-UPL-011",
        hint="The journal was changed or damaged. `pmac-comp status` shows what stands; restore a "
        "backup, or take what stands with `pmac-comp recover --keep`.",
    )


def _unfinished(context: Context, journal: Journal) -> Unfinished:
    entry = journal.last("intent")
    if entry is None:
        raise _damaged(journal, "intent")
    values = entry.data["manifest"]
    manifest = Manifest.from_values([float(v) for v in values])  # type: ignore[attr-defined]
    if manifest is None:
        raise _damaged(journal, "manifest")
    backup = context.store / Path(str(entry.data["backup"])).name
    tables = [table_from_json(t) for t in entry.data["new"]]  # type: ignore[attr-defined]
    old, _ = read_table_backup(backup)
    return Unfinished(
        journal,
        manifest,
        backup,
        TableSet(tuple(tables)),
        bool(entry.data["enable_after"]),
        old,
        is_rollback=entry.data["closing"] == ROLLED_BACK,
        i30=int(str(entry.data["i30"])) if "i30" in entry.data else None,
    )


def status_by_journal(link: Link, context: Context) -> TableStatus:
    """State of the tables as ``recover`` judges it, where the last change of them was an upload.

    A reset brings an older manifest with older tables, which the card alone cannot tell.
    """
    try:
        last = last_upload(context)
    except (ConfigError, OSError):
        last = None  # damaged: `left_open` says so
    if last is None or last.is_rollback or last.was_taken_back or last.was_kept:
        return table_status(link, context)
    return table_status(link, context, journal_manifest=last.expected)


def tables_state(link: Link, context: Context, journal: Journal) -> tuple[ControllerState, str]:
    """How the tables of one upload stand."""
    last = _unfinished(context, journal)
    status = table_status(link, context, journal_manifest=last.expected)
    if _is_removed(last, status):
        return ControllerState.NEW, "the tables are removed"
    return status.decision.state, status.decision.reason


def recover_tables(
    link: Link, context: Context, *, resume: bool = True, alone: bool = True, since: int = 0
) -> UploadResult:
    """Bring an interrupted upload of tables to OLD or NEW; see ``recovery.recover``.

    Parameters
    ----------
    link, context
        Conversation and limits.
    resume : bool
        Finish what stands whole.
    alone : bool
        Whether the tables of a finished upload make sense without its other parts, so that they
        may be written again after a reset without SAVE.
    since : int
        Number of a change of another folder or host behind the last one of this folder, 0 for none:
        what has ended here is not written over it.
    """
    with host_lock(context):
        last = last_upload(context)
        if last is not None and last.was_kept:
            return _as_kept(link, context, last)
        manifest = None if last is None else last.expected
        status = table_status(link, context, journal_manifest=manifest)
        _settle_lease(link, context)
        if status.decision.action is Action.DISABLE:
            return _of_others(link, context, last, status)
        stands = status.decision.action is Action.NOTHING or _is_removed(last, status)
        if stands and not _is_undone(last, status):
            return _settled(link, context, last, status)
    if last is None:
        raise UploadIncomplete(
            "Tables are switched off and no journal of this folder knows the upload.",
            code="PC-UPL-013",
            hint="Run recover where the upload was started, or restore a backup.",
            left=ControllerState.DISABLED,
        )
    if since and not last.journal.is_open:
        release_lease(link, context)
        note = (
            f"another folder or host has changed the controller since (number {since}): nothing "
            "was left open here, and nothing was written over that"
        )
        crc = status.tables.crc
        return UploadResult(status.decision.state, "table", crc, crc, notes=(note,))
    was_switched_off = status.decision.action is Action.RESUME and not last.journal.is_open
    result = _brought_about(link, context, last, status, resume=resume, alone=alone)
    if was_switched_off and result.verdict is ControllerState.NEW:
        return replace(result, notes=(*result.notes, "its tables were switched off and act again"))
    return result


def _brought_about(
    link: Link,
    context: Context,
    last: Unfinished,
    status: TableStatus,
    *,
    resume: bool,
    alone: bool,
) -> UploadResult:
    """What an upload or a rollback meant, or what stood before it; see ``recover_tables``."""
    if last.is_rollback and (not last.is_undoing or _is_undone(last, status)):
        return _finish(link, context, last, last.new, enable=last.enable_after)
    if not (alone or last.journal.is_open or status.decision.action is Action.RESUME):
        release_lease(link, context)
        what = "what stood before the last upload" if last.was_taken_back else "the upload"
        note = f"{what} is not on the controller any more (a reset without SAVE): upload it again"
        crc = status.tables.crc
        return UploadResult(
            ControllerState.DISABLED, "table", last.manifest.crc_old, crc, notes=(note,)
        )
    # A finished upload that is gone was lost in a reset without SAVE: it is written again.
    whole = status.decision.action is Action.RESUME or not last.journal.is_open
    if resume and whole and last.enable_after and not last.was_taken_back:
        return _finish(link, context, last, last.new, enable=True)
    return _finish(link, context, last, last.old, enable=bool(last.manifest.enabled_old))


def _of_others(
    link: Link, context: Context, last: Unfinished | None, status: TableStatus
) -> UploadResult:
    """Tables that are neither the old nor the new ones: of another bench file, or switched off."""
    waits = last is not None and last.journal.is_open
    other = None if waits else announced_elsewhere(link, context, status.tables)
    if other is not None:
        release_lease(link, context)
        crc = status.tables.crc
        return UploadResult(other.state, "table", crc, crc, notes=(other.reason,))
    _require_bumpless(link, context, status.tables)
    link.command("I51=0")
    raise ForeignChange(
        f"{status.decision.reason.capitalize()}; compensation was switched off.",
        code="PC-UPL-012",
        hint="Compare with a backup, then `pmac-comp rollback` or upload again.",
        left=ControllerState.DISABLED,
    )


def _require_bumpless(link: Link, context: Context, tables: TableSet) -> None:
    """Foreign tables are not switched off under a moving axis, nor where it would jump."""
    refusals = switch_refusals(link, context.limits, tables, on=False)
    try:
        raise_all(refusals, "Switching off tables that nobody announced")
    except SafetyRefusal as error:
        error.left = ControllerState.DISABLED
        error.context["confirmed"] = False
        error.hint = (
            f"{error.hint} They still act, though neither the old nor the new ones: "
            "then run `pmac-comp recover` again."
        ).strip()
        raise


def _is_removed(last: Unfinished | None, status: TableStatus) -> bool:
    """Whether the upload was meant to end switched off, and did."""
    if last is None or last.enable_after or status.i51:
        return False
    return status.tables.crc == last.manifest.crc_new


def _as_kept(link: Link, context: Context, last: Unfinished) -> UploadResult:
    """What somebody kept as it stood is looked at and left alone."""
    _settle_lease(link, context)
    status = table_status(link, context, journal_manifest=last.manifest)
    release_lease(link, context)
    note = f"nothing was left open, what stands was kept: {status.decision.reason}"
    crc = status.tables.crc
    return UploadResult(status.decision.state, "table", crc, crc, notes=(note,))


def _is_undone(last: Unfinished | None, status: TableStatus) -> bool:
    """Whether a rollback ended and its tables were switched off, or lost, since.

    Its own beginning may have been such: that it looks so again is not that it was never begun.
    """
    if last is None or not last.is_rollback or last.journal.is_open:
        return False
    return last.enable_after and bool(last.new) and not (status.i51 and status.tables.crc)


def _settle_lease(link: Link, context: Context) -> None:
    head = read_head(link, context)
    refusal = refuse_foreign_lease(head.lease, context.owner, read_clock(link))
    if refusal is not None:
        raise refusal


def _settled(
    link: Link, context: Context, last: Unfinished | None, status: TableStatus
) -> UploadResult:
    """Nothing is to be done: close the journal and say what stands there."""
    release_lease(link, context)
    crc, reason = status.tables.crc, status.decision.reason
    journal = latest_journal(context)
    if last is None:
        was_rollback = False
        if journal is not None and journal.is_open:
            begin = journal.first()
            was_rollback = begin is not None and begin.data.get("closing") == ROLLED_BACK
            journal.write(ROLLED_BACK)
        if was_rollback and status.decision.state is ControllerState.NEW:
            note = (f"the rollback was not begun: {reason}",)
            return UploadResult(ControllerState.NEW, "table", crc, crc, notes=note)
        return UploadResult(ControllerState.OLD, "table", crc, crc, notes=(reason,))
    state = ControllerState.NEW if _is_removed(last, status) else status.decision.state
    untouched = state is ControllerState.OLD
    if last.is_rollback:
        untouched = state is ControllerState.OLD and not last.is_undoing
        acts_again = bool(status.i51 and crc) and crc not in {
            last.manifest.crc_old,
            last.manifest.crc_new,
        }
        untouched = untouched or acts_again
        state = ControllerState.NEW if untouched else ControllerState.OLD
        if untouched and last.journal.is_open:
            reason = "the rollback was not begun: the uploaded tables act"
        elif untouched:
            reason = "the upload that was taken back acts again: it had been saved before that"
        elif not last.journal.is_open:
            reason = "nothing was left open: the last upload was taken back"
    if last.journal.is_open:
        if untouched or state is ControllerState.OLD:
            # The guard would switch tables off that stand beside a manifest of a beginning.
            i30 = [] if last.i30 is None else [f"I30={last.i30}"]
            link.write_buffer([*end_lines(context.block, crc), *i30])
        last.journal.write(DONE if state is ControllerState.NEW else ROLLED_BACK)
    return UploadResult(
        state, "table", last.manifest.crc_old, crc, journal=last.journal.path, notes=(reason,)
    )


def _finish(
    link: Link, context: Context, unfinished: Unfinished, goal: TableSet, *, enable: bool
) -> UploadResult:
    """Go on with the interrupted upload towards a set that was checked before."""
    origin = Origin(
        unfinished.journal,
        unfinished.backup,
        unfinished.manifest.crc_old,
        unfinished.manifest.enabled_old,
    )
    is_rollback = unfinished.is_rollback or goal.crc == unfinished.manifest.crc_old
    with TableUpload(
        link,
        context,
        exactly=goal,
        enable_after=enable,
        check_limits=False,
        origin=origin,
        closing=ROLLED_BACK if is_rollback else DONE,
        i30=unfinished.i30 if unfinished.journal.is_open else None,
    ) as upload:
        result = upload.execute()
    if is_rollback:
        link.write_buffer(end_lines(context.block, goal.crc))
    return UploadResult(
        ControllerState.OLD if is_rollback else ControllerState.NEW,
        "table",
        origin.crc_old,
        goal.crc,
        result.disabled_s,
        origin.backup,
        origin.journal.path,
        ("the old tables were written back" if is_rollback else "the upload was completed",),
    )


def rollback_tables(
    link: Link, context: Context, backup: Path, uploaded: Uploaded | None = None
) -> UploadResult:
    """Write the tables of a backup back, with the switch as it was then.

    Parameters
    ----------
    link, context
        Conversation and limits.
    backup : Path
        What stood before an upload.
    uploaded : Uploaded, optional
        What stood after it. Then tables that it did not touch stay as they are now: the
        compensation of another axis may have changed since.
    """
    rollback = _rollback_of(link, context, backup, uploaded)
    with rollback as upload:
        result = upload.execute()
    link.write_buffer(end_lines(context.block, result.crc_new))
    return UploadResult(
        ControllerState.OLD,
        "table",
        result.crc_old,
        result.crc_new,
        result.disabled_s,
        result.backup,
        result.journal,
        (f"tables of {backup.name} are back",),
    )


def rollback_refusals(
    link: Link, context: Context, backup: Path, uploaded: Uploaded | None = None
) -> list[SafetyRefusal]:
    """What forbids ``rollback_tables`` as motors and tables stand now; nothing is changed."""
    return list(_rollback_of(link, context, backup, uploaded).prepare().refusals)


def _rollback_of(
    link: Link, context: Context, backup: Path, uploaded: Uploaded | None
) -> TableUpload:
    tables, enabled = read_table_backup(backup)
    if uploaded is not None:
        tables, enabled = _with_others_as_now(link, context, tables, uploaded, enabled=enabled)
    last = last_upload(context)
    return TableUpload(
        link,
        context,
        exactly=tables,
        enable_after=enabled,
        check_limits=False,
        closing=ROLLED_BACK,
        i30=None if last is None or not last.journal.is_open else last.i30,
    )


def _with_others_as_now(
    link: Link, context: Context, old: TableSet, whole: Uploaded, *, enabled: bool
) -> tuple[TableSet, bool]:
    """The old set where an upload changed it, and what stands now of all other tables."""
    last = last_upload(context)
    status = table_status(link, context)
    # Begun and cut, when not all of the others stand; or done, and cut before it was noted.
    undone = last is not None and (last.journal.is_open or status.tables.crc == last.new.crc)
    if last is not None and last.is_rollback and undone:
        return last.new, last.enable_after
    uploaded = whole.tables
    brought = [t for t in uploaded if old.get(t.kind, t.motor) != t]
    asked = [t for t in uploaded if (t.kind, t.motor) in whole.asked]
    if any(status.tables.get(t.kind, t.motor) != t for t in (*brought, *asked)):
        _refuse_unknown(status.tables, old, uploaded)
        return old, enabled  # a reset took them, and may have taken others
    replaced = [t for t in old if uploaded.get(t.kind, t.motor) != t]
    others = status.tables.with_tables((), without=whole.changed(old))
    strangers = any(old.get(t.kind, t.motor) is None for t in others)
    return others.with_tables(replaced), enabled or (strangers and bool(status.i51))


def require_known(link: Link, backup: Path, uploaded: TableSet) -> None:
    """Tables that neither stood before an upload nor came with it are not deleted with it.

    Where the upload still stands they stay; else a reset took it, and somebody has begun anew.

    Parameters
    ----------
    link : Link
        Conversation.
    backup : Path
        What stood before the upload.
    uploaded : TableSet
        What stood after it, whole.

    Raises
    ------
    ForeignChange
        The upload is gone and such tables stand; nothing was changed.
    """
    old, _ = read_table_backup(backup)
    present = read_tables(link)
    if any(present.get(t.kind, t.motor) != t for t in uploaded if old.get(t.kind, t.motor) != t):
        _refuse_unknown(present, old, uploaded)


def _refuse_unknown(present: TableSet, old: TableSet, uploaded: TableSet) -> None:
    known = {(t.kind, t.motor) for t in (*old, *uploaded)}
    unknown = [f"{t.kind.value} of motor #{t.motor}" for t in present
               if (t.kind, t.motor) not in known]  # fmt: skip
    if not unknown:
        return
    raise ForeignChange(
        "The tables of this upload do not stand any more (a reset without SAVE?), and somebody has "
        f"defined others since: {', '.join(unknown)}. They would be deleted.",
        code=FOREIGN_TABLES,
        hint="Nothing was taken back. Look at what stands (`pmac-comp status`, `backup`); what is "
        "not wanted is taken off by whoever put it on, or by `pmac-comp restore` of a backup.",
        left=ControllerState.DISABLED,
        context={"confirmed": True},
    )
