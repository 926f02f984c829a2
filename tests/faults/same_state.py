"""Which bytes of a change a fault may meet with the same outcome, shown for each byte.

A change that ends at byte n and its recovery take 30 to 100 ms, and there are a hundred thousand
bytes. Here each of them is tried on what could tell it from its neighbours, and on nothing else. A
byte on its way to the card: the packet that ends there is handed to the card's session, and no code
beyond the session's own may run. A byte on its way to the host: the exchange under way is carried
out again, by a copy of the link, with the answer that ends there; what it sends and when, how it
ends, and what the link then is, is compared. Bytes that leave the same make a stretch; who runs the
ends of every stretch has run them all.
"""

import copy
import functools
import gc
import sys
from collections.abc import Callable, Sequence
from itertools import groupby
from types import CodeType, FrameType

from pmac_comp.base.clock import Deadline, VirtualClock
from pmac_comp.base.errors import PmacCompError
from pmac_comp.machine.client.packet_link import PacketLink
from pmac_comp.machine.transport.base import Framing
from pmac_comp.machine.transport.pair import PairTransport
from pmac_comp.machine.transport.tap import Fault, FaultKind, FaultyTransport, Way
from pmac_comp.machine.wire.ethernet import RequestReader
from pmac_comp.simulator.dialog.sessions import EthernetSession
from tests.faults.card_state import digest
from tests.unit.machine_controller.card_bench import CardBench

Act = Callable[[], object]
_EXCHANGES = ("exchange", "request", "control", "collect", "settle")
_OWN = {EthernetSession.receive.__code__, EthernetSession.answers.__code__}
_WIRE_FORMAT = RequestReader.receive.__code__.co_filename


Start = Callable[[], CardBench]


def stretches(start: Start, act: Act, way: Way, *, kind: FaultKind) -> list[range]:
    """Ranges of the bytes of ``act`` in which all leave the same.

    Parameters
    ----------
    start : callable
        Gives the bench as it is before ``act``, the same to the last bit each time, with a link
        that counts from zero.
    act : callable
        The change.
    way : Way
        Direction of the bytes.
    kind : FaultKind
        ``CUT`` or ``SILENCE`` from a byte on.
    """
    before = _traffic(start(), act)
    found = _sent(start(), act) if way is Way.SEND else _received(start(), act, kind)
    assert _traffic(start(), act) == before, "no two runs are the same"
    total = sum(len(pair[way is Way.RECEIVE]) for pair in before)
    assert [n for stretch in found for n in stretch] == list(range(total))
    return found


def stand_ins(found: Sequence[range]) -> list[tuple[int, bool]]:
    """First byte of each stretch, then resumed, and last byte, then not."""
    return [(n, resume) for r in found for n, resume in ((r[0], True), (r[-1], False))]


def _traffic(bench: CardBench, act: Act) -> list[tuple[bytes, bytes]]:
    """Every packet that is sent, with its answer."""
    said: list[tuple[bytes, bytes]] = []
    peer = bench.pair._peer

    def note(data: bytes) -> bytes:
        answer = peer(data)
        if data:
            said.append((data, answer))
        return answer

    bench.pair._peer = note
    act()
    return said


# To the card --------------------------------------------------------------------------------------


def _sent(bench: CardBench, act: Act) -> list[range]:
    found: list[range] = []

    def deliver(_number: int, data: bytes) -> bytes:
        begin = bench.tap.sent - len(data)
        found.append(range(begin, begin + 1))  # the packet is not sent at all
        if len(data) > 1:
            found.append(range(begin + 1, begin + len(data)))
            _require_idle(bench, data)
        return data

    bench.filter = deliver
    act()
    return found


def _require_idle(bench: CardBench, data: bytes) -> None:
    """No beginning of a packet does anything to the card."""
    session, whole = bench.session, bench.session._reader
    before = digest(bench.card)
    for end in range(1, len(data)):
        session._reader = copy.deepcopy(whole)
        answer, ran = traced(functools.partial(session.receive, data[:end]))
        strange = [code for code in ran if code not in _OWN and code.co_filename != _WIRE_FORMAT]
        assert not strange, (end, data, strange)
        assert answer == b"", (end, data)
    session._reader = whole
    assert digest(bench.card) == before, data


def traced(act: Callable[[], bytes]) -> tuple[bytes, list[CodeType]]:
    """Its result, and the Python code that ran."""
    ran: list[CodeType] = []

    def note(frame: FrameType, event: str, _argument: object) -> None:
        if event == "call":
            ran.append(frame.f_code)

    gc.disable()  # libraries have themselves called as it collects, whatever runs here
    sys.setprofile(note)
    try:
        return act(), ran
    finally:
        sys.setprofile(None)
        gc.enable()


# To the host --------------------------------------------------------------------------------------


def _received(bench: CardBench, act: Act, kind: FaultKind) -> list[range]:
    watch = _Exchanges(bench, kind)
    act()
    outcomes = watch.outcomes
    assert len(outcomes) == bench.tap.received, "bytes came outside of an exchange"
    groups = [list(group) for _, group in groupby(range(len(outcomes)), outcomes.__getitem__)]
    return [range(group[0], group[-1] + 1) for group in groups]


class _Exchanges:
    """Carries out every exchange of a link again for every byte at which its answer may end."""

    def __init__(self, bench: CardBench, kind: FaultKind) -> None:
        self.bench = bench
        self.kind = kind
        self.link: PacketLink = bench.link._link  # type: ignore[assignment]
        self.said: list[tuple[bytes, bytes]] = []
        self.outcomes: list[tuple[object, ...]] = []
        self.peer = bench.pair._peer
        bench.pair._peer = self._record
        for name in _EXCHANGES:
            if hasattr(self.link, name):
                setattr(self.link, name, functools.partial(self._exchange, name))

    def _record(self, data: bytes) -> bytes:
        answer = self.peer(data)
        assert data or not answer, "an answer came late"
        if data:
            self.said.append((data, answer))
        return answer

    def _exchange(self, name: str, *arguments: object, **options: object) -> object:
        before = copy.copy(self.link)
        before.statistics = copy.copy(self.link.statistics)
        before.unsolicited = list(self.link.unsolicited)
        before._meanwhile = None  # work while the answer comes: the same wherever it ends
        for other in _EXCHANGES:
            before.__dict__.pop(other, None)
        number, start_s = len(self.outcomes), self.bench.clock.now_s()
        assert number == self.bench.tap.received
        self.said = []
        result = getattr(type(self.link), name)(self.link, *arguments, **options)
        call = functools.partial(getattr(type(self.link), name), **options)
        for n in range(self.bench.tap.received - number):
            outcome = _Again(before, self.said, start_s, Fault(self.kind, Way.RECEIVE, n))
            self.outcomes.append((number, *outcome.of(call, arguments)))
        return result


class _Again:
    """One exchange again, on a copy of the link, with what was answered then and a fault."""

    def __init__(
        self, link: PacketLink, said: Sequence[tuple[bytes, bytes]], start_s: float, fault: Fault
    ) -> None:
        self.clock = VirtualClock(start_s)
        self.said = list(said)
        self.sent: list[tuple[bytes, float]] = []
        self.pair = PairTransport(self._answer, self.clock, framing=Framing.PACKETS)
        self.link = copy.copy(link)
        self.link.statistics = copy.copy(link.statistics)
        self.link.unsolicited = list(link.unsolicited)
        self.link.transport = FaultyTransport(self.pair, [fault])
        self.link._clock = self.clock

    def _answer(self, data: bytes) -> bytes:
        if not data:
            return b""
        self.sent.append((data, round(self.clock.now_s(), 6)))
        if self.said and self.said[0][0] == data:
            return self.said.pop(0)[1]
        return b""

    def of(self, call: Callable[..., object], arguments: Sequence[object]) -> tuple[object, ...]:
        """What was sent and when, how it ended, and what the link then is."""
        own = [Deadline(self.clock, a.at_s) if isinstance(a, Deadline) else a for a in arguments]
        end: object
        try:
            end = call(self.link, *own)
        except PmacCompError as error:
            end = (type(error), str(error), repr(vars(error)))
        self.link.statistics.bytes_received = 0  # counted for display
        apart = {"transport", "_clock"}
        state = {k: repr(v) for k, v in vars(self.link).items() if k not in apart}
        closed = self.pair._closed
        return tuple(self.sent), end, state, closed, round(self.clock.now_s(), 6)
