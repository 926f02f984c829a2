"""Compensation tables: storage in the card's buffer memory, order rules, look-up.

What lives here: DEFINE, DELETE and LIST of COMP, TCOMP and BLCOMP tables, and the interpolation
that the servo kernel calls. What may not: parsing of whole command lines, motors.
Imports numba, ``memory`` and ``registers``.

Tables lie in user memory from its end downward, in the order of definition, so the order rules of
the card keep the memory free of holes. One table is five header words and one long word per value
(value 0 included), so that SAVE and reload need to know nothing of tables.

Source: Turbo PMAC Software Reference Manual p. 300-317, 341-350, 509.
"""

import math
import re
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numba import njit

from pmac_comp.base.arrays import IntArray
from pmac_comp.simulator.memory import registers as reg
from pmac_comp.simulator.memory.errors import ERR_MEMORY, ERR_ORDER
from pmac_comp.simulator.memory.memory import (
    LARGEST_LONG,
    Memory,
    Space,
    read_long,
    read_word_signed,
    write_long,
)
from pmac_comp.simulator.memory.user_memory import (
    GATHER,
    LOOKAHEAD,
    ROTARY,
    TBUF,
    allocate_down,
    buffer_exists,
)

HEADER: Final = 5
VALUES_PER_LINE: Final = 12
_LIMIT = 0x7FFFFF

# Columns of a decoded table.
(
    T_KIND,
    T_SOURCE,
    T_DESIRED,
    T_TARGET,
    T_COLUMNS,
    T_ROWS,
    T_VALUES,
    T_SOURCE2,
    T_DESIRED2,
    T_SPAN,
    T_SPAN2,
    N_TABLE,
) = range(12)


class TableKind(Enum):
    """Kinds of tables, with the place of their pointers and the order in which they are defined."""

    COMP = reg.COMP_POINTERS
    TCOMP = reg.TCOMP_POINTERS
    BLCOMP = reg.BLCOMP_POINTERS


_KINDS = (TableKind.COMP, TableKind.TCOMP, TableKind.BLCOMP)
# Buffers that must not exist when a table is defined or deleted (p. 301-317).
_BLOCKS_DEFINE = (TBUF, ROTARY, LOOKAHEAD, GATHER)
_BLOCKS_DELETE = (TBUF, ROTARY, GATHER)
_SOURCE = re.compile(r"#(\d+)(D?)")
_SIZE_1D = re.compile(r"\d+")
_SIZE_2D = re.compile(r"(\d+)\.(\d+)")


@dataclass(frozen=True)
class TableHeader:
    """What DEFINE says of a table; ``rows`` is 0 for a one-dimensional one."""

    columns: int
    rows: int
    source: int
    source_desired: bool
    source2: int
    source2_desired: bool
    target: int
    span_ct: int
    span2_ct: int

    @property
    def n_values(self) -> int:
        """Values the table holds, the one at zero included."""
        return (self.rows + 1) * (self.columns + 1) if self.rows else self.columns + 1


class CompensationTables:
    """DEFINE, values, LIST and DELETE of all tables of a card.

    Every method that changes something answers with an error number (0 = done), as the command
    that asks for it does.
    """

    def __init__(self, memory: Memory) -> None:
        self._memory = memory
        self._filling: tuple[TableKind, int] | None = None

    def exists(self, kind: TableKind, motor: int) -> bool:
        """True if the motor has a table of this kind."""
        return bool(self._memory.x[kind.value + motor - 1])

    def define(self, kind: TableKind, motor: int, arguments: str) -> int:
        """DEFINE COMP, TCOMP or BLCOMP for the addressed motor.

        Parameters
        ----------
        kind : TableKind
            Which table.
        motor : int
            Addressed motor, 1-32.
        arguments : str
            What follows the keyword, e.g. ``100,#2D,#3,100000``.

        Returns
        -------
        int
            0, 3 (syntax or order) or 6 (no room).
        """
        header = _parse(kind, motor, arguments.replace(" ", "").upper())
        if header is None or self._blocked(kind, motor, _BLOCKS_DEFINE):
            return ERR_ORDER
        if self.exists(kind, motor):
            return ERR_ORDER
        start = allocate_down(self._memory, HEADER + header.n_values)
        if start is None:
            return ERR_MEMORY
        _write_header(self._memory, start, header)
        pointer = kind.value + motor - 1
        self._memory.x[pointer] = start
        self._memory.y[pointer] = start + HEADER + 1
        self._memory.y[start + HEADER] = 0
        self._filling = (kind, motor)
        self._update_highest()
        self._memory.touch()
        return 0

    def wants_values(self) -> bool:
        """True while a defined table is not full: bare constants go into it."""
        return self._filling is not None

    def store(self, value: float) -> int:
        """Put the next value into the table being filled; 3 if there is none or it is too large."""
        number = int(value)
        if self._filling is None or abs(number) > _LIMIT:
            return ERR_ORDER
        kind, motor = self._filling
        pointer = kind.value + motor - 1
        memory = self._memory
        start = int(memory.x[pointer])
        address = int(memory.y[pointer])
        header = read_header(memory, start)
        memory.y[address] = number & 0xFFFFFF
        memory.y[pointer] = address + 1
        memory.y[start + 3] = address - start - HEADER
        if address + 1 == start + HEADER + header.n_values:
            self._finish(start, header)
        memory.touch()
        return 0

    def _finish(self, start: int, header: TableHeader) -> None:
        """Full: I30 decides now what stands at position zero (p. 53)."""
        self._filling = None
        if int(self._memory.x[reg.INTERNAL_GLOBAL + 30]) and not header.rows:
            last = int(self._memory.y[start + HEADER + header.columns])
            self._memory.y[start + HEADER] = last

    def delete(self, kind: TableKind, motor: int) -> int:
        """DELETE COMP, TCOMP or BLCOMP; deleting a table that does not exist is accepted."""
        if self._blocked(kind, motor, _BLOCKS_DELETE):
            return ERR_ORDER
        pointer = kind.value + motor - 1
        self._memory.x[pointer] = 0
        self._memory.y[pointer] = 0
        if self._filling == (kind, motor):
            self._filling = None
        self._update_highest()
        self._memory.touch()
        return 0

    def delete_all(self) -> None:
        """DELETE ALL and ``$$$***``: no table is left."""
        for kind in _KINDS:
            self._memory.x[kind.value : kind.value + reg.MOTORS] = 0
            self._memory.y[kind.value : kind.value + reg.MOTORS] = 0
        self._filling = None
        self._update_highest()
        self._memory.touch()

    def reloaded(self) -> None:
        """Memory was restored from flash: no table is being filled."""
        self._filling = None
        self._update_highest()
        self._memory.touch()

    def list_definition(self, kind: TableKind, motor: int) -> str | None:
        """Line of LIST ... DEF, None if there is no table."""
        if not self.exists(kind, motor):
            return None
        header = read_header(self._memory, int(self._memory.x[kind.value + motor - 1]))
        if kind is not TableKind.COMP:
            return f"{header.columns},{header.span_ct}"
        first = f"#{header.source}{'D' if header.source_desired else ''}"
        if not header.rows:
            return f"{header.columns},{first},#{header.target},{header.span_ct}"
        second = f"#{header.source2}{'D' if header.source2_desired else ''}"
        return (
            f"{header.rows},{header.columns},{first},{second},#{header.target},"
            f"{header.span_ct},{header.span2_ct}"
        )

    def list_values(self, kind: TableKind, motor: int) -> list[str] | None:
        """Lines of LIST COMP (TCOMP, BLCOMP) in entry order, None if there is no table."""
        values = self.values(kind, motor)
        if values is None:
            return None
        texts = [str(value) for value in values]
        return [
            " ".join(texts[i : i + VALUES_PER_LINE]) for i in range(0, len(texts), VALUES_PER_LINE)
        ]

    def values(self, kind: TableKind, motor: int) -> list[int] | None:
        """Entries of a table (position zero left out), None if there is no table."""
        if not self.exists(kind, motor):
            return None
        start = int(self._memory.x[kind.value + motor - 1])
        header = read_header(self._memory, start)
        first = start + HEADER + 1
        return [
            int(read_word_signed(self._memory.y, first + i)) for i in range(header.n_values - 1)
        ]

    def _blocked(self, kind: TableKind, motor: int, buffers: tuple[str, ...]) -> bool:
        later = _KINDS[_KINDS.index(kind) + 1 :]
        if any(self.exists(other, m) for other in later for m in range(1, reg.MOTORS + 1)):
            return True
        if any(self.exists(kind, lower) for lower in range(1, motor)):
            return True
        return any(buffer_exists(self._memory, name) for name in buffers)

    def _update_highest(self) -> None:
        used = [m for m in range(1, reg.MOTORS + 1) if any(self.exists(k, m) for k in _KINDS)]
        self._memory.x[reg.HIGHEST_TABLE] = max(used, default=0)


def _parse(kind: TableKind, motor: int, text: str) -> TableHeader | None:
    parts = text.split(",")
    size = _SIZE_2D.fullmatch(parts[0])
    if size is not None and kind is TableKind.COMP:
        return _parse_2d(motor, int(size[1]), int(size[2]), parts[1:])
    span = _count(parts[-1]) if len(parts) > 1 else None
    motors = _motors(parts[1:-1], 2 if kind is TableKind.COMP else 0)
    if _SIZE_1D.fullmatch(parts[0]) is None or int(parts[0]) < 1 or span is None or motors is None:
        return None
    if len(motors) == 2 and motors[1][1]:
        return None
    source, desired = motors[0] if motors else (motor, False)
    target = motors[1][0] if len(motors) == 2 else motor
    return TableHeader(
        columns=int(parts[0]),
        rows=0,
        source=source,
        source_desired=desired,
        source2=0,
        source2_desired=False,
        target=target,
        span_ct=span,
        span2_ct=0,
    )


def _motors(parts: list[str], most: int) -> list[tuple[int, bool]] | None:
    """Motor numbers with their D mark, None if one is not a motor or there are too many."""
    matches = [_SOURCE.fullmatch(part) for part in parts]
    found = [(int(match[1]), bool(match[2])) for match in matches if match is not None]
    good = len(found) == len(parts) <= most and all(1 <= m <= reg.MOTORS for m, _ in found)
    return found if good else None


def _parse_2d(motor: int, rows: int, columns: int, parts: list[str]) -> TableHeader | None:
    motors = _motors(parts[:-2], 3)
    spans = [_count(part) for part in parts[-2:]]
    if not motors or rows < 1 or columns < 1 or len(spans) != 2:
        return None
    if spans[0] is None or spans[1] is None or (len(motors) == 3 and motors[2][1]):
        return None
    second = motors[1] if len(motors) > 1 else (motor, False)
    target = motors[2][0] if len(motors) > 2 else motor
    return TableHeader(columns, rows, *motors[0], *second, target, spans[0], spans[1])


def _count(text: str) -> int | None:
    """Positive number of counts; the card keeps whole counts."""
    if not re.fullmatch(r"\d+(\.\d*)?", text):
        return None
    value = int(float(text))
    return value if 1 <= value <= LARGEST_LONG else None


def _write_header(memory: Memory, start: int, header: TableHeader) -> None:
    memory.x[start] = header.source | (int(header.source_desired) << 8)
    memory.y[start] = header.target
    memory.x[start + 1] = header.columns
    memory.y[start + 1] = header.rows
    write_long(memory.x, memory.y, start + 2, header.span_ct)
    memory.x[start + 3] = header.source2 | (int(header.source2_desired) << 8)
    memory.y[start + 3] = 0
    write_long(memory.x, memory.y, start + 4, header.span2_ct)


def read_header(memory: Memory, start: int) -> TableHeader:
    """Header of the table that starts at an address."""
    return TableHeader(
        columns=int(memory.x[start + 1]),
        rows=int(memory.y[start + 1]),
        source=int(memory.x[start]) & 0xFF,
        source_desired=bool(int(memory.x[start]) & 0x100),
        source2=int(memory.x[start + 3]) & 0xFF,
        source2_desired=bool(int(memory.x[start + 3]) & 0x100),
        target=int(memory.y[start]),
        span_ct=int(read_long(memory.x, memory.y, start + 2)),
        span2_ct=int(read_long(memory.x, memory.y, start + 4)),
    )


@njit(cache=True)
def decode_tables(x: Space, y: Space, tables: IntArray) -> int:
    """Decode all tables for the servo kernel; COMP first, then TCOMP, then BLCOMP."""
    n = 0
    for kind in range(3):
        base = reg.COMP_POINTERS
        if kind == 1:
            base = reg.TCOMP_POINTERS
        elif kind == 2:
            base = reg.BLCOMP_POINTERS
        for i in range(32):
            start = int(x[base + i])
            if start == 0 or start >= x.shape[0] - HEADER:
                continue
            row = tables[n]
            row[T_KIND] = kind
            row[T_SOURCE] = x[start] & 0xFF
            row[T_DESIRED] = (x[start] >> 8) & 1
            row[T_TARGET] = y[start]
            row[T_COLUMNS] = x[start + 1]
            row[T_ROWS] = y[start + 1]
            row[T_VALUES] = start + HEADER
            row[T_SOURCE2] = x[start + 3] & 0xFF
            row[T_DESIRED2] = (x[start + 3] >> 8) & 1
            row[T_SPAN] = read_long(x, y, start + 2)
            row[T_SPAN2] = read_long(x, y, start + 4)
            # Words that were written over by hand must not lead outside of memory.
            n_values = (row[T_ROWS] + 1) * (row[T_COLUMNS] + 1)
            sane = 0 < row[T_SOURCE] <= 32 and 0 < row[T_TARGET] <= 32 and row[T_COLUMNS] > 0
            sane = sane and row[T_SPAN] > 0 and start + HEADER + n_values < x.shape[0]
            if row[T_ROWS] > 0:
                sane = sane and row[T_SPAN2] > 0 and 0 < row[T_SOURCE2] <= 32
            if sane:
                n += 1
    return n


@njit(cache=True)
def _knot(position: float, span: float, n: int) -> tuple[int, float]:
    """Interval and fraction of a position that rolls over at ``span``."""
    s = (position / span - math.floor(position / span)) * n
    k = min(int(s), n - 1)
    return k, s - k


@njit(cache=True)
def look_up(y: Space, table: IntArray, position_ct: float, position2_ct: float) -> float:
    """Value of a table at source positions in counts, linear or bilinear."""
    values = table[T_VALUES]
    columns = table[T_COLUMNS]
    k, f = _knot(position_ct, float(table[T_SPAN]), columns)
    if table[T_ROWS] == 0:
        low = read_word_signed(y, values + k)
        high = read_word_signed(y, values + k + 1)
        return float(low + f * (high - low))
    r, g = _knot(position2_ct, float(table[T_SPAN2]), table[T_ROWS])
    a = values + r * (columns + 1) + k
    b = a + columns + 1
    low = (1.0 - f) * read_word_signed(y, a) + f * read_word_signed(y, a + 1)
    high = (1.0 - f) * read_word_signed(y, b) + f * read_word_signed(y, b + 1)
    return float(low + g * (high - low))


def empty_tables() -> IntArray:
    """Room for three tables of each of 32 motors."""
    return np.zeros((96, N_TABLE), dtype=np.int64)
