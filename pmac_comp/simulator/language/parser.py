"""The parser of program statements: assignments, words and moves of one text line.

Statements that the simulated card cannot execute are refused with ERR003 when they are entered.
Source: Turbo PMAC Software Reference Manual p. 405-485.
"""

from __future__ import annotations

import re

from pmac_comp.simulator.language.expressions import STORES, STORES_AT, Code, ExpressionParser
from pmac_comp.simulator.language.keywords import KEYWORDS, names_at, program_word
from pmac_comp.simulator.language.scanner import Scanner
from pmac_comp.simulator.language.statements import AXES, MOTION, Statement
from pmac_comp.simulator.memory import vm
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.ivariables import TABLE

_ASSIGNED = re.compile(r"\s*I\s*(?:[\d\s]+=|\()")
_RANGE_ASSIGNED = re.compile(r"\s*(?:\.\.|,)[\s\d.,$A-F]*=")


class StatementParser(ExpressionParser):
    """Reads statements of one kind of buffer from a line."""

    def __init__(self, scanner: Scanner, buffer: str) -> None:
        super().__init__(scanner)
        self.buffer = buffer

    def statement(self) -> Statement | None:
        """Take one statement; None (nothing taken) if no program text stands here."""
        start = self.scanner.position
        found = self._keyword() or self._assignment() or self._move()
        if found is None:
            self._refuse_codes(start)
            self.scanner.position = start
        return found

    def _refuse_codes(self, start: int) -> None:
        """Refuse G, M, T and D codes and arc vectors, which are program text on a real card."""
        self.scanner.position = start
        if self.buffer != MOTION:
            return
        letter = self.scanner.take("G", "M", "T", "D", "I", "J", "K", "R")
        if letter is not None and self.scanner.peek()[:1].isdigit():
            raise CardError(3, f"{letter} codes are not supported")
        self.scanner.position = start

    # --- assignments ----------------------------------------------------------------------------

    def _assignment(self) -> Statement | None:
        start = self.scanner.position
        kind = self.scanner.take("P", "Q", "I", "M")
        if kind is None:
            return None
        code = Code()
        try:
            number = self.variable_number(kind, code)
        except CardError:
            self.scanner.position = start
            return None
        if self.scanner.peek(2) in ("==", "&=", "|=", "^="):
            return self._synchronous(kind, number, code)
        if _RANGE_ASSIGNED.match(self.scanner.rest):
            raise CardError(3, "ranges are not program text")
        if not self.scanner.take("="):
            self.scanner.position = start
            return None
        if kind == "I" and number is not None and TABLE[number].fixed:
            raise CardError(3, f"I{number} is not supported by the simulated card")
        code.write("=")
        self.expression(code)
        if number is None:
            code.emit(STORES_AT[kind])
        else:
            code.emit(STORES[kind], number)
        return Statement("assign", code, 0, code.text, code.text)

    def _synchronous(self, kind: str, number: int | None, code: Code) -> Statement:
        if kind != "M" or number is None or self.buffer != MOTION:
            raise CardError(3)
        op = self.scanner.take("==", "&=", "|=", "^=") or "=="
        head = code.text + op
        value = Code()
        self.expression(value)
        value.text = head + value.text
        return Statement("sync", value, 1, value.text, value.text, (number, op))

    # --- keywords -------------------------------------------------------------------------------

    def _keyword(self) -> Statement | None:
        start = self.scanner.position
        for name in names_at(self.scanner, self.buffer):
            if self.scanner.take(name):
                found = KEYWORDS[name](self, name)
                if found is not None:
                    return found
                self.scanner.position = start
        return None

    def data(self, code: Code) -> None:
        """Take {data}: a signed constant or an expression in parentheses."""
        if self.scanner.peek() == "(":
            self.scanner.expect("(")
            code.write("(")
            self.expression(code)
            self.scanner.expect(")")
            code.text += ")"
            return
        negative = self.scanner.take("-") is not None
        if negative:
            code.text += "-"
        if not self.constant(code):
            raise CardError(3, f"value expected at '{self.scanner.rest}'")
        if negative:
            code.emit(vm.OP_NEG)

    def starts_data(self) -> bool:
        """Whether {data} stands here."""
        return self.scanner.peek()[:1] in tuple("0123456789.$(-")

    # --- axis moves -----------------------------------------------------------------------------

    def _move(self) -> Statement | None:
        if self.buffer != MOTION:
            return None
        code = Code()
        parts: list[tuple[str, bool]] = []
        while True:
            start = self.scanner.position
            letter = self.scanner.take(*AXES)
            if letter is None or not self.starts_data():
                self.scanner.position = start
                break
            code.text += letter
            self.data(code)
            timed = self.scanner.take(":") is not None
            if timed:
                code.text += ":"
                self.data(code)
            elif self.scanner.peek() == "^":
                raise CardError(3, "move until trigger is not supported")
            parts.append((letter, timed))
        if not parts:
            return None
        if self.scanner.peek() in ("I", "J", "K", "R") and not self._is_word_or_assignment():
            raise CardError(3, "arc moves are not supported")
        count = sum(2 if timed else 1 for _, timed in parts)
        return Statement("move", code, count, code.text, code.text, tuple(parts))

    def _is_word_or_assignment(self) -> bool:
        """Whether what stands here goes on as a program word (``RAPID``) or ``I5=2``."""
        if program_word(self.scanner) is not None:
            return True
        match = _ASSIGNED.match(self.scanner.text, self.scanner.position)
        return match is not None
