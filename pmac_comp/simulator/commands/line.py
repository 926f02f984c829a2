"""Execution of one command line: left to right, the first error ends it.

Handlers register under their keyword; at each place in the line the longest keyword that stands
there wins, so ``PVF`` is three queries and ``PASSWORD`` is one command. While a program buffer is
open on the port, text that is legal program text goes into the buffer instead.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pmac_comp.simulator.language.expressions import Code, ExpressionParser
from pmac_comp.simulator.language.keywords import program_word
from pmac_comp.simulator.language.scanner import Scanner
from pmac_comp.simulator.memory.errors import CardError

if TYPE_CHECKING:
    from pmac_comp.simulator.card.card import Card
    from pmac_comp.simulator.programs.coordinate_system import CoordinateSystem

Handler = Callable[["LineContext"], None]
KEYWORDS: dict[str, Handler] = {}
_BY_FIRST: dict[str, list[str]] = {}
MAX_ANSWER_LINES = 100_000
# Words of the real card that are not supported here. Without this list their first letters would
# be taken for short commands: SETPHASE for a step, ROT for a run, AROT for an abort.
REFUSED_WORDS = (
    "ADIS",
    "AROT",
    "CCBUF",
    "CIRCLE",
    "DISPLAY",
    "IDIS",
    "IROT",
    "LEARN",
    "LOOKAHEAD",
    "MACRO",
    "NORMAL",
    "PRELUDE",
    "RD:",
    "RDP",
    "RF:",
    "RF$",
    "RHD",
    "RHF",
    "READ",
    "ROT",
    "SETPHASE",
    "SPLINE2",
    "TINIT",
    "TRACE",
    "TSEL",
)
_WORD = re.compile(r"[A-Z]+")


def command(*keywords: str) -> Callable[[Handler], Handler]:
    """Register a handler under one or more keywords."""

    def register(handler: Handler) -> Handler:
        for keyword in keywords:
            KEYWORDS[keyword] = handler
            group = _BY_FIRST.setdefault(keyword[0], [])
            group.append(keyword)
            group.sort(key=len, reverse=True)
        return handler

    return register


@dataclass
class Modal:
    """What a port remembers: addressed motor and coordinate system, group of ``##``."""

    motor: int = 1
    cs: int = 1
    group: int = 0

    def power_up(self) -> None:
        """Address motor 1, coordinate system 1 and the first group."""
        self.motor, self.cs, self.group = 1, 1, 0


@dataclass
class LineContext:
    """One line being executed.

    Parameters
    ----------
    card : Card
        The card.
    modal : Modal
        Addressing of the port, changed in place.
    scanner : Scanner
        Where in the line we are.
    owner : object
        Identity of the port, for open buffers.
    lines : list of str
        Answers so far.
    silent_end : bool
        Set by ``$$$``: no acknowledgement follows.
    """

    card: Card
    modal: Modal
    scanner: Scanner
    owner: object
    lines: list[str] = field(default_factory=list)
    silent_end: bool = False

    @property
    def system(self) -> CoordinateSystem:
        """The addressed coordinate system."""
        return self.card.systems[self.modal.cs]

    def answer(self, text: str) -> None:
        """Add one data line."""
        self.lines.append(text)
        if len(self.lines) > MAX_ANSWER_LINES:
            raise CardError(3, "answer too long")

    def value(self) -> float:
        """Take {data}: a constant, or an expression in parentheses."""
        start = self.scanner.position
        if self.scanner.take("("):
            self.scanner.position = start
            return self.expression()
        number = self.scanner.signed_number()
        if number is None:
            raise CardError(3, f"constant expected at '{self.scanner.rest}'")
        return number

    def expression(self) -> float:
        """Take an expression and evaluate it."""
        code = Code()
        ExpressionParser(self.scanner).expression(code)
        return self.card.machine.evaluate(code, self.modal.cs)

    def check(self, error: int) -> None:
        """Refuse the line when an action answered with an error number."""
        if error:
            raise CardError(error)


def execute_command(context: LineContext) -> None:
    """Execute the command that stands at the present place."""
    scanner = context.scanner
    character = scanner.peek()
    start = scanner.position
    for keyword in _BY_FIRST.get(character, ()):
        if scanner.take(keyword):
            end = scanner.position
            if scanner.peek().isalpha():
                scanner.position = start
                word = program_word(scanner)
                scanner.position = end
                if word is not None and len(word) > len(keyword):
                    # STOP is a program statement, not S followed by nonsense.
                    raise CardError(5)
            if keyword.isalpha() and scanner.text[end : end + 1].isalpha():
                _refuse_other_words(scanner, start)
            KEYWORDS[keyword](context)
            return
    if character.isdigit() or character in ".-":
        bare_constant(context)
        return
    raise CardError(3, f"unknown command at '{scanner.rest}'")


def _refuse_other_words(scanner: Scanner, start: int) -> None:
    """Refuse the word at `start` if a shorter command was only seen in its beginning."""
    text = scanner.text[start:]
    match = _WORD.match(text)
    if text.startswith(REFUSED_WORDS) or (match and not _splits_into_commands(match.group())):
        raise CardError(3, f"unknown word at '{text}'")


def _splits_into_commands(word: str) -> bool:
    """Whether a run of letters is a sequence of keywords (``PVF``); the last may go on."""
    while word:
        group = _BY_FIRST.get(word[0], ())
        keyword = next((k for k in group if word.startswith(k)), None)
        if keyword is None:
            # A keyword whose end lies beyond the letters, such as PASSWORD=.
            return any(k.startswith(word) and not k.isalpha() for k in group)
        word = word[len(keyword) :]
    return True


def bare_constant(context: LineContext) -> None:
    """Take a constant into the compensation table being filled, otherwise into P0 (p. 299)."""
    value = context.scanner.signed_number()
    if value is None:
        raise CardError(3)
    tables = context.card.tables
    if tables.wants_values():
        context.check(tables.store(value))
    else:
        context.card.variables.write("P", 0, value)
