"""Rotary buffers: program lines that are executed while more of them are sent.

Source: Turbo PMAC Software Reference Manual p. 311, 316, 381, 388, 441; thresholds I16 and I17 p.
45-46, 286.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pmac_comp.simulator.language.assembler import assemble
from pmac_comp.simulator.language.statements import MOTION, Statement
from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.user_memory import (
    GATHER,
    allocate_down,
    buffer_exists,
    lowest_defined,
)
from pmac_comp.simulator.programs.programs import Program, end_line

if TYPE_CHECKING:
    from pmac_comp.simulator.card.card import Card
    from pmac_comp.simulator.programs.coordinate_system import CoordinateSystem


@dataclass
class Rotary:
    """The rotary buffer of one coordinate system."""

    size: int
    lines: deque[list[Statement]] = field(default_factory=deque)

    @property
    def words(self) -> int:
        """Long words in use."""
        return sum(s.words for line in self.lines for s in line)


class RotaryBuffers:
    """All rotary buffers of a card."""

    def __init__(self, card: Card) -> None:
        self.card = card
        self.buffers: dict[int, Rotary] = {}
        self.owner: object = None
        self._line: list[Statement] = []

    def define(self, cs: int, size: int) -> None:
        """DEFINE ROTARY: reserve memory; the highest coordinate system comes first (p. 311)."""
        memory = self.card.memory
        if any(n <= cs for n in self.buffers) or buffer_exists(memory, GATHER):
            raise CardError(3)
        start = allocate_down(memory, size)
        if start is None:
            raise CardError(6)
        memory.x[r.ROTARY_POINTERS + cs - 1] = start
        memory.y[r.ROTARY_POINTERS + cs - 1] = start
        self.buffers[cs] = Rotary(size)

    def delete(self, cs: int) -> None:
        """DELETE ROTARY; refused while the buffer is open or not the last one defined."""
        memory = self.card.memory
        if cs not in self.buffers:
            return
        start = int(memory.x[r.ROTARY_POINTERS + cs - 1])
        if self.owner is not None or start != lowest_defined(memory):
            raise CardError(3)
        memory.x[r.ROTARY_POINTERS + cs - 1] = 0
        memory.y[r.ROTARY_POINTERS + cs - 1] = 0
        del self.buffers[cs]
        self._show_full(self.card.systems[cs], full=False)

    def delete_all(self) -> None:
        """Forget all rotary buffers."""
        self.owner = None
        for cs in self.buffers:
            self._show_full(self.card.systems[cs], full=False)
        self.buffers.clear()
        memory = self.card.memory
        memory.x[r.ROTARY_POINTERS : r.ROTARY_POINTERS + 16] = 0
        memory.y[r.ROTARY_POINTERS : r.ROTARY_POINTERS + 16] = 0

    def open(self, owner: object) -> None:
        """OPEN ROTARY."""
        if not self.buffers:
            raise CardError(3)
        if self.owner is not None or self.card.programs.open_program is not None:
            raise CardError(7)
        self.owner = owner
        self.card.memory.y[r.GLOBAL_STATUS] |= r.G2_ROTARY_OPEN

    def close(self) -> None:
        """CLOSE."""
        self.owner = None
        self.card.memory.y[r.GLOBAL_STATUS] &= ~r.G2_ROTARY_OPEN & 0xFFFFFF

    def is_open_on(self, owner: object) -> bool:
        """Whether lines of this port go into the rotary buffer."""
        return self.owner is not None and self.owner is owner

    def clear(self, cs: int) -> None:
        """CLEAR: drop the lines that wait."""
        if cs in self.buffers:
            self.buffers[cs].lines.clear()
            self.report_fill(self.card.systems[cs])

    def enter(self, cs: int, statement: Statement) -> None:
        """Collect a statement of the line being entered."""
        buffer = self.buffers.get(cs)
        if buffer is None:
            raise CardError(3)
        if buffer.words + statement.words > buffer.size:
            raise CardError(6)
        self._line.append(statement)

    def end_line(self, cs: int) -> None:
        """The line is whole and may be executed; ERR009 for IF or WHILE without its action."""
        line, self._line = self._line, []
        if line and cs in self.buffers:
            end_line(line)
            assemble(line, MOTION)
            self.buffers[cs].lines.append(line)
            self.report_fill(self.card.systems[cs])
            self.card.wake(cs)

    def drop_line(self) -> None:
        """The line was refused."""
        self._line = []

    def program(self, cs: int) -> Program | None:
        """Empty program that ``B0`` points to."""
        if cs not in self.buffers:
            return None
        program = Program(MOTION, 0)
        program.assembled = assemble([], MOTION)
        return program

    def more(self, system: CoordinateSystem) -> bool:
        """Continue with the next line; True while the rotary program goes on."""
        if system.pointer is None or system.pointer[0] != 0:
            return False
        buffer = self.buffers.get(system.number)
        if buffer is None:
            return False
        if not buffer.lines:
            if self.owner is None:
                return False
            system.idle()
            return True
        program = Program(MOTION, 0, buffer.lines.popleft())
        program.assembled = assemble(program.statements, MOTION)
        system.replace_program(program)
        self.report_fill(system)
        return True

    def report_fill(self, system: CoordinateSystem) -> None:
        """Bit of a full buffer: 1 from I17 lines on, 0 again below I16 (p. 45-46, 286)."""
        lines = len(self.buffers[system.number].lines)
        if lines >= self.card.variables.int_i(17):
            self._show_full(system, full=True)
        elif lines < self.card.variables.int_i(16):
            self._show_full(system, full=False)

    def _show_full(self, system: CoordinateSystem, *, full: bool) -> None:
        words, cell = self.card.memory.y, system.base + r.C_STATUS2_ADDRESS
        word = int(words[cell]) & ~r.CS2_ROTARY_FULL
        words[cell] = word | (r.CS2_ROTARY_FULL if full else 0)

    def goes_on(self, cs: int) -> bool:
        """Whether an empty running buffer need not be waited for: a line came, or it was closed."""
        buffer = self.buffers.get(cs)
        return buffer is None or self.owner is None or bool(buffer.lines)

    def lines_left(self, cs: int) -> int:
        """PR: lines that wait, valid while the buffer is open."""
        if self.owner is None or cs not in self.buffers:
            raise CardError(3)
        return len(self.buffers[cs].lines)
