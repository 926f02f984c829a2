"""One writer at a time: a lock file for this host, a lease in P-variables for all hosts."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from filelock import FileLock, Timeout

from pmac_comp.base.errors import ControllerState, ForeignChange, LeaseHeld
from pmac_comp.machine.controller.context import Context
from pmac_comp.machine.controller.journal import probe_folder
from pmac_comp.machine.controller.law_bank import Index
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.manifest import CLOCK_PER_s, Lease
from pmac_comp.machine.controller.numbers import parse_integer

CLOCK_REGISTER: Final = 0x17
LEASE_s: Final = 120.0


@contextmanager
def host_lock(context: Context) -> Iterator[None]:
    """Only one writer of this host at a time; raises LeaseHeld, or ConfigError for the folder."""
    probe_folder(context.store)
    lock = FileLock(context.store / f"{context.controller}.lock", timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise LeaseHeld(
            f"Another pmac-comp on this host is changing {context.controller}.",
            code="PC-TXN-001",
            hint="Wait until it has ended.",
            context={"lock": lock.lock_file},
            left=ControllerState.OLD,
        ) from error
    try:
        yield
    finally:
        lock.release()


def read_clock(link: Link) -> int:
    """Real-time clock of the controller, 1/1024 s since power-up (p. 495)."""
    return parse_integer(link.query(f"RL${CLOCK_REGISTER:X}")[0])


def parse_lease(values: list[float]) -> Lease:
    """Lease of its two variables."""
    return Lease(int(values[0]), int(values[1]))


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
    return parse_lease([float(v) for v in link.query(f"P{first}..{first + 1}")])


def take_lease(link: Link, context: Context, now: int) -> Lease:
    """Write the lease and read it back; raises ForeignChange if another writer was quicker."""
    lease = Lease(context.owner, now + int(LEASE_s * CLOCK_PER_s))
    link.write_buffer(lease.lines(context.block))
    if read_lease(link, context) != lease:
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
