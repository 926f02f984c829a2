"""Scanner of command and program lines.

Letter case and blanks do not count outside quotes; blanks only part one constant from the next.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from pmac_comp.simulator.memory.errors import CardError

_NUMBER = re.compile(r"\$[0-9A-F]+|\d+\.?\d*|\.\d+")
_INTEGER = re.compile(r"\$[0-9A-F]+|\d+")


class Scanner:
    """Position in one line of text.

    Parameters
    ----------
    text : str
        The line; upper-cased here outside quotes.
    """

    def __init__(self, text: str) -> None:
        self.raw = text
        self.text = _upper_outside_quotes(text)
        self.position = 0
        self._blanks = " " in text or "\t" in text

    def skip_blanks(self) -> None:
        """Move over blanks and tabs."""
        if self._blanks:
            while self.position < len(self.text) and self.text[self.position] in " \t":
                self.position += 1

    @property
    def at_end(self) -> bool:
        """Whether only blanks are left."""
        self.skip_blanks()
        return self.position >= len(self.text)

    def peek(self, length: int = 1) -> str:
        """Next characters after blanks, without taking them."""
        self.skip_blanks()
        return self.text[self.position : self.position + length]

    def take(self, *words: str) -> str | None:
        """Take the first of these words that stands here, else None; inner blanks do not count."""
        if self._blanks:
            self.skip_blanks()
        elif not self.text.startswith(words, self.position):
            return None
        for word in words:
            end = self._match(word)
            if end is not None:
                self.position = end
                return word
        return None

    def _match(self, word: str) -> int | None:
        position = self.position
        if self.text.startswith(word, position):
            return position + len(word)
        if not self._blanks or not self.text.startswith(word[0], position):
            return None
        for character in word:
            while position < len(self.text) and self.text[position] in " \t":
                position += 1
            if position >= len(self.text) or self.text[position] != character:
                return None
            position += 1
        return position

    def expect(self, word: str) -> None:
        """Take a word or refuse the line (ERR003)."""
        if self.take(word) is None:
            raise CardError(3, f"'{word}' expected at '{self.rest}'")

    def number(self) -> float | None:
        """Take an unsigned constant (decimal or $hex), None if there is none."""
        self.skip_blanks()
        match = _NUMBER.match(self.text, self.position)
        if match is None:
            return None
        self.position = match.end()
        return parse_number(match.group())

    def signed_number(self) -> float | None:
        """Take a constant with an optional minus sign; a plus sign is a syntax error."""
        start = self.position
        sign = -1.0 if self.take("-") else 1.0
        value = self.number()
        if value is None:
            self.position = start
            return None
        return sign * value

    def integer(self) -> int | None:
        """Take an unsigned whole constant, None if there is none."""
        self.skip_blanks()
        match = _INTEGER.match(self.text, self.position)
        if match is None:
            return None
        self.position = match.end()
        return int(parse_number(match.group()))

    def need_integer(self, low: int, high: int) -> int:
        """Take a whole constant within limits or refuse the line."""
        value = self.integer()
        if value is None or not low <= value <= high:
            raise CardError(3, f"number {low}..{high} expected at '{self.rest}'")
        return value

    def quoted(self) -> str:
        """Take a string in double quotes, letter case kept."""
        self.expect('"')
        end = self.text.find('"', self.position)
        if end < 0:
            raise CardError(3, "closing quote missing")
        text = self.raw[self.position : end]
        self.position = end + 1
        return text

    def any_of(self, words: Iterable[str]) -> str | None:
        """Take the longest of these words that stands here."""
        return self.take(*sorted(words, key=len, reverse=True))

    @property
    def rest(self) -> str:
        """What is left of the line."""
        return self.text[self.position :]


def parse_number(text: str) -> float:
    """Value of a constant as it is written in a line."""
    return float(int(text[1:], 16)) if text.startswith("$") else float(text)


def _upper_outside_quotes(text: str) -> str:
    if '"' not in text:
        return text.upper()
    parts = text.split('"')
    return '"'.join(part if index % 2 else part.upper() for index, part in enumerate(parts))
