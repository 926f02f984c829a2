"""What stands on a controller about its tables: manifest, switch and checksum, judged."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from pmac_comp.base.errors import ControllerState, ProtocolError
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.variables import VARIABLES
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.lease import parse_lease
from pmac_comp.machine.controller.change.manifest import (
    MAGIC,
    MANIFEST_SIZE,
    Action,
    Decision,
    Lease,
    Manifest,
    ManifestState,
    decide,
)
from pmac_comp.machine.controller.contents.law_bank import Index
from pmac_comp.machine.controller.contents.table_set import (
    TableSet,
    read_tables,
)
from pmac_comp.machine.wire.numbers import read_number

_P_STEP: Final = 64
FLASH_FAULTS: Final = (1 << 13) | (1 << 10)  # checksum and flash error in ???, first word
HEAD_LINES: Final = 3 + MANIFEST_SIZE + 2 + 1


@dataclass(frozen=True)
class Head:
    """What one question tells about tables, manifest and lease."""

    i51: int
    i30: int
    free_long_words: int
    manifest: Manifest | None
    lease: Lease
    global1: int
    global2: int


@dataclass(frozen=True)
class TableStatus:
    """State of the tables on a controller."""

    decision: Decision
    tables: TableSet
    manifest: Manifest | None
    i51: int


def read_head(link: Link, context: Context) -> Head:
    """I51, I30, SIZE, manifest, lease and global status in one question."""
    return parse_head(link.query(head_text(context)))


def head_text(context: Context) -> str:
    """Question for a head; others may stand behind it in the same line."""
    first = context.block.p(Index.MANIFEST)
    return f"I51I30SIZEP{first}..{first + MANIFEST_SIZE + 1}???"


def parse_head(lines: Sequence[str]) -> Head:
    """Head from the answer to ``head_text``; raises ProtocolError."""
    if len(lines) != HEAD_LINES or len(lines[-1].strip()) != 12:
        raise ProtocolError(
            f"The controller answered {len(lines)} lines to {HEAD_LINES} questions."
        )
    values = [float(read_number(v)) for v in lines[:-1]]
    digits = lines[-1].strip()
    return Head(
        i51=int(values[0]),
        i30=int(values[1]),
        free_long_words=int(values[2]),
        manifest=Manifest.from_values(values[3 : 3 + MANIFEST_SIZE]),
        lease=parse_lease(values[3 + MANIFEST_SIZE :]),
        global1=int(digits[:6], 16),
        global2=int(digits[6:], 16),
    )


def announced_elsewhere(link: Link, context: Context, tables: TableSet) -> Decision | None:
    """Who announced tables that are not those of our manifest: the bench file of another axis.

    Its block holds a sealed manifest of just these tables, or says that they were left when one was
    taken back. Asked where they would else be foreign.
    """
    values: list[float] = []
    for first in range(0, VARIABLES, _P_STEP):
        lines = link.query(f"P{first}..{first + _P_STEP - 1}")
        values += [float(read_number(line)) for line in lines]
    own = context.block.p(Index.MANIFEST)
    for n, value in enumerate(values):
        found = Manifest.told_by(values[n : n + MANIFEST_SIZE]) if value == MAGIC else None
        if found is None or n == own or found.crc_new != tables.crc:
            continue
        if found.state is not ManifestState.WRITING:
            block = n - int(Index.MANIFEST)
            did = "meant" if found.state is ManifestState.VALID else "that was taken back left"
            reason = f"tables act as an upload with the p_block at P{block} {did} them"
            return Decision(ControllerState.NEW, Action.NOTHING, reason)
    return None


def table_status(
    link: Link, context: Context, *, journal_manifest: Manifest | None = None
) -> TableStatus:
    """What stands on the controller, judged by ``decide``."""
    head = read_head(link, context)
    tables = read_tables(link)
    manifest = head.manifest
    ours = journal_manifest
    # Cut before the manifest was written whole: what is there is an older upload's.
    if ours is not None and (manifest is None or manifest.transaction != ours.transaction):
        decision = decide(ours, head.i51, tables.crc)
        if decision.action is not Action.DISABLE or manifest is None:
            return TableStatus(decision, tables, ours, head.i51)
    return TableStatus(decide(manifest, head.i51, tables.crc), tables, manifest, head.i51)
