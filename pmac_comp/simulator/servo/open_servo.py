"""The open servo: translates its source into the bytecode that the servo task runs.

What lives here: pointers L and F, the float and integer rules, COPYREG, MTRNUM, RETURN, IF and
WHILE. What may not: the expression grammar (it is the card's own) and the servo task.
Imports ``language`` and ``vm``.

A real card takes code compiled by the vendor's tool; the source cannot be downloaded. Giving the
source to the simulated card at its start stands in for that tool.

Source: Turbo PMAC User Manual p. 169-179.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from pmac_comp.base.errors import ConfigError
from pmac_comp.base.reading import why
from pmac_comp.simulator.language.expressions import (
    LOADS,
    OPERANDS,
    STORES,
    STORES_AT,
    Code,
    Compiled,
    ExpressionParser,
    compiled,
)
from pmac_comp.simulator.language.scanner import Scanner
from pmac_comp.simulator.memory import vm
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.memory import FIELD_WIDTHS

_POINTER = re.compile(
    r"(?P<kind>[LF])(?P<number>\d+)->(?P<space>X|Y|L|D):"
    r"(?:\(R1(?P<offset>[+-]\$?[0-9A-F]+)?\)|(?P<address>\$[0-9A-F]+|\d+))"
    r"(?P<rest>(?:,\w+)*)(?:\[(?P<size>\d+)\])?"
)
_INTEGER_ARITHMETIC = (vm.OP_ADD, vm.OP_SUB, vm.OP_MUL)
_MAX_WORDS: Final = 3072  # program memory of the servo part on an 80 MHz CPU


@dataclass(frozen=True)
class Pointer:
    """One compiler-only variable: a 24-bit field (L) or a 48-bit register (F)."""

    space: str
    relative: int
    address: int
    offset: int = 0
    width: int = 24
    signed: int = 1
    size: int = 0

    def load(self) -> list[int]:
        """Op code and operands that read it."""
        return self._ops(vm.OP_LOAD_FIELD, vm.OP_LOAD_LONG, vm.OP_LOAD_FLOAT)

    def store(self) -> list[int]:
        """Op code and operands that write it."""
        return self._ops(vm.OP_STORE_FIELD, vm.OP_STORE_LONG, vm.OP_STORE_FLOAT)

    def _ops(self, of_field: int, of_long: int, of_float: int) -> list[int]:
        shift = vm.OP_LOAD_FIELD_AT - vm.OP_LOAD_FIELD if self.size else 0
        if self.space in "XY":
            space = 0 if self.space == "X" else 1
            place = [space, self.relative, self.address]
            return [of_field + shift, *place, self.offset, self.width, self.signed]
        op = of_long if self.space == "D" else of_float
        return [op + shift, self.relative, self.address]


@dataclass
class _Block:
    """An open IF or WHILE: where to go back to and which jumps wait for the end."""

    kind: str
    start: int = 0
    waiting: list[int] = field(default_factory=list)


class _Parser(ExpressionParser):
    """Expressions with L and F pointers; remembers which number kinds a statement used."""

    def __init__(self, scanner: Scanner, pointers: dict[str, Pointer]) -> None:
        super().__init__(scanner)
        self._pointers = pointers
        self.uses_float = False
        self.uses_integer = False

    def operand(self, code: Code) -> bool:
        """ITOF, FTOI, MTRNUM, pointers, then what every program has."""
        name = self.scanner.take("ITOF", "FTOI", "MTRNUM")
        if name == "MTRNUM":
            code.emit(vm.OP_MOTOR)
            return True
        if name is not None:
            self._convert(name, code)
            return True
        if self.scanner.peek() in {"L", "F"} and self.scanner.peek(2)[1:].isdigit():
            self._pointer(code)
            return True
        if self.scanner.peek() in LOADS:
            self.uses_float = True
        return super().operand(code)

    def _convert(self, name: str, code: Code) -> None:
        inner = _Parser(self.scanner, self._pointers)
        fragment = Code()
        self.scanner.expect("(")
        inner.expression(fragment)
        self.scanner.expect(")")
        if name == "ITOF":
            if inner.uses_float:
                raise CardError(3, "ITOF() takes an integer expression")
            self.uses_float = True
            code.append(as_integer(fragment))
            return
        self.uses_integer = True
        code.append(fragment)
        code.constant(0.5)
        code.emit(vm.OP_ADD, vm.OP_INT, vm.OP_WRAP24)

    def _pointer(self, code: Code) -> None:
        pointer = self.pointer_here(code)
        if pointer.space in "XY":
            self.uses_integer = True
        else:
            self.uses_float = True
        code.emit(*pointer.load())

    def pointer_here(self, code: Code) -> Pointer:
        """Pointer that stands here; an array's index is left on the stack."""
        letter = self.scanner.take("L", "F") or ""
        name = f"{letter}{self.scanner.need_integer(0, 8191)}"
        pointer = self._pointers.get(name)
        if pointer is None:
            raise CardError(3, f"{name} is not defined")
        if pointer.size:
            self._index(pointer, code)
        return pointer

    def _index(self, pointer: Pointer, code: Code) -> None:
        inner = _Parser(self.scanner, self._pointers)
        self.scanner.expect("[")
        fragment = Code()
        inner.expression(fragment)
        self.scanner.expect("]")
        if inner.uses_float:
            raise CardError(3, "an index is an integer expression")
        code.append(as_integer(fragment))
        # Arrays are powers of two long; the index wraps as the hardware's modulo addressing does.
        code.constant(float(pointer.size))
        code.emit(vm.OP_MOD)


def as_integer(code: Code) -> Code:
    """The same expression in 24-bit arithmetic: wrapped results, division rounded to nearest."""
    result = Code(consts=list(code.consts))
    position = 0
    while position < len(code.ops):
        op = code.ops[position]
        words = code.ops[position : position + 1 + OPERANDS.get(op, 0)]
        position += len(words)
        if op == vm.OP_DIV:
            result.emit(vm.OP_INT_DIV)
        else:
            result.emit(*words)
        if op in _INTEGER_ARITHMETIC:
            result.emit(vm.OP_WRAP24)
    return result


class _Translator:
    """One pass over the source lines."""

    def __init__(self) -> None:
        self.code = Code()
        self.pointers: dict[str, Pointer] = {}
        self._blocks: list[_Block] = []
        self._open = False
        self.closed = False

    def line(self, text: str) -> None:
        """Translate one line without comment."""
        compact = text.replace(" ", "").replace("\t", "").upper()
        match = _POINTER.fullmatch(compact)
        if match is not None:
            self._define(match)
            return
        scanner = Scanner(text)
        while not scanner.at_end:
            self._statement(scanner)

    def finish(self) -> Compiled:
        """Bytecode; the source must be closed and its blocks ended."""
        if self._blocks or not self.closed:
            raise CardError(9, "ENDIF, ENDWHILE or CLOSE is missing")
        if len(self.code.ops) > _MAX_WORDS * 4:
            raise CardError(6, "the algorithm is larger than program memory")
        return compiled(self.code)

    def _define(self, match: re.Match[str]) -> None:
        kind, space = match["kind"], match["space"]
        if (kind == "L") != (space in "XY"):
            raise CardError(3, f"{match.string}: L points to X or Y, F to L or D")
        relative = 0 if match["address"] else 1
        offset = match["address"] or match["offset"] or "0"
        offset_bits, width, signed = _field(match["rest"].split(",")[1:] if match["rest"] else [])
        size = int(match["size"] or 0)
        if size and (size & (size - 1) or not 2 <= size <= 8192):
            raise CardError(3, "an array is a power of two from 2 to 8192 long")
        self.pointers[f"{kind}{match['number']}"] = Pointer(
            space, relative, _integer(offset), offset_bits, width, signed, size
        )

    def _statement(self, scanner: Scanner) -> None:
        word = scanner.take(
            "OPENSERVO", "CLEAR", "CLOSE", "COPYREG", "RETURN", "IF", "ELSE", "ENDIF", "WHILE",
            "ENDWHILE", "ENDW",
        )  # fmt: skip
        if word == "OPENSERVO":
            self._open = True
        elif word == "CLEAR" and self._open:
            return
        elif not self._open:
            raise CardError(5, "OPEN SERVO is missing")
        elif word == "CLOSE":
            self._open = False
            self.closed = True
        elif word is None:
            self._assignment(scanner)
        else:
            self._control(word, scanner)

    def _control(self, word: str, scanner: Scanner) -> None:
        if word == "COPYREG":
            scanner.expect("P")
            self.code.emit(vm.OP_COPYREG, scanner.need_integer(0, 8187))
        elif word == "RETURN":
            self._return(scanner)
        elif word in {"IF", "WHILE"}:
            self._begin(word, scanner)
        elif word == "ELSE":
            self._else()
        else:
            self._end("IF" if word == "ENDIF" else "WHILE")

    def _return(self, scanner: Scanner) -> None:
        parser = _Parser(scanner, self.pointers)
        fragment = Code()
        scanner.expect("(")
        parser.expression(fragment)
        scanner.expect(")")
        self._append(parser, fragment)
        self.code.emit(vm.OP_RETURN_VALUE)

    def _begin(self, word: str, scanner: Scanner) -> None:
        block = _Block(word, start=len(self.code.ops))
        parser = _Parser(scanner, self.pointers)
        fragment = Code()
        parser.condition(fragment)
        self._append(parser, fragment)
        block.waiting.append(self._jump(vm.OP_JUMP_FALSE))
        self._blocks.append(block)

    def _else(self) -> None:
        if not self._blocks or self._blocks[-1].kind != "IF":
            raise CardError(9, "ELSE without IF")
        block = self._blocks[-1]
        over = self._jump(vm.OP_JUMP)
        self._land(block.waiting)
        block.kind = "ELSE"
        block.waiting = [over]

    def _end(self, kind: str) -> None:
        kinds = {"IF", "ELSE"} if kind == "IF" else {"WHILE"}
        if not self._blocks or self._blocks[-1].kind not in kinds:
            raise CardError(9, f"END{kind} without {kind}")
        block = self._blocks.pop()
        if kind == "WHILE":
            self.code.emit(vm.OP_JUMP, block.start)
        self._land(block.waiting)

    def _jump(self, op: int) -> int:
        self.code.emit(op, 0)
        return len(self.code.ops) - 1

    def _land(self, places: list[int]) -> None:
        for place in places:
            self.code.ops[place] = len(self.code.ops)

    def _assignment(self, scanner: Scanner) -> None:
        parser = _Parser(scanner, self.pointers)
        if scanner.peek() in {"L", "F"}:
            index = Code()
            pointer = parser.pointer_here(index)
            fragment = self._value(scanner, integer=pointer.space in "XY")
            self.code.append(index)
            self.code.append(fragment)
            self.code.emit(*pointer.store())
            return
        kind = scanner.take(*STORES)
        if kind is None:
            raise CardError(3, f"statement expected at '{scanner.rest}'")
        index = Code()
        number = parser.variable_number(kind, index)
        fragment = self._value(scanner, integer=False)
        self.code.append(index)
        self.code.append(fragment)
        if number is None:
            self.code.emit(STORES_AT[kind])
        else:
            self.code.emit(STORES[kind], number)

    def _value(self, scanner: Scanner, *, integer: bool) -> Code:
        scanner.expect("=")
        parser = _Parser(scanner, self.pointers)
        fragment = Code()
        parser.expression(fragment)
        if (parser.uses_float and integer) or (parser.uses_integer and not integer):
            raise CardError(3, "float and integer values are mixed; use ITOF() or FTOI()")
        return as_integer(fragment) if integer else fragment

    def _append(self, parser: _Parser, fragment: Code) -> None:
        if parser.uses_float and parser.uses_integer:
            raise CardError(3, "float and integer values are mixed; use ITOF() or FTOI()")
        self.code.append(as_integer(fragment) if parser.uses_integer else fragment)


def _field(parts: list[str]) -> tuple[int, int, int]:
    """Offset, width and sign of an L pointer: whole words are signed, parts of them are not."""
    sign = parts.pop() if parts and parts[-1] in {"S", "U"} else ""
    numbers = [int(part) for part in parts]
    if not numbers or numbers == [24]:
        return 0, 24, int(sign != "U")
    offset = numbers[0]
    width = numbers[1] if len(numbers) > 1 else 1
    if width not in FIELD_WIDTHS or offset + width > 24 or len(numbers) > 2:
        raise CardError(3, f"no field of {width} bits at bit {offset}")
    return offset, width, int(sign == "S" or (width == 24 and sign != "U"))


def _integer(text: str) -> int:
    sign = -1 if text.startswith("-") else 1
    digits = text.lstrip("+-")
    return sign * (int(digits[1:], 16) if digits.startswith("$") else int(digits))


def _lines(text: str) -> Iterator[tuple[int, str]]:
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.split(";", 1)[0].strip()
        if line:
            yield number, line


def translate_open_servo(text: str, *, name: str = "open servo") -> Compiled:
    """Bytecode of an open-servo source.

    Parameters
    ----------
    text : str
        Source; ``;`` starts a comment.
    name : str
        Name for error texts.

    Raises
    ------
    ConfigError
        With the line that is wrong.
    """
    translator = _Translator()
    number = 0
    try:
        for at, line in _lines(text):
            number = at
            translator.line(line)
        return translator.finish()
    except CardError as error:
        raise ConfigError(
            f"{name}, line {number}: {error}." if number else f"{name} is empty.",
            code="PC-OSV-001",
            hint="The open servo takes the statements of the User Manual p. 169-179.",
        ) from error


def read_open_servo(path: Path) -> str:
    """Source of an open servo from a file; ConfigError if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"The open servo source {path} cannot be read: {why(error)}.",
            code="PC-OSV-002",
            hint="Give a text file such as firmware_plc/feedforward_servo.txt.",
        ) from error
