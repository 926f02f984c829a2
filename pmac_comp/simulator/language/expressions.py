"""Expressions and conditions: parsing, printing and translation to bytecode.

Grammar (Turbo PMAC User Manual p. 241-248): ``* / % &`` before ``+ - | ^``, left to right; unary
minus but no unary plus; functions with one argument; conditions are pairs of expressions with a
comparator, joined by AND and OR (OR lower).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pmac_comp.simulator.language.scanner import Scanner, parse_number
from pmac_comp.simulator.memory import vm
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.numbers import format_number

FUNCTIONS = {
    "SIN": vm.OP_SIN,
    "COS": vm.OP_COS,
    "TAN": vm.OP_TAN,
    "ASIN": vm.OP_ASIN,
    "ACOS": vm.OP_ACOS,
    "ATAN2": vm.OP_ATAN2,
    "ATAN": vm.OP_ATAN,
    "SQRT": vm.OP_SQRT,
    "LN": vm.OP_LN,
    "EXP": vm.OP_EXP,
    "ABS": vm.OP_ABS,
    "INT": vm.OP_INT,
}
_HIGH = {"*": vm.OP_MUL, "/": vm.OP_DIV, "%": vm.OP_MOD, "&": vm.OP_AND}
_LOW = {"+": vm.OP_ADD, "-": vm.OP_SUB, "|": vm.OP_OR, "^": vm.OP_XOR}
COMPARATORS = {
    "!=": vm.OP_NE,
    "!>": vm.OP_NGT,
    "!<": vm.OP_NLT,
    "!~": vm.OP_NAPPROX,
    "=": vm.OP_EQ,
    ">": vm.OP_GT,
    "<": vm.OP_LT,
    "~": vm.OP_APPROX,
}
LOADS = {"P": vm.OP_LOAD_P, "Q": vm.OP_LOAD_Q, "I": vm.OP_LOAD_I, "M": vm.OP_LOAD_M}
LOADS_AT = {"P": vm.OP_LOAD_P_AT, "Q": vm.OP_LOAD_Q_AT, "I": vm.OP_LOAD_I_AT, "M": vm.OP_LOAD_M_AT}
STORES = {"P": vm.OP_STORE_P, "Q": vm.OP_STORE_Q, "I": vm.OP_STORE_I, "M": vm.OP_STORE_M}
STORES_AT = {
    "P": vm.OP_STORE_P_AT,
    "Q": vm.OP_STORE_Q_AT,
    "I": vm.OP_STORE_I_AT,
    "M": vm.OP_STORE_M_AT,
}
MAX_NESTING = 12
_HEX_END = re.compile(r"\$[0-9A-F]+$")


@dataclass
class Code:
    """Growing bytecode with its constants and the text that lists it.

    ``text`` is the canonical source: upper case, no blanks, constants as the card prints them.
    """

    ops: list[int] = field(default_factory=list)
    consts: list[float] = field(default_factory=list)
    text: str = ""
    tokens: int = 0

    def emit(self, *words: int) -> None:
        """Append an op code with its operands."""
        self.ops.extend(words)

    def constant(self, value: float) -> None:
        """Append a load of a constant."""
        self.emit(vm.OP_CONST, len(self.consts))
        self.consts.append(value)

    def write(self, text: str) -> None:
        """Append to the listing."""
        self.text += text
        self.tokens += 1

    def append(self, other: Code) -> None:
        """Append code without jumps of another fragment, moving its constants."""
        base = len(self.consts)
        position = 0
        while position < len(other.ops):
            size = 1 + OPERANDS.get(other.ops[position], 0)
            words = other.ops[position : position + size]
            if words[0] == vm.OP_CONST:
                words = [words[0], words[1] + base]
            self.ops.extend(words)
            position += size
        self.consts.extend(other.consts)
        self.text += other.text
        self.tokens += other.tokens


OPERANDS: dict[int, int] = {
    vm.OP_CONST: 1,
    vm.OP_LOAD_P: 1,
    vm.OP_LOAD_Q: 1,
    vm.OP_LOAD_I: 1,
    vm.OP_LOAD_M: 1,
    vm.OP_STORE_P: 1,
    vm.OP_STORE_Q: 1,
    vm.OP_STORE_I: 1,
    vm.OP_STORE_M: 1,
    vm.OP_JUMP: 1,
    vm.OP_JUMP_FALSE: 1,
    vm.OP_JUMP_BACK: 1,
    vm.OP_SCAN_END: 1,
    vm.OP_EVENT: 2,
    vm.OP_ADDRESS: 2,
    vm.OP_COPYREG: 1,
    vm.OP_CALL: 1,
    vm.OP_LOAD_FIELD: 6,
    vm.OP_STORE_FIELD: 6,
    vm.OP_LOAD_FIELD_AT: 6,
    vm.OP_STORE_FIELD_AT: 6,
    vm.OP_LOAD_LONG: 2,
    vm.OP_STORE_LONG: 2,
    vm.OP_LOAD_LONG_AT: 2,
    vm.OP_STORE_LONG_AT: 2,
    vm.OP_LOAD_FLOAT: 2,
    vm.OP_STORE_FLOAT: 2,
    vm.OP_LOAD_FLOAT_AT: 2,
    vm.OP_STORE_FLOAT_AT: 2,
}


class ExpressionParser:
    """Reads expressions from a scanner into a `Code`.

    Subclasses add operand kinds (the open servo has L and F pointers) through `operand`.
    """

    def __init__(self, scanner: Scanner) -> None:
        self.scanner = scanner
        self._nesting = 0

    def expression(self, code: Code) -> None:
        """Translate one expression; its value is left on the stack."""
        self._nesting += 1
        if self._nesting > MAX_NESTING:
            raise CardError(3, "expression nested too deeply")
        self._term(code)
        while (op := self.scanner.take(*_LOW)) is not None:
            code.write(op)
            self._term(code)
            code.emit(_LOW[op])
        self._nesting -= 1

    def _term(self, code: Code) -> None:
        self._factor(code)
        while (op := self.scanner.take(*_HIGH)) is not None:
            code.write(op)
            self._factor(code)
            code.emit(_HIGH[op])

    def _factor(self, code: Code) -> None:
        if self.scanner.take("-"):
            code.write("-")
            self._primary(code)
            code.emit(vm.OP_NEG)
            return
        self._primary(code)

    def _primary(self, code: Code) -> None:
        if self.scanner.take("("):
            code.write("(")
            self.expression(code)
            self.scanner.expect(")")
            code.text += ")"
            return
        if self.constant(code) or self.operand(code):
            return
        raise CardError(3, f"value expected at '{self.scanner.rest}'")

    def constant(self, code: Code) -> bool:
        """Translate a constant if one stands here."""
        start = self.scanner.position
        value = self.scanner.number()
        if value is None:
            return False
        source = self.scanner.text[start : self.scanner.position].strip()
        code.write(source if source.startswith("$") else format_number(parse_number(source)))
        code.constant(value)
        return True

    def operand(self, code: Code) -> bool:
        """Translate a function or variable if one stands here."""
        name = self.scanner.take(*FUNCTIONS)
        if name is not None:
            code.write(name + "(")
            self.scanner.expect("(")
            self.expression(code)
            self.scanner.expect(")")
            code.text += ")"
            code.emit(FUNCTIONS[name])
            return True
        kind = self.scanner.take(*LOADS)
        if kind is None:
            return False
        number = self.variable_number(kind, code)
        if number is None:
            code.emit(LOADS_AT[kind])
        else:
            code.emit(LOADS[kind], number)
        return True

    def variable_number(self, kind: str, code: Code) -> int | None:
        """Number behind the letter; None if it is an expression, whose value is on the stack."""
        if self.scanner.take("("):
            code.write(f"{kind}(")
            self.expression(code)
            self.scanner.expect(")")
            code.text += ")"
            return None
        number = self.scanner.need_integer(0, 8191)
        code.write(f"{kind}{number}")
        return number

    def condition(self, code: Code) -> None:
        """Translate a condition in parentheses; 1 or 0 is left on the stack."""
        self.scanner.expect("(")
        code.write("(")
        self._or(code)
        self.scanner.expect(")")
        code.text += ")"

    def _or(self, code: Code) -> None:
        self._and(code)
        while self.scanner.take("OR"):
            code.write("OR")
            self._and(code)
            code.emit(vm.OP_LOR)

    def _and(self, code: Code) -> None:
        self._comparison(code)
        while self.scanner.take("AND"):
            # The card prints no blanks; without one A would be a digit of the constant before it.
            code.write(" AND" if _HEX_END.search(code.text) else "AND")
            self._comparison(code)
            code.emit(vm.OP_LAND)

    def _comparison(self, code: Code) -> None:
        self.expression(code)
        op = self.scanner.take(*COMPARATORS)
        if op is None:
            raise CardError(3, f"comparator expected at '{self.scanner.rest}'")
        code.write(op)
        self.expression(code)
        code.emit(COMPARATORS[op])


@dataclass(frozen=True)
class Compiled:
    """Bytecode ready to run."""

    code: NDArray[np.int64]
    consts: NDArray[np.float64]


def compiled(code: Code) -> Compiled:
    """Arrays of a `Code`, ended."""
    return Compiled(
        np.array([*code.ops, vm.OP_END], dtype=np.int64),
        np.array(code.consts or [0.0], dtype=np.float64),
    )
