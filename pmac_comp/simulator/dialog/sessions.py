"""Conversations over the packet port and over an ASCII line, bytes in and bytes out.

Source: UMAC Turbo CPU hardware manual p. 36-37 (requests), Turbo PMAC Software Reference Manual
p. 254-263 (control characters).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from pmac_comp.machine.wire.dialog import ControlCharacter
from pmac_comp.machine.wire.ethernet import (
    DPRAM_BYTES,
    FLUSH_REPLY,
    MAX_REPLY,
    BufferVerdict,
    Direction,
    Malformed,
    Request,
    RequestCode,
    RequestReader,
    read_datagram,
)
from pmac_comp.simulator.dialog.ports import Port
from pmac_comp.simulator.servo.commanded_faults import ConnectionDropped

if TYPE_CHECKING:
    from pmac_comp.simulator.card.card import Card

_ONE_BYTE = bytes([FLUSH_REPLY])
_NOTHING = b"\x00"  # what the interface says when the card has nothing to say
_LINE_ENDS = b"\r\x06\n"
# Where the interface stops reading the card: an error or what a program says ends with its CR.
_TEXT_END = re.compile(rb"\x06|\x02[^\r]*\r|\x07\r?[^\r]*\r")
_FIRST_LINE = 1
_MOST_SAID = 65536  # bytes of what programs say that wait for a client; the rest is lost
_ASCII_PIECE = 128  # bytes of an ASCII line taken at once


class Refused(Exception):
    """The request cannot be answered; the connection is closed."""


class EthernetSession:
    """One client of the packet port.

    Parameters
    ----------
    card : Card
        The card.
    """

    def __init__(self, card: Card) -> None:
        self.card = card
        self.port = Port(card)
        self._reader = RequestReader()
        self._waiting = bytearray()
        self.closed = False
        self.reason = ""
        self._handlers: dict[int, Callable[[Request], bytes]] = {
            RequestCode.GETRESPONSE: self._get_response,
            RequestCode.SENDLINE: self._send_line,
            RequestCode.GETLINE: self._get_line,
            RequestCode.GETBUFFER: lambda _request: self._next_part(),
            RequestCode.FLUSH: self._flush,
            RequestCode.READREADY: self._read_ready,
            RequestCode.SENDCTRLCHAR: self._send_control,
            RequestCode.CTRL_RESPONSE: self._control_response,
            RequestCode.WRITEBUFFER: self._write_buffer,
            RequestCode.GETMEM: self._get_memory,
            RequestCode.SETMEM: self._set_memory,
            RequestCode.SETBIT: self._set_bit,
            RequestCode.SETBITS: self._set_bits,
            RequestCode.PORT: self._host_port,
            RequestCode.IPADDRESS: self._address,
        }
        card.interpreter.listeners.append(self._announced)

    def close(self) -> None:
        """The client is gone."""
        self.closed = True
        if self._announced in self.card.interpreter.listeners:
            self.card.interpreter.listeners.remove(self._announced)
        self.port.close()

    def receive(self, data: bytes) -> bytes:
        """All answers to these bytes, joined."""
        return b"".join(self.answers(data))

    def answers(self, data: bytes) -> Iterator[bytes]:
        """One answer per request completed by these bytes; each belongs into one packet.

        A request is carried out when its answer is asked for, so that a server can give other
        clients their turn in between.
        """
        for event in self._reader.receive(data):
            if self.closed:
                return
            if isinstance(event, Malformed):
                self._refuse(event.reason)
                return
            try:
                yield self.answer(event)
            except Refused as refusal:
                self._refuse(str(refusal))

    def datagram(self, data: bytes) -> list[bytes]:
        """Answer to the one request of a datagram; what is no request is dropped."""
        event = read_datagram(data)
        if isinstance(event, Malformed):
            return []
        try:
            return [self.answer(event)]
        except Refused:
            return []

    @property
    def half_received(self) -> bool:
        """Whether the rest of a request is awaited."""
        return self._reader.pending > 0

    def _refuse(self, reason: str) -> None:
        self.reason = reason
        self.close()

    def answer(self, request: Request) -> bytes:
        """Answer to one request; Refused if there is none."""
        handler = self._handlers.get(request.code)
        if handler is None:
            raise Refused(f"{request.name} is not supported")
        try:
            return self.card.link_faults.spoil(handler(request))
        except ConnectionDropped as dropped:
            raise Refused(str(dropped)) from dropped

    def _announced(self, port: str, text: str) -> None:
        if port == "P" and len(self._waiting) < _MOST_SAID:
            self._waiting += self.port.unsolicited(text)

    # --- text -----------------------------------------------------------------------------------

    def _run(self, request: Request) -> None:
        """Execute the text of a request; its answer waits."""
        self._waiting.clear()  # a new command drops what was not read
        # The interface adds the CR, so a lone control character is acknowledged, too.
        answer = self.port.receive(request.text + b"\r")
        # A program that the line has started speaks after the acknowledgement.
        self._waiting[:0] = answer

    def _get_response(self, request: Request) -> bytes:
        self._run(request)
        return self._next_part()

    def _send_line(self, request: Request) -> bytes:
        self._run(request)
        return _ONE_BYTE

    def _next_part(self) -> bytes:
        if not self._waiting:
            return _NOTHING
        size = self._part_size()
        part = bytes(self._waiting[:size])
        del self._waiting[:size]
        return part

    def _part_size(self) -> int:
        """Bytes of the next part: to the end of the text, 1400 at most (manual p. 37)."""
        if self.card.variables.int_i(4) & 1:
            return MAX_REPLY  # a checksum may look like an end, and follows it
        end = _TEXT_END.search(self._waiting, 0, MAX_REPLY)
        return MAX_REPLY if end is None else end.end()

    def _get_line(self, _request: Request) -> bytes:
        for index, code in enumerate(self._waiting[:MAX_REPLY]):
            if code in _LINE_ENDS:
                line = bytes(self._waiting[: index + 1])
                del self._waiting[: index + 1]
                return line
        return self._next_part()

    def _flush(self, _request: Request) -> bytes:
        self._waiting.clear()
        self.port.receive(b"\x18")
        return _ONE_BYTE

    def _read_ready(self, _request: Request) -> bytes:
        return bytes([1 if self._waiting else 0, 0])

    def _control(self, request: Request) -> bytes:
        return self.port.control(ControlCharacter(request.control_character))

    def _send_control(self, request: Request) -> bytes:
        self._waiting.clear()
        self._waiting += self._control(request)
        return _ONE_BYTE

    def _control_response(self, request: Request) -> bytes:
        self._waiting.clear()
        self._waiting += self._control(request)
        return self._next_part()

    def _write_buffer(self, request: Request) -> bytes:
        self._waiting.clear()
        for number, line in enumerate(request.lines, start=_FIRST_LINE):
            error = self.port.verdict(line)
            if error is not None:
                return BufferVerdict(error, number).encode()
        return BufferVerdict().encode()

    # --- dual-ported RAM ------------------------------------------------------------------------

    def _check_window(self, offset: int, size: int) -> None:
        if offset + size > DPRAM_BYTES[self.card.dpram]:
            raise Refused(f"dual-ported RAM ends before offset {offset + size}")

    def _get_memory(self, request: Request) -> bytes:
        size = min(request.length, MAX_REPLY)
        self._check_window(request.value, size)
        self.card.ring_hold.look(request.value, size)
        return self.card.memory.read_bytes(request.value, size)

    def _set_memory(self, request: Request) -> bytes:
        self._check_window(request.value, len(request.payload))
        self._write(request.value, request.payload)
        return _ONE_BYTE

    def _write(self, offset: int, data: bytes) -> None:
        self.card.memory.write_bytes(offset, data)
        self.card.dpram_ascii.host_wrote(offset, len(data))

    def _change_cell(self, offset: int, and_mask: int, or_mask: int) -> bytes:
        self._check_window(offset, 4)
        (cell,) = struct.unpack("<I", self.card.memory.read_bytes(offset, 4))
        cell = (cell & and_mask) | or_mask
        self._write(offset, struct.pack("<I", cell))
        return _ONE_BYTE

    def _set_bit(self, request: Request) -> bytes:
        (mask,) = struct.unpack("<I", request.payload)
        if request.index:
            return self._change_cell(request.value, 0xFFFFFFFF, mask)
        return self._change_cell(request.value, mask, 0)

    def _set_bits(self, request: Request) -> bytes:
        set_mask, clear_mask = struct.unpack("<II", request.payload)
        return self._change_cell(request.value, 0xFFFFFFFF & ~clear_mask, set_mask)

    # --- the rest -------------------------------------------------------------------------------

    def _host_port(self, request: Request) -> bytes:
        # The host port itself is behind the Ethernet interface: it reads as idle.
        return _NOTHING if request.direction == Direction.UPLOAD else _ONE_BYTE

    def _address(self, request: Request) -> bytes:
        if request.direction == Direction.DOWNLOAD:
            # Takes effect at power-up; the address of the server itself is the host's affair.
            self.card.ip_address = request.payload
        return self.card.ip_address


class AsciiSession:
    """One client of an ASCII line (serial, terminal server)."""

    def __init__(self, card: Card) -> None:
        self.card = card
        self.port = Port(card)
        self._announcements = bytearray()
        self.closed = False
        card.interpreter.listeners.append(self._announced)

    def answers(self, data: bytes) -> Iterator[bytes]:
        """What answers these bytes, in pieces, so that other clients get their turn in between."""
        for start in range(0, len(data), _ASCII_PIECE):
            yield self.receive(data[start : start + _ASCII_PIECE])

    def receive(self, data: bytes) -> bytes:
        """Bytes the card sends in answer, after what programs have said meanwhile."""
        said = self.pending()
        try:
            return said + self.card.link_faults.spoil(self.port.receive(data))
        except ConnectionDropped:
            self.close()
            return said

    def pending(self) -> bytes:
        """Take what programs have sent."""
        data = bytes(self._announcements)
        self._announcements.clear()
        return data

    def _announced(self, port: str, text: str) -> None:
        if port == "S":
            self._announcements += self.port.unsolicited(text)

    def close(self) -> None:
        """The client is gone."""
        self.closed = True
        if self._announced in self.card.interpreter.listeners:
            self.card.interpreter.listeners.remove(self._announced)
        self.port.close()
