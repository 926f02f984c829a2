"""What every change of a controller shares: one writer at a time, and its files.

A lock file keeps two programs on this host apart, the lease on the controller two hosts. What
lives here: lock, lease, names of files, the result. What may not: what is written (``upload``,
``law_upload``, ``program_upload``).
"""

import json
import secrets
import socket
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Final

from filelock import FileLock, Timeout

from pmac_comp.base.atomic import atomic_write_text
from pmac_comp.base.errors import (
    ConfigError,
    ControllerState,
    ForeignChange,
    LeaseHeld,
    PmacCompError,
    TableStateError,
)
from pmac_comp.machine.controller.journal import Journal, probe_folder
from pmac_comp.machine.controller.law_bank import Index, LawBlock
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.manifest import CLOCK_PER_s, Lease
from pmac_comp.machine.controller.numbers import parse_integer
from pmac_comp.machine.controller.safety import Limits

CLOCK_REGISTER: Final = 0x17
LEASE_s: Final = 120.0

Progress = Callable[[str, int, int], None]
"""Called with a step, lines done and lines in all."""


def _no_progress(step: str, done: int, total: int) -> None:
    del step, done, total


def _never() -> bool:
    return False


@dataclass(frozen=True)
class Context:
    """Where and within which limits a change is made.

    Parameters
    ----------
    block : LawBlock
        P-variables we may use.
    limits : Limits
        Limits in counts.
    store : Path
        Folder of journals and backups; one per bench.
    servo_period_s : float
        For the watch after enabling.
    controller : str
        Name of the controller for lock and files, e.g. its fingerprint.
    progress : callable
        Told of every step and packet.
    stop_requested : callable
        Asked between packets; True ends the change at the next safe place.
    """

    block: LawBlock
    limits: Limits
    store: Path
    servo_period_s: float
    controller: str = "controller"
    progress: Progress = _no_progress
    stop_requested: Callable[[], bool] = _never

    @property
    def owner(self) -> int:
        """Number that stands for this host and folder in the lease, never 0."""
        text = f"{socket.gethostname()}:{self.store.resolve()}"
        return (zlib.crc32(text.encode()) & 0x7FFFFFFF) or 1


@dataclass(frozen=True)
class UploadResult:
    """How a change ended.

    Parameters
    ----------
    verdict : ControllerState
        OLD, NEW or DISABLED.
    route : str
        ``table``, ``cam``, ``law`` or ``program``.
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


def new_transaction_id() -> int:
    """Random number below 2^31, never 0; wall clocks may jump, this does not repeat."""
    return secrets.randbelow((1 << 31) - 1) + 1


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


def take_lease(link: Link, context: Context, now: int) -> None:
    """Write the lease and read it back; raises ForeignChange if another writer was quicker."""
    lease = Lease(context.owner, now + int(LEASE_s * CLOCK_PER_s))
    link.write_buffer(lease.lines(context.block))
    first = context.block.p(Index.LEASE)
    found = [float(v) for v in link.query(f"P{first}..{first + 1}")]
    if parse_lease(found) != lease:
        raise ForeignChange(
            "Somebody else took the lease at the same moment.",
            code="PC-TXN-003",
            left=ControllerState.OLD,
        )


def release_lease(link: Link, context: Context) -> None:
    """Give the lease back."""
    link.command(f"P{context.block.p(Index.LEASE)}=0")


def open_journal(context: Context, transaction: int) -> Journal:
    """Journal of a transaction."""
    return Journal(context.store / f"{context.controller}-{transaction:010d}.journal")


def write_sealed_json(path: Path, data: Mapping[str, object]) -> None:
    """Write JSON with its SHA-256, read it again and compare.

    Raises
    ------
    TableStateError
        What was read is not what was written; nothing was changed on the controller.
    """
    body = json.dumps(dict(data), sort_keys=True)
    digest = sha256(body.encode()).hexdigest()
    atomic_write_text(path, json.dumps({"sha256": digest, "body": body}, indent=1))
    if read_sealed_json(path) != json.loads(body):
        raise TableStateError(
            f"The file {path} does not read back as written.",
            code="PC-TXN-004",
            left=ControllerState.OLD,
        )


def read_sealed_json(path: Path) -> dict[str, object]:
    """Content of a sealed file.

    Raises
    ------
    ConfigError
        Missing, unreadable or changed since it was written.
    """
    try:
        outer = json.loads(path.read_text(encoding="utf-8"))
        body = str(outer["body"])
        fits = sha256(body.encode()).hexdigest() == outer["sha256"]
        data = json.loads(body)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} is no readable backup.", code="PC-TXN-005") from error
    if not fits or not isinstance(data, dict):
        raise ConfigError(
            f"{path} was changed after it was written (digest mismatch).",
            code="PC-TXN-006",
            hint="Use another backup.",
        )
    return data


def mark_left(error: PmacCompError, left: ControllerState, *, confirmed: bool) -> None:
    """Say on an error in which state the controller was left."""
    error.left = left
    error.context["confirmed"] = confirmed
    if not confirmed:
        error.hint = (
            error.hint + " " if error.hint else ""
        ) + "The state is unconfirmed: run `pmac-comp recover` when the link is back."
