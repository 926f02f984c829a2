"""ASCII conversation, the controller's side: how lines come in and how answers are put.

What lives here: framing by I3, I4 and I6, line checksums, command lines with control characters
in them. No socket, no clock; imports only numbers of errors. Source: Turbo PMAC Software Reference
Manual pp. 35-42 (I3, I4, I6), 254-263 (control characters), 469-471 (I62-I64).
"""

from collections.abc import Sequence
from dataclasses import dataclass

from pmac_comp.machine.wire.errors import error_text

STX, ACK, BEL, BS, LF, CR, CAN = 0x02, 0x06, 0x07, 0x08, 0x0A, 0x0D, 0x18
MAX_LINE = 255

_VISIBLE = {code: chr(code) for code in range(0x20, 0x7F)}


def visible(data: bytes | bytearray) -> str:
    r"""Text of ``data`` in which everything but printable ASCII is escaped as ``\xNN``."""
    if data.isascii() and (text := data.decode("ascii")).isprintable():
        return text
    return "".join(_VISIBLE.get(code, f"\\x{code:02x}") for code in data)


def line_sum(data: bytes) -> int:
    """8-bit sum the card sends after a line: of all its characters, control characters too."""
    return sum(data) & 0xFF


def command_sum(command: bytes) -> int:
    """8-bit sum the card computes of a command: control characters do not count."""
    return sum(code for code in command if code >= 0x20) & 0xFF


def format_reply(
    lines: Sequence[str],
    *,
    i3: int = 2,
    i4: int = 0,
    i6: int = 1,
    error: int | None = None,
    command: bytes = b"",
) -> bytes:
    """Bytes that answer one command line in the given modes.

    Parameters
    ----------
    lines : sequence of str
        Data lines that the command produced, before the error if there was one.
    i3, i4, i6 : int
        Handshake, integrity and error-reporting mode (0 to 3 each).
    error : int or None
        Number of the error that stopped the line.
    command : bytes
        The command line, for the checksum that follows the acknowledgement (I4 = 1 or 3).

    Source
    ------
    Software Reference Manual pp. 36-40. A refused line gets no checksum byte (User Manual,
    "Communications Checksum").
    """
    out = b"".join(format_line(text, i3=i3, i4=i4) for text in lines)
    if error is not None:
        return out + format_error(error, i3=i3, i6=i6)
    acknowledge = {0: b"", 1: b"\n", 2: b"\x06", 3: b"\x06"}[i3 & 3]
    check = bytes([command_sum(command)]) if i4 & 1 else b""
    return out + acknowledge + check


def format_line(text: str, *, i3: int = 2, i4: int = 0) -> bytes:
    """One data line: LF in front with I3=1 or 3, CR behind, its sum with I4=1 or 3."""
    start = b"\n" if i3 & 1 else b""
    return _checked(start + text.encode("ascii", "replace") + b"\r", i4)


def format_error(error: int, *, i3: int = 2, i6: int = 1) -> bytes:
    """BEL and, by I6, the error number; LF stands before it with I3=1 or 3."""
    if i6 in (0, 2):
        return b"\x07"
    between = (b"\r" if i6 == 3 else b"") + (b"\n" if i3 & 1 else b"")
    return b"\x07" + between + error_text(error).encode() + b"\r"


def format_unsolicited(text: str, *, i3: int = 2, i4: int = 0, i62: int = 0, i64: int = 1) -> bytes:
    """Text sent by SEND or CMD in a program: no acknowledgement follows it."""
    start = (b"\x02" if i64 else b"") + (b"\n" if i3 & 1 else b"")
    end = b"" if i62 else b"\r"
    data = start + text.encode("ascii", "replace") + end
    return _checked(data, i4) if end else data


def _checked(line: bytes, i4: int) -> bytes:
    return line + bytes([line_sum(line)]) if i4 & 1 else line


@dataclass(frozen=True)
class CommandLine:
    """A line ended by CR, without it and without the control characters put into it."""

    text: bytes


@dataclass(frozen=True)
class ControlCharacter:
    """A control character to be acted on at once; ``line_so_far`` serves control-N."""

    code: int
    line_so_far: bytes = b""


@dataclass(frozen=True)
class LineTooLong:
    """More characters than the queue takes arrived without a CR; they were dropped."""

    size: int


LineEvent = CommandLine | ControlCharacter | LineTooLong


class LineReader:
    """The controller's side of an ASCII port: characters in, command lines out.

    Control characters are reported at once, wherever in a line they come. CR executes, BS takes
    one character back, LF is ignored (terminal programs add it), control-X empties the line.
    """

    def __init__(self, max_line: int = MAX_LINE) -> None:
        self._line = bytearray()
        self._max_line = max_line
        self._excess = 0

    def receive(self, data: bytes) -> list[LineEvent]:
        """Lines completed and control characters met in these bytes, in order."""
        events: list[LineEvent] = []
        for code in data:
            event = self._take(code)
            if event is not None:
                events.append(event)
        return events

    def _take(self, code: int) -> LineEvent | None:
        if code == CR:
            return self._finish()
        if code in (LF, 0):
            return None
        if code == BS:
            del self._line[-1:]
            return None
        if code < 0x20:
            event = ControlCharacter(code, bytes(self._line))
            if code == CAN:
                self._line.clear()
                self._excess = 0
            return event
        if len(self._line) < self._max_line:
            self._line.append(code)
        else:
            self._excess += 1
        return None

    def _finish(self) -> LineEvent:
        text, excess = bytes(self._line), self._excess
        self._line.clear()
        self._excess = 0
        return LineTooLong(len(text) + excess) if excess else CommandLine(text)
