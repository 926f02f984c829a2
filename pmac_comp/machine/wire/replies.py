"""ASCII conversation, the host's side: where an answer ends and what is in it.

What lives here: the reading of answers, in any mode. No socket, no clock; imports the sums and
characters of ``dialog``. Source: Turbo PMAC Software Reference Manual pp. 35-42, 469-471.

A host sets I3=2 because then, and only then, does an answer end with a character of its own (ACK);
:class:`ReplyReader` reads that form. :func:`read_settled` reads any form from bytes after which
the line has gone quiet: it serves the first contact, when the modes are still unknown.
"""

import re
from dataclasses import dataclass, field, replace
from enum import Enum

from pmac_comp.base.errors import RemoteProtocolError
from pmac_comp.machine.wire.dialog import ACK, BEL, CAN, CR, LF, STX, line_sum, visible

MAX_ANSWER = 8_000_000
"""Default cap of one answer in bytes; a full program memory lists in less."""

_CONTROL = re.compile(rb"[\x00-\x1f]")
_PLAIN_ANSWER = re.compile(rb"(?:[\x20-\x7e]+\r)*\x06")
_ERROR = re.compile(r"ERR(\d{3})")


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
    checksum, line_feeds = bool(i4 & 1), bool(i3 & 1)
    tail = 1 if checksum else 0
    if len(data) < tail:
        return None
    command_sum = data[-1] if checksum else None
    end = {0: b"", 1: b"\n", 2: b"\x06", 3: b"\x06"}[i3 & 3]
    body = data[: len(data) - tail]
    if not body.endswith(end):
        return None
    body = body[: len(body) - len(end)].lstrip(b"\x00\x18")
    reply = _split_lines(body, checksum=checksum, line_feeds=line_feeds)
    return None if reply is None else replace(reply, command_sum=command_sum)


def _split_lines(body: bytes, *, checksum: bool, line_feeds: bool) -> Reply | None:
    lines: list[str] = []
    unsolicited: list[str] = []
    position = 0
    while position < len(body):
        end = body.find(b"\r", position) + 1
        line = body[position:end]
        text = line.removeprefix(b"\x02")
        if not end or text.startswith(b"\n") != line_feeds:
            return None
        position = end
        if checksum:
            # The sum may be any byte, a line feed or an ACK among them.
            if position >= len(body) or body[position] != line_sum(line):
                return None
            position += 1
        if _CONTROL.search(text[line_feeds:-1]):
            return None
        (unsolicited if text != line else lines).append(visible(text[line_feeds:-1]))
    return Reply(tuple(lines), unsolicited=tuple(unsolicited))
