"""User memory above the programs: which buffers are defined there, and where the next one goes.

Buffers made by DEFINE lie from the end of user memory downward, in the order of definition.
Source: Turbo PMAC Software Reference Manual p. 300-317, 509 (pointers).
"""

from typing import Final

import numpy as np

from pmac_comp.simulator.memory import registers as reg
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.memory import Memory

TBUF, ROTARY, LOOKAHEAD, GATHER = "TBUF", "ROTARY", "LOOKAHEAD", "GATHER"
_BUFFERS: Final = {
    GATHER: (reg.GATHER_POINTERS, 1),
    LOOKAHEAD: (0x3121, 16),
    "CCBUF": (0x3131, 16),
    ROTARY: (reg.ROTARY_POINTERS, 16),
    TBUF: (0x3151, 1),
}
_TABLES: Final = (reg.COMP_POINTERS, reg.TCOMP_POINTERS, reg.BLCOMP_POINTERS)
_START_CELLS: Final = np.concatenate(
    [pointers + np.arange(reg.MOTORS) for pointers in _TABLES]
    + [address + np.arange(count) for address, count in _BUFFERS.values()]
)


def buffer_exists(memory: Memory, name: str) -> bool:
    """True if a temporary buffer of this name is defined."""
    address, count = _BUFFERS[name]
    return any(int(memory.x[address + i]) for i in range(count))


def lowest_defined(memory: Memory) -> int:
    """Lowest address that a DEFINEd buffer in user memory uses (end of memory if none)."""
    low = int(memory.x[reg.MEMORY_END]) or reg.USER_BUFFER_END_STANDARD
    starts = memory.x[_START_CELLS]
    starts = starts[starts >= reg.USER_BUFFER_START]
    return min(low, int(starts.min())) if starts.size else low


def program_floor(memory: Memory) -> int:
    """First address above the fixed buffers (programs and PLCs)."""
    return max(int(memory.y[reg.PROGRAM_END]), reg.USER_BUFFER_START)


def allocate_down(memory: Memory, n_long: int) -> int | None:
    """Start address for a buffer of ``n_long`` long words, None when memory is short."""
    start = lowest_defined(memory) - n_long
    return start if start >= program_floor(memory) else None


def define_user_buffer(memory: Memory, words: int) -> None:
    """DEFINE UBUFFER: memory at the end of the user area; no other buffer may exist."""
    if lowest_defined(memory) != int(memory.x[reg.MEMORY_END]):
        raise CardError(3)
    end = reg.USER_BUFFER_END_STANDARD - words
    if end < int(memory.y[reg.PROGRAM_END]):
        raise CardError(6)
    memory.x[reg.MEMORY_END] = end
