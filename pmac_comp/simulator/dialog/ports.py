"""One conversation with the card: addressing, line execution, control characters, framing.

Source: Turbo PMAC Software Reference Manual p. 35-42, 254-263, 276-277.
"""

from __future__ import annotations

import re
from contextlib import suppress
from typing import TYPE_CHECKING

from pmac_comp.machine.wire.dialog import (
    MAX_LINE,
    CommandLine,
    ControlCharacter,
    LineReader,
    LineTooLong,
    command_sum,
    format_line,
    format_reply,
    format_unsolicited,
)
from pmac_comp.simulator.commands.line import LineContext, Modal
from pmac_comp.simulator.language.scanner import Scanner, parse_number
from pmac_comp.simulator.memory.errors import CardError

if TYPE_CHECKING:
    from pmac_comp.simulator.card.card import Card

_TAB, _CHECKSUM, _CANCEL, _CONTROL_T, _CONTROL_Z = 0x09, 0x0E, 0x18, 0x14, 0x1A
_BLANK = 0x20
_ERROR_LINE_TOO_LONG = 3
_ERROR_CHARACTER = 4
# Most of a download is one constant per line; it needs no parser.
_CONSTANT = re.compile(rb"([IPQM])(\d{1,4})=(-?)(\$[0-9A-F]+|\d+\.?\d*|\.\d+)", re.IGNORECASE)
_LAST_VARIABLE = 8191


class Port:
    """Addressing and command queue of one port.

    Parameters
    ----------
    card : Card
        The card.
    """

    def __init__(self, card: Card) -> None:
        self.card = card
        self.modal = Modal()
        self._reader = LineReader()
        self._last_line = b""
        self._resets = card.resets  # that the addressing knows of

    def line(self, text: str | bytes) -> bytes:
        """Answer to one command line, framed by I3, I4 and I6."""
        raw = text.encode("latin-1", "replace") if isinstance(text, str) else text
        lines: list[str] = []
        error, silent = self.execute(raw, lines)
        if silent and error is None:
            return b""
        return self._reply(lines, raw, error=error)

    def verdict(self, raw: bytes) -> int | None:
        """Execute one command line for its error number only, None if it was carried out."""
        if len(raw) <= MAX_LINE and min(raw, default=_BLANK) >= _BLANK:
            return self.execute(raw, [])[0]
        # Lines of a file may be indented by tabs and still carry their CR.
        for event in self._reader.receive(raw.replace(b"\t", b" ") + b"\r"):
            error = None
            if isinstance(event, CommandLine):
                error = self.execute(event.text, [])[0]
            elif isinstance(event, ControlCharacter):
                self.control(event)
            else:
                error = _ERROR_LINE_TOO_LONG
            if error is not None:
                return error
        return None

    def execute(self, raw: bytes, lines: list[str]) -> tuple[int | None, bool]:
        """Execute a line into `lines`; its error and whether it ends without acknowledgement."""
        self._last_line = raw
        self._after_reset()
        try:
            constant = _CONSTANT.fullmatch(raw)
            if constant is not None and self._assign_constant(constant):
                return None, False
            if not raw.isascii() or b"\x7f" in raw:
                return _ERROR_CHARACTER, False
            text = raw.decode("ascii")
            context = LineContext(self.card, self.modal, Scanner(text), owner=self, lines=lines)
            self.card.interpreter.execute_line(context)
        except CardError as refusal:
            return refusal.code, False
        return None, context.silent_end

    def _after_reset(self) -> None:
        """After power-up every port addresses #1 and &1 again (p. 276-277)."""
        if self._resets != self.card.resets:
            self._resets = self.card.resets
            self.modal.power_up()

    def _assign_constant(self, match: re.Match[bytes]) -> bool:
        """Carry out ``P5=7`` unless it belongs into an open buffer; False if it does."""
        card = self.card
        number = int(match[2])
        if number > _LAST_VARIABLE or card.programs.is_open_on(self):
            return False
        if card.rotary.is_open_on(self):
            return False
        value = parse_number(match[4].decode("ascii").upper())
        kind = match[1].decode("ascii").upper()
        card.variables.write(kind, number, -value if match[3] else value, self.modal.cs)
        card.variable_written(kind, number)
        return True

    def _reply(self, lines: list[str], command: bytes, *, error: int | None) -> bytes:
        read = self.card.variables.int_i
        return format_reply(lines, i3=read(3), i4=read(4), i6=read(6), error=error, command=command)

    def receive(self, data: bytes) -> bytes:
        """Answer to characters of an ASCII line, control characters included."""
        out = bytearray()
        for event in self._reader.receive(data):
            if isinstance(event, CommandLine):
                out += self.line(event.text)
            elif isinstance(event, ControlCharacter):
                out += self.control(event)
            elif isinstance(event, LineTooLong):
                out += self._reply([], b"", error=_ERROR_LINE_TOO_LONG)
        return bytes(out)

    def control(self, event: ControlCharacter) -> bytes:
        """Act on a control character; the bytes it answers with."""
        code = event.code
        if code == _TAB:
            return self.line(self._last_line)
        if code == _CHECKSUM:
            return bytes([command_sum(event.line_so_far)])
        if code in (_CANCEL, _CONTROL_T):
            return b"\x18" if self.card.variables.int_i(63) else b""
        self._after_reset()
        self.card.refresh_status()
        text = self.card.status.report(code, self.modal.group)
        if text is not None:
            # Reporting characters answer one line without an acknowledgement (p. 257).
            read = self.card.variables.int_i
            return format_line(text, i3=read(3) & 2, i4=read(4))
        self.card.interpreter.control_character(code)
        return b""

    def unsolicited(self, text: str) -> bytes:
        """Framing of a text that a program sent."""
        read = self.card.variables.int_i
        return format_unsolicited(text, i3=read(3), i4=read(4), i62=read(62), i64=read(64))

    def close(self) -> None:
        """The other side is gone: a buffer it left open is closed, or nobody could use buffers."""
        self._reader = LineReader()
        # What was entered so far may be no whole program; it then stays disabled.
        with suppress(CardError):
            self.card.close(self)
