"""The upload manifest and the lease in P-variables, and the pure function that judges them.

What lives here: what stands on the controller about an upload, and what it means. What may not:
doing anything about it (``upload``). Offsets of the block: 70-77 manifest, 78-79 lease, 80-82
written by the guard PLC.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Final

from pmac_comp.base.errors import ControllerState
from pmac_comp.machine.controller.contents.law_bank import Index, LawBlock

MAGIC: Final = 505143
MANIFEST_SIZE: Final = 8
_PART: Final = 22  # bits of both checksums in one variable: seven digits
CLOCK_PER_s: Final = 1024.0  # D:$17 counts 1/1024 s (Reference Manual p. 495)
LONGEST_LEASE_s: Final = 3600.0  # no writer asks for a longer one


class ManifestState(IntEnum):
    """Second value of the manifest."""

    NONE = 0
    WRITING = 1
    VALID = 2
    ENDED = 3


@dataclass(frozen=True)
class Manifest:
    """What an upload meant to do.

    Parameters
    ----------
    state : ManifestState
        WRITING until the tables were read back, then VALID. ENDED says nothing of an upload any
        more, only to other blocks which tables stood when it was taken back.
    transaction : int
        Random number of the upload, below 2^31.
    n_entries : int
        Entries of all new tables.
    crc_old, crc_new : int
        Checksums of the table sets.
    enabled_old : int
        I51 before.
    """

    state: ManifestState
    transaction: int
    n_entries: int
    crc_old: int
    crc_new: int
    enabled_old: int

    def values(self) -> tuple[int, ...]:
        """The eight values of the manifest; the last is a checksum of the others but the state."""
        both = self.crc_old << 32 | self.crc_new
        body = (
            MAGIC,
            int(self.state),
            self.transaction,
            2 * self.n_entries + self.enabled_old,
            *(both >> shift & (1 << _PART) - 1 for shift in (2 * _PART, _PART, 0)),
        )
        return (*body, _checksum(body))

    @classmethod
    def from_values(cls, values: Sequence[float]) -> "Manifest | None":
        """Manifest of eight values; None if there is none, or it has ended or was torn."""
        found = cls.told_by(values)
        return None if found is None or found.state is ManifestState.ENDED else found

    @classmethod
    def told_by(cls, values: Sequence[float]) -> "Manifest | None":
        """The same, and one that has ended as well."""
        whole = [int(v) if v == int(v) else -1 for v in values]
        if len(whole) != MANIFEST_SIZE or whole[0] != MAGIC or whole[7] != _checksum(whole):
            return None
        if whole[1] not in {1, 2, 3}:
            return None
        both = whole[4] << 2 * _PART | whole[5] << _PART | whole[6]
        return cls(
            state=ManifestState(whole[1]),
            transaction=whole[2],
            n_entries=whole[3] >> 1,
            crc_old=both >> 32,
            crc_new=both & 0xFFFFFFFF,
            enabled_old=whole[3] & 1,
        )

    def lines(self, block: LawBlock) -> list[str]:
        """Commands that write the manifest, checksum before magic so that a torn one is none."""
        first = block.p(Index.MANIFEST)
        pairs = list(enumerate(self.values()))
        return [f"P{first}=0", *(f"P{first + k}={v}" for k, v in reversed(pairs))]


def end_lines(block: LawBlock, crc: int) -> list[str]:
    """Commands after which no upload is under way or stands, as before the first one.

    What is left tells other blocks of the tables: their own manifests may be of a time when others
    stood there, and these would be foreign to them.

    Parameters
    ----------
    block : LawBlock
        P-variables of the manifest.
    crc : int
        Checksum of the tables that stand, 0 for none.
    """
    first = block.p(Index.MANIFEST)
    # All at once: in between the guard PLC would find tables acting beside one that is WRITING.
    lines = [f"P{first}..{first + MANIFEST_SIZE - 1}=0"]
    if not crc:
        return lines
    return lines + Manifest(ManifestState.ENDED, 0, 0, crc, crc, 0).lines(block)


def _checksum(body: Sequence[int]) -> int:
    # The state is left out: sealing then is one single write.
    text = " ".join(str(v) for k, v in enumerate(body[:7]) if k != 1)
    return zlib.crc32(text.encode()) & 0xFFFF


class Action(Enum):
    """What a recovery does next."""

    NOTHING = "nothing to do"
    RESUME = "seal and enable what was written"
    ROLL_BACK = "write the old tables back"
    DISABLE = "disable: somebody else changed the tables"


@dataclass(frozen=True)
class Decision:
    """State of the controller after an interruption."""

    state: ControllerState
    action: Action
    reason: str


def decide(manifest: Manifest | None, i51: int, crc: int) -> Decision:
    """State of the controller from what stands on it: a pure function, total over its domain.

    Parameters
    ----------
    manifest : Manifest or None
        As read, or as the journal has it.
    i51 : int
        Whether tables act.
    crc : int
        Checksum of the tables that are there, 0 for none: then nothing acts whatever I51 is.

    Returns
    -------
    Decision
        ``OLD`` only if the old set stands whole and acts as before, ``NEW`` only if the new set
        stands whole, sealed and enabled, ``DISABLED`` in every other case with tables off.
    """
    if manifest is None:
        return Decision(ControllerState.OLD, Action.NOTHING, "no upload is under way")
    if crc == manifest.crc_old and i51 == manifest.enabled_old:
        if not (crc == manifest.crc_new and manifest.state is ManifestState.VALID and i51):
            return Decision(ControllerState.OLD, Action.NOTHING, "the old tables are untouched")
        return Decision(ControllerState.NEW, Action.NOTHING, "old and new tables are the same")
    if i51 and crc:
        return _decide_enabled(manifest, crc)
    if crc == manifest.crc_new:
        stands = "the new tables stand whole, switched off" if crc else "no tables, as was meant"
        return Decision(ControllerState.DISABLED, Action.RESUME, stands)
    return Decision(
        ControllerState.DISABLED, Action.ROLL_BACK, "tables are switched off, none or incomplete"
    )


def _decide_enabled(manifest: Manifest, crc: int) -> Decision:
    if crc == manifest.crc_new and manifest.state is ManifestState.VALID:
        return Decision(ControllerState.NEW, Action.NOTHING, "the new tables act")
    if crc == manifest.crc_old:
        return Decision(ControllerState.OLD, Action.NOTHING, "the old tables act")
    return Decision(
        ControllerState.DISABLED,
        Action.DISABLE,
        "foreign change: tables act that are neither the old nor the sealed new ones",
    )


@dataclass(frozen=True)
class Lease:
    """Who may write, and until when on the controller's own clock (1/1024 s since power-up)."""

    owner: int
    expires: int

    @property
    def is_free(self) -> bool:
        """Whether nobody holds it."""
        return self.owner == 0

    def is_held_against(self, owner: int, now: int) -> bool:
        """Whether somebody else holds it at this time.

        One that ends later than anybody asks for is of another time: the clock began anew with a
        reset and the P-variables came back from the flash, or something else wrote there.
        """
        last = now + int(LONGEST_LEASE_s * CLOCK_PER_s)
        return not self.is_free and self.owner != owner and now <= self.expires <= last

    def lines(self, block: LawBlock) -> list[str]:
        """Commands that write the lease, its end first."""
        first = block.p(Index.LEASE)
        return [f"P{first + 1}={self.expires}", f"P{first}={self.owner}"]
