"""Packets of the Ethernet (and USB) port: bytes in, events out.

What lives here: the eight-byte header, what follows it, and what answers it; what a client asks for
is made in ``ethernet_requests``. No socket, no clock,
no sleep; imports only the error tree. Source of all codes: UMAC Turbo CPU hardware manual,
chapter "Ethernet Protocol", pp. 36-37, and the maker's header of request numbers.

Two traps of this protocol are kept in one place, :func:`carries_payload`:

* ``wLength`` announces a payload only for some requests; for the others it is the number of bytes
  *wanted*, and some clients leave rubbish in it;
* replies carry no header and no number, so only their order says what they answer.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum

from pmac_comp.base.errors import LocalProtocolError, RemoteProtocolError

HEADER_SIZE = 8
MAX_REPLY = 1400
"""Most bytes one request is answered with."""
MAX_PAYLOAD = 1492
"""Size of the data field in the maker's packet structure."""
MAX_WRITE_BUFFER = 1024
"""Documented limit of the text in one WRITEBUFFER request."""
MAX_COMMAND = 255
"""Longest command line: real ports queue 256 words."""
FLUSH_REPLY = 0x40
"""What a real unit answers to FLUSH; clients must not check it."""
DPRAM_BYTES = {"small": 0x4000, "large": 0x10000, "none": 0}
"""Byte size of the dual-ported RAM as a host sees it (8K x 16 or 32K x 16)."""

_HEADER = struct.Struct(">BBHHH")


class Direction(IntEnum):
    """First header byte."""

    DOWNLOAD = 0x40
    UPLOAD = 0xC0


class RequestCode(IntEnum):
    """Second header byte."""

    SENDLINE = 0xB0
    GETLINE = 0xB1
    FLUSH = 0xB3
    GETMEM = 0xB4
    SETMEM = 0xB5
    SENDCTRLCHAR = 0xB6
    SETBIT = 0xBA
    SETBITS = 0xBB
    PORT = 0xBE
    GETRESPONSE = 0xBF
    READREADY = 0xC2
    CTRL_RESPONSE = 0xC4
    GETBUFFER = 0xC5
    WRITEBUFFER = 0xC6
    FWDOWNLOAD = 0xCB
    IPADDRESS = 0xE0


NAMED_ONLY = {
    0xB7: "ENARTDATAGAT",
    0xB8: "INIT",
    0xB9: "EEPROM_VIDDID",
    0xBC: "DATAPORT",
    0xBD: "STATUSPORT",
    0xC0: "SETSERCHAR",
    0xC1: "GETSERCHAR",
    0xC3: "GETLINE_B",
    0xC7: "WRITEERROR",
    0xC8: "BINROTPUT",
    0xC9: "BINROTERROR",
    0xCA: "BINROTINIT",
    0xD0: "CLOSE",
    0xE1: "MACADDRESS",
    0xE2: "DATE",
    0xE3: "TIME",
    0xE4: "VERSION",
}
"""Requests of which only the name is public: they are refused, never guessed at."""

_ALWAYS_PAYLOAD = frozenset(
    {
        RequestCode.SENDLINE,
        RequestCode.GETRESPONSE,
        RequestCode.WRITEBUFFER,
        RequestCode.SETMEM,
        RequestCode.SETBIT,
        RequestCode.SETBITS,
        RequestCode.FWDOWNLOAD,
    }
)
_PAYLOAD_SIZE: dict[int, int] = {
    RequestCode.SETBIT: 4,
    RequestCode.SETBITS: 8,
    RequestCode.IPADDRESS: 4,
}
_PAYLOAD_LIMIT: dict[int, int] = {
    RequestCode.SETMEM: MAX_REPLY,
    RequestCode.WRITEBUFFER: MAX_PAYLOAD,
}
_IDLE_BYTES = b"\x00\n\r"
_KNOWN_CODES = frozenset(int(code) for code in RequestCode)
_TEXT_REPLY = frozenset(
    {
        RequestCode.GETLINE,
        RequestCode.GETRESPONSE,
        RequestCode.CTRL_RESPONSE,
        RequestCode.GETBUFFER,
    }
)


@dataclass(frozen=True)
class Request:
    """One request as it goes over the wire.

    Parameters
    ----------
    direction : int
        ``Direction.DOWNLOAD`` or ``Direction.UPLOAD``; several requests are seen with either.
    code : int
        A ``RequestCode``.
    value, index, length : int
        The three header words, 16 bit unsigned.
    payload : bytes
        Data after the header, empty for requests that carry none.
    """

    direction: int
    code: int
    value: int = 0
    index: int = 0
    length: int = 0
    payload: bytes = b""

    @property
    def name(self) -> str:
        """Name of the request in the manual."""
        return RequestCode(self.code).name

    @property
    def control_character(self) -> int:
        """Control character of CTRL_RESPONSE and SENDCTRLCHAR.

        A widely used driver forgets to swap the bytes of the word: either byte may hold it.
        """
        return (self.value & 0xFF) or (self.value >> 8)

    @property
    def text(self) -> bytes:
        """Command text of SENDLINE and GETRESPONSE without the endings that clients add."""
        return self.payload.rstrip(_IDLE_BYTES)

    @property
    def lines(self) -> tuple[bytes, ...]:
        """Lines of WRITEBUFFER; a last line without its null byte counts too."""
        parts = self.payload.split(b"\x00")
        return tuple(parts[:-1] if not parts[-1] else parts)


@dataclass(frozen=True)
class Malformed:
    """Bytes that are no request; the stream cannot be followed beyond them.

    Parameters
    ----------
    reason : str
        Why, for the log of the server.
    data : bytes
        As much of the header as shows it; it does not depend on how the stream was cut.
    """

    reason: str
    data: bytes


def carries_payload(direction: int, code: int) -> bool:
    """Whether ``wLength`` bytes follow the header of this request."""
    if code == RequestCode.IPADDRESS:
        return direction == Direction.DOWNLOAD
    return code in _ALWAYS_PAYLOAD


def encode(request: Request) -> bytes:
    """Bytes of a request: header, then payload."""
    try:
        header = _HEADER.pack(
            request.direction, request.code, request.value, request.index, request.length
        )
    except struct.error as error:
        raise LocalProtocolError(f"{request} does not fit the header: {error}") from error
    return header + request.payload


class RequestReader:
    """The controller's side of a stream: bytes in, requests out, however they were cut.

    After a :class:`Malformed` the reader is ``broken``: a server closes the connection.
    """

    def __init__(self) -> None:
        self._pending = bytearray()
        self.broken = False

    @property
    def pending(self) -> int:
        """Number of bytes that wait for the rest of their request."""
        return len(self._pending)

    def receive(self, data: bytes) -> list[Request | Malformed]:
        """Requests completed by these bytes, in order."""
        events: list[Request | Malformed] = []
        if self.broken:
            return events
        self._pending += data
        while not self.broken and (event := self._next()) is not None:
            events.append(event)
            self.broken = isinstance(event, Malformed)
        if self.broken:
            self._pending.clear()
        return events

    def _next(self) -> Request | Malformed | None:
        self._drop_idle()
        if not self._pending:
            return None
        early = _early_fault(self._pending)
        if early is not None:
            return early
        if len(self._pending) < HEADER_SIZE:
            return None
        direction, code, value, index, length = _HEADER.unpack_from(self._pending)
        fault = _length_fault(direction, code, length)
        if fault is not None:
            return Malformed(fault, bytes(self._pending[:HEADER_SIZE]))
        end = HEADER_SIZE + (length if carries_payload(direction, code) else 0)
        if len(self._pending) < end:
            return None
        payload = bytes(self._pending[HEADER_SIZE:end])
        del self._pending[:end]
        return Request(direction, code, value, index, length, payload)

    def _drop_idle(self) -> None:
        # Clients that end their text with CR LF or NUL *behind* wLength leave it here.
        keep = 0
        while keep < len(self._pending) and self._pending[keep] in _IDLE_BYTES:
            keep += 1
        del self._pending[:keep]


def read_datagram(data: bytes) -> Request | Malformed:
    """The request of one UDP datagram, which holds exactly one."""
    reader = RequestReader()
    events = reader.receive(data)
    if len(events) == 1 and not reader.pending:
        return events[0]
    reason = "datagram with more than one request" if events else "datagram cut short"
    return Malformed(reason, data[:HEADER_SIZE])


def _early_fault(pending: bytearray) -> Malformed | None:
    if pending[0] not in (Direction.DOWNLOAD, Direction.UPLOAD):
        reason = f"request type {pending[0]:02X} is neither 40 nor C0"
        return Malformed(reason, bytes(pending[:1]))
    if len(pending) >= 2 and pending[1] not in _KNOWN_CODES:
        name = NAMED_ONLY.get(pending[1])
        what = f"not supported: {name}" if name else "unknown"
        return Malformed(f"request {pending[1]:02X} is {what}", bytes(pending[:2]))
    return None


def _length_fault(direction: int, code: int, length: int) -> str | None:
    if not carries_payload(direction, code):
        return None
    exact = _PAYLOAD_SIZE.get(code)
    if exact is not None and length != exact:
        return f"request {code:02X} carries {exact} bytes, not {length}"
    limit = _PAYLOAD_LIMIT.get(code, MAX_PAYLOAD)
    if length > limit:
        return f"request {code:02X} announces {length} bytes, more than {limit}"
    return None


# What answers it ---------------------------------------------------------------------------------


def reply_size(request: Request) -> int | None:
    """Exact number of bytes that answer a request; None for text, which ends by its content."""
    if request.code in _TEXT_REPLY:
        return None
    if request.code == RequestCode.GETMEM:
        return request.length
    sizes: dict[int, int] = {
        RequestCode.READREADY: 2,
        RequestCode.WRITEBUFFER: 4,
        RequestCode.IPADDRESS: 4,
    }
    return sizes.get(request.code, 1)


@dataclass(frozen=True)
class BufferVerdict:
    """What the controller says about a WRITEBUFFER request.

    Parameters
    ----------
    error : int
        Number nnn of ERRnnn, 0 for success.
    line_number : int
        Number of the refused line. The manual does not say whether it counts from 0 or 1.
    """

    error: int = 0
    line_number: int = 0

    @property
    def refused(self) -> bool:
        """Whether a line was refused."""
        return self.error != 0

    def encode(self) -> bytes:
        """The four bytes of the reply: line number low, high, error number, 80 for an error."""
        flag = 0x80 if self.refused else 0
        return struct.pack("<HBB", self.line_number & 0xFFFF, self.error & 0xFF, flag)

    @classmethod
    def decode(cls, data: bytes) -> "BufferVerdict":
        """Verdict from the four bytes of the reply."""
        if len(data) != 4:
            raise RemoteProtocolError(f"WRITEBUFFER was answered with {len(data)} bytes, not 4")
        line_number, error, flag = struct.unpack("<HBB", data)
        # A set flag with error number 0 is still an error: never take it for success.
        return cls(error or 255, line_number) if flag else cls()


def cut_reply(text: bytes) -> list[bytes]:
    """An answer cut into the parts that GETRESPONSE and GETBUFFER give, 1400 bytes each."""
    return [text[start : start + MAX_REPLY] for start in range(0, len(text), MAX_REPLY)]
