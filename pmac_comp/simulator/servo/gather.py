"""Data gathering: the engine of RAM buffer and dual-ported RAM ring, and its commands.

What lives here: DEFINE, DELETE, LIST GATHER, start and stop, and the sampling that the servo kernel
calls at the end of every servo cycle. What may not: command parsing.
Imports numba, ``memory``, ``registers`` and the allocator of ``compensation``.

Layout in RAM: a sample is a stream of 24-bit words, Y before X of each long word; a 24-bit source
is one word, a 48-bit source two (low first); an odd number is filled up with one word. Layout in
dual-ported RAM: one 32-bit cell per 24-bit word, sign-extended, low word first, no filler.
``X:$06044F`` is the offset of the next cell to be written, ``Y:$06044F`` the size.

Source: Turbo PMAC Software Reference Manual p. 170-171, 307, 321, 324, 344; User Manual p. 401-402.
"""

from typing import Final

import numpy as np
from numba import njit

from pmac_comp.base.arrays import IntArray
from pmac_comp.simulator.memory import registers as reg
from pmac_comp.simulator.memory.errors import ERR_MEMORY, ERR_ORDER
from pmac_comp.simulator.memory.memory import Memory, Space, read_word_signed, write_dpram32
from pmac_comp.simulator.memory.user_memory import allocate_down, lowest_defined, program_floor

ERR_RUNNING: Final = 1
MAX_SOURCES: Final = 48
WORDS_PER_LINE: Final = 16
# Internal words beside I5000: X end address or size of the buffer; Y whether it may be listed.
_MODE = reg.INTERNAL_GATHER
_END = reg.INTERNAL_GATHER + 1

# Decoded plan: header row, then one row per source.
(P_COUNT, P_WORDS, P_MODE, P_START, P_END) = range(5)
(SRC_TYPE, SRC_ADDRESS) = range(2)


def new_plan() -> IntArray:
    """Array for ``decode_plan``."""
    return np.zeros((MAX_SOURCES + 1, 5), dtype=np.int64)


@njit(cache=True)
def decode_plan(x: Space, y: Space, plan: IntArray) -> None:
    """Decode masks, sources and buffer limits."""
    n = 0
    words = 0
    for k in range(MAX_SOURCES):
        mask = int(x[reg.GATHER_MASKS]) if k < 24 else int(x[reg.GATHER_MASKS + 1])
        if not (mask >> (k % 24)) & 1:
            continue
        source = int(x[reg.GATHER_SOURCES + k])
        n += 1
        plan[n, SRC_TYPE] = source >> 22
        plan[n, SRC_ADDRESS] = source & 0x7FFFF
        words += 2 if source >> 23 else 1
    plan[0, P_COUNT] = n
    plan[0, P_WORDS] = words
    plan[0, P_MODE] = x[_MODE] & 3
    plan[0, P_START] = x[reg.GATHER_POINTERS]
    plan[0, P_END] = x[_END]


@njit(cache=True)
def gather_cycle(x: Space, y: Space, plan: IntArray, trigger: bool) -> None:  # noqa: FBT001
    """What the servo task does for gathering in one servo cycle."""
    status = int(x[reg.GLOBAL_STATUS])
    if not status & (reg.G1_GATHERING | reg.G1_GATHER_TRIGGER):
        return
    if not status & reg.G1_GATHERING:
        if not trigger:
            return
        x[reg.GLOBAL_STATUS] = (status & ~reg.G1_GATHER_TRIGGER) | reg.G1_GATHERING
        x[reg.GATHER_PERIOD] = 0
    waiting = int(x[reg.GATHER_PERIOD])
    if waiting > 0:
        x[reg.GATHER_PERIOD] = waiting - 1
        return
    period = int(y[reg.GATHER_PERIOD])
    if plan[0, P_COUNT] == 0 or plan[0, P_START] == 0 or not _sample(x, y, plan) or period == 0:
        x[reg.GLOBAL_STATUS] &= ~reg.G1_GATHERING
    x[reg.GATHER_PERIOD] = max(period - 1, 0)


@njit(cache=True)
def _sample(x: Space, y: Space, plan: IntArray) -> bool:
    """Store one sample; False when the buffer is full and does not wrap."""
    if plan[0, P_MODE] >= 2:
        return bool(_sample_dpram(x, y, plan))
    words = plan[0, P_WORDS]
    size = (words + 1) // 2
    pointer = int(y[reg.GATHER_POINTERS])
    wraps = plan[0, P_MODE] == 1
    if pointer + size > plan[0, P_END]:
        if not wraps:
            return False
        pointer = plan[0, P_START]
        if pointer + size > plan[0, P_END]:
            return False
    half = 0
    address = pointer
    for i in range(1, plan[0, P_COUNT] + 1):
        source = plan[i, SRC_ADDRESS]
        kind = plan[i, SRC_TYPE]
        first = x[source] if kind == 1 else y[source]
        for part in range(2 if kind >= 2 else 1):
            word = first if part == 0 else x[source]
            if half == 0:
                y[address] = word
                half = 1
            else:
                x[address] = word
                address += 1
                half = 0
    if half == 1:
        x[address] = 0
    pointer += size
    if wraps and pointer + size > plan[0, P_END]:
        pointer = plan[0, P_START]
    y[reg.GATHER_POINTERS] = pointer
    return bool(wraps or pointer + size <= plan[0, P_END])


@njit(cache=True)
def _sample_dpram(x: Space, y: Space, plan: IntArray) -> bool:
    words = plan[0, P_WORDS]
    size = plan[0, P_END]
    offset = int(x[reg.DPRAM_GATHER_SIZE])
    wraps = plan[0, P_MODE] == 3
    if offset + words > size:
        if not wraps or words > size:
            return False
        offset = 0
    address = reg.DPRAM_GATHER_DATA + offset
    for i in range(1, plan[0, P_COUNT] + 1):
        source = plan[i, SRC_ADDRESS]
        kind = plan[i, SRC_TYPE]
        if kind != 1:
            write_dpram32(x, y, address, read_word_signed(y, source))
            address += 1
        if kind != 0:
            write_dpram32(x, y, address, read_word_signed(x, source))
            address += 1
    offset += words
    if wraps and offset + words > size:
        offset = 0
    x[reg.DPRAM_GATHER_SIZE] = offset
    y[reg.GATHER_POINTERS] = reg.DPRAM_GATHER_DATA + offset
    return bool(wraps or offset + words <= size)


class GatherBuffer:
    """Commands of the gather buffer; changing ones answer with an error number (0 = done)."""

    def __init__(self, memory: Memory) -> None:
        self._memory = memory
        self._plan = new_plan()

    @property
    def running(self) -> bool:
        """True while samples are taken or a trigger is awaited."""
        flags = reg.G1_GATHERING | reg.G1_GATHER_TRIGGER
        return bool(int(self._memory.x[reg.GLOBAL_STATUS]) & flags)

    @property
    def exists(self) -> bool:
        """True if the buffer is defined."""
        return bool(self._memory.x[reg.GATHER_POINTERS])

    @property
    def words_per_sample(self) -> int:
        """24-bit words of one sample under the present masks."""
        decode_plan(self._memory.x, self._memory.y, self._plan)
        return int(self._plan[0, P_WORDS])

    def define(self, size: int | None = None) -> int:
        """DEFINE GATHER [size]: long words in RAM modes, 32-bit cells in DPRAM modes (p. 307)."""
        if self.running:
            return ERR_RUNNING
        if int(self._memory.x[_MODE]) & 2:
            return self._define_dpram(size)
        return self._define_ram(size)

    def _define_ram(self, size: int | None) -> int:
        memory = self._memory
        again = self.exists
        memory.x[reg.GATHER_POINTERS] = 0
        free = lowest_defined(memory) - program_floor(memory)
        wanted = free if size is None else size
        start = allocate_down(memory, wanted) if wanted > 0 else None
        if start is None:
            return ERR_MEMORY
        memory.x[reg.GATHER_POINTERS] = start
        memory.y[reg.GATHER_POINTERS] = start
        memory.x[_END] = start + wanted
        memory.y[_END] = 0 if again else 1
        memory.touch()
        return 0

    def _define_dpram(self, size: int | None) -> int:
        memory = self._memory
        end = int(memory.y[reg.DPRAM_END_REGISTER])
        room = end - reg.DPRAM_GATHER_DATA
        words = max(self.words_per_sample, 1)
        wanted = room if size is None else -(-size // words) * words
        if wanted <= 0 or wanted > room:
            return ERR_MEMORY
        memory.x[reg.GATHER_POINTERS] = reg.DPRAM_GATHER_DATA
        memory.y[reg.GATHER_POINTERS] = reg.DPRAM_GATHER_DATA
        # The size register has 16 bits, as every cell half.
        memory.y[reg.DPRAM_GATHER_SIZE] = wanted & 0xFFFF
        memory.x[reg.DPRAM_GATHER_SIZE] = 0
        memory.x[_END] = wanted
        memory.y[_END] = 0
        memory.touch()
        return 0

    def start(self, *, on_trigger: bool = False) -> int:
        """GATHER or GATHER TRIGGER; 3 if no buffer is defined.

        A second GATHER while running restarts the period only; after ENDGATHER it appends.
        """
        if not self.exists:
            return ERR_ORDER
        memory = self._memory
        status = int(memory.x[reg.GLOBAL_STATUS])
        bit = reg.G1_GATHER_TRIGGER if on_trigger else reg.G1_GATHERING
        memory.x[reg.GLOBAL_STATUS] = status | bit
        memory.x[reg.GATHER_PERIOD] = 0
        memory.touch()
        return 0

    def stop(self) -> int:
        """ENDGATHER."""
        flags = reg.G1_GATHERING | reg.G1_GATHER_TRIGGER
        self._memory.x[reg.GLOBAL_STATUS] &= ~flags & 0xFFFFFF
        self._memory.touch()
        return 0

    def delete(self) -> int:
        """DELETE GATHER; refused while gathering runs."""
        if self.running:
            return ERR_RUNNING
        memory = self._memory
        memory.x[reg.GATHER_POINTERS] = 0
        memory.y[reg.GATHER_POINTERS] = 0
        memory.x[_END] = 0
        memory.touch()
        return 0

    def list_lines(self, start: int = 0, length: int | None = None) -> list[str] | None:
        """LIST GATHER [start][,length]: 12 hex digits per long word; None means an error."""
        memory = self._memory
        first = int(memory.x[reg.GATHER_POINTERS])
        if not first or int(memory.x[_MODE]) & 2 or not int(memory.y[_END]):
            return None
        wraps = int(memory.x[_MODE]) & 1
        end = int(memory.x[_END]) if wraps else int(memory.y[reg.GATHER_POINTERS])
        begin = first + start
        stop = end if length is None else min(begin + length, int(memory.x[_END]))
        if start < 0 or begin > int(memory.x[_END]):
            return None
        words = [f"{memory.x[a]:06X}{memory.y[a]:06X}" for a in range(begin, stop)]
        return [
            " ".join(words[i : i + WORDS_PER_LINE]) for i in range(0, len(words), WORDS_PER_LINE)
        ]
