"""The spine of every change of a controller: lock, lease, journal, backup, verdict.

Order of steps, journalled and synced before they are done: intent (old and new), write, enable,
done. The first line (begin) announces nothing but the lease and is synced with the intent. What
lives here is what tables, laws and settings share; what is written and how a change is judged lives
with each kind (``upload``, ``law_upload``, ``settings_upload``). Several changes that only make
sense together are a group: ``recover`` takes a torn group back whole.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Final, Self

from pmac_comp.base.errors import (
    ChangeInterrupted,
    CommandRefused,
    ControllerState,
    ForeignChange,
    PmacCompError,
    SafetyRefusal,
)
from pmac_comp.base.interrupts import DeferredInterrupt
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journal import CLOSING, Journal, Sync
from pmac_comp.machine.controller.change.journals import (
    DONE,
    FIRST_P,
    ROLLED_BACK,
    ChangeKind,
    is_torn,
    journal_names,
    new_transaction_id,
    next_journal,
    number_in,
    number_of,
    own_numbers,
    take_mark_away,
    torn_refusals,
)
from pmac_comp.machine.controller.change.lease import (
    LEASE_s,
    ask_free,
    host_lock,
    is_lost,
    pause_lease,
    read_lease,
    release_lease,
    renew_lease,
    take_lease,
    without_lease,
)
from pmac_comp.machine.controller.change.manifest import Lease
from pmac_comp.machine.controller.change.verdict import is_told, link_is_lost, mark_left

FOUND: Final = "number found"  # in an intent: of the last change before it
RENEW_SHARE: Final = 0.25


@dataclass(frozen=True)
class UploadResult:
    """How a change ended.

    Parameters
    ----------
    verdict : ControllerState
        OLD, NEW or DISABLED.
    route : str
        ``table``, ``cam``, ``law``, ``program`` or ``settings``.
    crc_old, crc_new : int
        Checksums before and after.
    disabled_s : float
        How long compensation was off.
    backup, journal : Path or None
        Files to go back with.
    notes : tuple of str
        What a person should know.
    """

    verdict: ControllerState
    route: str
    crc_old: int
    crc_new: int
    disabled_s: float = 0.0
    backup: Path | None = None
    journal: Path | None = None
    notes: tuple[str, ...] = field(default=())

    def as_dict(self) -> dict[str, object]:
        """For ``--json``."""
        return {
            "verdict": self.verdict.value,
            "route": self.route,
            "crc_old": f"{self.crc_old:08x}",
            "crc_new": f"{self.crc_new:08x}",
            "disabled_s": self.disabled_s,
            "backup": None if self.backup is None else str(self.backup),
            "journal": None if self.journal is None else str(self.journal),
            "notes": list(self.notes),
        }


RESET_AMID: Final = "PC-TXN-016"  # of an error: between the parts of an upload


class Change:
    """One journalled change: ``with`` holds the lock, ``begin`` takes the lease.

    Parameters
    ----------
    link, context
        Conversation and limits.
    kind : ChangeKind
        What is changed.
    journal : Journal or None
        Journal that goes on; a new one if None.

    Attributes
    ----------
    left : ControllerState
        What is known to stand on the controller if the link is lost now.
    settle : callable or None
        Looks at what a failed change left, while the link lives; its verdict is confirmed.
    """

    def __init__(
        self, link: Link, context: Context, kind: ChangeKind, journal: Journal | None = None
    ) -> None:
        self.link = link
        self.context = context
        self.kind = kind
        self.transaction = new_transaction_id()
        self.left = ControllerState.OLD
        self.settle: Callable[[], ControllerState] | None = None
        self._is_new = journal is None
        self._journal = journal
        self._stack = ExitStack()
        self._leased_at_s: float | None = None
        self._interrupt = DeferredInterrupt()
        self._ended: ControllerState | None = None
        self._lease: Lease | None = None
        self._found = 0

    def __enter__(self) -> Self:
        self._stack.enter_context(host_lock(self.context))
        self._stack.enter_context(self._interrupt)
        if not self._is_new:
            take_mark_away(self.context)  # an old journal goes on: it opens again
        return self

    def __exit__(self, *failure: object) -> None:
        try:
            if failure[0] is None:
                self.release()
        finally:
            self._stack.close()
        if failure[0] is None and self._interrupt.pending:
            part = "this part of the upload" if self.context.group else "the change"
            raise self._interrupted(f"when {part} was complete")

    def _interrupted(self, when: str) -> ChangeInterrupted:
        return ChangeInterrupted(
            f"Stopped on request {when}.",
            code="PC-UPL-005",
            hint="`pmac-comp status` shows what stands; `pmac-comp recover` settles what is open.",
            left=self._ended or self.left,
            context={"confirmed": True},
        )

    def may_go_on(self) -> None:
        """Asked at every safe place; raises ChangeInterrupted if somebody asked for an end."""
        if self._interrupt.pending or self.context.stop_requested():
            part = "this part of the upload" if self.context.group else "the change"
            error = self._interrupted(f"before {part} was complete")
            error.left = None  # looked at before it leaves
            raise error

    @property
    def journal(self) -> Journal:
        """Journal of this change, named when it is first needed."""
        if self._journal is None:
            self._journal = next_journal(self.context, self._before, self.transaction)
            self._stack.enter_context(self._journal.kept_open())
        return self._journal

    @cached_property
    def _before(self) -> list[str]:
        """Names of the journals before this one; the lock of this host keeps them."""
        return journal_names(self.context)

    @cached_property
    def _earlier(self) -> list[SafetyRefusal]:
        """What waits for ``recover``; the lock of this host keeps it as it was found."""
        goes_on = self.context.group or not self._is_new
        return [] if goes_on else torn_refusals(self.context, self._before)

    def look_into_folder(self) -> None:
        """Name the journal and look for earlier changes: work for while the controller answers."""
        _ = self.journal, self._earlier

    def require_settled(self) -> None:
        """Refuse while another change, of this folder or elsewhere, has not ended.

        For a change that is refused anyway: what forbids it may come from the other one.

        Raises
        ------
        SafetyRefusal, ForeignChange
            One has not.
        """
        for refusal in self._earlier:
            raise refusal
        if self.context.settling:
            return
        ask_free(self.link, self.context, lambda n: n in own_numbers(self.context))

    def begin(self, data: Mapping[str, object] | None = None) -> None:
        """First entry of a new journal, then the lease; nothing is changed yet.

        Raises
        ------
        SafetyRefusal
            An earlier change of this folder was interrupted and waits for ``recover``.
        """
        self.may_go_on()
        for refusal in self._earlier:
            raise refusal
        if self._is_new:
            head = {
                "kind": self.kind.value,
                "group": self.context.group,
                FIRST_P: self.context.block.first,
            }
            self.journal.write("begin", {**head, **(data or {})}, when=Sync.LATER)
        self._take()

    def _take(self) -> None:
        self._lease, self._found = take_lease(
            self.link, self.context, self._number, lambda n: n in own_numbers(self.context)
        )
        self._leased_at_s = self.link.clock.now_s()
        follows = self._follows_a_part
        if self.context.group and self._found != (
            self._number if follows else self.context.number_before
        ):
            raise ForeignChange(
                "The controller was reset as the upload went on, or somebody else made a change.",
                code=RESET_AMID,
                hint="Look at what stands (`pmac-comp status`), then upload again.",
            )

    @property
    def _follows_a_part(self) -> bool:
        """Whether another part of the same upload stands before this one in the folder."""
        before = [name for name in self._before if name != self.journal.path.name]
        return bool(self.context.group and before) and number_in(before[-1]) != self.context.group

    def do_without_lease(self, command: str, *, timeout_s: float) -> None:
        """Send what must not find a lease in the memory, and take the lease again.

        Raises
        ------
        LeaseHeld, ForeignChange
            Somebody else began a change meanwhile.
        """
        number = -self._number
        try:
            without_lease(self.link, self.context, number, command, timeout_s=timeout_s)
        except CommandRefused:
            self._take()  # gives the claim back with it
            raise
        self._take()
        if self._found != number:
            raise ForeignChange(
                f"Somebody else changed the controller during {command}.",
                code="PC-TXN-060",
                hint="`pmac-comp status URL` says who holds it; wait until that is done, then run "
                "the command again.",
            )

    def step(self, name: str, data: Mapping[str, object] | None = None) -> None:
        """Put a step on the disk before it is done, unless somebody asked for an end."""
        if name not in CLOSING:
            self.may_go_on()
        if name == "intent":
            data = {**(data or {}), FOUND: self._found}
        self.journal.write(name, data)

    @property
    def _number(self) -> int:
        return self.context.group or number_of(self.journal)

    def backup_path(self, suffix: str) -> Path:
        """Where the backup of this change belongs."""
        return self.context.store / f"{self.journal.path.stem}.{suffix}.json"

    def keep_lease(self, ahead_s: float = 0.0) -> None:
        """Renew the lease of a change that takes long; called between packets.

        Parameters
        ----------
        ahead_s : float
            Time in s during which it cannot be renewed: an open buffer would take the command.

        Raises
        ------
        ForeignChange
            Somebody else holds it.
        ChangeInterrupted
            Somebody asked for an end.
        """
        self.may_go_on()
        if self._leased_at_s is None:
            return
        now_s = self.link.clock.now_s()
        if now_s - self._leased_at_s + ahead_s > RENEW_SHARE * LEASE_s:
            self._lease = renew_lease(self.link, self.context, LEASE_s + ahead_s)
            self._leased_at_s = now_s + ahead_s

    def finish(self, verdict: ControllerState, closing: str = DONE) -> None:
        """Close the journal and give the lease back.

        Raises
        ------
        ForeignChange
            The lease is gone: what was written may be gone with it.
        """
        if self._lease is not None and is_lost(self.link, self.context, self._lease):
            raise ForeignChange(
                "The lease is gone: the controller was reset meanwhile, or somebody took it.",
                code="PC-TXN-009",
                hint="Run `pmac-comp recover`; it looks at what stands.",
            )
        self.left = verdict
        self._ended = ControllerState.OLD if closing == ROLLED_BACK else verdict
        self.journal.write(closing, {"verdict": verdict.value})
        self.release()

    def _is_leased(self) -> bool:
        return read_lease(self.link, self.context).owner == self.context.owner

    def release(self) -> None:
        """Give the lease back if it is held."""
        if self._leased_at_s is not None:
            # An upload ends with its last part, a recovery when all is settled.
            alone = not (self.context.group or self.context.settling)
            over = alone and (self._ended is not None or not is_torn(self.journal))
            release_lease(self.link, self.context, number=-self._number if over else None)
            self._leased_at_s = None

    def leave_open(self, verdict: ControllerState) -> None:
        """Give the lease back and leave the journal open: what was put on stands for a while."""
        self.left = self._ended = verdict
        if self._leased_at_s is not None:
            # For what compensates an axis the change before is still the last one.
            pause_lease(self.link, self.context, self._found)
            self._leased_at_s = None

    @contextmanager
    def explained(self) -> Iterator[None]:
        """Errors leave with the state of the controller on them, the lease is given back."""
        try:
            yield
        except PmacCompError as error:
            lost = link_is_lost(error)
            if not lost and self.settle is not None:
                self._settle(error, self.settle)
            elif not is_told(error):
                # Until the first command that may have acted OLD is certain; what acts on it later,
                # as the guard PLC does, nobody has seen.
                certain = not lost or (self.settle is None and self.left is ControllerState.OLD)
                mark_left(error, self.left, confirmed=certain)
            if not lost:
                self._release_after(error)
            raise

    def _settle(self, error: PmacCompError, look: Callable[[], ControllerState]) -> None:
        try:
            mark_left(error, look(), confirmed=True)
        except PmacCompError as second:
            error.add_note(f"What was left could not be read: {second.message}")
            mark_left(error, self.left, confirmed=False)

    def _release_after(self, error: PmacCompError) -> None:
        try:
            if self._leased_at_s is not None and not self._is_leased():
                self._leased_at_s = None
            self.release()
        except PmacCompError as second:
            error.add_note(f"The lease could not be given back: {second.message}")
