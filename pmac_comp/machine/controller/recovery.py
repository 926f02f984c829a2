"""After an interruption: bring the controller to OLD or NEW, or back to a backup."""

from dataclasses import dataclass
from pathlib import Path

from pmac_comp.base.errors import (
    ConfigError,
    ControllerState,
    ForeignChange,
    UploadIncomplete,
)
from pmac_comp.machine.controller.journal import Journal
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.manifest import Action, Manifest, clear_lines
from pmac_comp.machine.controller.table_files import read_table_backup, table_from_json
from pmac_comp.machine.controller.table_set import TableSet
from pmac_comp.machine.controller.transaction import (
    Context,
    UploadResult,
    host_lock,
    read_clock,
    refuse_foreign_lease,
    release_lease,
)
from pmac_comp.machine.controller.upload import (
    TableStatus,
    TableUpload,
    read_head,
    table_status,
)


@dataclass(frozen=True)
class Unfinished:
    """A transaction that was begun and not finished, from its journal."""

    journal: Journal
    manifest: Manifest
    backup: Path
    new: TableSet
    enable_after: bool
    old: TableSet


def find_unfinished(context: Context) -> Unfinished | None:
    """Latest open journal of this controller."""
    paths = sorted(
        context.store.glob(f"{context.controller}-*.journal"), key=lambda p: p.stat().st_mtime_ns
    )
    for path in reversed(paths):
        journal = Journal(path)
        entry = journal.last("intent")
        if entry is not None and "manifest" in entry.data and journal.is_open:
            return _unfinished(context, journal)
    return None


def _unfinished(context: Context, journal: Journal) -> Unfinished:
    entry = journal.last("intent")
    if entry is None:
        raise ConfigError(f"{journal.path} holds no intent.", code="PC-UPL-011")
    values = entry.data["manifest"]
    manifest = Manifest.from_values([float(v) for v in values])  # type: ignore[attr-defined]
    if manifest is None:
        raise ConfigError(f"{journal.path} holds no manifest.", code="PC-UPL-011")
    backup = context.store / Path(str(entry.data["backup"])).name
    tables = [table_from_json(t) for t in entry.data["new"]]  # type: ignore[attr-defined]
    old, _ = read_table_backup(backup)
    return Unfinished(
        journal, manifest, backup, TableSet(tuple(tables)), bool(entry.data["enable_after"]), old
    )


def recover(link: Link, context: Context, *, resume: bool = True) -> UploadResult:
    """Bring an interrupted upload to OLD or NEW.

    Parameters
    ----------
    link, context
        Conversation and limits.
    resume : bool
        Enable new tables that stand whole; otherwise write the old ones back.

    Returns
    -------
    UploadResult
        OLD or NEW; DISABLED only if the old state was "no tables".

    Raises
    ------
    ForeignChange
        Tables act that nobody announced; they were switched off.
    """
    with host_lock(context):
        unfinished = find_unfinished(context)
        status = table_status(
            link, context, journal_manifest=unfinished.manifest if unfinished else None
        )
        _settle_lease(link, context)
        if status.decision.action is Action.DISABLE:
            link.command("I51=0")
            raise ForeignChange(
                f"{status.decision.reason.capitalize()}; compensation was switched off.",
                code="PC-UPL-012",
                hint="Compare with a backup, then `pmac-comp rollback` or upload again.",
                left=ControllerState.DISABLED,
            )
        if status.decision.action is Action.NOTHING:
            return _settled(link, context, unfinished, status)
    if unfinished is None:
        raise UploadIncomplete(
            "Tables are switched off and no journal of this folder knows the upload.",
            code="PC-UPL-013",
            hint="Run recover where the upload was started, or restore a backup.",
            left=ControllerState.DISABLED,
        )
    if resume and status.decision.action is Action.RESUME and unfinished.enable_after:
        return _finish(link, context, unfinished, unfinished.new, enable=True)
    return _finish(
        link, context, unfinished, unfinished.old, enable=bool(unfinished.manifest.enabled_old)
    )


def _settle_lease(link: Link, context: Context) -> None:
    head = read_head(link, context)
    refusal = refuse_foreign_lease(head.lease, context.owner, read_clock(link))
    if refusal is not None:
        raise refusal


def _settled(
    link: Link, context: Context, unfinished: Unfinished | None, status: TableStatus
) -> UploadResult:
    release_lease(link, context)
    state = status.decision.state
    if state is ControllerState.OLD and status.manifest is not None:
        link.write_buffer(clear_lines(context.block))
    if unfinished is not None:
        unfinished.journal.write("done" if state is ControllerState.NEW else "rolled back")
    crc = status.tables.crc
    old = unfinished.manifest.crc_old if unfinished else crc
    return UploadResult(state, "table", old, crc, notes=(status.decision.reason,))


def _finish(
    link: Link, context: Context, unfinished: Unfinished, goal: TableSet, *, enable: bool
) -> UploadResult:
    """A transaction of its own towards a set that was checked before."""
    with TableUpload(
        link, context, exactly=goal, enable_after=enable, check_limits=False
    ) as upload:
        result = upload.execute()
    rolled_back = goal.crc == unfinished.manifest.crc_old
    unfinished.journal.write("rolled back" if rolled_back else "done")
    if rolled_back:
        link.write_buffer(clear_lines(context.block))
    verdict = ControllerState.OLD if rolled_back else ControllerState.NEW
    return UploadResult(
        verdict,
        "table",
        unfinished.manifest.crc_old,
        goal.crc,
        result.disabled_s,
        result.backup,
        result.journal,
        ("the old tables were written back" if rolled_back else "the upload was completed",),
    )


def rollback(link: Link, context: Context, backup: Path) -> UploadResult:
    """Write the tables of a backup back, with the switch as it was then."""
    tables, enabled = read_table_backup(backup)
    with TableUpload(
        link, context, exactly=tables, enable_after=enabled, check_limits=False
    ) as upload:
        result = upload.execute()
    link.write_buffer(clear_lines(context.block))
    return UploadResult(
        ControllerState.OLD,
        "table",
        result.crc_old,
        tables.crc,
        result.disabled_s,
        result.backup,
        result.journal,
        (f"tables of {backup.name} are back",),
    )
