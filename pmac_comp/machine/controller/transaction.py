"""The spine of every change of a controller: lock, lease, journal, backup, verdict.

Order of steps, journalled and synced before they are done: intent (old and new), write, enable,
done. The first line (begin) announces nothing but the lease and is synced with the intent. What
lives here is what tables, laws and settings share; what is written and how a change is judged lives
with each kind (``upload``, ``law_upload``, ``settings_upload``). Several changes that only make
sense together are a group: ``recover`` takes a torn group back whole.
"""

import os
import re
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import Final, Self

from pmac_comp.base.atomic import sync_folder
from pmac_comp.base.errors import (
    ChangeInterrupted,
    CommandRefused,
    ConfigError,
    ControllerState,
    ForeignChange,
    LinkError,
    LocalProtocolError,
    PmacCompError,
    ProtocolError,
    SafetyRefusal,
)
from pmac_comp.base.interrupts import DeferredInterrupt
from pmac_comp.machine.controller.context import Context
from pmac_comp.machine.controller.journal import CLOSING, Journal, Sync
from pmac_comp.machine.controller.lease import (
    LEASE_s,
    host_lock,
    is_lost,
    pause_lease,
    read_lease,
    release_lease,
    renew_lease,
    take_lease,
    without_lease,
)
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.manifest import Lease

DONE: Final = "done"
ROLLED_BACK: Final = "rolled back"
KEPT: Final = "kept"  # closed without writing: somebody else has changed the controller since
TEMPORARY: Final = "temporary"  # mark of an intent that is always taken back
FIRST_P: Final = "first P-variable"  # in a beginning: of the block that the change is made with
FOUND: Final = "number found"  # in an intent: of the last change before it
RENEW_SHARE: Final = 0.25
_READ_AGAIN: Final = 4  # so many settled journals are read by each change before a mark is moved


class ChangeKind(Enum):
    """What a journal is about, as its first entry says."""

    TABLES = "tables"
    LAW = "law"
    SETTINGS = "settings"
    SAVE = "save"
    GROUP = "group"


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
            _take_mark_away(self.context)  # an old journal goes on: it opens again
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
            self._journal = _next_journal(self.context, self._before, self.transaction)
            self._stack.enter_context(self._journal.kept_open())
        return self._journal

    @cached_property
    def _before(self) -> list[str]:
        """Names of the journals before this one; the lock of this host keeps them."""
        return _names(self.context)

    @cached_property
    def _earlier(self) -> list[SafetyRefusal]:
        """What waits for ``recover``; the lock of this host keeps it as it was found."""
        goes_on = self.context.group or not self._is_new
        return [] if goes_on else torn_refusals(self.context, self._before)

    def look_into_folder(self) -> None:
        """Name the journal and look for earlier changes: work for while the controller answers."""
        _ = self.journal, self._earlier

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
            elif not _is_told(error):
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


def open_group(context: Context, name: str) -> tuple[Journal, Context]:
    """Begin an upload of several parts; its journal, and the context for the parts.

    Raises
    ------
    SafetyRefusal
        An earlier change of this folder was interrupted and waits for ``recover``.
    """
    with host_lock(context):
        require_settled(context)
        number = new_transaction_id()
        journal = _next_journal(context, _names(context), number)
        data = {"kind": ChangeKind.GROUP.value, "group": number, "name": name}
        journal.write("begin", {**data, FIRST_P: context.block.first})
    return journal, replace(context, group=number)


def new_transaction_id() -> int:
    """Random number below 2^31, never 0; wall clocks may jump, this does not repeat."""
    return secrets.randbelow((1 << 31) - 1) + 1


def journals(context: Context) -> list[Journal]:
    """Journals of this controller in this folder, oldest first."""
    return _journals(context, _names(context))


def _journals(context: Context, names: Sequence[str]) -> list[Journal]:
    return [Journal(context.store / name) for name in names]


def own_numbers(context: Context) -> set[int]:
    """Numbers of the changes that were begun from this folder."""
    return {_number_of(name) for name in _names(context)}


def number_of(journal: Journal) -> int:
    """Number of a change that is no part of an upload."""
    return _number_of(journal.path.name)


def _number_of(name: str) -> int:
    return int(name.rsplit("-", 1)[1].removesuffix(".journal"))


def is_torn(journal: Journal) -> bool:
    """Whether a change, or an upload of several, got far enough to need settling and was not."""
    if not journal.is_open:
        return False
    entries = journal.entries()
    begun = entries[0].data.get("kind") == ChangeKind.GROUP.value
    return begun or any(entry.step == "intent" for entry in entries)


def is_of_block(context: Context, journal: Journal) -> bool:
    """Whether a change was made with the block of this bench file, as far as its journal tells."""
    begin = journal.first()
    return begin is None or begin.data.get(FIRST_P, context.block.first) == context.block.first


def require_own_block(context: Context, changes: Sequence[Journal]) -> None:
    """Refuse to settle what was changed with another block: law and manifest would be sought here.

    Raises
    ------
    ConfigError
        One of the changes was made with the bench file of another axis.
    """
    other = next((j for j in changes if not is_of_block(context, j)), None)
    begin = None if other is None else other.first()
    if other is None or begin is None:
        return
    raise ConfigError(
        f"The change was made with a bench file whose p_block begins at P{begin.data[FIRST_P]}; "
        f"this one's begins at P{context.block.first}.",
        code="PC-TXN-012",
        hint="Name the bench file of that upload with --bench; each axis is best given a folder of "
        "its own with --journal.",
        context={"journal": str(other.path)},
        left=ControllerState.OLD,
    )


def require_settled(context: Context) -> None:
    """Refuse a change while an interrupted one of this folder waits; see ``torn_refusals``.

    Raises
    ------
    SafetyRefusal
        There is one.
    """
    for refusal in torn_refusals(context):
        raise refusal


def torn_refusals(context: Context, before: Sequence[str] | None = None) -> list[SafetyRefusal]:
    """Refusal of a change while an interrupted one of this folder waits for ``recover``.

    Its backup is what stood before: a change on top would be lost when that is written back.
    What a measurement borrowed stands open without being half-changed, and is taken off apart.
    What the interrupted one has left is not looked at here: the refusal does not say OLD of it.

    Parameters
    ----------
    context : Context
        Folder and name of the controller.
    before : sequence of str, optional
        Names of the journals, oldest first, if they have been listed already.
    """
    if context.settling:
        return []
    names = _not_known_settled(context, _names(context) if before is None else before)
    torn = [j for j in _journals(context, names) if is_torn(j)]
    if not torn and len(names) > _READ_AGAIN:
        with suppress(OSError):  # it only saves time
            _mark(context).write_text(names[-1], encoding="ascii")
    torn = [j for j in torn if not is_temporary(j)]
    if not torn:
        return []
    begin = torn[-1].first()
    data = {} if begin is None else begin.data
    name = data.get("name") or data.get("route") or data.get("kind")
    return [
        SafetyRefusal(
            f"An earlier change of this controller ({name}) was interrupted and is still open.",
            code="PC-TXN-010",
            hint="Run `pmac-comp recover` first: it ends the earlier one as it was before or as "
            "it was meant. Then try again; nothing was changed now, and `pmac-comp status` says "
            "what stands.",
            context={"journal": str(torn[-1].path), "confirmed": False},
        )
    ]


def _mark(context: Context) -> Path:
    """File that names a journal: it and all before it were found settled.

    Else each change would read all journals that were ever written. Half written it names none, and
    a journal that goes on after it was closed takes it away.
    """
    return context.store / f"{context.controller}.settled"


def _take_mark_away(context: Context) -> None:
    mark = _mark(context)
    if mark.exists():
        mark.unlink()
        sync_folder(context.store)  # else it stands again after a power failure


def open_again(context: Context, journal: Journal, step: str) -> None:
    """Let a journal that was closed go on with a step; no change passes it over from then on."""
    with host_lock(context):  # nobody else moves the mark meanwhile
        _take_mark_away(context)
        journal.write(step)


def _not_known_settled(context: Context, names: Sequence[str]) -> Sequence[str]:
    """The names behind the mark; all of them without one that stands among them."""
    try:
        name = _mark(context).read_bytes().decode("ascii", "replace")
    except OSError:
        return names
    return names[names.index(name) + 1 :] if name in names else names


def is_temporary(journal: Journal) -> bool:
    """Whether a change stands only while something is measured."""
    intent = journal.last("intent")
    return intent is not None and bool(intent.data.get(TEMPORARY))


def _names(context: Context) -> list[str]:
    # The count comes first in the name: a clock that jumps cannot change the order.
    name = re.compile(re.escape(context.controller) + r"-.{6}-.{10}\.journal")
    found = os.listdir(context.store) if context.store.is_dir() else ()  # noqa: PTH208 - fast
    return sorted(filter(name.fullmatch, found))


def _next_journal(context: Context, before: Sequence[str], transaction: int) -> Journal:
    count = int(before[-1].rsplit("-", 2)[1]) + 1 if before else 1
    name = f"{context.controller}-{count:06d}-{transaction:010d}.journal"
    return Journal(context.store / name)


@contextmanager
def untouched() -> Iterator[None]:
    """Errors of looking, before anything was changed, leave with OLD on them.

    But not those that tell of a change which waits: what that one left is something else.
    """
    try:
        yield
    except PmacCompError as error:
        if not _is_told(error):
            mark_left(error, ControllerState.OLD, confirmed=True)
        raise


def _is_told(error: PmacCompError) -> bool:
    """Whether an error says what was left, or that nobody has looked at it."""
    return error.left is not None or error.context.get("confirmed") is False


def link_is_lost(error: PmacCompError) -> bool:
    """Whether nobody can tell what the controller did, nor tell it anything.

    What could not be put in words for it was never sent, and the link lives.
    """
    if isinstance(error, LocalProtocolError):
        return False
    return isinstance(error, LinkError | ProtocolError)


def mark_left(error: PmacCompError, left: ControllerState, *, confirmed: bool) -> None:
    """Say on an error in which state the controller was left."""
    error.left = left
    error.context["confirmed"] = confirmed
    if not confirmed:
        error.hint = (
            error.hint + " " if error.hint else ""
        ) + "The state is unconfirmed: run `pmac-comp recover` as soon as the controller answers."
