"""One writer at a time: lock files for this host, a lease in P-variables for all hosts.

A lock goes by the address of a card, so that it holds between folders; another by its folder and
identity, so that it holds between addresses. A measurement holds the lease from its first run to
its last, as between two runs the axis rests and nothing else would refuse a change.

Bench files with another block are kept out by a register that all of them share (``claim``).

Beside the lease stands the number of the last change, positive until it has ended: a lease runs
out, but a change that nobody ended must still be seen from another folder or host, and one that
somebody else began since must be seen by the one that is recovered.
"""

import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from filelock import FileLock, Timeout

from pmac_comp.base.errors import (
    ConfigError,
    ControllerState,
    ForeignChange,
    LeaseHeld,
    RemoteProtocolError,
    SafetyRefusal,
)
from pmac_comp.base.reading import why
from pmac_comp.files.resources import locks_folder
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.change.claim import (
    CLAIM_TEXT,
    claim,
    claim_refusal,
    parse_claim,
    release_claim,
)
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journal import require_folder, unwritable
from pmac_comp.machine.controller.change.manifest import CLOCK_PER_s, Lease, LONGEST_LEASE_s
from pmac_comp.machine.controller.contents.law_bank import Index

if sys.platform != "win32":
    import fcntl

CLOCK_REGISTER: Final = 0x17
CLOCK_TEXT: Final = f"RL${CLOCK_REGISTER:X}"
LEASE_s: Final = 120.0
NO_FILE_NAME: Final = re.compile(r"[^A-Za-z0-9.-]+")
_NUMBERS_END: Final = float(1 << 31)


@contextmanager
def card_lock(address: str) -> Iterator[None]:
    """Only one command of this user at a card, whatever folder it works in.

    Parameters
    ----------
    address : str
        Of the card: the same for all ways in which it is named.

    Raises
    ------
    LeaseHeld
        Another one is at work there.
    ConfigError
        The folder for locks cannot be used.
    """
    folder = locks_folder()
    path = folder / f"{NO_FILE_NAME.sub('_', address)}.lock"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        release = _lock(path)
    except (Timeout, BlockingIOError) as error:
        raise LeaseHeld(
            f"Another pmac-comp on this host measures or changes the card at {address}.",
            code="PC-WRK-001",
            hint="Wait until it has ended, or end it there with Ctrl-C.",
            context={"lock": str(path)},
            left=ControllerState.OLD,
        ) from error
    except OSError as error:
        raise ConfigError(
            f"The lock of the card {path} cannot be made: {why(error)}.",
            code="PC-WRK-002",
            hint="Name a folder that you may write to in XDG_STATE_HOME (LOCALAPPDATA on "
            "Windows); the controller was not touched.",
        ) from error
    try:
        yield
    finally:
        release()


@contextmanager
def host_lock(context: Context, scope: str = "") -> Iterator[None]:
    """Only one writer of this host at a time; raises LeaseHeld, or ConfigError for the folder.

    Parameters
    ----------
    context : Context
        Folder and name of the controller.
    scope : str
        What else than a single change is locked, e.g. a whole upload; a lock of its own.
    """
    name = context.alike or context.controller  # in whatever way the card is reached
    path = context.store / f"{name}{scope}.lock"
    require_folder(context.store)
    try:
        release = _lock(path)
    except (Timeout, BlockingIOError) as error:
        raise LeaseHeld(
            f"Another pmac-comp on this host measures or changes {name}: it holds {path}.",
            code="PC-TXN-001",
            hint="Wait until it has ended, or end it there with Ctrl-C. Cards that answer alike "
            "(simulated ones do) count as one: give each a --journal of its own.",
            context={"lock": str(path)},
            left=ControllerState.OLD,
        ) from error
    except OSError as error:
        raise unwritable(context.store, error) from error
    try:
        yield
    finally:
        release()


def _lock(path: Path) -> Callable[[], None]:
    """Lock a file for this process; what is returned unlocks it, as the end of the process does.

    The library takes half a millisecond for what is two calls of the system on POSIX, which is a
    twentieth of an upload; both lock the same.
    """
    if sys.platform == "win32":
        lock = FileLock(path, timeout=0)
        lock.acquire()
        return lock.release
    fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(fd)
        raise

    def release() -> None:
        # Said, not left to closing: a child of this process may hold the file as well.
        fcntl.flock(fd, fcntl.LOCK_UN)
        os.close(fd)

    return release


def read_clock(link: Link) -> int:
    """Real-time clock of the controller, 1/1024 s since power-up (p. 495)."""
    return parse_integer(link.query(CLOCK_TEXT)[0])


def parse_lease(values: Sequence[float | str]) -> Lease:
    """Lease of its two variables."""
    return Lease(int(float(values[0])), int(float(values[1])))


def _lines(lines: list[str], n: int) -> list[str]:
    if len(lines) != n:
        raise RemoteProtocolError(f"The lease was answered with {len(lines)} lines, not {n}.")
    return lines


def refuse_foreign_lease(lease: Lease, owner: int, now: int) -> LeaseHeld | None:
    """Refusal if somebody else holds the lease."""
    if not lease.is_held_against(owner, now):
        return None
    left_s = (lease.expires - now) / CLOCK_PER_s
    return LeaseHeld(
        f"Another command, on this host or another (owner {lease.owner}), holds the lease on this "
        f"controller for {left_s:.0f} s more.",
        code="PC-TXN-002",
        hint="Wait until it has ended; if it was killed, `pmac-comp recover` where it was started.",
        context={"owner": lease.owner, "expires_in_s": left_s},
    )


def read_lease(link: Link, context: Context) -> Lease:
    """The lease as it stands."""
    first = context.block.p(Index.LEASE)
    return parse_lease(_lines(link.query(f"P{first}..{first + 1}"), 2))


def is_lost(link: Link, context: Context, lease: Lease) -> bool:
    """Whether our lease is gone, or somebody began a change with another block meanwhile."""
    first = context.block.p(Index.LEASE)
    *found, word = _lines(link.query(f"P{first}..{first + 1}{CLAIM_TEXT}"), 3)
    return parse_lease(found) != lease or claim_refusal(parse_claim(word), context) is not None


def take_lease(
    link: Link, context: Context, number: int, is_known: Callable[[int], bool]
) -> tuple[Lease, int]:
    """Write the lease and the number of a change, and read them back.

    Parameters
    ----------
    link, context
        Conversation and block.
    number : int
        Of the change, or of the upload that it is a part of.
    is_known : callable
        Whether a change of this number was begun from this folder.

    Returns
    -------
    tuple of Lease and int
        The lease, and the number that stood there.

    Raises
    ------
    LeaseHeld
        Somebody else took it since the pre-flight.
    ForeignChange
        Another writer was quicker, or one of another folder or with another block left a change
        unfinished.
    """
    first, change = context.block.p(Index.LEASE), context.block.p(Index.CHANGE)
    now, last, claimed = ask_free(link, context, is_known)
    claim(link, context, claimed)
    lease = Lease(context.owner, now + int(LEASE_s * CLOCK_PER_s))
    lines = [*lease.lines(context.block), f"P{change}={number}"]
    *back, there = _lines(link.command(f"{' '.join(lines)} P{first}..{first + 1}P{change}"), 3)
    if parse_lease(back) != lease or parse_number(there) != number:
        raise _taken_at_once()
    return lease, last


def ask_free(link: Link, context: Context, is_known: Callable[[int], bool]) -> tuple[int, int, int]:
    """Clock, number of the last change and claim; refused where somebody else is at the card.

    Raises
    ------
    LeaseHeld, ForeignChange
        Somebody is, or has left a change unfinished.
    """
    first, change = context.block.p(Index.LEASE), context.block.p(Index.CHANGE)
    question = f"P{first}..{first + 1}P{change}{CLOCK_TEXT}{CLAIM_TEXT}"
    *found, before, clock, word = _lines(link.query(question), 5)
    claimed = parse_claim(word)
    now, last = parse_integer(clock), parse_number(before)
    refusal: SafetyRefusal | None = refuse_foreign_lease(parse_lease(found), context.owner, now)
    if refusal is None and last > 0 and not is_known(last):
        refusal = begun_elsewhere(last)
    refusal = refusal or claim_refusal(claimed, context)
    if refusal is not None:
        refusal.left = ControllerState.OLD
        raise refusal
    return now, last, claimed


def _taken_at_once() -> ForeignChange:
    return ForeignChange(
        "Somebody else took the lease at the same moment.",
        code="PC-TXN-003",
        hint="`pmac-comp status URL` says who holds it; wait until that is done.",
        left=ControllerState.OLD,
    )


def hold_lease(link: Link, context: Context, is_known: Callable[[int], bool]) -> Lease:
    """Write the lease for a measurement, which begins no change; taken anew before each run.

    What a measurement itself changes (definitions that it borrows) gives the lease back.

    Raises
    ------
    LeaseHeld, ForeignChange
        As ``take_lease``: somebody else changes or measures.
    """
    now, _, _ = ask_free(link, context, is_known)
    lease = Lease(context.owner, now + int(LEASE_s * CLOCK_PER_s))
    first = context.block.p(Index.LEASE)
    back = link.command(f"{' '.join(lease.lines(context.block))} P{first}..{first + 1}")
    if parse_lease(_lines(back, 2)) != lease:
        raise _taken_at_once()
    return lease


def drop_lease(link: Link, context: Context) -> None:
    """Give back a lease that is ours, if one stands, of a measurement that ended or was killed."""
    if read_lease(link, context).owner == context.owner:
        link.command(_free(context))


def renew_lease(link: Link, context: Context, duration_s: float = LEASE_s) -> Lease:
    """Move the end of our own lease; raises ForeignChange if it is not ours any more."""
    if read_lease(link, context).owner != context.owner:
        raise ForeignChange(
            "Somebody else took the lease during the change.",
            code="PC-TXN-007",
            hint="Find out who writes to this controller, then run `pmac-comp recover`.",
        )
    expires = read_clock(link) + int(min(duration_s, LONGEST_LEASE_s) * CLOCK_PER_s)
    link.command(f"P{context.block.p(Index.LEASE) + 1}={expires}")
    return Lease(context.owner, expires)


def release_lease(link: Link, context: Context, *, number: int | None = None) -> None:
    """Give the lease back; with a number, which ends a change, also write that and end our claim.

    The parts of an upload give the lease back between them, and keep the claim.
    """
    if number is None:
        link.command(_free(context))
        return
    word = _lines(link.command(f"{_ended(context, number)} {CLAIM_TEXT}"), 1)[0]
    release_claim(link, context, parse_claim(word))


def give_back(link: Link, context: Context) -> None:
    """Give the lease back after a failure, unless somebody else has it by now."""
    if read_lease(link, context).owner == context.owner:
        release_lease(link, context)


def pause_lease(link: Link, context: Context, number: int) -> None:
    """Give the lease back and keep the claim: what was put on for a measurement is of the card."""
    link.command(_ended(context, number))


def without_lease(
    link: Link, context: Context, number: int, command: str, *, timeout_s: float
) -> None:
    """Give the lease back, write a number and send a command, all in one line; the claim stays.

    For SAVE, which would keep lease and number in the flash.
    """
    link.command(f"{_ended(context, number)} {command}", timeout_s=timeout_s)


def _free(context: Context) -> str:
    return f"P{context.block.p(Index.LEASE)}=0"


def _ended(context: Context, number: int) -> str:
    return f"{_free(context)} P{context.block.p(Index.CHANGE)}={number}"


def read_change(link: Link, context: Context) -> int:
    """Number of the last change of this controller: positive under way, negative ended, 0 none."""
    return parse_number(_lines(link.query(f"P{context.block.p(Index.CHANGE)}"), 1)[0])


def read_change_and_claim(link: Link, context: Context) -> tuple[int, int]:
    """The same, and the block of a change under way (``claim.read_claim``), by one question."""
    number, word = _lines(link.query(f"P{context.block.p(Index.CHANGE)}{CLAIM_TEXT}"), 2)
    return parse_number(number), parse_claim(word)


def parse_number(text: str) -> int:
    """Number of a change; what cannot be one counts as none."""
    value = float(text)
    return int(value) if value.is_integer() and abs(value) < _NUMBERS_END else 0


def begun_elsewhere(number: int) -> ForeignChange:
    """Refusal of a change beside one that another folder or host began and never ended."""
    return ForeignChange(
        f"A change of this controller (number {number}) was begun from another folder or host and "
        "has not ended.",
        code="PC-TXN-011",
        hint="Wait for it; if it was interrupted run `pmac-comp recover` where it was started. If "
        "that folder is lost, `pmac-comp recover --keep` takes what stands as it is.",
        context={"number": number},
    )
