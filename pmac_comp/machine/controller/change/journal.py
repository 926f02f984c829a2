"""What we were about to do, on disk before it is done: append-only lines, synced.

After a kill the journal and the state of the controller decide together what happened. A line is
JSON with a checksum. Reading stops at the first damaged or unfinished one; it and what stands
behind it were never read by anybody, and are taken away before the next line is written: behind
them that one would not be read either. Imports ``base`` only.
"""

import errno
import json
import os
import shutil
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Final

from pmac_comp.base.atomic import BINARY
from pmac_comp.base.errors import ConfigError, StorageFull
from pmac_comp.base.reading import why

_NOT_YET: Final = -1
_CRC_AND_ENDS: Final = 10  # bytes of a line beside its JSON
_ENCODER: Final = json.JSONEncoder(sort_keys=True)
CLOSING: Final = frozenset({"done", "rolled back", "kept"})


class Sync(Enum):
    """When a line has to be on the disk itself and not only in the care of the system."""

    NOW = "now"
    LATER = "with the next line"


@dataclass(frozen=True)
class Entry:
    """One line of the journal."""

    step: str
    data: dict[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Journal:
    """Append-only journal in a file.

    Parameters
    ----------
    path : Path
        File; created with its first entry.
    """

    path: Path
    _kept: list[int] = field(default_factory=list, compare=False, repr=False)

    @contextmanager
    def kept_open(self) -> Iterator[None]:
        """Within ``with``, the file that the first entry opens stays open for the next ones."""
        self._kept.append(_NOT_YET)
        try:
            yield
        finally:
            fd = self._kept.pop()
            if fd != _NOT_YET:
                os.close(fd)

    def write(
        self, step: str, data: Mapping[str, object] | None = None, *, when: Sync = Sync.NOW
    ) -> None:
        """Append an entry and sync it; returns only when it is on the disk.

        With ``Sync.LATER`` a kill of this program keeps the entry, a power failure may not: only
        for one that announces nothing that would have to be undone. The name of a new file reaches
        the disk with the backup that is written into the same folder before anything is changed.

        Raises
        ------
        StorageFull
            The entry could not be stored: the step must not be taken.
        """
        body = _ENCODER.encode({"step": step, **(data or {})})
        line = f"{zlib.crc32(body.encode()):08x} {body}\n".encode()
        try:
            if not self._kept:
                with self.kept_open():
                    self._append(line, when)
            else:
                self._append(line, when)
        except OSError as error:
            raise StorageFull(
                f"The journal {self.path} cannot be written: {why(error)}.",
                code="PC-JRN-001",
                hint="Nothing is changed without a journal; free the disk or choose a folder.",
            ) from error

    def _append(self, line: bytes, when: Sync) -> None:
        if self._kept[-1] == _NOT_YET:
            flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | BINARY
            self._kept[-1] = os.open(self.path, flags, 0o644)
            self._take_damage_away(self._kept[-1])
        _append(self._kept[-1], line, when)

    def _take_damage_away(self, fd: int) -> None:
        size = os.fstat(fd).st_size
        whole = sum(_CRC_AND_ENDS + len(body) for body in self._intact_bodies()) if size else 0
        if whole < size:
            os.ftruncate(fd, whole)

    def entries(self) -> list[Entry]:
        """Intact entries in order; reading stops at the first damaged line."""
        return [_entry(body) for body in self._intact_bodies()]

    def _lines(self) -> list[bytes]:
        """Lines with an end: what follows the last was not written to its end, and not synced."""
        try:
            # Bare calls of the system take half the time of a file object.
            fd = os.open(self.path, os.O_RDONLY | BINARY)
        except FileNotFoundError:
            return []
        try:
            content = os.read(fd, os.fstat(fd).st_size)
        finally:
            os.close(fd)
        return content.split(b"\n")[:-1]

    def _intact_bodies(self) -> list[bytes]:
        return _intact(self._lines())

    @property
    def is_damaged(self) -> bool:
        """Whether a line that was written to its end does not read as it was written.

        A power failure leaves half a line or room that was never filled, which is none.
        """
        lines = self._lines()
        return len(_intact(lines)) < len(lines)

    @property
    def last_step(self) -> str:
        """Step of the last entry; there must be one."""
        return self.entries()[-1].step

    def last(self, step: str) -> Entry | None:
        """Latest entry of a step."""
        return next((e for e in reversed(self.entries()) if e.step == step), None)

    def first(self) -> Entry | None:
        """Entry with which the transaction began."""
        return next(iter(self.entries()), None)

    @property
    def kind(self) -> str:
        """What the first entry says the journal is about; empty without one."""
        begin = self.first()
        return "" if begin is None else str(begin.data.get("kind", ""))

    @property
    def group(self) -> int:
        """Number of the group that this change belongs to, 0 for none."""
        begin = self.first()
        return 0 if begin is None else int(str(begin.data.get("group", 0)))

    @property
    def is_open(self) -> bool:
        """Whether a transaction was begun and neither finished nor rolled back.

        Every change asks it of all journals before it: only the last line is taken apart.
        """
        bodies = self._intact_bodies()
        return bool(bodies) and _entry(bodies[-1]).step not in CLOSING


def _intact(lines: Sequence[bytes]) -> list[bytes]:
    """JSON of the lines before the first damaged one."""
    found: list[bytes] = []
    for line in lines:
        crc, _, body = line.partition(b" ")
        if not body or crc != b"%08x" % zlib.crc32(body):
            break
        found.append(body)
    return found


def _entry(body: bytes) -> Entry:
    data = json.loads(body)
    return Entry(str(data.pop("step")), data)


def _append(fd: int, line: bytes, when: Sync) -> None:
    """Write a line and sync it, or leave the file as it was: what follows a torn line is lost."""
    before = os.fstat(fd).st_size
    try:
        _write_whole(fd, line)
        if when is Sync.NOW:
            os.fsync(fd)
    except OSError:
        with suppress(OSError):
            os.ftruncate(fd, before)
        raise


def _write_whole(fd: int, line: bytes) -> None:
    if os.write(fd, line) < len(line):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def require_folder(folder: Path) -> None:
    """Make a folder where it is missing; refuse one without the right or the room to write.

    What this cannot see fails with the first entry, before anything is changed.

    Raises
    ------
    ConfigError
        Missing, read-only or full folder.
    """
    try:
        reason = _prepare(folder)
    except OSError as error:
        raise unwritable(folder, error) from error
    if reason:
        raise unwritable(folder, OSError(reason, os.strerror(reason)))


def _prepare(folder: Path) -> int:
    """Make the folder; the number of the error with which writing there would end, 0 for none."""
    if not folder.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK | os.X_OK):
        return errno.EACCES
    return 0 if shutil.disk_usage(folder).free else errno.ENOSPC


def unwritable(folder: Path, error: OSError) -> ConfigError:
    """What is said of a folder in which no journal can be kept."""
    return ConfigError(
        f"The folder {folder} cannot be written: {why(error)}.",
        code="PC-JRN-002",
        hint="Make room there, or see that you may write to it and to the files in it (those of an "
        "earlier `sudo` are not yours). What was interrupted is settled with that folder only; for "
        "a new change --journal may name another one.",
    )
