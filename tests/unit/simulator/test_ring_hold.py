"""Faster than real time, the card waits for a host that empties the gather ring."""

import time

import numpy as np
import pytest

from pmac_comp.machine.client.commander import Commander
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.serving.server import ServeOptions, running_server
from pmac_comp.simulator.servo.ring_hold import NO_LIMIT, POINTER_OFFSET, PATIENCE_s

from .conftest import Ask

RING = (
    "DELETE GATHER", "I5000=3 I5001=$400000 I5002=$80008B I5050=3 I5049=1", "DEFINE GATHER 3000",
)  # fmt: skip


def test_a_third_of_the_ring_between_two_looks(card: Card, ask: Ask) -> None:
    hold = card.ring_hold
    assert hold.allowance(0, 0.0) == NO_LIMIT
    for line in (*RING, "GATHER"):
        assert "ERR" not in ask(line)
    card.run_cycles(1)
    start = card.cycles
    assert hold.allowance(start, 1.0) == 333  # 3000 cells of 3, a third
    assert hold.allowance(start + 300, 1.1) == 33
    assert hold.allowance(start + 400, 1.2) == 0
    hold.look(POINTER_OFFSET - 2, 2)  # the size, not the pointer
    hold.look(POINTER_OFFSET + 2, 1400)  # samples
    assert hold.allowance(start + 400, 1.3) == 0
    hold.look(POINTER_OFFSET - 2, 4)
    assert hold.allowance(start + 400, 1.4) == 333
    # Nobody looks any more: time runs on.
    assert hold.allowance(start + 733, 1.4 + PATIENCE_s + 0.01) == NO_LIMIT
    ask("ENDGATHER")
    assert hold.allowance(start + 733, 1.5) == NO_LIMIT


@pytest.mark.parametrize("setup", ["I5000=1", "I5000=2"], ids=["RAM", "no wrap"])
def test_only_the_ring_holds(card: Card, ask: Ask, setup: str) -> None:
    for line in (RING[0], RING[1], setup, "DEFINE GATHER 300", "GATHER"):
        assert "ERR" not in ask(line)
    assert card.ring_hold.allowance(card.cycles, 0.0) == NO_LIMIT


@pytest.mark.parametrize("speed", ["max", "50"])
def test_host_that_follows_the_ring_loses_no_sample(card: Card, speed: str) -> None:
    found: list[np.ndarray] = []
    with (
        running_server(card, ServeOptions(tcp=0, speed=speed)) as endpoints,
        Commander.open(endpoints["tcp"], timeout_s=10.0) as link,
    ):
        for line in (*RING, "GATHER"):
            link.command(line)
        begin, last = time.perf_counter(), 0
        while sum(part.size for part in found) < 9000 and time.perf_counter() - begin < 20.0:
            now = int.from_bytes(link.get_memory(POINTER_OFFSET, 2), "little")
            found.append(cells(link, last, now))
            last = now
    counter = np.concatenate(found)[::3] & 0xFFFFFF
    assert counter.size >= 3000
    assert np.array_equal(counter, counter[0] + np.arange(counter.size))


def cells(link: Commander, first: int, end: int) -> np.ndarray:
    """Cells of the ring from `first` up to `end`, round the corner if need be."""
    parts = [(first, 3000), (0, end)] if end < first else [(first, end)]
    data = b"".join(link.get_memory(0x1140 + 4 * a, 4 * (b - a)) for a, b in parts if b > a)
    return np.frombuffer(data, dtype="<i4")
