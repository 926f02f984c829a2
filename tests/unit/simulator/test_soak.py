"""Hours of simulated time: counters roll over, samples stay in step, nothing drifts."""

import struct

import numpy as np
import pytest

from pmac_comp.files.bench import Bench
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.memory.memory import read_long

SETUP = """
I5=2 I124=$20001 I113=0 I114=0 I116=300 I117=1 I68=0
#1 DEFINE COMP 4,#1D,#1,40000
16 -16 32 0
I51=1
I8006=$680035 I8007=$010020 I8008=$EC0007
I500=1 I503=$3509 I504=$3509 I505=$35C0 I524=$20001 I511=0
I5000=3 I5001=$400000 I5002=$80008B I5003=$80010B I5050=7 I5049=1
DEFINE GATHER
&1#1->1000X
OPEN PROG 7 CLEAR
LINEAR ABS TA150 TS50 F280
WHILE(1<2)
X280
P5=P5+1
X-280
ENDWHILE
CLOSE
#1J/
""".strip().splitlines()
RING_CELL_BYTES = 4
CELLS = 5  # one 24-bit and two 48-bit sources
PERIOD_s = 441.995e-6


def samples(card: Card, first: int, end: int, size: int) -> np.ndarray:
    """Samples between two storage pointers of the ring, as a host unpacks them."""
    cells = (end - first) % size
    raw = card.memory.read_bytes(0x1140, size * RING_CELL_BYTES)
    ring = np.frombuffer(raw, "<i4")
    return ring[(first + np.arange(cells)) % size].reshape(-1, CELLS)


@pytest.mark.parametrize(
    "minutes", [2, pytest.param(60, marks=pytest.mark.slow)], ids=["two minutes", "an hour"]
)
def test_nothing_drifts_and_nothing_is_lost(bench: Bench, minutes: int) -> None:
    card = Card(bench)
    port = card.port()
    for line in SETUP:
        assert b"ERR" not in port.line(line), line
    card.run_cycles(2000)
    total = round(minutes * 60.0 / bench.servo_period_s)
    # The servo counter goes through its 24 bits on the way.
    start = (1 << 24) - total // 3
    card.memory.x[0] = start
    card.memory.y[0] = start + 1
    port.line("I5111=8388607 I5112=0")
    port.line("GATHER")
    port.line("&1B7R")
    # An endless axis: its motor integrates a constant word of 777 counts a cycle.
    card.memory.x[0x35] = 777 << 8
    card.run_cycles(1)
    begin = int(read_long(card.memory.x, card.memory.y, 0x280 + 0x0B))
    clock = int(read_long(card.memory.x, card.memory.y, 0x17))
    size = struct.unpack("<H", card.memory.read_bytes(0x113C, 2))[0]
    pointer = struct.unpack("<H", card.memory.read_bytes(0x113E, 2))[0]
    expected, done, turns = None, 1, 0
    while done < total:
        # A third of the ring at a time, now and then looked at closely.
        cycles = min(size // CELLS // 3, total - done)
        card.run_cycles(cycles)
        done += cycles
        now = struct.unpack("<H", card.memory.read_bytes(0x113E, 2))[0]
        found = samples(card, pointer, now, size)
        pointer = now
        assert found.shape[0] == cycles
        counter = found[:, 0] & 0xFFFFFF
        if expected is not None:
            assert counter[0] == expected
        assert np.array_equal(np.diff(counter) % (1 << 24), np.ones(cycles - 1))
        expected = (int(counter[-1]) + 1) % (1 << 24)
        turns += 1
    assert turns > 100
    assert int(card.memory.x[0]) == (start + total) % (1 << 24) < start
    # The endless axis has passed its 24-bit word over and over and lost nothing.
    endless = int(read_long(card.memory.x, card.memory.y, 0x280 + 0x0B)) - begin
    assert endless == (total - 1) * 777 * 96
    # Real-time clock in 1/1024 s, and the two user timers, one of which has reached its end.
    passed = int(read_long(card.memory.x, card.memory.y, 0x17)) - clock
    assert passed == pytest.approx(total * PERIOD_s * 1024, rel=1e-4, abs=5)
    timer1 = 8388607 - total
    assert port.line("I5111").split(b"\r")[0] == str(max(timer1, -8388608)).encode()
    # Stop: the registers say where the drive is, to the count, after kilometres of travel.
    port.line("&1A")
    card.run_cycles(4000)
    angle, table_m = card.servo.plant.reading()  # type: ignore[attr-defined]
    shuttles = float(port.line("P5").split(b"\r")[0])
    assert shuttles > minutes * 60 / 6
    actual_ct = read_long(card.memory.x, card.memory.y, 0x8B) / (32 * 96)
    assert actual_ct == pytest.approx(angle / (2 * np.pi) * 10000, abs=0.51)
    scale_ct = read_long(card.memory.x, card.memory.y, 0x10B) / (32 * 96)
    assert scale_ct == pytest.approx(table_m * 8e6, abs=0.51)
    assert abs(card.servo.following_error(1)) < 20
