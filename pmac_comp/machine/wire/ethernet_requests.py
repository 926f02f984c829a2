"""What a client says on the Ethernet (and USB) port: one function for each request it may make.

Source: UMAC Turbo CPU hardware manual, chapter "Ethernet Protocol", pp. 36-37.
"""

import struct
from collections.abc import Sequence

from pmac_comp.base.errors import LocalProtocolError
from pmac_comp.machine.wire.ethernet import (
    MAX_COMMAND,
    MAX_REPLY,
    MAX_WRITE_BUFFER,
    Direction,
    Request,
    RequestCode,
)

_GETRESPONSE = struct.Struct(">BBIH")


def send_line(text: bytes) -> Request:
    """SENDLINE: hand over a command; its answer is fetched with GETBUFFER."""
    return Request(
        Direction.DOWNLOAD, RequestCode.SENDLINE, length=len(text), payload=_command(text)
    )


def get_response(text: bytes) -> Request:
    """GETRESPONSE: hand over a command and receive the first part of its answer."""
    return Request(
        Direction.DOWNLOAD, RequestCode.GETRESPONSE, length=len(text), payload=_command(text)
    )


def command_packet(text: bytes) -> bytes:
    """Bytes of GETRESPONSE, the request of nearly every exchange, in one step."""
    return _GETRESPONSE.pack(Direction.DOWNLOAD, RequestCode.GETRESPONSE, 0, len(text)) + text


def get_line() -> Request:
    """GETLINE: the waiting text up to the next CR, ACK or LF."""
    return Request(Direction.UPLOAD, RequestCode.GETLINE)


def get_buffer() -> Request:
    """GETBUFFER: the next part of a waiting answer."""
    return Request(Direction.UPLOAD, RequestCode.GETBUFFER, length=MAX_REPLY)


def read_ready() -> Request:
    """READREADY: whether text waits."""
    return Request(Direction.UPLOAD, RequestCode.READREADY, length=2)


def flush() -> Request:
    """FLUSH: drop what is pending in either direction."""
    return Request(Direction.DOWNLOAD, RequestCode.FLUSH)


def control_response(character: int) -> Request:
    """CTRL_RESPONSE: the text that answers a reporting control character."""
    return Request(
        Direction.UPLOAD, RequestCode.CTRL_RESPONSE, value=_control(character), length=MAX_REPLY
    )


def send_control(character: int) -> Request:
    """SENDCTRLCHAR: a control character that answers nothing."""
    return Request(Direction.DOWNLOAD, RequestCode.SENDCTRLCHAR, value=_control(character))


def get_memory(offset: int, size: int) -> Request:
    """GETMEM: ``size`` bytes of the dual-ported RAM from byte ``offset``."""
    if not 0 < size <= MAX_REPLY:
        raise LocalProtocolError(f"GETMEM takes 1 to {MAX_REPLY} bytes, not {size}")
    return Request(Direction.UPLOAD, RequestCode.GETMEM, value=offset, length=size)


def set_memory(offset: int, data: bytes) -> Request:
    """SETMEM: write bytes into the dual-ported RAM from byte ``offset``."""
    if not 0 < len(data) <= MAX_REPLY:
        raise LocalProtocolError(f"SETMEM takes 1 to {MAX_REPLY} bytes, not {len(data)}")
    return Request(
        Direction.UPLOAD, RequestCode.SETMEM, value=offset, length=len(data), payload=data
    )


def set_bits(offset: int, set_mask: int, clear_mask: int) -> Request:
    """SETBITS: set and clear bits of one 32-bit cell of the dual-ported RAM in one access."""
    payload = struct.pack("<II", set_mask, clear_mask)
    return Request(Direction.DOWNLOAD, RequestCode.SETBITS, value=offset, length=8, payload=payload)


def or_bits(offset: int, mask: int) -> Request:
    """SETBIT with wIndex 1: set bits of one 32-bit cell."""
    return Request(
        Direction.DOWNLOAD,
        RequestCode.SETBIT,
        value=offset,
        index=1,
        length=4,
        payload=struct.pack("<I", mask),
    )


def and_bits(offset: int, mask: int) -> Request:
    """SETBIT with wIndex 0: keep only the bits of ``mask`` in one 32-bit cell."""
    return Request(
        Direction.DOWNLOAD,
        RequestCode.SETBIT,
        value=offset,
        length=4,
        payload=struct.pack("<I", mask),
    )


def get_address() -> Request:
    """IPADDRESS (get): the controller's IPv4 address."""
    return Request(Direction.UPLOAD, RequestCode.IPADDRESS, length=4)


def write_buffer(lines: Sequence[bytes]) -> Request:
    """WRITEBUFFER: several lines in one request, each ended by a null byte."""
    if max(map(len, lines), default=0) > MAX_COMMAND:
        lines = [_command(line) for line in lines]  # raises for the line that is too long
    payload = b"".join([line + b"\x00" for line in lines])
    if not 0 < len(payload) <= MAX_WRITE_BUFFER:
        raise LocalProtocolError(
            f"WRITEBUFFER takes 1 to {MAX_WRITE_BUFFER} bytes, not {len(payload)}"
        )
    return Request(
        Direction.DOWNLOAD, RequestCode.WRITEBUFFER, length=len(payload), payload=payload
    )


def _command(text: bytes) -> bytes:
    if len(text) > MAX_COMMAND:
        raise LocalProtocolError(
            f"a command line holds at most {MAX_COMMAND} characters, not {len(text)}",
            hint="Split it into several lines.",
        )
    return text


def _control(character: int) -> int:
    if not 0 < character < 0x20:
        raise LocalProtocolError(f"{character:#04x} is no control character")
    return character
