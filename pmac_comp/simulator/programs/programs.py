"""Program buffers of the card: OPEN, CLEAR, CLOSE, LIST of motion programs and PLCs.

What lives here: the text of programs, their entries in the tables at $3000 and $3100, the space
they take in user memory. Running them is in `plcs` and `coordinate_system`.
Source: Turbo PMAC Software Reference Manual p. 295-298, 341-349, 378-385, 509.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from itertools import accumulate, islice

from pmac_comp.simulator.language.assembler import Assembled, assemble
from pmac_comp.simulator.language.parser import StatementParser
from pmac_comp.simulator.language.scanner import Scanner
from pmac_comp.simulator.language.statements import MOTION, PLC, Statement
from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.memory import Memory
from pmac_comp.simulator.memory.user_memory import lowest_defined

PLC_DISABLED = 1 << 22
PLC_OPEN = 1 << 23
MOST_PROGRAMS = 224
_LINE_TEXT_LIMIT = 255


@dataclass
class Program:
    """One program buffer.

    Parameters
    ----------
    kind : str
        ``PROG`` or ``PLC``.
    number : int
        1..32767 or 0..31.
    statements : list of Statement
        What was entered.
    assembled : Assembled or None
        Runnable form, None while the structure is wrong or the buffer is open.
    """

    kind: str
    number: int
    statements: list[Statement] = field(default_factory=list)
    assembled: Assembled | None = None
    _offsets: list[int] = field(default_factory=list, repr=False)
    _counted: tuple[int, int] = (0, 0)  # statements that were counted, their words

    @property
    def words(self) -> int:
        """Long words of memory, the closing RETURN included."""
        count, words = self._counted
        if count > len(self.statements):
            count = words = 0
        words += sum(s.words for s in islice(self.statements, count, None))
        self._counted = (len(self.statements), words)
        return words + 1

    def clear(self) -> None:
        """Drop all statements."""
        self.statements.clear()
        self._counted = (0, 0)

    def lines(self, *, long: bool) -> list[tuple[int, str]]:
        """Word offset and text of each listed line, RETURN last."""
        found: list[tuple[int, str]] = []
        offset = 0
        inline = False
        for index, statement in enumerate(self.statements):
            if statement.kind == "line_end":
                inline = False
                continue
            if statement.starts_line:  # a line that ended on an IF has no mark of its end
                inline = False
            text = statement.long if long else statement.short
            if inline and found and len(found[-1][1]) + len(text) < _LINE_TEXT_LIMIT:
                found[-1] = (found[-1][0], found[-1][1] + text)
            else:
                found.append((offset, text))
            offset += statement.words
            inline = inline or self._opens_inline(index)
        found.append((offset, "RETURN" if long else "RET"))
        return found

    def _opens_inline(self, index: int) -> bool:
        statement = self.statements[index]
        if self.kind != MOTION or statement.kind not in ("if", "else", "while"):
            return False
        following = index + 1
        return (
            following < len(self.statements)
            and not self.statements[following].starts_line
            and self.statements[following].kind != "line_end"
        )

    def reassemble(self) -> None:
        """Make the runnable form; a wrong structure leaves none."""
        try:
            self.assembled = assemble(self.statements, self.kind)
        except CardError:
            self.assembled = None

    def offset_of(self, statement: int) -> int:
        """Word offset of a statement."""
        if len(self._offsets) != len(self.statements) + 1:
            self._offsets = [0, *accumulate(s.words for s in self.statements)]
        return self._offsets[statement]


def end_line(statements: list[Statement]) -> None:
    """Mark the end of a line whose IF, ELSE or WHILE has its action on the same line."""
    for statement in reversed(statements):
        if statement.kind in ("if", "else", "while"):
            if statement is not statements[-1]:
                statements.append(Statement("line_end", starts_line=False))
            return
        if statement.starts_line or statement.kind == "line_end":
            return


class ProgramStore:
    """All program buffers of a card, and the one that is open."""

    def __init__(self, memory: Memory) -> None:
        self.memory = memory
        self.programs: dict[int, Program] = {}
        self.plcs: dict[int, Program] = {}
        self.open_program: Program | None = None
        self.open_owner: object = None
        self.password = ""
        self.unlocked = True
        self._line_entered = 0  # statements of the line being read

    # --- opening and closing --------------------------------------------------------------------

    def open(self, kind: str, number: int, owner: object) -> Program:
        """OPEN PROG or OPEN PLC: the buffer of this number, made if it does not exist."""
        if self.open_program is not None:
            raise CardError(7)
        if self.protected(kind, number):
            raise CardError(2)
        table = self.programs if kind == MOTION else self.plcs
        if kind == MOTION and number not in table and len(table) >= MOST_PROGRAMS:
            raise CardError(6)
        program = table.setdefault(number, Program(kind, number))
        self.open_program, self.open_owner = program, owner
        program.assembled = None
        self._line_entered = 0
        self._mark_open(is_open=True)
        self.update_memory()
        return program

    def is_open_on(self, owner: object) -> bool:
        """Whether a buffer is open that was opened from this port."""
        return self.open_program is not None and self.open_owner is owner

    def clear(self, owner: object) -> None:
        """CLEAR: empty the open buffer."""
        if not self.is_open_on(owner) or self.open_program is None:
            raise CardError(7)
        self.open_program.clear()
        self.update_memory()

    def close(self, owner: object, *, force: bool = False) -> None:
        """CLOSE: end the buffer of this port; ERR009 for a wrong structure, but closed anyway."""
        program = self.open_program
        if program is None or (self.open_owner is not owner and not force):
            return
        self._mark_open(is_open=False)
        self.open_program, self.open_owner = None, None
        self.update_memory()
        program.assembled = assemble(program.statements, program.kind)

    def enter(self, statement: Statement) -> None:
        """Put a statement into the open buffer; ERR006 when memory is full."""
        program = self.open_program
        if program is None:
            raise CardError(5)
        free = self.free_words() - statement.words
        if free < 0:
            raise CardError(6)
        program.statements.append(statement)
        self._line_entered += 1
        # The entries of programs behind this one move when it is closed.
        self.memory.y[r.PROGRAM_END] += statement.words
        self._update_status(free)

    def drop_line(self) -> None:
        """A line was refused: no part of it stays in the buffer."""
        program = self.open_program
        if program is None:
            return
        while program.statements and self._line_entered:
            statement = program.statements.pop()
            self.memory.y[r.PROGRAM_END] -= statement.words
            self._line_entered -= 1
        self._line_entered = 0

    def end_line(self) -> None:
        """Close the text line being entered, which ends inline IF and WHILE actions."""
        self._line_entered = 0
        program = self.open_program
        if program is None or program.kind != MOTION or not program.statements:
            return
        end_line(program.statements)

    def clear_all(self, *, plcs_only: bool = False) -> None:
        """CLEAR ALL (PLCS): drop program buffers."""
        self.open_program, self.open_owner = None, None
        if not plcs_only:
            self.programs.clear()
        self.plcs.clear()
        self.update_memory()

    # --- protection -----------------------------------------------------------------------------

    def protected(self, kind: str, number: int) -> bool:
        """Whether the password keeps a buffer from being opened or listed (p. 384)."""
        if self.unlocked or not self.password:
            return False
        return number >= 1000 if kind == MOTION else number <= 15

    def set_password(self, text: str) -> None:
        """PASSWORD: unlock with the right one, then a new one may be given (p. 384)."""
        if self.unlocked:
            self.password = text
        elif text == self.password:
            self.unlocked = True
        else:
            raise CardError(2)

    # --- memory ---------------------------------------------------------------------------------

    def checksum(self) -> int:
        """CHECKSUM: a sum over the fixed buffers."""
        programs = (*self.programs.values(), *self.plcs.values())
        texts = [text for program in programs for _, text in program.lines(long=True)]
        return zlib.crc32("\n".join(texts).encode()) & 0xFFFFFF

    def update_memory(self) -> None:
        """Write the program tables and the end of the fixed buffers."""
        m = self.memory
        m.x[r.PROGRAM_TABLE : r.PROGRAM_TABLE + MOST_PROGRAMS] = 0
        m.y[r.PROGRAM_TABLE : r.PROGRAM_TABLE + MOST_PROGRAMS] = 0
        address = r.USER_BUFFER_START
        for index, program in enumerate(self.programs.values()):
            m.x[r.PROGRAM_TABLE + index] = program.number
            m.y[r.PROGRAM_TABLE + index] = address
            address += program.words
        for number in range(32):
            flags = int(m.y[r.PLC_TABLE + number]) & (PLC_DISABLED | PLC_OPEN)
            plc = self.plcs.get(number)
            if plc is None or not (plc.statements or flags & PLC_OPEN):
                m.y[r.PLC_TABLE + number] = PLC_DISABLED
                m.x[r.PLC_TABLE + number] = 0
                continue
            m.y[r.PLC_TABLE + number] = flags | address
            address += plc.words
        m.y[r.PROGRAM_END] = address
        self._update_status(self.free_words())

    def free_words(self) -> int:
        """Long words between the programs and the buffers made by DEFINE."""
        return lowest_defined(self.memory) - int(self.memory.y[r.PROGRAM_END])

    def _mark_open(self, *, is_open: bool) -> None:
        program = self.open_program
        if program is None or program.kind != PLC:
            return
        cell = r.PLC_TABLE + program.number
        word = int(self.memory.y[cell])
        # OPEN disables the PLC, CLOSE does not enable it again (p. 380).
        self.memory.y[cell] = (
            word | PLC_DISABLED | PLC_OPEN if is_open else (word | PLC_DISABLED) & ~PLC_OPEN
        )

    def _update_status(self, free_words: int) -> None:
        m = self.memory
        word = int(m.y[r.GLOBAL_STATUS])
        word &= ~(r.G2_MOTION_BUFFER_OPEN | r.G2_PLC_BUFFER_OPEN)
        if self.open_program is not None:
            kind = self.open_program.kind
            word |= r.G2_MOTION_BUFFER_OPEN if kind == MOTION else r.G2_PLC_BUFFER_OPEN
        threshold = int(m.x[0x1093])  # I18
        if self.open_program is None or free_words <= threshold:
            word |= r.G2_FIXED_BUFFER_FULL
        else:
            word &= ~r.G2_FIXED_BUFFER_FULL
        m.y[r.GLOBAL_STATUS] = word & 0xFFFFFF

    # --- listing --------------------------------------------------------------------------------

    def find(self, kind: str, number: int) -> Program:
        """Program of this number; ERR003 if it does not exist, ERR002 if it is protected."""
        program = (self.programs if kind == MOTION else self.plcs).get(number)
        if program is None or (not program.statements and program is not self.open_program):
            raise CardError(3)
        if self.protected(kind, number):
            raise CardError(2)
        return program


def listing(
    program: Program,
    *,
    long: bool,
    is_open: bool = False,
    start: int | None = None,
    length: int | None = None,
) -> list[str]:
    """Lines of LIST; with a start or length every line has its word offset in front.

    The last RETURN is there once the buffer was closed.

    Raises
    ------
    CardError
        ERR003 when the start lies beyond the end.
    """
    lines = program.lines(long=long)
    if is_open:
        lines.pop()
    if start is None and length is None:
        return [text for _, text in lines]
    first = start or 0
    last = first + (length if length is not None else program.words)
    if first >= program.words:
        raise CardError(3)
    return [f"{offset}:{text}" for offset, text in lines if first <= offset < last]


def parse_program(text: str, kind: str) -> list[Statement]:
    """Statements of a whole program text without OPEN, CLEAR and CLOSE (flash image)."""
    statements: list[Statement] = []
    for line in text.splitlines():
        scanner = Scanner(line)
        first = True
        while not scanner.at_end:
            statement = StatementParser(scanner, kind).statement()
            if statement is None:
                raise CardError(3, f"no program text: '{scanner.rest}'")
            statement.starts_line = first
            first = False
            statements.append(statement)
        if kind == MOTION:
            end_line(statements)
    return statements
