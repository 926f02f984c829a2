"""F44: a controller that sends too much, or text that is meant for a terminal or a page."""

import pytest

from pmac_comp.base.clock import VirtualClock
from pmac_comp.base.errors import CommandRefused, ConnectFailed, LinkError, PmacCompError
from pmac_comp.base.errors import RemoteProtocolError as Remote
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.transport.base import Framing
from pmac_comp.machine.transport.pair import PairTransport
from tests.contract.scripted_card import LinePort, PacketPort, ScriptedCard

pytestmark = pytest.mark.faults
PORTS = {Framing.PACKETS: PacketPort, Framing.LINES: LinePort}
CANARY = "\x1b]0;canary\x07\x1b[31m[red]<script>alert(1)</script>"


class Hostile:
    """A healthy port until it is told what to answer everything with."""

    def __init__(self, framing: Framing, card: ScriptedCard) -> None:
        self._port = PORTS[framing](card)
        self.answer: bytes | None = None

    def __call__(self, data: bytes) -> bytes:
        return self._port(data) if self.answer is None else self.answer


def bench(framing: Framing, max_answer: int = 100_000) -> tuple[Commander, Hostile]:
    clock = VirtualClock()
    peer = Hostile(framing, ScriptedCard())
    transport = PairTransport(peer, clock, framing=framing)
    return Commander(transport, clock=clock, max_answer=max_answer), peer


@pytest.mark.parametrize("framing", PORTS)
def test_f44_an_endless_answer_ends_at_the_cap(framing):
    commander, peer = bench(framing)
    peer.answer = b"9" * 3000  # every waiting call gives 3000 more
    with pytest.raises((Remote, LinkError)) as caught:
        commander.query("P1")
    assert "exceeds" in str(caught.value) or isinstance(caught.value, LinkError)
    assert commander.statistics.bytes_received < 100_000 * 8


@pytest.mark.parametrize("framing", PORTS)
def test_f44_a_listing_of_a_hundred_megabytes_is_not_swallowed(framing):
    commander, peer = bench(framing)
    peer.answer = (b"$12345,0\r" * 200_000) + b"\x06"
    with pytest.raises((Remote, LinkError)):
        commander.query("LIST GATHER")


@pytest.mark.parametrize("framing", PORTS)
@pytest.mark.parametrize("where", ["value", "error", "unsolicited"])
def test_f44_terminal_codes_reach_no_terminal(framing, where):
    commander, peer = bench(framing)
    text = CANARY.encode()
    peer.answer = {
        "value": text.replace(b"\x07", b"") + b"\r\x06",
        "error": b"\x07" + text.replace(b"\x07", b"") + b"\r",
        "unsolicited": b"\x02" + text.replace(b"\x07", b"") + b"\r1\r\x06",
    }[where]
    with pytest.raises(PmacCompError) as caught:
        commander.command("P1")
    assert "\x1b" not in str(caught.value)
    assert all(line.isprintable() for line in commander.take_unsolicited())


@pytest.mark.parametrize("framing", PORTS)
def test_f44_a_refusal_with_an_unreadable_number_is_still_a_refusal(framing):
    commander, peer = bench(framing)
    peer.answer = b"\x07ERRxyz\r"
    with pytest.raises((CommandRefused, Remote)):
        commander.command("P1=1")


@pytest.mark.parametrize("framing", PORTS)
@pytest.mark.parametrize(
    "answer",
    [b"\x07", b"\x06\x06\x06", b"\x00" * 50, b"\xff" * 50, b"\x02"],
    ids=["bell", "acknowledgements", "nulls", "high bytes", "start of text"],
)
def test_f44_no_answer_hangs(framing, answer):
    commander, peer = bench(framing)
    peer.answer = answer
    start_s = commander.clock.now_s()
    with pytest.raises(PmacCompError):
        commander.query("P1")
    assert commander.clock.now_s() - start_s <= 3.05


@pytest.mark.parametrize("framing", PORTS)
@pytest.mark.parametrize(
    "answer", [b"", b"\x06", b"2\r0\r1\r2\r3\r\x06", b"9\r9\r9\r9\r\x06", b"\x1b[2J"]
)
def test_f44_what_is_no_pmac_is_refused_at_the_start(framing, answer):
    clock = VirtualClock()
    with pytest.raises(ConnectFailed) as caught:
        Commander(PairTransport(lambda _: answer, clock, framing=framing), clock=clock)
    assert "\x1b" not in str(caught.value)
