"""Compensation tables as values: position, backlash and torque tables, their text and checksum.

What lives here: validation, the lines that define a table, the parser of what the card lists, the
host's own reading of what a table does. What may not: order rules between tables (``table_set``),
limits in um (``safety``), the wire. Source: Software Reference Manual p. 301-311, 341-350.
"""

import re
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Final

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ConfigError, RemoteProtocolError
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.card.registers import motor_base

CT16_PER_CT: Final = 16.0  # entries are in 1/16 count (Software Reference Manual p. 303)
ENTRY_MIN: Final = -(1 << 23)
ENTRY_MAX: Final = (1 << 23) - 1
SPAN_MAX: Final = (1 << 31) - 1
ENTRIES_MAX: Final = 65535
ENTRIES_PER_LINE: Final = 12  # at most 108 characters, far below the 255 of a command line
_HEADER: Final = re.compile(r"^\s*(\d+)\s*,\s*#(\d+)(D?)\s*,\s*#(\d+)(D?)\s*,\s*(\d+)\s*$", re.I)
_SHORT_HEADER: Final = re.compile(r"^\s*(\d+)\s*,\s*(\d+)\s*$")


class TableKind(Enum):
    """Kind of a table, valued by its command word, in the order in which they are defined."""

    COMP = "COMP"
    TCOMP = "TCOMP"
    BLCOMP = "BLCOMP"


@dataclass(frozen=True)
class Table:
    """What all three kinds share: the motor that owns the table, its entries and its span.

    Entry k (from 1) belongs to position k * span / n from the motor's zero; the correction at
    position 0 is zero, or the last entry when the table was loaded with I30 = 1.

    Parameters
    ----------
    motor : int
        Motor that owns the table.
    entries : tuple of int
        Values in the unit of the kind.
    span_ct : int
        Length of the table in counts of the source motor; beyond it the table repeats.
    wrap : bool
        Loaded with I30 = 1.
    is_wrap_guessed : bool
        Whether the card did not show what it holds at position 0.
    """

    motor: int
    entries: tuple[int, ...]
    span_ct: int
    wrap: bool = False
    is_wrap_guessed: bool = field(default=False, compare=False, kw_only=True)

    def __post_init__(self) -> None:
        motor_base(self.motor)
        object.__setattr__(self, "entries", _checked(self.entries))
        if not 0 < self.span_ct <= SPAN_MAX:
            raise ConfigError(
                f"A table span of {self.span_ct} counts is not possible.", code="PC-TBL-003"
            )
        if self.span_ct < len(self.entries):
            raise ConfigError(
                f"{len(self.entries)} entries over {self.span_ct} counts: "
                "the spacing is below one count.",
                code="PC-TBL-004",
                hint="Use fewer entries.",
            )

    @property
    def kind(self) -> TableKind:
        """Kind of the table."""
        raise NotImplementedError

    @property
    def spacing_ct(self) -> float:
        """Counts between neighbouring entries."""
        return self.span_ct / len(self.entries)

    @property
    def definition(self) -> str:
        """Command that defines the table for its motor."""
        return f"#{self.motor}DEFINE {self.kind.value} {len(self.entries)},{self.span_ct}"

    @cached_property
    def lines(self) -> tuple[str, ...]:
        """Lines that define and fill the table, I30 first."""
        return (f"I30={int(self.wrap)}", self.definition, *entry_lines(self.listed.split()))

    @property
    def largest_entry(self) -> int:
        """Largest size of an entry, in the unit of the entries."""
        return max(map(abs, self.entries))

    @cached_property
    def listed(self) -> str:
        """Entries as text, with blanks between."""
        # By one pattern for all: in half the time of as many conversions.
        return " ".join(("%d",) * len(self.entries)) % self.entries

    @cached_property
    def canonical(self) -> str:
        """Text that the checksum is taken of: what the card lists, and a jump at position 0."""
        return f"{self.kind.value} {self.motor} {self.span_ct} {self.listed}{self._jump}"

    @property
    def jumps(self) -> bool:
        """Whether the table jumps where it repeats: from its last entry to zero."""
        return not self.wrap and self.entries[-1] != 0

    @property
    def _jump(self) -> str:
        return " I30=0" if self.jumps else ""

    @property
    def crc(self) -> int:
        """CRC-32 of the canonical text."""
        return zlib.crc32(self.canonical.encode("ascii"))

    def at(self, position_ct: FloatArray | float) -> FloatArray:
        """Table value at positions in counts, in the unit of the entries.

        Linear between neighbours, position reduced modulo the span (the host's own reading of
        p. 302-305).
        """
        first = self.entries[-1] if self.wrap else 0
        knots = np.array([first, *self.entries], dtype=float)
        where = np.mod(np.asarray(position_ct, dtype=float), self.span_ct) / self.spacing_ct
        return np.asarray(np.interp(where, np.arange(len(knots), dtype=float), knots))


@dataclass(frozen=True)
class CompTable(Table):
    """Position compensation: entries in 1/16 count of the target, added to its command.

    Parameters
    ----------
    source : int
        Motor whose position selects the entry; the owner if 0.
    target : int
        Motor that is corrected; the owner if 0.
    by_desired : bool
        Look up by desired instead of actual position.
    """

    source: int = 0
    target: int = 0
    by_desired: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "source", self.source or self.motor)
        object.__setattr__(self, "target", self.target or self.motor)
        motor_base(self.source)
        motor_base(self.target)

    @property
    def kind(self) -> TableKind:
        """COMP."""
        return TableKind.COMP

    @property
    def definition(self) -> str:
        """Command that defines the table, source and target always stated."""
        desired = "D" if self.by_desired else ""
        return (
            f"#{self.motor}DEFINE COMP {len(self.entries)},"
            f"#{self.source}{desired},#{self.target},{self.span_ct}"
        )

    @cached_property
    def canonical(self) -> str:
        """Text that the checksum is taken of; the D of the source is not always listed."""
        head = f"COMP {self.motor} {self.source} {self.target} {self.span_ct}"
        return f"{head} {self.listed}{self._jump}"

    def correction_ct(self, position_ct: FloatArray | float) -> FloatArray:
        """Correction in counts of the target at source positions in counts."""
        return self.at(position_ct) / CT16_PER_CT

    @property
    def largest_correction_ct(self) -> float:
        """Largest size of a correction in counts of the target."""
        return self.largest_entry / CT16_PER_CT


@dataclass(frozen=True)
class BacklashTable(Table):
    """Backlash: entries in 1/16 count, subtracted while the last motion was negative."""

    @property
    def kind(self) -> TableKind:
        """BLCOMP."""
        return TableKind.BLCOMP

    def backlash_ct(self, position_ct: FloatArray | float) -> FloatArray:
        """Backlash in counts at positions in counts."""
        return self.at(position_ct) / CT16_PER_CT


@dataclass(frozen=True)
class TorqueTable(Table):
    """Torque: entries in 1/256 DAC unit, added to the servo output."""

    @property
    def kind(self) -> TableKind:
        """TCOMP."""
        return TableKind.TCOMP

    def torque_dac(self, position_ct: FloatArray | float) -> FloatArray:
        """Torque in 16-bit DAC units at positions in counts."""
        return self.at(position_ct) / 256.0


@dataclass(frozen=True)
class TableHeader:
    """What ``LIST ... DEF`` says of a table."""

    kind: TableKind
    motor: int
    n_entries: int
    span_ct: int
    source: int
    target: int
    by_desired: bool | None  # None: the card does not say

    def is_of(self, table: Table, listed: str) -> bool:
        """Whether this header with the entries listed is that table, character by character.

        Of a table that does not end with 0 the listing does not tell all.
        """
        by_desired = isinstance(table, CompTable) and table.by_desired
        if table.entries[-1] or by_desired != bool(self.by_desired):
            return False
        who = f"{self.source} {self.target} " if self.kind is TableKind.COMP else ""
        canonical = f"{self.kind.value} {self.motor} {who}{self.span_ct} {listed}"
        return self.n_entries == len(table.entries) and canonical == table.canonical


def entry_lines(texts: Sequence[str]) -> list[str]:
    """Entries as lines of blank-separated numbers, each well below the line limit."""
    starts = range(0, len(texts), ENTRIES_PER_LINE)
    return [" ".join(texts[k : k + ENTRIES_PER_LINE]) for k in starts]


def parse_header(kind: TableKind, motor: int, lines: Sequence[str]) -> TableHeader:
    """Header of a table from the answer to ``LIST <kind> DEF``.

    Raises
    ------
    RemoteProtocolError
        Unknown form; two-dimensional tables are not ours and are refused with their header.
    """
    text = " ".join(lines).strip()
    if kind is TableKind.COMP:
        match = _HEADER.match(text)
        if match:
            count, source, desired, target, target_desired, span = match.groups()
            said = True if desired or target_desired else None
            return TableHeader(
                kind, motor, int(count), int(span), int(source), int(target), by_desired=said
            )
    else:
        match = _SHORT_HEADER.match(text)
        if match:
            return TableHeader(
                kind, motor, int(match[1]), int(match[2]), motor, motor, by_desired=None
            )
    raise RemoteProtocolError(
        f"LIST {kind.value} DEF of motor #{motor} answered {text!r}, which is not understood.",
        code="PC-TBL-010",
        hint="Two-dimensional tables are left alone; delete them by hand if they may go.",
    )


def parse_entries(lines: Iterable[str]) -> tuple[int, ...]:
    """Entries from the answer to ``LIST <kind>``: white space separates, lines do not matter."""
    items = " ".join(lines).split()
    try:
        return tuple(map(int, items))
    except ValueError:
        return tuple(map(parse_integer, items))  # names the item that is no integer


def build_table(
    header: TableHeader, entries: tuple[int, ...], *, at_zero: int | None = None
) -> Table:
    """Table from what the card listed, and holds at position 0.

    Parameters
    ----------
    header, entries
        As listed.
    at_zero : int or None
        Value at position 0. If the card does not show it, that of a table which goes on smoothly
        where it repeats is taken.

    Raises
    ------
    RemoteProtocolError
        Number of entries differs from the header.
    """
    if len(entries) != header.n_entries:
        raise RemoteProtocolError(
            f"{header.kind.value} of motor #{header.motor} lists {len(entries)} entries, "
            f"its header says {header.n_entries}.",
            code="PC-TBL-011",
        )
    wrap = entries[-1] != 0 and at_zero != 0
    guessed = wrap and at_zero is None
    if header.kind is TableKind.COMP:
        return CompTable(
            header.motor,
            entries,
            header.span_ct,
            wrap,
            is_wrap_guessed=guessed,
            source=header.source,
            target=header.target,
            by_desired=bool(header.by_desired),
        )
    maker = BacklashTable if header.kind is TableKind.BLCOMP else TorqueTable
    return maker(header.motor, entries, header.span_ct, wrap, is_wrap_guessed=guessed)


def same_on_card(meant: Table, found: Table) -> bool:
    """Whether a table that was read back is the one that was meant, entry by entry."""
    return meant.canonical == found.canonical


def _checked(entries: tuple[int, ...]) -> tuple[int, ...]:
    """Entries as plain integers."""
    if not 1 <= len(entries) <= ENTRIES_MAX:
        raise ConfigError(
            f"A table has 1 to {ENTRIES_MAX} entries, not {len(entries)}.", code="PC-TBL-001"
        )
    if set(map(type, entries)) == {int} and min(entries) >= ENTRY_MIN and max(entries) <= ENTRY_MAX:
        return tuple(entries)
    for k, value in enumerate(entries, start=1):
        if isinstance(value, bool) or not isinstance(value, int | np.integer):
            raise ConfigError(f"Entry {k} is {value!r}, not an integer.", code="PC-TBL-002")
        if not ENTRY_MIN <= value <= ENTRY_MAX:
            raise ConfigError(
                f"Entry {k} is {value}; a table word holds {ENTRY_MIN} to {ENTRY_MAX}.",
                code="PC-TBL-002",
            )
    return tuple(map(int, entries))
