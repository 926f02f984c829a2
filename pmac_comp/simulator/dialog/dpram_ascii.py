"""Command lines through the dual-ported RAM (I58): what the host writes there, and the answers.

The host writes a line and sets the command bit, or writes a control character; the card looks in
its background, takes the sign back and puts one line of the answer after the other, each when the
host has cleared the word of the one before. I3 has no influence.
Source: Turbo PMAC Software Reference Manual p. 64 (I58), 525 (map).
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

from pmac_comp.machine.wire.dialog import ControlCharacter
from pmac_comp.simulator.dialog.ports import Port
from pmac_comp.simulator.memory import registers as r

if TYPE_CHECKING:
    from pmac_comp.simulator.card.card import Card

COMMAND: Final = 0x0603A7  # Y bit 0: a line is there; X bits 0-7: control character
ANSWER: Final = 0x0603D0  # Y: how the line ends, kind, error; X: characters + 1
_COMMAND_TEXT, _COMMAND_SIZE = 0x0EA0, 160
_ANSWER_TEXT, _ANSWER_SIZE = 0x0F44, 256
_HOST_OFFSETS: Final = range(0x0E9C, 0x0F44)
_CR, _ACK, _CANCEL = 0x0D, 0x06, 0x18
_BEL = "\x07"
_REPLY, _COMMANDED, _SENT = 0x0000, 0x0100, 0x0200
_ERROR = 0x8000


class DpramAscii:
    """The conversation of one card through its dual-ported RAM.

    Parameters
    ----------
    card : Card
        The card.
    """

    def __init__(self, card: Card) -> None:
        self._card = card
        self._port = Port(card)
        self._waiting: deque[tuple[int, str]] = deque()  # word of the answer, its text

    @property
    def _enabled(self) -> bool:
        return bool(self._card.memory.x[r.INTERNAL_GLOBAL + 58])

    def power_up(self) -> None:
        """I58 follows the presence of the memory; what waited is gone."""
        present = self._card.dpram != "none"
        self._card.memory.x[r.INTERNAL_GLOBAL + 58] = int(present)
        self._waiting.clear()

    def host_wrote(self, offset: int, size: int) -> None:
        """The host wrote `size` bytes at `offset`: look in the next background cycle."""
        if offset < _HOST_OFFSETS.stop and offset + size > _HOST_OFFSETS.start:
            self._card.background_needed()

    def background(self) -> None:
        """One background cycle."""
        memory = self._card.memory
        if not self._enabled:
            return
        code = int(memory.x[COMMAND]) & 0xFF
        if code:
            memory.x[COMMAND] = int(memory.x[COMMAND]) & 0xFF00
            self._control(code)
        if int(memory.y[COMMAND]) & 1:
            memory.y[COMMAND] = int(memory.y[COMMAND]) & 0xFFFE
            self._line(memory.read_bytes(_COMMAND_TEXT, _COMMAND_SIZE).partition(b"\0")[0])
        if self._waiting and not int(memory.y[ANSWER]) & 0xFFFF:
            self._put(*self._waiting.popleft())

    def _line(self, text: bytes) -> None:
        lines: list[str] = []
        self._waiting.clear()
        error, silent = self._port.execute(text, lines)
        if error is not None:
            self._waiting.append((_ERROR | _bcd(error), ""))
        elif lines:
            self._answer(lines, _REPLY)
        elif not silent:
            self._waiting.append((_REPLY | _ACK, ""))

    def _control(self, code: int) -> None:
        if code == _CANCEL:
            self._waiting.clear()
            return
        text = self._port.control(ControlCharacter(code)).decode("latin-1").strip("\r\n\x06")
        if text:
            self._answer([text], _REPLY)

    def announce(self, text: str, *, commanded: bool) -> None:
        """What a program says with SENDR, or what answers its CMDR (an error behind BEL)."""
        if not self._enabled:
            return
        kind = _COMMANDED if commanded else _SENT
        if text.startswith(_BEL):
            kind |= _ERROR
        self._answer([text.removeprefix(_BEL)], kind)
        self._card.background_needed()

    def _answer(self, lines: list[str], kind: int) -> None:
        parts = [line for text in lines for line in text.split("\r")]
        ends = [_CR] * (len(parts) - 1) + [_ACK]
        self._waiting += [(kind | end, part) for part, end in zip(parts, ends, strict=True)]

    def _put(self, word: int, text: str) -> None:
        memory = self._card.memory
        raw = text.encode("latin-1", "replace")[: _ANSWER_SIZE - 1]
        memory.write_bytes(_ANSWER_TEXT, raw + b"\0")
        memory.x[ANSWER] = len(raw) + 1
        memory.y[ANSWER] = word


def _bcd(number: int) -> int:
    """Return decimal digits, four bits each."""
    return int(str(number), 16)
