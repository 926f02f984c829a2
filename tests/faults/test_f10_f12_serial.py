"""F10 to F12: a noisy serial line, every flipped bit of a download, modes changed by others."""

import itertools
import os
import random
import threading
import tty

import pytest

from pmac_comp.base.clock import Deadline, VirtualClock
from pmac_comp.base.errors import ConnectFailed, LinkError, PmacCompError, ProtocolError
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.client.line_link import CHANGED_ON_THE_WAY
from pmac_comp.machine.client.modes import Modes
from pmac_comp.machine.transport.base import Framing
from pmac_comp.machine.transport.pair import PairTransport
from pmac_comp.machine.transport.tap import Fault, FaultKind, Way
from tests.contract.scripted_card import LinePort, ScriptedCard
from tests.fault_table import all_of
from tests.faults.link_bench import LinkBench

pytestmark = pytest.mark.faults


class NoisyTransport(PairTransport):
    """A pair that replaces bytes at random, in both directions."""

    def __init__(self, card: ScriptedCard, clock: VirtualClock, seed: int) -> None:
        super().__init__(LinePort(card), clock, framing=Framing.LINES)
        self._random = random.Random(seed)
        self.rate = 0.0
        self.hits = 0

    def _noisy(self, data: bytes) -> bytes:
        out = bytearray(data)
        for k in range(len(out)):
            if self._random.random() < self.rate:
                out[k] = self._random.randrange(256)
                self.hits += 1
        return bytes(out)

    def send(self, data: bytes, deadline: Deadline) -> None:
        super().send(self._noisy(data), deadline)

    def receive(self, deadline: Deadline) -> bytes:
        return self._noisy(super().receive(deadline))


def test_f10_noise_never_gives_a_wrong_value(exhaustive):
    card = ScriptedCard()
    card.variables.update({f"P{k}": str(7919 * k % 100003) for k in range(1000)})
    clock = VirtualClock()
    rng = random.Random(10)
    wrong = answered = sessions = hits = told = 0
    commander = None
    for _ in range(10_000 if exhaustive else 3_000):
        if commander is None:
            # A line so bad that the conversation had to be given up is opened again.
            sessions += 1
            line = NoisyTransport(card, clock, seed=sessions)
            commander = Commander(line, clock=clock, checksum=True)
            line.rate = 1e-3
        k = rng.randrange(1000)
        del card.executed[:]
        try:
            value = commander.query(f"P{k}")
        except LinkError:
            hits += line.hits
            commander = None
            continue
        except ProtocolError as error:
            # Noise may turn a question into an assignment: that is told, not asked again.
            told += error.code == CHANGED_ON_THE_WAY
            continue
        assert not any("=" in text for text in card.executed)
        answered += 1
        wrong += value != [card.variables[f"P{k}"]]
    assert wrong == 0
    assert answered > 0.97 * (10_000 if exhaustive else 3_000)
    assert hits + line.hits > 20
    assert told > 0


@pytest.mark.parametrize("checksum", [True, False])
def test_f11_every_flipped_bit_of_a_download_is_found(checksum, exhaustive):
    table = [(13 * k * k) % 997 - 400 for k in range(64)]
    lines = [f"P{100 + k}={value}" for k, value in enumerate(table)]
    total = sum(len(line) + 1 for line in lines)
    flagged = found = harmless = 0
    every = range(total * 8)
    for place in all_of(every) if exhaustive else every[::17]:
        bench = LinkBench(Framing.LINES, checksum=checksum)
        bench.commander.timeout_s = 0.5
        at, bit = divmod(place, 8)
        bench.break_link([Fault(FaultKind.FLIP, Way.SEND, at=at, argument=1 << bit)])
        try:
            bench.commander.write_buffer(lines)
        except PmacCompError:
            flagged += 1
            continue
        try:
            read = bench.commander.query_many(f"P{100 + k}" for k in range(64))
        except PmacCompError:
            flagged += 1
            continue
        same = read == [str(value) for value in table]
        card_same = [bench.card.variables.get(f"P{100 + k}") for k in range(64)] == [
            str(value) for value in table
        ]
        assert same == card_same  # what was read back is what the card holds
        found += not same
        harmless += same
    # With sums a flip is flagged at once, unless the card took it for a control character and
    # left it out of both sum and line, or for the same letter in another case.
    assert flagged > 0
    if checksum:
        assert found == 0
    else:
        assert found > 0
    assert harmless < 0.3 * (flagged + found)


def test_f11_errors_that_keep_the_sum_are_found_by_reading_back():
    rng = random.Random(11)
    for _ in range(300):
        bench = LinkBench(Framing.LINES, checksum=True)
        value = "".join(rng.choice("123456789") for _ in range(6))
        first, second = rng.sample(range(6), 2)
        swapped = list(value)
        swapped[first], swapped[second] = swapped[second], swapped[first]
        masks = [ord(a) ^ ord(b) for a, b in zip(value, swapped, strict=True)]
        bench.break_link(
            [
                Fault(FaultKind.FLIP, Way.SEND, at=len("P100=") + k, argument=mask)
                for k, mask in enumerate(masks)
                if mask
            ]
        )
        bench.commander.command(f"P100={value}")
        assert (bench.commander.query("P100") == [value]) == (swapped == list(value))


MODES = list(itertools.product(range(4), repeat=3))


@pytest.mark.parametrize("framing", [Framing.PACKETS, Framing.LINES])
@pytest.mark.parametrize("i9", [0, 1, 2, 3])
def test_f12_every_mode_is_found_set_and_put_back(framing, i9):
    for i3, i4, i6 in MODES:
        card = ScriptedCard(I3=i3, I4=i4, I6=i6, I9=i9)
        bench = LinkBench(framing, card=card, checksum=bool(i3 & 1))
        assert bench.commander.found_modes == Modes(i3, i4, i6, i9)
        assert bench.commander.query("ver") == ["1.947  "]
        with pytest.raises(PmacCompError, match="ERR003"):
            bench.commander.command("NONSENSE")
        bench.commander.close()
        assert tuple(card.mode(name) for name in ("I3", "I4", "I6", "I9")) == (i3, i4, i6, i9)


@pytest.mark.parametrize("framing", [Framing.PACKETS, Framing.LINES])
def test_f12_a_mode_changed_by_another_client_is_noticed(framing):
    for i3, i4, i6 in MODES:
        bench = LinkBench(framing, card=ScriptedCard(P1=5))
        bench.card.variables.update({"I3": str(i3), "I4": str(i4), "I6": str(i6)})
        try:
            value = bench.commander.query("P1")
        except PmacCompError:
            continue
        # I3=3 and other I6 do not change what a value looks like
        assert value == ["5"]
        assert i3 in {2, 3}
        assert i4 in {0, 2}


def test_f12_modes_that_do_not_stay_set_are_refused():
    card = ScriptedCard(I3=1)

    class Stubborn(LinePort):
        def __call__(self, data: bytes) -> bytes:
            out = super().__call__(data)
            self.card.variables["I3"] = "1"
            return out

    clock = VirtualClock()
    with pytest.raises(ConnectFailed, match="could not be set"):
        Commander(PairTransport(Stubborn(card), clock, framing=Framing.LINES), clock=clock)


def serve_pty(card: ScriptedCard) -> tuple[str, list[int], threading.Thread]:
    master, slave = os.openpty()
    tty.setraw(slave)
    port = LinePort(card)

    def run() -> None:
        try:
            while data := os.read(master, 4096):
                os.write(master, port(data))
        except OSError:
            return

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    # The slave stays open too: its last close would end the master.
    return os.ttyname(slave), [slave, master], thread


def test_serial_line_on_a_pty():
    card = ScriptedCard(I3=0, I4=0, I6=0)
    name, ends, thread = serve_pty(card)
    with Commander.open(f"serial://{name}?baud=38400") as commander:
        assert card.mode("I4") == 1  # sums are on where noise is real
        assert commander.query("ver") == ["1.947  "]
        commander.write_buffer([f"P{k}={k * k}" for k in range(50)])
        assert commander.query_many([f"P{k}" for k in range(50)]) == [str(k * k) for k in range(50)]
        with pytest.raises(ConnectFailed):
            Commander.open(f"serial://{name}")  # the device is ours alone
    assert (card.mode("I3"), card.mode("I4"), card.mode("I6")) == (0, 0, 0)
    for end in ends:
        os.close(end)
    thread.join(2.0)


def test_garbled_writes_are_reported_not_repeated():
    bench = LinkBench(Framing.LINES, checksum=True)
    bench.break_link([Fault(FaultKind.FLIP, Way.SEND, at=3, argument=1)])
    with pytest.raises(ProtocolError, match="carried it out"):
        bench.commander.command("P1=4")
    assert sum(text.startswith("P1") for text in bench.card.executed) == 1
