"""One writer at a time: a lock file for this host, a lease in P-variables for all hosts."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from filelock import FileLock, Timeout

from pmac_comp.base.errors import ControllerState, ForeignChange, LeaseHeld, RemoteProtocolError
from pmac_comp.machine.controller.context import Context
from pmac_comp.machine.controller.journal import require_folder, unwritable
from pmac_comp.machine.controller.law_bank import Index
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.manifest import CLOCK_PER_s, Lease
from pmac_comp.machine.controller.numbers import parse_integer

if sys.platform != "win32":
    import fcntl

CLOCK_REGISTER: Final = 0x17
CLOCK_TEXT: Final = f"RL${CLOCK_REGISTER:X}"
LEASE_s: Final = 120.0


@contextmanager
def host_lock(context: Context) -> Iterator[None]:
    """Only one writer of this host at a time; raises LeaseHeld, or ConfigError for the folder."""
    path = context.store / f"{context.controller}.lock"
    require_folder(context.store)
    try:
        release = _lock(path)
    except (Timeout, BlockingIOError) as error:
        raise LeaseHeld(
            f"Another pmac-comp on this host is changing {context.controller}.",
            code="PC-TXN-001",
            hint="Wait until it has ended.",
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
        f"Another host (owner {lease.owner}) holds the lease on this controller "
        f"for {left_s:.0f} s more.",
        code="PC-TXN-002",
        hint="Wait until it has ended; an abandoned lease expires by itself.",
        context={"owner": lease.owner, "expires_in_s": left_s},
    )


def read_lease(link: Link, context: Context) -> Lease:
    """The lease as it stands."""
    first = context.block.p(Index.LEASE)
    return parse_lease(_lines(link.query(f"P{first}..{first + 1}"), 2))


def take_lease(link: Link, context: Context) -> Lease:
    """Write the lease and read it back.

    Raises
    ------
    LeaseHeld
        Somebody else took it since the pre-flight.
    ForeignChange
        Another writer was quicker.
    """
    first = context.block.p(Index.LEASE)
    *found, clock = _lines(link.query(f"P{first}..{first + 1}{CLOCK_TEXT}"), 3)
    now = parse_integer(clock)
    refusal = refuse_foreign_lease(parse_lease(found), context.owner, now)
    if refusal is not None:
        refusal.left = ControllerState.OLD
        raise refusal
    lease = Lease(context.owner, now + int(LEASE_s * CLOCK_PER_s))
    back = link.command(f"{' '.join(lease.lines(context.block))} P{first}..{first + 1}")
    if parse_lease(_lines(back, 2)) != lease:
        raise ForeignChange(
            "Somebody else took the lease at the same moment.",
            code="PC-TXN-003",
            left=ControllerState.OLD,
        )
    return lease


def renew_lease(link: Link, context: Context, duration_s: float = LEASE_s) -> Lease:
    """Move the end of our own lease; raises ForeignChange if it is not ours any more."""
    if read_lease(link, context).owner != context.owner:
        raise ForeignChange(
            "Somebody else took the lease during the change.",
            code="PC-TXN-007",
            hint="Find out who writes to this controller, then run `pmac-comp recover`.",
        )
    expires = read_clock(link) + int(duration_s * CLOCK_PER_s)
    link.command(f"P{context.block.p(Index.LEASE) + 1}={expires}")
    return Lease(context.owner, expires)


def release_lease(link: Link, context: Context) -> None:
    """Give the lease back."""
    link.command(f"P{context.block.p(Index.LEASE)}=0")
