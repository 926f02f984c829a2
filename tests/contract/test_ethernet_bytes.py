"""Bytes of the packet port, typed in from the manual's protocol chapter (pp. 36-37)."""

import struct

import pytest

from pmac_comp.base.errors import LocalProtocolError, RemoteProtocolError
from pmac_comp.machine.wire import ethernet, ethernet_requests
from pmac_comp.machine.wire.ethernet import (
    BufferVerdict,
    Malformed,
    Request,
    RequestReader,
    encode,
    read_datagram,
)

# What a host puts on the wire, byte by byte.
GOLDEN = [
    (ethernet_requests.send_line(b"J+"), "40 B0 0000 0000 0002 4A2B"),
    (ethernet_requests.get_response(b"ver"), "40 BF 0000 0000 0003 766572"),
    (ethernet_requests.get_line(), "C0 B1 0000 0000 0000"),
    (ethernet_requests.flush(), "40 B3 0000 0000 0000"),
    (ethernet_requests.get_memory(0x400, 64), "C0 B4 0400 0000 0040"),
    (ethernet_requests.set_memory(0x0E9C, b"\x01\x00"), "C0 B5 0E9C 0000 0002 0100"),
    (ethernet_requests.send_control(0x0B), "40 B6 000B 0000 0000"),
    (ethernet_requests.or_bits(0x0E9C, 1), "40 BA 0E9C 0001 0004 01000000"),
    (ethernet_requests.and_bits(0x0F40, 0xFFFF0000), "40 BA 0F40 0000 0004 0000FFFF"),
    (ethernet_requests.set_bits(0x68, 1, 0x8000), "40 BB 0068 0000 0008 01000000 00800000"),
    (ethernet_requests.read_ready(), "C0 C2 0000 0000 0002"),
    (ethernet_requests.control_response(0x10), "C0 C4 0010 0000 0578"),
    (ethernet_requests.get_buffer(), "C0 C5 0000 0000 0578"),
    (
        ethernet_requests.write_buffer([b"OPEN PLC 1 CLEAR", b"P1=P1+1", b"CLOSE"]),
        "40 C6 0000 0000 001F 4F50454E20504C43203120434C45415200 50313D50312B3100 434C4F534500",
    ),
    (ethernet_requests.get_address(), "C0 E0 0000 0000 0004"),
]


@pytest.mark.parametrize(("request_", "text"), GOLDEN, ids=[r.name for r, _ in GOLDEN])
def test_client_role_puts_the_manual_s_bytes(request_, text):
    assert encode(request_) == bytes.fromhex(text)


@pytest.mark.parametrize(("request_", "text"), GOLDEN, ids=[r.name for r, _ in GOLDEN])
def test_server_role_reads_them_back(request_, text):
    assert RequestReader().receive(bytes.fromhex(text)) == [request_]


def test_length_without_payload_is_never_taken_from_the_stream():
    # GETMEM and GETBUFFER name what they want; one client leaves rubbish in GETLINE's length.
    stream = bytes.fromhex(
        "C0B4 0400 0000 0008  C0C5 0000 0000 0800  C0B1 0000 0000 FFFF 40B3000000000000"
    )
    names = [event.name for event in RequestReader().receive(stream)]
    assert names == ["GETMEM", "GETBUFFER", "GETLINE", "FLUSH"]


def test_address_carries_a_payload_only_when_it_is_set():
    stream = bytes.fromhex("C0E0000000000004 40E0000000000004C0065E05 C0C2000000000002")
    events = RequestReader().receive(stream)
    assert [event.payload.hex() for event in events] == ["", "c0065e05", ""]


def test_text_endings_that_clients_add_are_dropped():
    for ending in (b"\n", b"\r\n", b"\x00", b"\r"):
        request = ethernet_requests.get_response(b"cid" + ending)
        assert request.text == b"cid"


def test_endings_behind_the_length_do_not_shift_the_stream():
    first = encode(ethernet_requests.get_response(b"cid"))
    events = RequestReader().receive(first + b"\r\n\x00" + encode(ethernet_requests.flush()))
    assert [event.name for event in events] == ["GETRESPONSE", "FLUSH"]


@pytest.mark.parametrize("word", ["0002", "0200"])
def test_control_character_in_either_byte(word):
    (event,) = RequestReader().receive(bytes.fromhex(f"C0C4 {word} 0000 0578"))
    assert event.control_character == 2


@pytest.mark.parametrize(
    "text",
    [
        "41BF000000000000",  # no such request type
        "40FF000000000000",  # no such request
        "40C7000000000000",  # WRITEERROR: only its name is known
        "C0E4000000000000",  # VERSION: likewise
        "40BA000000000005",  # SETBIT carries 4 bytes
        "40BB000000000004",  # SETBITS carries 8
        "40BFF00000000000"[:8] + "0000FFFF",  # longer than the packet's data field
        "C0B5000000000579",  # SETMEM above 1400 bytes
    ],
)
def test_server_role_refuses_what_is_no_request(text):
    reader = RequestReader()
    (event,) = reader.receive(bytes.fromhex(text))
    assert isinstance(event, Malformed)
    assert reader.broken
    assert reader.receive(bytes.fromhex("40B3000000000000")) == []


def test_a_wrong_first_byte_is_known_at_once():
    assert RequestReader().receive(b"GET / HTTP/1.1\r\n")[0].reason.startswith("request type 47")


@pytest.mark.parametrize(
    ("text", "verdict"),
    [
        ("00000000", BufferVerdict()),
        ("02000380", BufferVerdict(3, 2)),
        ("0A010680", BufferVerdict(6, 0x10A)),
    ],
)
def test_write_buffer_verdict(text, verdict):
    assert BufferVerdict.decode(bytes.fromhex(text)) == verdict
    assert verdict.encode() == bytes.fromhex(text)


def test_a_set_flag_is_an_error_whatever_the_number():
    assert BufferVerdict.decode(bytes.fromhex("000000FF")).refused
    with pytest.raises(RemoteProtocolError):
        BufferVerdict.decode(b"\0\0\0")


def test_reply_sizes():
    sizes = {r.name: ethernet.reply_size(r) for r, _ in GOLDEN}
    assert sizes == {
        "SENDLINE": 1, "GETRESPONSE": None, "GETLINE": None, "FLUSH": 1, "GETMEM": 64, "SETMEM": 1,
        "SENDCTRLCHAR": 1, "SETBIT": 1, "SETBITS": 1, "READREADY": 2, "CTRL_RESPONSE": None,
        "GETBUFFER": None, "WRITEBUFFER": 4, "IPADDRESS": 4,
    }  # fmt: skip


@pytest.mark.parametrize(
    "make",
    [
        lambda: ethernet_requests.get_response(b"x" * 256),
        lambda: ethernet_requests.write_buffer([b"x" * 250] * 5),
        lambda: ethernet_requests.write_buffer([]),
        lambda: ethernet_requests.get_memory(0, 1401),
        lambda: ethernet_requests.get_memory(0, 0),
        lambda: ethernet_requests.set_memory(0, bytes(1401)),
        lambda: ethernet_requests.send_control(0x20),
        lambda: encode(Request(0x40, 0xBF, value=70000)),
    ],
)
def test_client_role_refuses_what_cannot_be_said(make):
    with pytest.raises(LocalProtocolError):
        make()


def test_the_smallest_and_largest_that_can_be_said():
    assert encode(ethernet_requests.get_memory(0, 1))[-2:] == b"\x00\x01"
    assert encode(ethernet_requests.get_memory(0xFFFF, 1400))[2:4] == b"\xff\xff"
    assert len(encode(ethernet_requests.set_memory(0, b"x"))) == 9
    assert len(encode(ethernet_requests.set_memory(0, bytes(1400)))) == 1408
    assert len(encode(ethernet_requests.get_response(b"x" * 255))) == 263
    assert len(encode(ethernet_requests.write_buffer([b"x" * 255] * 4))) == 1032
    assert encode(ethernet_requests.send_control(1))[2:4] == b"\x00\x01"
    assert encode(ethernet_requests.send_control(0x1F))[2:4] == b"\x00\x1f"
    assert ethernet_requests.command_packet(b"ver") == encode(
        ethernet_requests.get_response(b"ver")
    )


def test_server_role_takes_the_largest_and_refuses_one_more():
    for code, limit in ((0xBF, 1492), (0xC6, 1492), (0xB5, 1400)):
        header = struct.pack(">BBHHH", 0x40, code, 0, 0, limit)
        (event,) = RequestReader().receive(header + bytes(limit))
        assert isinstance(event, Request)
        header = struct.pack(">BBHHH", 0x40, code, 0, 0, limit + 1)
        assert isinstance(RequestReader().receive(header)[0], Malformed)


# The maker's header lists these requests without saying what they carry.
NAMED_ONLY = "B7 B8 B9 BC BD C0 C1 C3 C7 C8 C9 CA D0 E1 E2 E3 E4"
KNOWN = "B0 B1 B3 B4 B5 B6 BA BB BE BF C2 C4 C5 C6 CB E0"


def test_every_code_is_supported_named_or_unknown():
    assert bytes(sorted(ethernet.NAMED_ONLY)) == bytes.fromhex(NAMED_ONLY)
    assert bytes(sorted(ethernet.RequestCode)) == bytes.fromhex(KNOWN)
    others = set(range(256)) - set(bytes.fromhex(NAMED_ONLY + KNOWN))
    for code in others:
        (event,) = RequestReader().receive(bytes([0x40, code]))
        assert isinstance(event, Malformed)
        assert event.reason.endswith("is unknown")


@pytest.mark.parametrize("code", sorted(ethernet.NAMED_ONLY))
def test_requests_known_by_name_only_are_refused_by_name(code):
    (event,) = RequestReader().receive(bytes([0xC0, code]))
    assert isinstance(event, Malformed)
    assert ethernet.NAMED_ONLY[code] in event.reason


def test_replies_are_cut_at_exactly_1400():
    assert [len(part) for part in ethernet.cut_reply(bytes(3000))] == [1400, 1400, 200]
    assert ethernet.cut_reply(b"") == []
    assert [len(part) for part in ethernet.cut_reply(bytes(1400))] == [1400]


def test_a_datagram_is_one_request():
    whole = encode(ethernet_requests.get_response(b"ver"))
    assert read_datagram(whole) == ethernet_requests.get_response(b"ver")
    assert isinstance(read_datagram(whole[:-1]), Malformed)
    assert isinstance(read_datagram(whole + whole), Malformed)
    assert isinstance(read_datagram(b""), Malformed)


def test_lines_of_write_buffer():
    header = struct.pack(">BBHHH", 0x40, 0xC6, 0, 0, 9)
    (event,) = RequestReader().receive(header + b"P1=1\0P2=2")
    assert event.lines == (b"P1=1", b"P2=2")
