"""The upload of tables as a transaction: old, new or switched off, at every instant.

Order of steps: pre-flight, backup, intent, disable, write, read back, seal, enable, persist. Every
journal entry is synced before its step. A line is never sent twice: a lost or repeated number
shifts all later entries, so any doubt ends in DISABLED and ``recover`` begins anew.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import (
    CommandRefused,
    ControllerState,
    ForeignChange,
    LinkError,
    MotorNotSafe,
    PmacCompError,
    ProtocolError,
    SafetyRefusal,
    UploadIncomplete,
    VerifyMismatch,
)
from pmac_comp.machine.controller.comp_table import (
    Table,
)
from pmac_comp.machine.controller.journal import Journal
from pmac_comp.machine.controller.law_bank import Index
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.manifest import (
    Action,
    Manifest,
    ManifestState,
    clear_lines,
)
from pmac_comp.machine.controller.motors import (
    MotorReading,
    MotorStatus,
    read_motors,
)
from pmac_comp.machine.controller.safety import check_step, check_table, raise_all
from pmac_comp.machine.controller.table_files import table_to_json, write_table_backup
from pmac_comp.machine.controller.table_set import (
    Key,
    TableSet,
    keys_of,
    plan,
    read_pointers,
    read_tables,
    with_lookup,
)
from pmac_comp.machine.controller.table_status import (
    Head,
    read_head,
    table_status,
)
from pmac_comp.machine.controller.transaction import (
    Context,
    UploadResult,
    host_lock,
    mark_left,
    new_transaction_id,
    open_journal,
    read_clock,
    refuse_foreign_lease,
    release_lease,
    take_lease,
)
from pmac_comp.machine.controller.upload_checks import (
    buffer_refusals,
    difference,
    largest_change_ct,
    memory_refusals,
    motion_refusals,
    packets,
)
from pmac_comp.machine.wire.numbers import read_number

WATCH_CYCLES: Final = 100
WATCH_POLLS: Final = 4
FRESH_s: Final = 5.0
SAVE_TIMEOUT_s: Final = 15.0


@dataclass(frozen=True)
class UploadPlan:
    """What an upload would do, for a person to look at before it is done.

    Parameters
    ----------
    old, new : TableSet
        Tables before and after.
    enabled_old : bool
        Whether tables act now.
    refusals : tuple of SafetyRefusal
        Everything that forbids it.
    largest_change_ct : float
        Largest difference between old and new position correction in the travel.
    lines : tuple of str
        What would be sent for the tables.
    motors : tuple of int
        Motors that must stand still.
    """

    old: TableSet
    new: TableSet
    enabled_old: bool
    refusals: tuple[SafetyRefusal, ...]
    largest_change_ct: float
    lines: tuple[str, ...]
    motors: tuple[int, ...]


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
    persist : bool
        SAVE afterwards; only with all motors killed.
    route : str
        For the result: ``table`` or ``cam``.
    exactly : TableSet or None
        Complete new set instead of a change (rollback).
    enable_after : bool
        Whether tables act at the end; False only to restore a set that was off.
    check_limits : bool
        False only to restore what was there before.
    origin : Origin or None
        Interrupted upload that is finished or rolled back by this one.
    closing : str
        Last entry of the journal: ``done`` or ``rolled back``.
    """

    def __init__(
        self,
        link: Link,
        context: Context,
        tables: Sequence[Table] = (),
        *,
        without: Sequence[Key] = (),
        persist: bool = False,
        route: str = "table",
        exactly: TableSet | None = None,
        enable_after: bool = True,
        check_limits: bool = True,
        origin: Origin | None = None,
        closing: str = "done",
    ) -> None:
        self.link = link
        self.context = context
        self.persist = persist
        self.route = route
        self.enable_after = enable_after
        self._check_limits = check_limits
        self._origin = origin
        self._closing = closing
        self._tables = tuple(tables)
        self._without = tuple(without)
        self._exactly = exactly
        self._stack = ExitStack()
        self._plan: UploadPlan | None = None
        self._prepared_s = 0.0
        self._has_lease = False
        self._i30 = 0
        self._manifest: Manifest | None = None
        self._pointers: tuple[int, ...] = ()
        self._left = ControllerState.OLD
        self._disabled_at_s: float | None = None
        self._disabled_s = 0.0

    def __enter__(self) -> "TableUpload":
        self._stack.enter_context(host_lock(self.context))
        return self

    def __exit__(self, *failure: object) -> None:
        try:
            if self._has_lease and failure[0] is None:
                self._release()
        finally:
            self._stack.close()

    # Looking --------------------------------------------------------------------------------------

    def prepare(self) -> UploadPlan:
        """Pre-flight: everything that can be known before anything is changed.

        Returns
        -------
        UploadPlan
            With all refusals; ``execute`` raises them together.
        """
        with self._explained():
            return self._look()

    def _look(self) -> UploadPlan:
        self.context.progress("pre-flight", 0, 1)
        head = read_head(self.link, self.context)
        self._i30 = head.i30
        now = read_clock(self.link)
        old = with_lookup(read_tables(self.link), self._wanted(TableSet()))
        new = self._wanted(old)
        motors = tuple(sorted(set(old.motors) | set(new.motors)))
        refusals = self._refusals(head, now, old, new, motors)
        steps = plan(old, new)
        self._plan = UploadPlan(
            old=old,
            new=new,
            enabled_old=bool(head.i51),
            refusals=tuple(refusals),
            largest_change_ct=largest_change_ct(old, new, self.context),
            lines=(*steps.delete_lines, *steps.define_lines),
            motors=motors,
        )
        self._prepared_s = self.link.clock.now_s()
        self.context.progress("pre-flight", 1, 1)
        return self._plan

    def _wanted(self, old: TableSet) -> TableSet:
        if self._exactly is not None:
            return self._exactly
        return old.with_tables(self._tables, without=self._without)

    def _refusals(
        self, head: Head, now: int, old: TableSet, new: TableSet, motors: tuple[int, ...]
    ) -> list[SafetyRefusal]:
        limits = self.context.limits
        refusals: list[SafetyRefusal] = []
        lease = refuse_foreign_lease(head.lease, self.context.owner, now)
        if lease is not None:
            refusals.append(lease)
        refusals += buffer_refusals(head)
        if self._check_limits:
            changed = [t for t in new if old.get(t.kind, t.motor) != t]
            refusals += [r for table in changed for r in check_table(table, limits)]
        refusals += memory_refusals(head, old, new)
        readings: dict[int, MotorReading] = {}
        if motors:
            refusals += motion_refusals(self.link, motors)
            readings = read_motors(self.link, motors)
        refusals += self._step_refusals(readings, old if head.i51 else TableSet(), new)
        return refusals

    def _step_refusals(
        self, readings: dict[int, MotorReading], old: TableSet, new: TableSet
    ) -> list[SafetyRefusal]:
        position = {m: r.position_ct for m, r in readings.items()}
        closed = {m: r.status.is_closed_loop for m, r in readings.items()}
        after = new if self.enable_after else TableSet()
        return check_step(old.tables, after.tables, position, closed, self.context.limits)

    # Doing ----------------------------------------------------------------------------------------

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
        try:
            raise_all(the_plan.refusals, "The upload")
        except SafetyRefusal as error:
            mark_left(error, ControllerState.OLD, confirmed=True)
            raise
        transaction = new_transaction_id()
        journal = self._origin.journal if self._origin else open_journal(self.context, transaction)
        with self._explained():
            if self._origin is None:
                journal.write("begin", {"kind": "tables"})
            take_lease(self.link, self.context, read_clock(self.link))
            self._has_lease = True
            backup = self._backup(the_plan, transaction)
            manifest = self._intend(the_plan, journal, transaction, backup)
            self._disable(journal, the_plan)
            self._write(journal, the_plan)
            self._read_back(the_plan, manifest)
            self._seal(journal, manifest)
            if self.enable_after:
                self._enable(journal, the_plan)
            if self.persist:
                self._persist(journal, the_plan)
            journal.write(self._closing, {"verdict": self._left.value})
            self._release()
        return UploadResult(
            verdict=self._left,
            route=self.route,
            crc_old=the_plan.old.crc,
            crc_new=the_plan.new.crc,
            disabled_s=self._disabled_s,
            backup=backup,
            journal=journal.path,
        )

    def _fresh_plan(self) -> UploadPlan:
        age_s = self.link.clock.now_s() - self._prepared_s
        if self._plan is None or age_s > FRESH_s:
            before = self._plan
            again = self.prepare()
            if before is not None and before.old.crc != again.old.crc:
                raise ForeignChange(
                    "The tables changed since they were looked at.",
                    code="PC-UPL-001",
                    hint="Look at the plan again.",
                    left=ControllerState.OLD,
                )
            return again
        return self._plan

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Errors leave with the state of the controller on them."""
        try:
            yield
        except PmacCompError as error:
            lost = isinstance(error, LinkError | ProtocolError)
            if not lost and self._manifest is not None:
                self._settle(error, self._manifest)
            elif error.left is None:
                # Until compensation is switched off for the first time OLD is certain.
                certain = not lost or self._left is ControllerState.OLD
                mark_left(error, self._left, confirmed=certain)
            if not lost and self._has_lease:
                self._release_after(error)
            raise

    def _settle(self, error: PmacCompError, manifest: Manifest) -> None:
        """Look at what the controller was left with; tables that nobody meant are switched off."""
        try:
            status = table_status(self.link, self.context, journal_manifest=manifest)
            if status.decision.action is Action.DISABLE:
                self.link.command("I51=0")
            if status.decision.state is ControllerState.OLD:
                self._disarm_manifest()
            mark_left(error, status.decision.state, confirmed=True)
        except PmacCompError as second:
            error.add_note(f"What was left could not be read: {second.message}")
            mark_left(error, self._left, confirmed=False)

    def _release_after(self, error: PmacCompError) -> None:
        try:
            self._release()
        except PmacCompError as second:
            error.add_note(f"The lease could not be given back: {second.message}")

    def _release(self) -> None:
        if self._has_lease:
            release_lease(self.link, self.context)
            self._has_lease = False

    def _backup(self, the_plan: UploadPlan, transaction: int) -> Path:
        if self._origin is not None:
            return self._origin.backup
        path = self.context.store / f"{self.context.controller}-{transaction:010d}.tables.json"
        write_table_backup(path, the_plan.old, enabled=the_plan.enabled_old)
        return path

    def _intend(
        self, the_plan: UploadPlan, journal: Journal, transaction: int, backup: Path
    ) -> Manifest:
        origin = self._origin
        manifest = Manifest(
            state=ManifestState.WRITING,
            transaction=transaction,
            n_entries=the_plan.new.n_entries,
            crc_old=the_plan.old.crc if origin is None else origin.crc_old,
            crc_new=the_plan.new.crc,
            enabled_old=int(the_plan.enabled_old) if origin is None else origin.enabled_old,
        )
        journal.write(
            "intent",
            {
                "manifest": list(manifest.values()),
                "backup": backup.name,
                "new": [table_to_json(t) for t in the_plan.new],
                "enable_after": int(self.enable_after),
                "closing": self._closing,
            },
        )
        self._manifest = manifest
        self.link.write_buffer(manifest.lines(self.context.block))
        head = read_head(self.link, self.context)
        self._require_ours(head, manifest, int(the_plan.enabled_old))
        return manifest

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
                self._left = ControllerState.DISABLED
            return
        what = "enabled the tables" if live else "changed the manifest, the lease or I51"
        raise ForeignChange(
            f"Another client {what} during the upload"
            + (": incomplete tables were live until now." if live else "."),
            code="PC-UPL-002",
            hint="Find out who writes to this controller, then run `pmac-comp recover`.",
            context={"was_live": bool(live)},
        )

    def _disarm_manifest(self) -> None:
        self.link.write_buffer(clear_lines(self.context.block))

    def _disable(self, journal: Journal, the_plan: UploadPlan) -> None:
        journal.write("disable")
        self.context.progress("disable", 0, 1)
        # From here on the answer may be lost while the command acted.
        self._left = ControllerState.DISABLED if the_plan.enabled_old else self._left
        self._disabled_at_s = self.link.clock.now_s()
        self._switch(0, the_plan)
        if not the_plan.enabled_old:
            self._left = ControllerState.DISABLED

    def _switch(self, value: int, the_plan: UploadPlan) -> None:
        """Set I51 with the motors' status in the same line, before and after.

        Raises
        ------
        MotorNotSafe
            A motor moved: what was switched on is off again, what was switched off stays off.
        """
        status = "".join(f"#{m}?" for m in the_plan.motors)
        lines = self.link.command(f"{status}I51={value}{status}I51")
        if len(lines) != 2 * len(the_plan.motors) + 1:
            raise VerifyMismatch(
                f"I51={value} was answered with {len(lines)} lines.", code="PC-UPL-003"
            )
        words = [MotorStatus.parse(text) for text in lines[:-1]]
        if int(read_number(lines[-1])) != value:
            raise VerifyMismatch(f"I51 is {lines[-1]} after I51={value}.", code="PC-UPL-003")
        motors = [*the_plan.motors, *the_plan.motors]
        moving = [
            f"motor #{m}"
            for m, w in zip(motors, words, strict=True)
            if w.is_activated and w.is_closed_loop and not w.is_commanded_still
        ]
        if not moving:
            return
        if value == 1:
            self.link.command("I51=0")
        if value == 0 and the_plan.enabled_old:
            self._left = ControllerState.DISABLED
        raise MotorNotSafe(
            f"{moving[0]} started to move when compensation was to be switched.",
            code="PC-UPL-004",
            hint="Stop the motion, then run `pmac-comp recover`.",
        )

    def _write(self, journal: Journal, the_plan: UploadPlan) -> None:
        journal.write("write", {"n_lines": len(the_plan.lines)})
        lines = ["DELETE GATHER", *the_plan.lines, f"I30={self._i30}"]
        parts = list(packets(lines))
        for k, packet in enumerate(parts):
            if self.context.stop_requested():
                raise UploadIncomplete(
                    "Stopped on request while tables were being written.",
                    code="PC-UPL-005",
                    hint="`pmac-comp recover` writes the old tables back.",
                )
            try:
                self.link.write_buffer(packet)
            except CommandRefused:
                self._switch_back(the_plan)
                raise
            self.context.progress("write", k + 1, len(parts))

    def _switch_back(self, the_plan: UploadPlan) -> None:
        """After a refused line: if the old tables still stand whole, let them act again."""
        if the_plan.enabled_old and read_tables(self.link).crc == the_plan.old.crc:
            self._switch(1, the_plan)

    def _read_back(self, the_plan: UploadPlan, manifest: Manifest) -> None:
        self.context.progress("read back", 0, 1)
        head = read_head(self.link, self.context)
        self._require_ours(head, manifest, 0)
        self._pointers = read_pointers(self.link)
        found = read_tables(self.link, keys_of(self._pointers))
        if found.crc != the_plan.new.crc:
            raise VerifyMismatch(
                f"The tables on the controller are not those that were sent: "
                f"{difference(the_plan.new, found)}.",
                code="PC-UPL-006",
                hint="`pmac-comp recover` writes the old tables back; then try again.",
            )
        self.context.progress("read back", 1, 1)

    def _seal(self, journal: Journal, manifest: Manifest) -> None:
        journal.write("seal")
        state = self.context.block.p(Index.MANIFEST) + 1
        self.link.command(f"P{state}={int(ManifestState.VALID)}")
        head = read_head(self.link, self.context)
        self._require_ours(head, manifest, 0)
        if head.manifest is None or head.manifest.state is not ManifestState.VALID:
            raise VerifyMismatch("The manifest could not be sealed.", code="PC-UPL-007")

    def _enable(self, journal: Journal, the_plan: UploadPlan) -> None:
        motors = the_plan.motors
        if motors:
            refusals = motion_refusals(self.link, motors)
            readings = read_motors(self.link, motors)
            refusals += self._step_refusals(readings, TableSet(), the_plan.new)
            raise_all(refusals, "Enabling")
        if read_pointers(self.link) != self._pointers:
            raise ForeignChange(
                "Another client defined or deleted a table after the read-back.",
                code="PC-UPL-002",
                context={"was_live": False},
            )
        journal.write("enable")
        self.context.progress("enable", 0, 1)
        try:
            self._switch(1, the_plan)
        except (LinkError, ProtocolError):
            self._left = ControllerState.NEW  # sent once; unconfirmed
            raise
        if self._disabled_at_s is not None:
            self._disabled_s = self.link.clock.now_s() - self._disabled_at_s
        self._left = ControllerState.NEW
        self._watch(motors)
        self.context.progress("enable", 1, 1)

    def _watch(self, motors: tuple[int, ...]) -> None:
        """Following errors for 100 servo cycles; too large ones switch compensation off."""
        if not motors:
            return
        bound_ct = 2.0 * self.context.limits.max_step_ct
        begin = {m: r.following_error_ct for m, r in read_motors(self.link, motors).items()}
        deadline = Deadline.after(self.link.clock, WATCH_CYCLES * self.context.servo_period_s)
        while not deadline.expired():
            self.link.clock.sleep_s(WATCH_CYCLES * self.context.servo_period_s / WATCH_POLLS)
            for motor, reading in read_motors(self.link, motors).items():
                jump = abs(reading.following_error_ct - begin[motor])
                if jump > bound_ct and reading.status.is_closed_loop:
                    self.link.command("I51=0")
                    self._left = ControllerState.DISABLED
                    raise MotorNotSafe(
                        f"Motor #{motor} left its place by {jump:.1f} counts after enabling; "
                        "compensation was switched off again.",
                        code="PC-UPL-008",
                    )

    def _persist(self, journal: Journal, the_plan: UploadPlan) -> None:
        journal.write("persist")
        save(self.link)
        after = table_status(self.link, self.context)
        if after.tables.crc != the_plan.new.crc or after.decision.state is not self._left:
            raise VerifyMismatch(
                "After SAVE the controller holds something else.", code="PC-UPL-009"
            )


def upload_tables(
    link: Link, context: Context, tables: Sequence[Table], **options: bool | str
) -> UploadResult:
    """Upload tables in one call; see ``TableUpload`` for the options and errors."""
    with TableUpload(link, context, tables, **options) as upload:  # type: ignore[arg-type]
        upload.prepare()
        return upload.execute()


def remove_tables(link: Link, context: Context, keys: Sequence[Key]) -> UploadResult:
    """Take tables off; the rest acts as before (none left: compensation stays off)."""
    remaining = read_tables(link).with_tables((), without=keys)
    with TableUpload(
        link, context, exactly=remaining, enable_after=len(remaining) > 0, check_limits=False
    ) as upload:
        return upload.execute()


def save(link: Link) -> None:
    """SAVE with all motors killed; the answer takes seconds and may be a NUL over Ethernet.

    Raises
    ------
    MotorNotSafe
        A motor is enabled: nothing else runs during SAVE, not even limit checks (p. 394).
    """
    active = [k + 1 for k, v in enumerate(link.query("I100,32,100")) if int(read_number(v))]
    alive = [m for m, r in read_motors(link, active).items() if not r.status.is_killed]
    if alive:
        raise MotorNotSafe(
            f"SAVE needs all motors killed; enabled: {', '.join(f'#{m}' for m in alive)}.",
            code="PC-UPL-010",
        )
    link.command("SAVE", timeout_s=SAVE_TIMEOUT_s)
