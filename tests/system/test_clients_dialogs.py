"""Byte dialogs of other people's clients that no package index carries, repeated on every port.

What each sends was read from its public source: the ESRF's motor controller (SENDLINE answered by
``@``, then GETBUFFER), MX (GETRESPONSE, a serial line with control-Z), the EPICS drivers (FLUSH
before each command, CR or LF in the text, control characters in either byte of wValue), LS-CAT's
pgpmac (SENDLINE, READREADY, GETBUFFER, binary memory), NSLS-II's dPMAC (WRITEBUFFER, IPADDRESS),
one-shot scripts and terminal programs. No code of theirs is used.
"""

import os
import re
import select
import socket
import struct
import time
from collections.abc import Callable, Iterator

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.serving.server import ServeOptions, running_server

pytestmark = pytest.mark.system

DOWNLOAD, UPLOAD = 0x40, 0xC0
SENDLINE, GETLINE, FLUSH, GETMEM, SETMEM, SENDCTRLCHAR = 0xB0, 0xB1, 0xB3, 0xB4, 0xB5, 0xB6
SETBIT, SETBITS, PORT, GETRESPONSE, READREADY = 0xBA, 0xBB, 0xBE, 0xBF, 0xC2
CTRL_RESPONSE, GETBUFFER, WRITEBUFFER, IPADDRESS = 0xC4, 0xC5, 0xC6, 0xE0
ACK, BEL = b"\x06", b"\x07"
Ask = Callable[[str], bytes]


class Packets:
    """Packet port, over TCP or UDP."""

    def __init__(self, url: str) -> None:
        kind, _, place = url.partition("://")
        host, port = place.split(":")
        kinds = {"tcp": socket.SOCK_STREAM, "udp": socket.SOCK_DGRAM}
        self.socket = socket.socket(socket.AF_INET, kinds[kind])
        self.socket.settimeout(5)
        self.socket.connect((host, int(port)))

    def request(
        self, kind: int, code: int, value: int = 0, index: int = 0, data: bytes = b"", want: int = 0
    ) -> bytes:
        """One request and the one piece that answers it."""
        header = struct.pack(">BBHHH", kind, code, value, index, len(data) or want)
        self.socket.sendall(header + data)
        return self.socket.recv(4096)

    def respond(self, text: str) -> bytes:
        """GETRESPONSE."""
        return self.request(DOWNLOAD, GETRESPONSE, data=text.encode())


class Line:
    """ASCII port or pseudo terminal."""

    def __init__(self, url: str) -> None:
        kind, _, place = url.partition("://")
        if kind == "serial":
            self.file = os.open(place, os.O_RDWR | os.O_NOCTTY)
        else:
            host, port = place.partition("?")[0].split(":")
            self.file = socket.create_connection((host, int(port))).detach()

    def send(self, data: bytes) -> None:
        """Put bytes on the line."""
        os.write(self.file, data)

    def until(self, *ends: bytes) -> bytes:
        """Characters up to one of these."""
        got = b""
        end_s = time.monotonic() + 5
        while time.monotonic() < end_s and got[-1:] not in ends:
            if select.select([self.file], [], [], 0.1)[0]:
                got += os.read(self.file, 1)
        return got

    def rest(self) -> bytes:
        """What still arrives until the line is silent."""
        got = b""
        while select.select([self.file], [], [], 0.15)[0]:
            got += os.read(self.file, 4096)
        return got


@pytest.fixture(scope="module")
def endpoints() -> Iterator[dict[str, str]]:
    card = Card(load_bench("paper"))
    options = ServeOptions(tcp=0, udp=0, ascii_port=0, pty=True, speed="5")
    with running_server(card, options) as found:
        yield found


@pytest.fixture(params=["tcp", "udp"])
def packets(endpoints: dict[str, str], request: pytest.FixtureRequest) -> Iterator[Packets]:
    link = Packets(endpoints[request.param])
    link.respond("I3=2 I4=0 I6=1 CLOSE")
    yield link
    link.socket.close()


@pytest.fixture(params=["ascii", "pty"])
def line(endpoints: dict[str, str], request: pytest.FixtureRequest) -> Iterator[Line]:
    link = Line(endpoints[request.param])
    link.send(b"I3=2 I4=0 I6=1 I63=1\r")
    link.rest()
    yield link
    os.close(link.file)


def esrf(link: Packets) -> Ask:
    """Every line is flushed, sent, acknowledged by ``@`` and its answer fetched."""

    def ask(text: str) -> bytes:
        assert link.request(DOWNLOAD, FLUSH, 500) == b"@"
        assert link.request(DOWNLOAD, SENDLINE, data=text.encode()) == b"@"
        got = b""
        while not got.endswith(ACK) and not (BEL in got and got.endswith(b"\r")):
            part = link.request(UPLOAD, GETBUFFER, want=1400)
            assert part != b"\0", text
            got += part
        return got

    return ask


def test_esrf_controller_sets_up_moves_and_reads(packets: Packets) -> None:
    ask = esrf(packets)
    assert ask("VERSION") == b"1.947  \r\x06"
    assert ask("TYPE") == b"TURBO2, X4\r\x06"
    assert re.fullmatch(rb"\d\d/\d\d/\d{4}\r\x06", ask("DATE"))
    for text in ("I119=1000.0", "I121=0", "I120=50", "M161->D:$000088", "M162->D:$00008B"):
        assert ask(text) == ACK
    assert ask("#1J/") == ACK
    assert ask("#1J=0.0") == ACK
    _until_in_position(ask)
    assert ask("#1J:500.0") == ACK
    _until_in_position(ask)
    status, scale, commanded, _actual = ask("#1?I108M161M162").split(b"\r")[:4]
    assert int(status, 16) & 1
    assert float(commanded) / 32 / float(scale) == pytest.approx(500)
    assert ask("NOSUCHWORD") == b"\x07ERR003\r"
    assert ask("I120") == b"50\r\x06"
    assert len(ask("I0..1500").split(b"\r")) == 1502  # several packets of 1400 characters


def _until_in_position(ask: Ask) -> None:
    for _ in range(400):
        if int(ask("#1?")[:12], 16) & (1 | 1 << 41) == 1:
            return
        time.sleep(0.01)
    raise TimeoutError


def test_mx_reads_and_renames_a_position(packets: Packets) -> None:
    assert packets.request(DOWNLOAD, FLUSH) == b"@"
    assert packets.respond("TYPE").split(b",")[0] == b"TURBO2"
    assert packets.respond("I6") == b"1\r\x06"
    # A command nobody waits for is sent by SENDLINE; its answer must not reach the next one.
    assert len(packets.request(DOWNLOAD, SENDLINE, data=b"I0122=15.000000")) == 1
    assert packets.respond("I0122") == b"15\r\x06"
    packets.request(DOWNLOAD, SENDLINE, data=b"#1HOMEZ M164=250*32*I108")
    assert float(packets.respond("#1P")[:-2]) == pytest.approx(250, abs=2)
    packets.request(DOWNLOAD, SENDLINE, data=b"M164=0")
    assert packets.respond("#1P").endswith(b"\r\x06")


@pytest.mark.parametrize("end", ["\r", "\n", "\0", ""])
def test_epics_driver_polls_whatever_ends_its_text(packets: Packets, end: str) -> None:
    def ask(text: str) -> bytes:
        packets.request(DOWNLOAD, FLUSH)
        return packets.respond(text + end)

    assert ask("") == ACK
    assert ask("#1 ? F P").count(b"\r") == 3
    assert len(ask("&1??")) == 20
    assert ask("&1Q81Q82Q83Q84Q85Q86Q87Q88Q89").count(b"\r") == 9
    assert ask("&1I5189=1.5 I5187=250.000000 Q71=0.123456789012") == ACK
    assert ask("&1Q71") == b"0.123456789\r\x06"
    assert ask("&1A Q71=Q81") == ACK
    assert ask("I113 I114 I130 I131 I133").count(b"\r") == 5
    assert packets.request(UPLOAD, READREADY, want=2) == b"\0\0"
    assert ask("\x0b") == ACK


@pytest.mark.parametrize(
    ("code", "fields"), [(2, 8), (3, 16), (6, 8), (7, 1), (0x10, 8), (0x16, 8)]
)
def test_control_characters_answer_through_each_request(
    packets: Packets, code: int, fields: int
) -> None:
    for value in (code, code << 8):  # one driver forgets to swap the bytes
        got = packets.request(UPLOAD, CTRL_RESPONSE, value, want=1400)
        assert len(got.split()) == fields
        assert got.endswith(b"\r")
    assert len(packets.request(DOWNLOAD, SENDCTRLCHAR, code)) == 1
    assert packets.request(UPLOAD, READREADY, want=2)[0]
    assert len(packets.request(UPLOAD, GETBUFFER, want=1400).split()) == fields


def test_pgpmac_shares_memory_and_waits_for_readiness(packets: Packets) -> None:
    def ask(text: str) -> bytes:
        assert packets.request(DOWNLOAD, SENDLINE, data=text.encode()) not in (ACK, BEL)
        while not packets.request(UPLOAD, READREADY, want=2)[0]:
            time.sleep(0.01)
        return packets.request(UPLOAD, GETBUFFER, want=1400)

    assert len(packets.request(UPLOAD, SETMEM, 0xE9C, data=bytes(424))) == 1
    assert ask("I5=0") == ACK
    assert ask("NOSUCHWORD").startswith(BEL)
    ask("M4500->DP:$60101 M4500=-123456 M4501->DP:$60102")
    block = packets.request(UPLOAD, GETMEM, 0x400, want=0x118)
    assert len(block) == 0x118
    assert struct.unpack_from("<i", block, 4) == (-123456,)
    packets.request(UPLOAD, SETMEM, 0x408, data=struct.pack("<i", 777))
    assert ask("M4501") == b"777\r\x06"
    packets.request(UPLOAD, SETBIT, 0x408, 1, data=struct.pack("<I", 0x1000))
    assert ask("M4501") == b"4873\r\x06"
    packets.request(UPLOAD, SETBIT, 0x408, 0, data=struct.pack("<I", 0xFFFFEFFF))
    packets.request(DOWNLOAD, SETBITS, 0x408, data=struct.pack("<II", 2, 8))
    assert ask("M4501") == b"771\r\x06"


def test_pgpmac_speaks_through_the_dual_ported_ram(packets: Packets) -> None:
    def ask(text: str) -> list[tuple[int, bytes]]:
        for cell in (0xF40, 0xE9C):
            packets.request(UPLOAD, SETMEM, cell, data=bytes(4))
        packets.request(UPLOAD, SETMEM, 0xEA0, data=text.encode() + b"\0")
        packets.request(UPLOAD, SETBIT, 0xE9C, 1, data=struct.pack("<I", 1))
        found: list[tuple[int, bytes]] = []
        until = time.monotonic() + 5
        while not found or found[-1][0] & 0xFF == 0x0D:
            assert time.monotonic() < until
            block = packets.request(UPLOAD, GETMEM, 0xE9C, want=424)
            (word,) = struct.unpack_from("<H", block, 0xA4)
            if word:
                found.append((word, block[0xA8:].partition(b"\0")[0]))
                packets.request(UPLOAD, SETMEM, 0xF40, data=bytes(4))
        return found

    assert ask("P20=3 P21=4") == [(0x06, b"")]
    assert ask("P20,2") == [(0x0D, b"3"), (0x06, b"4")]
    assert ask("#1J/") == [(0x06, b"")]
    assert ask("NOSUCHWORD") == [(0x8003, b"")]


def test_dpmac_downloads_lines_and_asks_the_interface(packets: Packets) -> None:
    def download(*lines: bytes) -> bytes:
        return packets.request(DOWNLOAD, WRITEBUFFER, data=b"".join(x + b"\0" for x in lines))

    good = download(b"OPEN PLC 9 CLEAR", b"P1=1", b"IF(P1=1)", b"P2=2", b"ENDIF", b"CLOSE")
    assert good == bytes(4)
    bad = download(b"OPEN PLC 9 CLEAR", b"P1=1", b"NO SUCH WORD", b"CLOSE")
    assert (bad[2], bad[3]) == (3, 0x80)
    assert packets.respond("CLOSE ALL") == ACK
    assert packets.request(UPLOAD, IPADDRESS) == bytes((192, 6, 94, 5))
    assert len(packets.request(UPLOAD, PORT, 2)) == 1
    assert len(packets.request(DOWNLOAD, PORT, 2, 0x55)) == 1
    # Lengths that mean "bytes wanted" may be rubbish; no payload follows them.
    for code in (GETLINE, GETBUFFER):
        assert packets.request(UPLOAD, code, want=0xCDCD) == b"\0"


def test_scripts_send_definitions_and_single_questions(packets: Packets) -> None:
    many = r"M132->X:$078200,18,1 M140->Y:$0000C0,0,1 M231->X:$078208,17,1 M245->Y:$000140,10,1"
    assert packets.respond(many) == ACK
    assert packets.respond(many + " #2p #3p #4p").count(b"\r") == 3
    assert packets.respond("M140").strip(b"\r\x06") in (b"0", b"1")
    assert packets.respond(" P1021=0.0 P1022=0.0 P1023=0.0") == ACK
    assert packets.respond("enable plc 7") == ACK
    assert packets.respond("M132->X:$78000,17 M231->X:$78008,17 M245->Y:$140,10") == ACK


def test_a_stream_may_come_in_any_pieces(endpoints: dict[str, str]) -> None:
    link = Packets(endpoints["tcp"])

    def packet(text: bytes) -> bytes:
        return struct.pack(">BBHHH", DOWNLOAD, GETRESPONSE, 0, 0, len(text)) + text

    for byte in packet(b"P1=7 P1"):
        link.socket.sendall(bytes([byte]))
    assert link.socket.recv(100) == b"7\r\x06"
    link.socket.sendall(packet(b"P1") + packet(b"P1=8") + packet(b"P1"))
    got = b""
    while got.count(ACK) < 3:
        got += link.socket.recv(100)
    assert got == b"7\r\x06\x068\r\x06"
    link.socket.close()


def test_every_client_keeps_its_address_and_its_buffer(endpoints: dict[str, str]) -> None:
    links = [Packets(endpoints["tcp"]) for _ in range(16)]
    for number, link in enumerate(links, start=1):
        link.respond(f"#{number}&{number}")
    assert [link.respond("#&") for link in links] == [
        b"%d\r%d\r\x06" % (k, k) for k in range(1, 17)
    ]
    first, second = links[:2]
    first.respond("OPEN PLC 8 CLEAR")
    assert second.respond("OPEN PLC 7") == b"\x07ERR007\r"
    assert second.respond("CLOSE") == ACK
    assert second.respond("CLEAR") == b"\x07ERR007\r"
    first.socket.close()  # who vanishes leaves no buffer open
    time.sleep(0.2)
    assert second.respond("OPEN PLC 7 CLEAR CLOSE") == ACK
    for link in links[1:]:
        link.socket.close()


@pytest.mark.parametrize(
    ("i3", "answer"), [(0, b"5\r"), (1, b"\n5\r\n"), (2, b"5\r\x06"), (3, b"\n5\r\x06")]
)
def test_terminal_sees_the_chosen_handshake(line: Line, i3: int, answer: bytes) -> None:
    line.send(f"P77=5 I3={i3}\r".encode())
    line.rest()
    line.send(b"P77\r\n")
    assert line.rest() == answer
    line.send(b"\t")  # the last line again
    assert line.rest() == answer


@pytest.mark.parametrize(
    ("i6", "answer"),
    [(0, b"\x07"), (1, b"\x07ERR003\r"), (2, b"\x07"), (3, b"\x07\rERR003\r")],
)
def test_terminal_sees_the_chosen_errors(line: Line, i6: int, answer: bytes) -> None:
    line.send(f"I6={i6}\r".encode())
    line.rest()
    line.send(b"NOSUCHWORD\r")
    assert line.rest() == answer


def test_serial_drivers_use_control_characters_anywhere(line: Line) -> None:
    line.send(b"\x1a#1?\r")  # MX makes the port the active one before each command
    assert len(line.until(ACK)) == 14
    line.send(b"P77=5\x086 P77\r")
    assert line.rest() == b"6\r\x06"
    line.send(b"P77=99\x18")
    assert line.rest() == b"\x18"
    line.send(b"P77\r")
    assert line.rest() == b"6\r\x06"
    line.send(b"P77P77\x0e")
    assert line.rest() == bytes([sum(b"P77P77") & 0xFF])
    line.send(b"\x18\x02")
    answer = line.rest()
    assert answer.startswith(b"\x18")
    assert len(answer[1:].split()) == 8
    assert ACK not in answer
    line.send(b"P\xc1\r")
    assert line.rest() == b"\x07ERR004\r"


def test_checksums_follow_every_carriage_return(line: Line) -> None:
    line.send(b"P77=5 I4=1\r")
    line.rest()
    line.send(b"P77\r")
    sums = bytes([sum(b"5\r") & 0xFF]), bytes([sum(b"P77") & 0xFF])
    assert line.rest() == b"5\r" + sums[0] + ACK + sums[1]
    line.send(b"I4=0\r")
    line.rest()
