"""The upload of tables as a transaction: old, new or switched off, at every instant.

Order of steps: pre-flight, backup, intent, disable, write, read back, seal, enable. Before a
step the journal holds on the disk that it is going to be taken: one entry announces intent,
disable and write, the next seal and enable. How far it came is judged by what stands on the
controller. A line is never sent twice: a lost or repeated number shifts all later entries, so any
doubt ends in DISABLED and ``recover`` begins anew.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from pmac_comp.base.errors import (
    CommandRefused,
    ControllerState,
    ForeignChange,
    LeaseHeld,
    LinkError,
    ProtocolError,
    SafetyRefusal,
    StorageFull,
    VerifyMismatch,
)
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.variables import batches
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journal import Journal
from pmac_comp.machine.controller.change.journals import DONE, ROLLED_BACK, ChangeKind
from pmac_comp.machine.controller.change.manifest import (
    Action,
    Manifest,
    ManifestState,
    end_lines,
)
from pmac_comp.machine.controller.change.transaction import Change, UploadResult
from pmac_comp.machine.controller.change.verdict import mark_left
from pmac_comp.machine.controller.contents.comp_table import Table
from pmac_comp.machine.controller.contents.law_bank import Index
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.contents.table_set import (
    POINTERS_TEXT,
    Key,
    TableSet,
    keys_of,
    parse_pointers,
    read_tables,
    same_lookup,
)
from pmac_comp.machine.controller.motors.motors import (
    LONGEST_SPACING_s,
    PART_SPACING_s,
    QUICK_SPACING_s,
    Rest,
    Standstill,
    begin_standstill,
)
from pmac_comp.machine.controller.motors.switching import switch_tables, watch
from pmac_comp.machine.controller.tables.bumpless import step_refusals
from pmac_comp.machine.controller.tables.table_files import table_to_json, write_table_backup
from pmac_comp.machine.controller.tables.table_status import (
    HEAD_LINES,
    Head,
    head_text,
    parse_head,
    read_head,
    table_status,
)
from pmac_comp.machine.controller.tables.upload_checks import PACKET_BYTES, difference, not_at_rest
from pmac_comp.machine.controller.tables.upload_look import do_and_look
from pmac_comp.machine.controller.tables.upload_plan import UploadPlan, Wish, look

FRESH_s: Final = 5.0
ASKED: Final = "asked"  # in an intent: kind and motor of the tables that were to stand


@dataclass(frozen=True)
class Origin:
    """The interrupted upload that this one brings to its end.

    Its journal and its backup go on, and OLD keeps meaning what stood before it.
    """

    journal: Journal
    backup: Path
    crc_old: int
    enabled_old: int


class TableUpload:
    """One upload of tables: ``prepare`` looks, ``execute`` does it, ``with`` holds the locks.

    Parameters
    ----------
    link : Link
        Conversation; nobody else should use it meanwhile.
    context : Context
        Limits, folder, block.
    tables : sequence of Table
        New tables; they replace tables of the same kind and motor.
    without : sequence of (TableKind, int)
        Tables to remove.
    route : str
        For the result: ``table`` or ``cam``.
    exactly : TableSet or None
        Complete new set instead of a change (rollback).
    enable_after : bool
        Whether tables act at the end; False only to restore a set that was off. An upload that
        only takes tables off leaves the switch as it was, and off where none is left.
    check_limits : bool
        False only to restore what was there before.
    origin : Origin or None
        Interrupted upload that is finished or rolled back by this one.
    closing : str
        Last entry of the journal: ``done`` or ``rolled back``.
    i30 : int or None
        I30 as it stood before an upload that was interrupted; as it stands now if None.
    """

    def __init__(
        self,
        link: Link,
        context: Context,
        tables: Sequence[Table] = (),
        *,
        without: Sequence[Key] = (),
        route: str = "table",
        exactly: TableSet | None = None,
        enable_after: bool = True,
        check_limits: bool = True,
        origin: Origin | None = None,
        closing: str = DONE,
        i30: int | None = None,
    ) -> None:
        self.link = link
        self.context = context
        self.route = route
        self._wish = Wish(
            TableSet(tuple(tables)),
            tuple(without),
            exactly,
            enable_after=enable_after,
            check_limits=check_limits,
        )
        self._origin = origin
        self._closing = closing
        self._change = Change(
            link, context, ChangeKind.TABLES, None if origin is None else origin.journal
        )
        self._plan: UploadPlan | None = None
        self._prepared_s = 0.0
        self._i30_before = i30
        self._i30 = 0
        self._looks: tuple[Standstill | None, ...] = ()
        self._rest: Rest | None = None
        self._pointers: tuple[int, ...] = ()
        self._disabled_at_s: float | None = None
        self._disabled_s = 0.0

    def __enter__(self) -> Self:
        self._change.__enter__()
        return self

    def __exit__(self, *failure: object) -> None:
        self._change.__exit__(*failure)

    def prepare(self) -> UploadPlan:
        """Pre-flight: everything that can be known before anything is changed.

        Returns
        -------
        UploadPlan
            With all refusals; ``execute`` raises them together.
        """
        return self._look(to_the_end=True)

    def _look(self, *, to_the_end: bool) -> UploadPlan:
        with self._change.explained():
            found = look(
                self.link,
                self.context,
                self._wish,
                to_the_end=to_the_end,
                meanwhile=self._change.look_into_folder,
            )
        self._plan = found.plan
        self._i30 = found.head.i30 if self._i30_before is None else self._i30_before
        self._looks = (found.begun,)
        self._prepared_s = self.link.clock.now_s()
        return self._plan

    def execute(self) -> UploadResult:
        """Carry the plan out.

        Raises
        ------
        SafetyRefusal
            All refusals of the pre-flight together; nothing was changed.
        PmacCompError
            Anything that stopped it; ``left`` says in which state, ``context["confirmed"]``
            whether that was read back.
        """
        the_plan = self._fresh_plan()
        # What forbids an upload may come from a change that nobody ended. One that runs is told
        # together with all else.
        if the_plan.refusals and not any(isinstance(r, LeaseHeld) for r in the_plan.refusals):
            self._change.require_settled()
        try:
            raise_all(the_plan.refusals, "The upload")
        except SafetyRefusal as error:
            mark_left(error, ControllerState.OLD, confirmed=True)
            raise
        change = self._change
        with change.explained():
            change.begin({"closing": self._closing})
            backup = self._backup(the_plan)
            manifest = self._intend(the_plan, backup)
            self._disable(the_plan)
            self._write(the_plan)
            self._read_back(the_plan, manifest)
            self._seal(the_plan, manifest)
            if the_plan.enabled_new:
                self._enable(the_plan)
            change.finish(change.left, self._closing)
        return UploadResult(
            verdict=change.left,
            route=self.route,
            crc_old=the_plan.old.crc,
            crc_new=the_plan.new.crc,
            disabled_s=self._disabled_s,
            backup=backup,
            journal=change.journal.path,
            notes=the_plan.remarks,
        )

    def _fresh_plan(self) -> UploadPlan:
        age_s = self.link.clock.now_s() - self._prepared_s
        if self._plan is None or age_s > FRESH_s:
            before = self._plan
            # Drift is judged before the first switch, over all that lies between.
            again = self._look(to_the_end=False)
            if before is not None and before.old.crc != again.old.crc:
                raise ForeignChange(
                    "The tables changed since they were looked at.",
                    code="PC-UPL-001",
                    hint="Look at the plan again.",
                    left=ControllerState.OLD,
                )
            return again
        return self._plan

    def _backup(self, the_plan: UploadPlan) -> Path:
        if self._origin is not None:
            return self._origin.backup
        path = self._change.backup_path("tables")
        write_table_backup(path, the_plan.old, enabled=the_plan.enabled_old)
        return path

    def _intend(self, the_plan: UploadPlan, backup: Path) -> Manifest:
        origin = self._origin
        manifest = Manifest(
            state=ManifestState.WRITING,
            transaction=self._change.transaction,
            n_entries=the_plan.new.n_entries,
            crc_old=the_plan.old.crc if origin is None else origin.crc_old,
            crc_new=the_plan.new.crc,
            enabled_old=int(the_plan.enabled_old) if origin is None else origin.enabled_old,
        )
        self._change.step(
            "intent",
            {
                "manifest": list(manifest.values()),
                "backup": backup.name,
                "steps": ["manifest", "disable", "write", "read back"],
                "n_lines": len(the_plan.lines),
                "new": [table_to_json(t) for t in the_plan.new],
                ASKED: [[t.kind.value, t.motor] for t in self._wish.change],
                "enable_after": int(the_plan.enabled_new),
                "i30": self._i30,
                "closing": self._closing,
            },
        )
        self._change.settle = lambda: self._settle(manifest)
        found = do_and_look(
            self.link,
            self.context,
            manifest.lines(self.context.block),
            the_plan.motors,
            self._looks,
            spacing_s=PART_SPACING_s,
        )
        self._require_ours(found.head, manifest, int(the_plan.enabled_old))
        self._rest = found.rest
        raise_all(not_at_rest(found.reasons), "Switching off")
        return manifest

    def _settle(self, manifest: Manifest) -> ControllerState:
        """Look at what the controller was left with; tables that nobody meant are switched off."""
        status = table_status(self.link, self.context, journal_manifest=manifest)
        if status.decision.action is Action.DISABLE:
            self.link.command("I51=0")
        if status.decision.state is ControllerState.OLD:
            self.link.write_buffer(end_lines(self.context.block, status.tables.crc))
            # Between the look and the clearing the guard PLC may have switched off once more.
            if read_head(self.link, self.context).i51 != status.i51:
                return ControllerState.DISABLED
            if self._origin is None and self._closing == DONE:
                # A full disk leaves it open: `recover` then finds the same.
                with suppress(StorageFull):
                    self._change.step(ROLLED_BACK)
        return status.decision.state

    def _require_ours(self, head: Head, manifest: Manifest, i51: int) -> None:
        """Manifest, lease and I51 are as we left them; raises ForeignChange."""
        live = head.i51 and not i51
        if live:
            self.link.command("I51=0")
        found = head.manifest
        same = found is not None and found.transaction == manifest.transaction
        # Our manifest says WRITING, so the guard PLC may have switched the tables off already.
        guarded = bool(i51) and not head.i51
        if same and head.lease.owner == self.context.owner and (head.i51 == i51 or guarded):
            if guarded:
                self._change.left = ControllerState.DISABLED
            return
        what = "enabled the tables" if live else "changed the manifest, the lease or I51"
        raise ForeignChange(
            f"Another client {what} during the upload"
            + (": incomplete tables were live until now." if live else "."),
            code="PC-UPL-002",
            hint="Find out who writes to this controller, then run `pmac-comp recover`.",
            context={"was_live": bool(live)},
        )

    def _disable(self, the_plan: UploadPlan) -> None:
        self._change.may_go_on()
        self.context.progress("disable", 0, 1)
        # From here on the answer may be lost while the command acted.
        if the_plan.enabled_old:
            self._change.left = ControllerState.DISABLED
        self._disabled_at_s = self.link.clock.now_s()
        look = switch_tables(self.link, 0, the_plan.motors)
        if look is not None and self._rest is not None:
            look = self._rest.goes_on(look)
        self._looks = (look,)
        self._change.left = ControllerState.DISABLED

    def _write(self, the_plan: UploadPlan) -> None:
        lines = ["DELETE GATHER", *the_plan.lines, f"I30={self._i30}"]
        parts = list(batches(lines, PACKET_BYTES))
        for k, packet in enumerate(parts):
            self._change.keep_lease()
            try:
                self.link.write_buffer(packet)
            except CommandRefused:
                self._switch_back(the_plan)
                raise
            self.context.progress("write", k + 1, len(parts))
        look = next(iter(self._looks), None)
        if look is None or self.link.clock.now_s() - look.at_s > 0.5 * LONGEST_SPACING_s:
            # The look while switching off is too old by then: another first one.
            self._looks += (begin_standstill(self.link, the_plan.motors),)

    def _switch_back(self, the_plan: UploadPlan) -> None:
        """After a refused line: if the old tables still stand whole, let them act again."""
        if the_plan.enabled_old and read_tables(self.link).crc == the_plan.old.crc:
            # While the manifest says WRITING the guard PLC holds the tables off.
            ended = end_lines(self.context.block, the_plan.old.crc)
            self.link.write_buffer([*ended, f"I30={self._i30}"])
            switch_tables(self.link, 1, the_plan.motors)

    def _read_back(self, the_plan: UploadPlan, manifest: Manifest) -> None:
        self.context.progress("read back", 0, 1)
        lines = self.link.query(head_text(self.context) + POINTERS_TEXT)
        self._require_ours(parse_head(lines[:HEAD_LINES]), manifest, 0)
        self._pointers = parse_pointers(lines[HEAD_LINES:])
        found = read_tables(self.link, keys_of(self._pointers), the_plan.new)
        if found.crc != the_plan.new.crc or not same_lookup(the_plan.new, found):
            raise VerifyMismatch(
                f"The tables on the controller are not those that were sent: "
                f"{difference(the_plan.new, found)}.",
                code="PC-UPL-006",
                hint="`pmac-comp recover` writes the old tables back; then try again.",
            )
        self.context.progress("read back", 1, 1)

    def _seal(self, the_plan: UploadPlan, manifest: Manifest) -> None:
        """Call the new tables whole; if they are to act, look whether they may."""
        acting = the_plan.enabled_new
        self._change.step("seal", {"steps": ["seal", "enable"] if acting else ["seal"]})
        state = self.context.block.p(Index.MANIFEST) + 1
        found = do_and_look(
            self.link,
            self.context,
            [f"P{state}={int(ManifestState.VALID)}"],
            the_plan.motors if acting else (),
            self._looks,
            spacing_s=QUICK_SPACING_s,
            behind=POINTERS_TEXT,
        )
        self._require_ours(found.head, manifest, 0)
        if found.head.manifest is None or found.head.manifest.state is not ManifestState.VALID:
            raise VerifyMismatch(
                "The manifest could not be sealed.",
                code="PC-UPL-007",
                hint="Something else writes the P-variables of p_block: find it, or choose another "
                "p_block in the bench file; `pmac-comp recover` settles this upload.",
            )
        refusals = not_at_rest(found.reasons)
        readings = {} if found.rest is None else found.rest.readings
        if acting:
            limits = self.context.limits
            refusals += step_refusals(self.link, limits, readings, TableSet(), the_plan.new)
        raise_all(refusals, "Enabling")
        if parse_pointers(found.behind) != self._pointers:
            raise ForeignChange(
                "Another client defined or deleted a table after the read-back.",
                code="PC-UPL-002",
                hint="Find out who writes to this controller, then run `pmac-comp recover`.",
                context={"was_live": False},
            )

    def _enable(self, the_plan: UploadPlan) -> None:
        self._change.may_go_on()
        self.context.progress("enable", 0, 1)
        try:
            switch_tables(self.link, 1, the_plan.motors)
        except (LinkError, ProtocolError):
            self._change.left = ControllerState.NEW  # sent once; unconfirmed
            raise
        if self._disabled_at_s is not None:
            self._disabled_s = self.link.clock.now_s() - self._disabled_at_s
        self._change.left = ControllerState.NEW
        watch(self.link, self.context, the_plan.motors)
        self.context.progress("enable", 1, 1)


def upload_tables(link: Link, context: Context, tables: Sequence[Table]) -> UploadResult:
    """Upload tables in one call; see ``TableUpload.execute`` for the errors."""
    with TableUpload(link, context, tables) as upload:
        return upload.execute()


def remove_tables(link: Link, context: Context, keys: Sequence[Key]) -> UploadResult:
    """Take tables off; those that remain act if tables acted before.

    With none left the switch is off (I51 = 0). Errors are those of ``TableUpload.execute``.
    """
    with TableUpload(link, context, without=keys, check_limits=False) as upload:
        return upload.execute()
