"""Statements of motion and PLC programs: parsing of one line and the text that lists it.

A statement keeps the bytecode of its expressions and two spellings: short (``DWE``, I9 bit 0 = 0)
and long (``DWELL``). Statements that the simulated card cannot execute are refused with ERR003 when
they are entered. Source: Turbo PMAC Software Reference Manual p. 405-485.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from pmac_comp.simulator import vm
from pmac_comp.simulator.errors import CardError
from pmac_comp.simulator.ivariables import TABLE
from pmac_comp.simulator.language.expressions import STORES, STORES_AT, Code, ExpressionParser
from pmac_comp.simulator.language.scanner import Scanner

AXES = "ABCUVWXYZ"
MOTION, PLC = "PROG", "PLC"


@dataclass
class Statement:
    """One statement of a program.

    Parameters
    ----------
    kind : str
        What it does; the assembler and the program runners switch on it.
    code : Code
        Bytecode that leaves the arguments on the stack (or, for assignments, stores them).
    arguments : int
        How many values the code leaves.
    short, long : str
        Listing text.
    data : Any
        Anything else the runner needs.
    starts_line : bool
        First of its text line.
    """

    kind: str
    code: Code = field(default_factory=Code)
    arguments: int = 0
    short: str = ""
    long: str = ""
    data: Any = None
    starts_line: bool = True

    @property
    def words(self) -> int:
        """Long words of program memory it takes."""
        if self.kind == "line_end":
            return 0
        return max(1, self.code.tokens) if self.kind != "move" else len(self.data)


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
        if self.scanner.take(".."):
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
        names = _MOTION_NAMES if self.buffer == MOTION else _PLC_NAMES
        start = self.scanner.position
        for name in names.get(self.scanner.peek(), ()):
            if self.scanner.take(name):
                found = _KEYWORDS[name](self, name)
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


_ASSIGNED = re.compile(r"\s*I\s*(?:[\d\s]+=|\()")
Reader = Callable[[StatementParser, str], Statement | None]
_KEYWORDS: dict[str, Reader] = {}
_MOTION_NAMES: dict[str, list[str]] = {}
_PLC_NAMES: dict[str, list[str]] = {}


def _keyword(*names: str, buffers: tuple[str, ...] = (MOTION, PLC)) -> Callable[[Reader], Reader]:
    def register(reader: Reader) -> Reader:
        for name in names:
            _KEYWORDS[name] = reader
            for buffer, table in ((MOTION, _MOTION_NAMES), (PLC, _PLC_NAMES)):
                if buffer in buffers:
                    group = table.setdefault(name[0], [])
                    group.append(name)
                    group.sort(key=len, reverse=True)
        return reader

    return register


def _plain(kind: str, short: str, long: str, *names: str, only: str | None = None) -> None:
    @_keyword(*names, buffers=(only,) if only else (MOTION, PLC))
    def reader(_parser: StatementParser, _name: str) -> Statement:
        return Statement(kind, short=short, long=long)


def _with_data(kind: str, short: str, long: str, *names: str, optional: bool = False) -> None:
    @_keyword(*names, buffers=(MOTION,))
    def reader(parser: StatementParser, _name: str) -> Statement | None:
        code = Code()
        if not parser.starts_data():
            return Statement(kind, short=short, long=long) if optional else None
        parser.data(code)
        return Statement(kind, code, 1, short + code.text, long + code.text)


_plain("else", "ELSE", "ELSE", "ELSE")
_plain("endif", "ENDI", "ENDIF", "ENDIF", "ENDI")
_plain("endwhile", "ENDW", "ENDWHILE", "ENDWHILE", "ENDW")
_plain("linear", "LIN", "LINEAR", "LINEAR", "LIN", only=MOTION)
_plain("rapid", "RPD", "RAPID", "RAPID", "RPD", only=MOTION)
_plain("spline1", "SPLINE1", "SPLINE1", "SPLINE1", only=MOTION)
_plain("wait", "WAIT", "WAIT", "WAIT", "WAI", only=MOTION)
_plain("return", "RET", "RETURN", "RETURN", "RET", only=MOTION)
_plain("stop", "STOP", "STOP", "STOP", only=MOTION)
_plain("block_start", "BSTART", "BLOCKSTART", "BLOCKSTART", "BSTART", only=MOTION)
_plain("block_stop", "BSTOP", "BLOCKSTOP", "BLOCKSTOP", "BSTOP", only=MOTION)
_plain("gather", "GAT", "GATHER", "GATHER", "GAT")
_plain("endgather", "ENDG", "ENDGATHER", "ENDGATHER", "ENDG")
_with_data("pvt", "PVT", "PVT", "PVT")
_with_data("tm", "TM", "TM", "TM")
_with_data("ta", "TA", "TA", "TA")
_with_data("ts", "TS", "TS", "TS")
_with_data("feed", "F", "F", "F")
_with_data("dwell", "DWE", "DWELL", "DWELL", "DWE")
_with_data("delay", "DLY", "DELAY", "DELAY", "DLY")
_with_data("goto", "GOTO", "GOTO", "GOTO")
_with_data("gosub", "GOSUB", "GOSUB", "GOSUB", "GOS")
_with_data("call", "CALL", "CALL", "CALL")
_with_data("spindle", "S", "S", "S")


@_keyword("IF", "WHILE")
def _condition(parser: StatementParser, name: str) -> Statement:
    code = Code()
    code.text = name
    parser.condition(code)
    return Statement(name.lower(), code, 1, code.text, code.text)


@_keyword("AND", "OR", buffers=(PLC,))
def _condition_line(parser: StatementParser, name: str) -> Statement:
    code = Code()
    code.text = name
    parser.condition(code)
    return Statement("condition_" + name.lower(), code, 1, code.text, code.text)


@_keyword("N", "O", buffers=(MOTION,))
def _label(parser: StatementParser, name: str) -> Statement | None:
    number = parser.scanner.integer()
    if number is None:
        return None
    return Statement("label", short=f"{name}{number}", long=f"{name}{number}", data=number)


def _axes(parser: StatementParser) -> tuple[str, ...]:
    """Axis letters in parentheses, empty if none are given."""
    if not parser.scanner.take("("):
        return ()
    letters: list[str] = []
    while True:
        letter = parser.scanner.take(*AXES, "R")
        if letter is None:
            raise CardError(3, "axis letter expected")
        letters.append(letter)
        if not parser.scanner.take(","):
            break
    parser.scanner.expect(")")
    return tuple(letters)


def axis_modes(parser: StatementParser, name: str) -> Statement:
    """Axes of ABS, INC or FRAX, which may also stand on-line."""
    letters = _axes(parser)
    text = name + (f"({','.join(letters)})" if letters else "")
    return Statement(name.lower(), short=text, long=text, data=letters)


_keyword("ABS", "INC", "FRAX", buffers=(MOTION,))(axis_modes)


@_keyword("PSET", buffers=(MOTION,))
def _position_set(parser: StatementParser, _name: str) -> Statement | None:
    code = Code()
    letters: list[str] = []
    while True:
        start = parser.scanner.position
        letter = parser.scanner.take(*AXES)
        if letter is None or not parser.starts_data():
            parser.scanner.position = start
            break
        code.text += letter
        parser.data(code)
        letters.append(letter)
    if not letters:
        raise CardError(3)
    text = "PSET" + code.text
    return Statement("pset", code, len(letters), text, text, tuple(letters))


@_keyword("HOMEZ", "HMZ", "HOME", "HM", buffers=(MOTION,))
def _home(parser: StatementParser, name: str) -> Statement:
    numbers, text = _number_list(parser, 1, 32)
    zero = name in ("HOMEZ", "HMZ")
    short, long = ("HMZ", "HOMEZ") if zero else ("HM", "HOME")
    kind = "homez" if zero else "home"
    return Statement(kind, short=short + text, long=long + text, data=numbers)


def _number_list(parser: StatementParser, low: int, high: int) -> tuple[tuple[int, ...], str]:
    """Take ``1``, ``1..3``, ``1,2,5`` and combinations."""
    numbers: list[int] = []
    texts: list[str] = []
    while True:
        first = parser.scanner.need_integer(low, high)
        if parser.scanner.take(".."):
            last = parser.scanner.need_integer(first, high)
            numbers.extend(range(first, last + 1))
            texts.append(f"{first}..{last}")
        else:
            numbers.append(first)
            texts.append(str(first))
        if not parser.scanner.take(","):
            return tuple(numbers), ",".join(texts)


_PLC_ACTIONS = {
    "ENABLE": "ENA",
    "DISABLE": "DIS",
    "PAUSE": "PAU",
    "RESUME": "RES",
}
_SHORT_TO_LONG = {short: long for long, short in _PLC_ACTIONS.items()}


@_keyword(*(f"{word}PLC" for pair in _PLC_ACTIONS.items() for word in pair))
def _plc_action(parser: StatementParser, name: str) -> Statement:
    verb = name.removesuffix("PLC")
    long = _SHORT_TO_LONG.get(verb, verb)
    if parser.scanner.take("C"):
        raise CardError(3, "compiled PLCs are not supported")
    numbers, text = _number_list(parser, 0, 31)
    return Statement(
        "plc",
        short=f"{_PLC_ACTIONS[long]}PLC{text}",
        long=f"{long}PLC{text}",
        data=(long, numbers),
    )


@_keyword("COMMAND", "CMD")
def _command(parser: StatementParser, _name: str) -> Statement:
    port = parser.scanner.take("S", "P", "R", "A") or ""
    if parser.scanner.take("^"):
        letter = parser.scanner.peek()
        parser.scanner.expect(letter or "A")
        text, body = f"^{letter}", chr(ord(letter or "@") & 31)
    else:
        body = parser.scanner.quoted()
        text = f'"{body}"'
    return Statement(
        "command", short=f"CMD{port}{text}", long=f"COMMAND{port}{text}", data=(port, body)
    )


@_keyword("SEND")
def _send(parser: StatementParser, _name: str) -> Statement:
    port = parser.scanner.take("S", "P", "R", "A") or ""
    body = parser.scanner.quoted()
    text = f'SEND{port}"{body}"'
    return Statement("send", short=text, long=text, data=(port, body))


@_keyword("ADDRESS", "ADR", buffers=(PLC,))
def _address(parser: StatementParser, _name: str) -> Statement:
    code = Code()
    found: dict[str, int] = {}
    while (sign := parser.scanner.take("#", "&")) is not None:
        code.text += sign
        if parser.scanner.peek() == "P":
            return _address_by_variable(parser, sign, code)
        found[sign] = parser.scanner.need_integer(1, 32 if sign == "#" else 16)
        code.text += str(found[sign])
    if not found:
        raise CardError(3)
    code.emit(vm.OP_ADDRESS, found.get("#", 0), found.get("&", 0))
    return Statement("assign", code, 0, f"ADR{code.text}", f"ADDRESS{code.text}")


def _address_by_variable(parser: StatementParser, sign: str, code: Code) -> Statement:
    """``ADDRESS#P5``: the number is the value of a P variable (p. 410-411)."""
    if len(code.text) > 1:
        raise CardError(3, "a number and a variable in one ADDRESS")
    parser.operand(code)
    text = code.text
    return Statement("address", code, 1, f"ADR{text}", f"ADDRESS{text}", data=sign)


@_keyword("LOCK", "UNLOCK")
def _lock(parser: StatementParser, name: str) -> Statement:
    number = parser.scanner.need_integer(0, 7)
    text = f"{name}{number}"
    variable = None
    if name == "LOCK":
        parser.scanner.expect(",")
        parser.scanner.expect("P")
        variable = parser.scanner.need_integer(0, 8191)
        text += f",P{variable}"
    return Statement("lock", short=text, long=text, data=(number, variable))


def program_word(scanner: Scanner) -> str | None:
    """Longest word of the program languages that stands here, without taking it."""
    start = scanner.position
    found: list[str] = []
    for table in (_MOTION_NAMES, _PLC_NAMES):
        for name in table.get(scanner.peek(), ()):
            if scanner.take(name):
                found.append(name)
                scanner.position = start
                break
    return max(found, key=len, default=None)


def words_of(buffer: str) -> list[str]:
    """Words that may start a statement of a motion (``PROG``) or PLC program."""
    table = _MOTION_NAMES if buffer == MOTION else _PLC_NAMES
    return sorted(name for names in table.values() for name in names)
