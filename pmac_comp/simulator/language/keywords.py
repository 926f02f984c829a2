"""The words of the program languages, and how each is read.

What lives here: one reader per word, registered for motion programs, PLC programs or both. What may
not: assignments, moves and the order in which a line is read (``parser``).
Source: Turbo PMAC Software Reference Manual p. 405-485.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from pmac_comp.simulator.language.expressions import Code
from pmac_comp.simulator.language.scanner import Scanner
from pmac_comp.simulator.language.statements import AXES, MOTION, PLC, Statement
from pmac_comp.simulator.memory import vm
from pmac_comp.simulator.memory.errors import CardError

if TYPE_CHECKING:
    from pmac_comp.simulator.language.parser import StatementParser

Reader = Callable[["StatementParser", str], Statement | None]
KEYWORDS: dict[str, Reader] = {}
# Words by buffer and first letter, longest first.
_NAMES: dict[str, dict[str, list[str]]] = {MOTION: {}, PLC: {}}


def _keyword(*names: str, buffers: tuple[str, ...] = (MOTION, PLC)) -> Callable[[Reader], Reader]:
    def register(reader: Reader) -> Reader:
        for name in names:
            KEYWORDS[name] = reader
            for buffer in buffers:
                group = _NAMES[buffer].setdefault(name[0], [])
                group.append(name)
                group.sort(key=len, reverse=True)
        return reader

    return register


def _plain(kind: str, short: str, long: str, *names: str, only: str | None = None) -> None:
    @_keyword(*names, buffers=(only,) if only else (MOTION, PLC))
    def reader(_parser: StatementParser, _name: str) -> Statement:
        return Statement(kind, short=short, long=long)


def _with_data(kind: str, short: str, long: str, *names: str) -> None:
    @_keyword(*names, buffers=(MOTION,))
    def reader(parser: StatementParser, _name: str) -> Statement | None:
        code = Code()
        if not parser.starts_data():
            return None
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
    for table in _NAMES.values():
        for name in table.get(scanner.peek(), ()):
            if scanner.take(name):
                found.append(name)
                scanner.position = start
                break
    return max(found, key=len, default=None)


def words_of(buffer: str) -> list[str]:
    """Words that may start a statement of a motion (``PROG``) or PLC program."""
    return sorted(name for names in _NAMES[buffer].values() for name in names)


def names_at(scanner: Scanner, buffer: str) -> Sequence[str]:
    """Words of a kind of buffer that begin as what stands here, longest first."""
    return _NAMES[buffer].get(scanner.peek(), ())
