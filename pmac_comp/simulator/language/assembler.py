"""Turns the statements of a program into one piece of bytecode, with its structure checked.

In PLCs ENDWHILE ends the scan and the next one starts at its WHILE; in motion programs it jumps
back. An ``IF(...)`` followed by text on its line is closed by the end of the line, in motion
programs only. Source: Turbo PMAC Software Reference Manual p. 431-433, 482-483.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pmac_comp.simulator.language.expressions import Code, Compiled
from pmac_comp.simulator.language.statements import MOTION, PLC, Statement
from pmac_comp.simulator.memory import vm
from pmac_comp.simulator.memory.errors import CardError

CONDITION_LINES = ("condition_and", "condition_or")


@dataclass(frozen=True)
class Assembled:
    """A program ready to run.

    Parameters
    ----------
    compiled : Compiled
        Bytecode; event number k is statement k.
    starts : tuple of int
        Bytecode position of each statement.
    labels : dict
        Position of each label (motion programs); label 0 is the start.
    """

    compiled: Compiled
    starts: tuple[int, ...]
    labels: dict[int, int]

    def statement_at(self, position: int) -> int:
        """Index of the statement that a bytecode position belongs to."""
        return int(np.searchsorted(np.asarray(self.starts), position, side="right")) - 1


@dataclass
class _Block:
    kind: str  # "if", "else", "while"
    start: int
    exits: list[int] = field(default_factory=list)
    inline: bool = False


class Assembler:
    """One pass over the statements of a buffer."""

    def __init__(self, statements: Sequence[Statement], buffer: str) -> None:
        self.statements = statements
        self.buffer = buffer
        self.code = Code()
        self.blocks: list[_Block] = []
        self.labels: dict[int, int] = {0: 0}
        self.declared = sorted({0, *(s.data for s in statements if s.kind == "label")})
        self.jumps: list[tuple[int, int]] = []
        self.starts: list[int] = []

    def assemble(self) -> Assembled:
        """Bytecode of the program; CardError ERR009 when its structure is wrong."""
        index = 0
        while index < len(self.statements):
            index = self._statement(index)
        if self.blocks:
            raise CardError(9, f"{self.blocks[-1].kind.upper()} is not closed")
        self.code.emit(vm.OP_RETURN if self.buffer == MOTION else vm.OP_END)
        for place, label in self.jumps:
            self.code.ops[place] = self._target(place, label)
        ops = self.code.ops
        compiled = Compiled(
            np.array(ops, dtype=np.int64), np.array(self.code.consts or [0.0], dtype=np.float64)
        )
        return Assembled(compiled, tuple(self.starts), dict(self.labels))

    @property
    def here(self) -> int:
        """Position of the next instruction."""
        return len(self.code.ops)

    def _statement(self, index: int) -> int:
        statement = self.statements[index]
        self.starts.append(self.here)
        method = getattr(self, f"_do_{statement.kind}", None)
        if method is not None:
            taken: int | None = method(index)
            return index + (taken or 1)
        self.code.append(statement.code)
        if statement.kind != "assign":
            self.code.emit(vm.OP_EVENT, index, statement.arguments)
        return index + 1

    # --- conditions -----------------------------------------------------------------------------

    def _condition(self, index: int) -> int:
        """Condition of IF or WHILE with the AND and OR lines that follow; statements used."""
        self.code.append(self.statements[index].code)
        used = 1
        pending_or = 0
        while index + used < len(self.statements):
            line = self.statements[index + used]
            if line.kind not in CONDITION_LINES:
                break
            self.starts.append(self.here)
            self.code.append(line.code)
            if line.kind == "condition_and":
                self.code.emit(vm.OP_LAND)
            else:
                pending_or += 1
            used += 1
        for _ in range(pending_or):
            self.code.emit(vm.OP_LOR)
        return used

    def _do_if(self, index: int) -> int:
        used = self._condition(index)
        block = _Block("if", self.here, inline=self._inline(index))
        self.code.emit(vm.OP_JUMP_FALSE, 0)
        block.exits.append(self.here - 1)
        self._open(block)
        return used

    def _open(self, block: _Block) -> None:
        """Enter a block; what ends on a later line holds open what was opened on its own line."""
        if not block.inline:
            for outer in self.blocks:
                outer.inline = False
        self.blocks.append(block)

    def _do_condition_and(self, _index: int) -> None:
        raise CardError(9, "AND without IF or WHILE")

    def _do_condition_or(self, _index: int) -> None:
        raise CardError(9, "OR without IF or WHILE")

    def _inline(self, index: int) -> bool:
        following = index + 1
        return (
            self.buffer == MOTION
            and following < len(self.statements)
            and not self.statements[following].starts_line
            and self.statements[following].kind != "line_end"
        )

    def _do_else(self, index: int) -> None:
        if not self.blocks or self.blocks[-1].kind != "if":
            raise CardError(9, "ELSE without IF")
        block = self.blocks[-1]
        self.code.emit(vm.OP_JUMP, 0)
        self.code.ops[block.exits.pop()] = self.here
        block.exits.append(self.here - 1)
        block.kind = "else"
        block.inline = self._inline(index)

    def _do_endif(self, _index: int) -> None:
        if not self.blocks or self.blocks[-1].kind == "while":
            raise CardError(9, "ENDIF without IF")
        self._close()

    def _close(self) -> None:
        for place in self.blocks.pop().exits:
            self.code.ops[place] = self.here

    def _do_line_end(self, index: int) -> None:
        following = self.statements[index + 1].kind if index + 1 < len(self.statements) else ""
        while self.blocks and self.blocks[-1].inline:
            if self.blocks[-1].kind == "if" and following == "else":
                self.blocks[-1].inline = False
                return
            if self.blocks[-1].kind == "while":
                self._end_loop()
            else:
                self._close()

    # --- loops and jumps ------------------------------------------------------------------------

    def _do_while(self, index: int) -> int:
        block = _Block("while", self.here, inline=self._inline(index))
        used = self._condition(index)
        self.code.emit(vm.OP_JUMP_FALSE, 0)
        block.exits.append(self.here - 1)
        self._open(block)
        return used

    def _do_endwhile(self, _index: int) -> None:
        if not self.blocks or self.blocks[-1].kind != "while":
            raise CardError(9, "ENDWHILE without WHILE")
        self._end_loop()

    def _end_loop(self) -> None:
        start = self.blocks[-1].start
        self.code.emit(vm.OP_SCAN_END if self.buffer == PLC else vm.OP_JUMP_BACK, start)
        self._close()

    def _do_label(self, index: int) -> None:
        self.labels[self.statements[index].data] = self.here

    def _static_label(self, index: int) -> int | None:
        text = self.statements[index].code.text
        return int(text) if text.isdigit() else None

    def _target(self, place: int, label: int) -> int:
        """Where a jump goes; a GOSUB whose label is missing goes on behind itself (p. 436)."""
        if label in self.labels:
            return self.labels[label]
        self.code.ops[place - 1] = vm.OP_JUMP
        return place + 1

    def _do_goto(self, index: int) -> None:
        label = self._static_label(index)
        if label is None:
            for candidate in self.declared:
                skip = self._unless(index, candidate)
                self._jump(candidate)
                self.code.ops[skip] = self.here
        elif label in self.declared:
            self._jump(label)
            return
        # No such label: a run-time error when it is executed, not when it is entered (p. 437).
        self.code.emit(vm.OP_EVENT, index, 0)

    def _jump(self, label: int) -> None:
        self.code.emit(vm.OP_JUMP_BACK if label in self.labels else vm.OP_JUMP, 0)
        self.jumps.append((self.here - 1, label))

    def _do_gosub(self, index: int) -> None:
        label = self._static_label(index)
        if label is not None:
            self._call(label)
            return
        ends: list[int] = []
        for candidate in self.declared:
            skip = self._unless(index, candidate)
            self._call(candidate)
            self.code.emit(vm.OP_JUMP, 0)
            ends.append(self.here - 1)
            self.code.ops[skip] = self.here
        for place in ends:
            self.code.ops[place] = self.here

    def _call(self, label: int) -> None:
        self.code.emit(vm.OP_CALL, 0)
        self.jumps.append((self.here - 1, label))

    def _unless(self, index: int, label: int) -> int:
        """Compare a computed label with one of the program's; place of the jump if they differ."""
        self.code.append(self.statements[index].code)
        self.code.constant(float(label))
        self.code.emit(vm.OP_APPROX, vm.OP_JUMP_FALSE, 0)
        return self.here - 1

    def _do_return(self, _index: int) -> None:
        self.code.emit(vm.OP_RETURN)


def assemble(statements: Sequence[Statement], buffer: str) -> Assembled:
    """Bytecode of a program buffer."""
    return Assembler(statements, buffer).assemble()
