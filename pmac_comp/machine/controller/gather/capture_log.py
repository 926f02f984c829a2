"""The log a capture is written to while it runs: append-only, every record with its checksum.

HDF5 files are made from it afterwards: a full disk or a kill may break a file that is rewritten in
place, but never the records that were synced here. Layout: the magic line, then records of
``kind u8 | length u32 | crc32 u32 | payload``, little-endian, the checksum seeded with the kind.
Kinds: header (JSON), block (JSON head, then int64 columns), gap (JSON), end (JSON). Imports
``base`` only.
"""

import errno
import json
import os
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Final, Self

import numpy as np

from pmac_comp.base.arrays import IntArray
from pmac_comp.base.atomic import BINARY
from pmac_comp.base.clock import Clock, SystemClock
from pmac_comp.base.errors import CaptureError, StorageFull
from pmac_comp.base.reading import why

MAGIC: Final = b"PMAC-COMP CAPTURE LOG 1\n"
SYNC_EVERY_s: Final = 0.5
RECORD_MAX: Final = 1 << 28
_HEAD: Final = struct.Struct("<BII")
_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


class RecordKind(IntEnum):
    """First byte of a record."""

    HEADER = 1
    BLOCK = 2
    GAP = 3
    END = 4


@dataclass
class CaptureLog:
    """Open log; use ``create`` and close it with a reason.

    Parameters
    ----------
    path : Path
        File being written.
    clock : Clock
        Clock of the sync interval.
    """

    path: Path
    clock: Clock = field(default_factory=SystemClock)
    _fd: int = -1
    _synced_s: float = 0.0
    _n_rows: int = 0

    @classmethod
    def create(
        cls, path: Path, header: Mapping[str, object], *, clock: Clock | None = None
    ) -> Self:
        """New log; refuses to overwrite.

        Raises
        ------
        StorageFull
            No room for the header.
        CaptureError
            The file exists or cannot be made.
        """
        log = cls(path, clock or SystemClock())
        try:
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | BINARY
            log._fd = os.open(path, flags, 0o644)
        except OSError as error:
            raise CaptureError(
                f"The capture log {path} cannot be made: {why(error)}.",
                code="PC-LOG-001",
                hint="Choose a new name in a folder that can be written.",
            ) from error
        log._write(MAGIC)
        log._record(RecordKind.HEADER, json.dumps(dict(header)).encode())
        log.sync()
        return log

    @property
    def n_rows(self) -> int:
        """Samples appended so far."""
        return self._n_rows

    def append(self, columns: Mapping[str, IntArray]) -> None:
        """Append a block of samples; synced at least every half second."""
        arrays = {name: np.ascontiguousarray(a, dtype="<i8") for name, a in columns.items()}
        n_rows = len(next(iter(arrays.values())))
        head = json.dumps({"n": n_rows, "columns": list(arrays)}).encode()
        body = b"".join(a.tobytes() for a in arrays.values())
        self._record(RecordKind.BLOCK, struct.pack("<I", len(head)) + head + body)
        self._n_rows += n_rows
        if self.clock.now_s() - self._synced_s >= SYNC_EVERY_s:
            self.sync()

    def gap(self, after_row: int, n_missing: int, reason: str) -> None:
        """Write down that samples are missing after a row (negative: samples were doubled)."""
        text = {"after_row": after_row, "n_missing": n_missing, "reason": reason}
        self._record(RecordKind.GAP, json.dumps(text).encode())

    def sync(self) -> None:
        """Push everything to the disk."""
        try:
            os.fsync(self._fd)
        except OSError as error:
            raise self._full(error) from error
        self._synced_s = self.clock.now_s()

    def close(self, reason: str = "complete") -> None:
        """Write the end record, sync and close; a second call does nothing."""
        if self._fd < 0:
            return
        try:
            self._record(RecordKind.END, json.dumps({"reason": reason}).encode())
            self.sync()
        finally:
            os.close(self._fd)
            self._fd = -1

    def abandon(self) -> None:
        """Close without an end record, after the disk refused."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _record(self, kind: RecordKind, payload: bytes) -> None:
        self._write(_HEAD.pack(kind, len(payload), _crc(kind, payload)) + payload)

    def _write(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            try:
                view = view[os.write(self._fd, view) :]
            except OSError as error:
                raise self._full(error) from error

    def _full(self, error: OSError) -> CaptureError:
        if error.errno in _FULL:
            return StorageFull(
                f"No room left on the disk of {self.path}; {self._n_rows} samples were stored.",
                code="PC-LOG-002",
                hint="Free space and capture again.",
                context={"rows": self._n_rows},
            )
        return CaptureError(
            f"The capture log {self.path} cannot be written: {why(error)}.",
            code="PC-LOG-003",
            hint="Check the disk, or capture into another folder with --out.",
        )


@dataclass(frozen=True)
class RecoveredLog:
    """What a log holds.

    Parameters
    ----------
    header : dict
        As given at creation.
    columns : dict of IntArray, shape (n,)
        All samples of intact records.
    gaps : tuple of dict
        Gap records.
    reason : str or None
        Why the capture ended; None if it was cut off.
    bytes_lost : int
        Bytes behind the last intact record.
    """

    header: dict[str, object]
    columns: dict[str, IntArray]
    gaps: tuple[dict[str, object], ...]
    reason: str | None
    bytes_lost: int

    @property
    def is_complete(self) -> bool:
        """Whether the log was closed in order and nothing behind it is damaged."""
        return self.reason is not None and self.bytes_lost == 0


def recover(path: Path) -> RecoveredLog:
    """Everything intact in a log, also after a kill or a full disk.

    Raises
    ------
    CaptureError
        Not a capture log, or not even its header is intact.
    """
    data = path.read_bytes()
    if not data.startswith(MAGIC):
        raise CaptureError(
            f"{path} is no capture log.",
            code="PC-LOG-004",
            hint="Give the .log file that an interrupted `pmac-comp capture` named.",
        )
    records, end = _intact_records(data)
    if not records or records[0][0] != RecordKind.HEADER:
        raise CaptureError(
            f"{path} holds no intact header.",
            code="PC-LOG-005",
            hint="Nothing can be read from it: the disk was full or failed as it was begun.",
        )
    blocks = [_decode_block(payload) for kind, payload in records if kind == RecordKind.BLOCK]
    gaps = tuple(json.loads(p) for kind, p in records if kind == RecordKind.GAP)
    ends = [json.loads(p)["reason"] for kind, p in records if kind == RecordKind.END]
    return RecoveredLog(
        header=json.loads(records[0][1]),
        columns=_join(blocks),
        gaps=gaps,
        reason=ends[-1] if ends else None,
        bytes_lost=len(data) - end,
    )


def _crc(kind: int, payload: bytes) -> int:
    return zlib.crc32(payload, kind)


def _intact_records(data: bytes) -> tuple[list[tuple[int, bytes]], int]:
    records: list[tuple[int, bytes]] = []
    at = len(MAGIC)
    while at + _HEAD.size <= len(data):
        kind, length, crc = _HEAD.unpack_from(data, at)
        payload = data[at + _HEAD.size : at + _HEAD.size + length]
        if length > RECORD_MAX or len(payload) < length or _crc(kind, payload) != crc:
            break
        records.append((kind, payload))
        at += _HEAD.size + length
    return records, at


def _decode_block(payload: bytes) -> dict[str, IntArray]:
    (head_length,) = struct.unpack_from("<I", payload)
    head = json.loads(payload[4 : 4 + head_length])
    values = np.frombuffer(payload, dtype="<i8", offset=4 + head_length).astype(np.int64)
    table = values.reshape(len(head["columns"]), head["n"])
    return dict(zip(head["columns"], table, strict=True))


def _join(blocks: list[dict[str, IntArray]]) -> dict[str, IntArray]:
    if not blocks:
        return {}
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
