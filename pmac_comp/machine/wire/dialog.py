"""ASCII conversation of the controller, both roles: how a line is put and how an answer ends.

What lives here: framing by I3, I4 and I6, line checksums, command lines with control characters
in them. No socket, no clock; imports only numbers of errors. Source: Turbo PMAC Software Reference
Manual pp. 35-42 (I3, I4, I6), 254-263 (control characters), 469-471 (I62-I64).

A host sets I3=2 because then, and only then, does an answer end with a character of its own (ACK);
:class:`ReplyReader` reads that form. :func:`read_settled` reads any form from bytes after which
the line has gone quiet: it serves the first contact, when the modes are still unknown.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum

from pmac_comp.base.errors import RemoteProtocolError
from pmac_comp.machine.wire.errors import error_text

STX, ACK, BEL, BS, LF, CR, CAN = 0x02, 0x06, 0x07, 0x08, 0x0A, 0x0D, 0x18
MAX_LINE = 255
MAX_ANSWER = 8_000_000
"""Default cap of one answer in bytes; a full program memory lists in less."""

_CONTROL = re.compile(rb"[\x00-\x1f]")
_PLAIN_ANSWER = re.compile(rb"(?:[\x20-\x7e]+\r)*\x06")
_ERROR = re.compile(r"ERR(\d{3})")
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


# The controller's side ---------------------------------------------------------------------------


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


# The host's side ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reply:
    """A whole answer.

    Parameters
    ----------
    lines : tuple of str
        Data lines without their endings.
    error : int or None
        Number nnn of ERRnnn; 0 if the card said BEL without a number.
    unsolicited : tuple of str
        Lines a program sent in between (STX in front).
    command_sum : int or None
        The card's sum of the command it received, with I4=1 or 3.
    faults : tuple of str
        What was wrong with the bytes: sums that differ, characters that cannot stand in a line.
    """

    lines: tuple[str, ...] = ()
    error: int | None = None
    unsolicited: tuple[str, ...] = ()
    command_sum: int | None = None
    faults: tuple[str, ...] = ()


class _Text(Enum):
    DATA = "data"
    UNSOLICITED = "unsolicited"
    ERROR = "error"


class _Sum(Enum):
    LINE = "line"
    COMMAND = "command"


@dataclass
class _Draft:
    lines: list[str] = field(default_factory=list)
    unsolicited: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    error: int | None = None
    command_sum: int | None = None


def plain_lines(data: bytes) -> tuple[str, ...] | None:
    """Lines of a whole answer with I3=2 and I4=0 and nothing else in it, else None.

    Nearly all answers are such; :class:`ReplyReader` would read the same, more slowly.
    """
    if _PLAIN_ANSWER.fullmatch(data):
        return tuple(data[:-1].decode("ascii").split("\r")[:-1])
    return None


class ReplyReader:
    """Reads one answer in the form that I3=2 (or 3) and I6=1 (or 3) give it.

    Any split of the bytes gives the same :attr:`reply`. Stray line feeds, null bytes, control-X
    echoes and empty lines before an answer do not shift it.

    Parameters
    ----------
    checksum : bool
        Whether I4 is 1 or 3: a sum follows each CR and the ACK, and may be any byte.
    limit : int
        Most bytes accepted, so that an endless answer ends in an error.
    """

    def __init__(self, *, checksum: bool = False, limit: int = MAX_ANSWER) -> None:
        self._checksum = checksum
        self._limit = limit
        self._draft = _Draft()
        self._kind = _Text.DATA
        self._line = bytearray()
        self._sum = 0
        self._expected: _Sum | None = None
        self._interrupted: tuple[bytes, int] | None = None
        self.size = 0
        self.done = False
        self.rest = b""
        self.null_seen = False

    @property
    def reply(self) -> Reply:
        """What was read; whole once ``done``."""
        draft = self._draft
        return Reply(
            tuple(draft.lines),
            draft.error,
            tuple(draft.unsolicited),
            draft.command_sum,
            tuple(draft.faults),
        )

    @property
    def at_line_start(self) -> bool:
        """Whether the bytes so far end at a line's end, with no part of a line behind."""
        return not self._line and self._expected is None

    def receive(self, data: bytes) -> bool:
        """Take bytes; True once the answer is whole. Bytes behind it are kept in ``rest``."""
        self.size += len(data)
        if self.size > self._limit:
            raise RemoteProtocolError(
                f"the answer exceeds {self._limit} bytes",
                hint="Ask for less at once, or check what is connected.",
            )
        position = 0
        while position < len(data) and not self.done:
            position = self._step(data, position)
        self.rest += data[position:]
        return self.done

    def _step(self, data: bytes, position: int) -> int:
        if self._expected is not None:
            self._take_sum(data[position])
            return position + 1
        match = _CONTROL.search(data, position)
        end = match.start() if match else len(data)
        self._line += data[position:end]
        if self._checksum:
            self._sum += sum(data[position:end])
        if match is None:
            return end
        self._sum += data[end]
        self._take_control(data[end])
        return end + 1

    def _take_sum(self, value: int) -> None:
        expected, self._expected = self._expected, None
        if expected is _Sum.COMMAND:
            self._draft.command_sum = value
            self.done = True
            return
        if value != self._sum & 0xFF:
            self._draft.faults.append(f"line checksum {value:#04x}, not {self._sum & 0xFF:#04x}")
        self._start_line()

    def _take_control(self, code: int) -> None:
        if code == CR:
            self._end_line()
        elif code == ACK:
            self._end_reply()
        elif code == BEL:
            self._begin_error()
        elif code == STX:
            self._interrupted = (bytes(self._line), self._sum - code)
            self._line.clear()
            self._sum = code
            self._kind = _Text.UNSOLICITED
        elif code in (LF, CAN, 0) and not self._line:
            self.null_seen |= code == 0
            self._sum = code if code == LF else 0
        else:
            self._draft.faults.append(f"character {code:#04x} inside a line")

    def _begin_error(self) -> None:
        if self._line:
            self._draft.faults.append(f"'{visible(self._line)}' cut off by an error")
        self._line.clear()
        self._kind = _Text.ERROR

    def _end_line(self) -> None:
        text = self._clean()
        if self._kind is _Text.ERROR:
            self._line.clear()
            self._end_error(text)
            return
        if self._kind is _Text.UNSOLICITED:
            self._draft.unsolicited.append(text)
        elif text:
            self._draft.lines.append(text)
        self._line.clear()
        if self._checksum:
            self._expected = _Sum.LINE
        else:
            self._start_line()

    def _start_line(self) -> None:
        # A program may have spoken in the middle of a line: go on where it was.
        text, self._sum = self._interrupted or (b"", 0)
        self._line += text
        self._interrupted = None
        self._kind = _Text.DATA

    def _end_error(self, text: str) -> None:
        if not text:
            return  # I6=3 sends a CR between BEL and the number
        match = _ERROR.fullmatch(text)
        if match is None:
            self._draft.faults.append(f"'{text}' is no error number")
        self._draft.error = int(match[1]) if match else 0
        self.done = True

    def _end_reply(self) -> None:
        if self._line:
            self._draft.faults.append(f"'{visible(self._line)}' ends without CR")
            self._line.clear()
        if self._kind is _Text.ERROR:
            self._draft.faults.append("ACK after BEL")
            self._draft.error = 0
        if self._checksum:
            self._expected = _Sum.COMMAND
        else:
            self.done = True

    def _clean(self) -> str:
        text = visible(self._line)
        if len(text) != len(self._line):
            self._draft.faults.append(f"'{text}' holds characters that are not ASCII")
        return text


def read_settled(data: bytes, *, i3: int, i4: int = 0) -> Reply | None:
    """The answer in ``data`` if it is whole in the given modes, None if it is not.

    The line must have gone quiet: with I3=0 nothing marks the end, with I3=1 the final LF looks
    like the start of another line.

    Parameters
    ----------
    data : bytes
        Everything received.
    i3, i4 : int
        The modes to read it in.
    """
    if i3 in (2, 3):
        return _settled_acknowledged(data, checksum=bool(i4 & 1), line_feeds=i3 == 3)
    checksum = bool(i4 & 1)
    tail = 1 if checksum else 0
    sum_of_command = data[-1] if checksum and data else None
    body = data[: len(data) - tail]
    if i3 == 1:
        if not body.endswith(b"\n"):
            return None
        body = body[:-1]
    lines = _split_lines(body, checksum=checksum, line_feeds=i3 == 1)
    return None if lines is None else Reply(tuple(lines), command_sum=sum_of_command)


def _settled_acknowledged(data: bytes, *, checksum: bool, line_feeds: bool) -> Reply | None:
    reader = ReplyReader(checksum=checksum)
    if not reader.receive(data) or reader.rest or reader.reply.faults:
        return None
    has_line_feeds = b"\n" in data
    return reader.reply if has_line_feeds == (line_feeds and bool(reader.reply.lines)) else None


def _split_lines(body: bytes, *, checksum: bool, line_feeds: bool) -> list[str] | None:
    lines: list[str] = []
    position = 0
    while position < len(body):
        end = body.find(b"\r", position) + 1
        line = body[position:end]
        if not end or line.startswith(b"\n") != line_feeds:
            return None
        position = end
        if checksum:
            if position >= len(body) or body[position] != line_sum(line):
                return None
            position += 1
        text = line.strip(b"\r\n")
        if _CONTROL.search(text):
            return None
        lines.append(visible(text))
    return lines
