"""Keeps a card faster than real time from outrunning a host that empties the gather ring.

A real card gathers at servo rate whether the host keeps up or not. A simulated one at 400 times
real time fills the ring within two milliseconds, and no host could follow. So while samples go into
the ring, time passes only as far as a host that follows it can read: from one look at the storage
pointer to the next at most a third of the ring is filled, which leaves what the host is reading
untouched. A card nobody looks at is not held: after a while without a look time runs on.
"""

from __future__ import annotations

import sys
from typing import Final

from pmac_comp.simulator.memory import registers as reg
from pmac_comp.simulator.memory.memory import DPRAM_START, Memory
from pmac_comp.simulator.servo import gather

POINTER_OFFSET: Final = 4 * (reg.DPRAM_GATHER_SIZE - DPRAM_START) + 2  # 0x113E, what a host reads
PATIENCE_s: Final = 2.0  # of wall time without a look at the pointer
NO_LIMIT: Final = sys.maxsize
_RING = 3  # I5000
_SHARE = 3  # of the ring between two looks


class RingHold:
    """How far time may pass before a host has to look at the ring again.

    Parameters
    ----------
    memory : Memory
        Memory of the card.
    """

    def __init__(self, memory: Memory) -> None:
        self._memory = memory
        self._buffer = gather.GatherBuffer(memory)
        self._gathering = False
        self._looked = False  # since it was asked last
        self._from_cycle = 0
        self._from_s = 0.0

    def look(self, offset: int, size: int) -> None:
        """A host reads ``size`` bytes of the dual-ported RAM from ``offset``."""
        if offset <= POINTER_OFFSET < offset + size:
            self._looked = True

    def allowance(self, cycle: int, wall_s: float) -> int:
        """Servo cycles that may pass now.

        Parameters
        ----------
        cycle : int
            Servo cycles of the card so far.
        wall_s : float
            Any clock that runs in real time.
        """
        memory = self._memory
        gathering = bool(int(memory.x[reg.GLOBAL_STATUS]) & reg.G1_GATHERING)
        gathering = gathering and int(memory.x[reg.INTERNAL_GATHER]) & 3 == _RING
        if self._looked or gathering != self._gathering:
            self._looked, self._gathering = False, gathering
            self._from_cycle, self._from_s = cycle, wall_s
        if not gathering or wall_s - self._from_s > PATIENCE_s:
            return NO_LIMIT
        return max(0, self._share_cycles() - (cycle - self._from_cycle))

    def _share_cycles(self) -> int:
        words = max(self._buffer.words_per_sample, 1)
        samples = int(self._memory.y[reg.DPRAM_GATHER_SIZE]) // words
        period = max(int(self._memory.y[reg.GATHER_PERIOD]), 1)
        return max(samples // _SHARE, 1) * period
