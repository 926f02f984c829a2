"""All tables of a controller together: what is there, and in which order it may be changed.

The card keeps its tables in one stack (Software Reference Manual p. 303, 311-317): COMP tables
from the highest motor down, then TCOMP, then BLCOMP; only the top may go. Changing one table
therefore may mean to take others off and to put them back, and this module plans that.
"""

import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

from pmac_comp.base.errors import CommandRefused, RemoteProtocolError
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.card.registers import (
    BLCOMP_POINTERS,
    COMP_POINTERS,
    TCOMP_POINTERS,
)
from pmac_comp.machine.controller.contents.comp_table import (
    CompTable,
    Table,
    TableKind,
    build_table,
    parse_entries,
    parse_header,
    same_on_card,
)

Key = tuple[TableKind, int]
POINTERS_TEXT: Final = f"RX${BLCOMP_POINTERS:X},96"
"""Question for all start addresses; the last of its line, since it is answered with many."""
_POINTERS: Final = {
    TableKind.BLCOMP: BLCOMP_POINTERS,
    TableKind.TCOMP: TCOMP_POINTERS,
    TableKind.COMP: COMP_POINTERS,
}
_COMPARED: Final = 15  # entries that are looked for in the memory
_WORD: Final = 1 << 24
_KINDS = (TableKind.COMP, TableKind.TCOMP, TableKind.BLCOMP)


@dataclass(frozen=True)
class TableSet:
    """Tables of a controller, at most one of a kind per motor, in the order of definition."""

    tables: tuple[Table, ...] = ()

    def __post_init__(self) -> None:
        ordered = tuple(sorted(self.tables, key=lambda t: _rank((t.kind, t.motor))))
        keys = [(t.kind, t.motor) for t in ordered]
        if len(set(keys)) != len(keys):
            raise ValueError("a motor has at most one table of a kind")
        object.__setattr__(self, "tables", ordered)

    def __iter__(self) -> Iterator[Table]:
        return iter(self.tables)

    def __len__(self) -> int:
        return len(self.tables)

    def get(self, kind: TableKind, motor: int) -> Table | None:
        """Table of a kind owned by a motor."""
        return next((t for t in self.tables if (t.kind, t.motor) == (kind, motor)), None)

    def with_tables(self, new: Iterable[Table], *, without: Iterable[Key] = ()) -> "TableSet":
        """Set in which ``new`` replace tables of the same kind and motor, ``without`` are gone."""
        changed = {(t.kind, t.motor): t for t in self.tables}
        for key in without:
            changed.pop(key, None)
        changed.update({(t.kind, t.motor): t for t in new})
        return TableSet(tuple(changed.values()))

    @cached_property
    def crc(self) -> int:
        """CRC-32 over all tables in order; 0 for none."""
        if not self.tables:
            return 0
        return zlib.crc32("\n".join(t.canonical for t in self.tables).encode("ascii"))

    @property
    def n_entries(self) -> int:
        """Entries of all tables."""
        return sum(len(t.entries) for t in self.tables)

    @property
    def motors(self) -> tuple[int, ...]:
        """Motors that own, select or receive a table."""
        found = {t.motor for t in self.tables}
        for table in self.tables:
            if isinstance(table, CompTable):
                found |= {table.source, table.target}
        return tuple(sorted(found))


@dataclass(frozen=True)
class TablePlan:
    """Steps from one set to another: deletions in order, then definitions in order."""

    delete: tuple[Key, ...]
    define: tuple[Table, ...]

    @property
    def delete_lines(self) -> list[str]:
        """Commands that take the tables off."""
        return [f"#{motor}DELETE {kind.value}" for kind, motor in self.delete]

    @property
    def define_lines(self) -> list[str]:
        """Commands that define and fill the new tables."""
        return [line for table in self.define for line in table.lines]


def plan(old: TableSet, new: TableSet) -> TablePlan:
    """Least change from ``old`` to ``new`` that the order rules allow.

    The common bottom of the two stacks stays; what lies above goes and is built anew.
    """
    keep = 0
    for before, after in zip(old.tables, new.tables, strict=False):
        if before.canonical != after.canonical or _desired(before) != _desired(after):
            break
        keep += 1
    gone = [(t.kind, t.motor) for t in reversed(old.tables[keep:])]
    return TablePlan(tuple(gone), new.tables[keep:])


def read_tables(
    link: Link,
    keys: Sequence[Key] | None = None,
    expected: TableSet | None = None,
    *,
    meanwhile: Callable[[], None] | None = None,
) -> TableSet:
    """All tables on the controller, headers and entries.

    Parameters
    ----------
    link : Link
        Conversation.
    keys : sequence of (TableKind, int), optional
        Tables to look at; those with a start address in the card's pointer words if not given.
    expected : TableSet, optional
        Tables that may well stand there: one that is listed exactly so is not parsed again.
    meanwhile : callable, optional
        Work of the host that is done while the first listing is on its way.
    """
    found: list[Table] = []
    for kind, motor in candidates(link) if keys is None else keys:
        twin = expected.get(kind, motor) if expected else None
        table = read_table(link, kind, motor, twin, meanwhile=meanwhile)
        meanwhile = None
        if table is not None:
            found.append(table)
    return TableSet(tuple(found))


def read_table(
    link: Link,
    kind: TableKind,
    motor: int,
    expected: Table | None = None,
    *,
    meanwhile: Callable[[], None] | None = None,
) -> Table | None:
    """One table, None if the motor has none (ERR003, p. 341-350)."""
    try:
        lines = link.query(f"#{motor}LIST {kind.value} DEF")
    except CommandRefused as error:
        if error.context.get("error") in {3, "ERR003", None}:
            return None
        raise
    header = parse_header(kind, motor, lines)
    lines = link.query(f"#{motor}LIST {kind.value}", meanwhile=meanwhile)
    if expected is not None and header.is_of(expected, " ".join(" ".join(lines).split())):
        return expected
    entries = parse_entries(lines)
    if not entries or not entries[-1] or len(entries) != header.n_entries:
        return build_table(header, entries)
    return build_table(header, entries, at_zero=_at_zero(link, (kind, motor), entries))


def _at_zero(link: Link, key: Key, entries: Sequence[int]) -> int | None:
    """What stands at position 0, which no listing shows: 0 or the last entry.

    Entries lie before the storage address that the card keeps beside the start address (Y, p. 509),
    and the value at position 0 before them. How is not documented: None if they do not.
    """
    kind, motor = key
    storage = parse_integer(link.query(f"RY${_POINTERS[kind] + motor - 1:X}")[0])
    first = storage - len(entries) - 1
    if first <= 0:
        return None
    begin = entries[:_COMPARED]
    value, *found = parse_entries(link.query(f"RY${first:X},{len(begin) + 1}"))
    alike = all((a - b) % _WORD == 0 for a, b in zip(begin, found, strict=True))
    known = next((k for k in (0, entries[-1]) if (value - k) % _WORD == 0), None)
    return known if alike else None


def candidates(link: Link) -> list[Key]:
    """Tables that may exist, from the start addresses at X:$003152-$0031B1 (p. 509)."""
    return keys_of(read_pointers(link))


def read_pointers(link: Link) -> tuple[int, ...]:
    """Start addresses of the 96 possible tables: BLCOMP, TCOMP, COMP of motors 1 to 32."""
    return parse_pointers(link.query(POINTERS_TEXT))


def parse_pointers(lines: Sequence[str]) -> tuple[int, ...]:
    """Start addresses from the answer to ``POINTERS_TEXT``; raises RemoteProtocolError."""
    words = parse_entries(lines)
    if len(words) != 96:
        raise RemoteProtocolError(f"96 table pointers were asked for, {len(words)} came.")
    return words


def keys_of(pointers: Sequence[int]) -> list[Key]:
    """Kinds and motors whose start address is not zero: no table can start at the counter."""
    kinds = (TableKind.BLCOMP, TableKind.TCOMP, TableKind.COMP)
    keys = [(kinds[k // 32], k % 32 + 1) for k, word in enumerate(pointers) if word]
    return sorted(keys, key=_rank)


def lists_lookup(found: TableSet) -> bool:
    """Whether the listing tells what selects entries: a card may leave the D of a source out."""
    return any(_desired(t) for t in found) or not any(isinstance(t, CompTable) for t in found)


def with_lookup(found: TableSet, put: TableSet) -> TableSet:
    """``found`` with the D of sources as they were ``put``, for a card that does not list it.

    Tables that are not those that were put stay as listed.
    """
    tables: list[Table] = []
    for table in found:
        twin = put.get(table.kind, table.motor)
        ours = twin is not None and _desired(twin) and same_on_card(twin, table)
        if ours and isinstance(table, CompTable):
            tables.append(replace(table, by_desired=True))
        else:
            tables.append(table)
    return TableSet(tuple(tables))


def same_lookup(meant: TableSet, found: TableSet) -> bool:
    """Whether sources are listed with D where that is meant, or nowhere."""
    listed = {(t.kind, t.motor) for t in found if _desired(t)}
    return not listed or listed == {(t.kind, t.motor) for t in meant if _desired(t)}


def _rank(key: Key) -> tuple[int, int]:
    return _KINDS.index(key[0]), -key[1]


def _desired(table: Table) -> bool:
    return isinstance(table, CompTable) and table.by_desired
