"""What we were about to do, on disk before it is done: append-only lines, each synced.

After a kill the journal and the state of the controller decide together what happened. A line is
JSON with a checksum; a torn last line is ignored. Imports ``base`` only.
"""

import errno
import json
import os
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from pmac_comp.base.errors import ConfigError, StorageFull

CLOSING: Final = frozenset({"done", "rolled back"})


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

    def write(self, step: str, data: Mapping[str, object] | None = None) -> None:
        """Append an entry and sync it; returns only when it is on the disk.

        Raises
        ------
        StorageFull
            The entry could not be stored: the step must not be taken.
        """
        body = json.dumps({"step": step, **(data or {})}, sort_keys=True)
        line = f"{zlib.crc32(body.encode()):08x} {body}\n".encode()
        try:
            fd = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            try:
                _append(fd, line)
            finally:
                os.close(fd)
        except OSError as error:
            raise StorageFull(
                f"The journal {self.path} cannot be written: {error.strerror}.",
                code="PC-JRN-001",
                hint="Nothing is changed without a journal; free the disk or choose a folder.",
            ) from error

    def entries(self) -> list[Entry]:
        """Intact entries in order; reading stops at the first damaged line."""
        if not self.path.exists():
            return []
        found: list[Entry] = []
        for line in self.path.read_bytes().split(b"\n"):
            crc, _, body = line.partition(b" ")
            if not body or crc != f"{zlib.crc32(body):08x}".encode():
                break
            data = json.loads(body)
            found.append(Entry(str(data.pop("step")), data))
        return found

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
        """Whether a transaction was begun and neither finished nor rolled back."""
        steps = [entry.step for entry in self.entries()]
        return bool(steps) and steps[-1] not in CLOSING


def _append(fd: int, line: bytes) -> None:
    """Write a line and sync it, or leave the file as it was: what follows a torn line is lost."""
    before = os.fstat(fd).st_size
    try:
        _write_whole(fd, line)
        os.fsync(fd)
    except OSError:
        with suppress(OSError):
            os.ftruncate(fd, before)
        raise


def _write_whole(fd: int, line: bytes) -> None:
    if os.write(fd, line) < len(line):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def probe_folder(folder: Path) -> None:
    """Prove that files can be made in a folder, before a machine is touched.

    The first entry of the journal is synced before anything is changed, so this need not be.

    Raises
    ------
    ConfigError
        Missing, read-only or full folder.
    """
    probe = folder / f".probe-{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        fd = os.open(probe, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            os.write(fd, b"probe")
        finally:
            os.close(fd)
            probe.unlink()
    except OSError as error:
        raise ConfigError(
            f"The folder {folder} cannot be written: {error.strerror}.",
            code="PC-JRN-002",
            hint="Choose a folder with room that you may write to; the controller was not touched.",
        ) from error
