"""Encoder channels: how positions become counter registers, and how a trigger captures them.

What lives here: the registers of one channel of a servo IC. What may not: the conversion table
(`conversion`), motors. Imports numba and ``memory``.

Source: Turbo PMAC Software Reference Manual p. 222-223 (capture), 533-535 (registers).
"""

import math

from numba import njit

from pmac_comp.simulator.memory.memory import Space, signed24

_WORD = 0xFFFFFF
# Extension registers: time since the last count over time between counts, in these units.
_TIMER_ONE = 0x10000
CAPTURED = 1 << 11  # in the status word of a channel
INDEX_FLAG = 1 << 14
CAPTURE_INDEX, CAPTURE_FLAG, CAPTURE_BOTH = 1, 2, 3  # bits 0-1 of I7mn2
INDEX_LOW = 4  # bit 2


@njit(cache=True)
def latch_channel(x: Space, y: Space, base: int, position_ct: float, sign: int) -> int:
    """Latch one incremental encoder into its channel registers; the signed count.

    The counter changes half way between the marks that are whole ``position_ct``; the extension
    registers say how far the encoder is past the last edge.
    """
    edge = position_ct * sign + 0.5
    whole = math.floor(edge)
    count = int(whole)
    before = x[base + 1]
    raw = count & _WORD
    x[base + 1] = raw
    direction = x[base + 2] & 1
    if raw != before:
        direction = 1 if signed24(raw - before) < 0 else 0
    x[base + 2] = ((count << 1) & 0xFFFFFE) | direction
    y[base] = _TIMER_ONE
    y[base + 1] = int((edge - whole) * _TIMER_ONE)
    return count


@njit(cache=True)
def index_between(before_ct: float, here_ct: float, per_rev: float) -> tuple[bool, float]:
    """Whether an index mark was crossed since the last cycle, and its position in counts."""
    low, high = math.floor(before_ct / per_rev), math.floor(here_ct / per_rev)
    return low != high, max(low, high) * per_rev


@njit(cache=True)
def index_trigger(
    x: Space, base: int, control: int, before_ct: float, here_ct: float, per_rev: float
) -> tuple[bool, float]:
    """Whether the index is as I7mn2 wants it, and where that began in counts.

    A high index is a mark that may be crossed between two cycles; it is low nearly everywhere.
    """
    if control & INDEX_LOW:
        return not x[base] & INDEX_FLAG, here_ct
    hit, mark = index_between(before_ct, here_ct, per_rev)
    return bool(hit), float(mark)


@njit(cache=True)
def capture_channel(
    x: Space, base: int, control: int, select: int, before_ct: float, here_ct: float, per_rev: float
) -> None:
    """Capture the counter into X:+3 when the trigger of I7mn2 and I7mn3 comes (level-triggered).

    Armed while the capture flag is off; the flag stays until the captured position was read.
    """
    if x[base] & CAPTURED:
        return
    mode = control & 3
    flag = bool((int(x[base]) >> (16 + (select & 3))) & 1) != bool(control & 8)
    captured = float(signed24(x[base + 1]))
    if mode == CAPTURE_FLAG and not flag:
        return
    if mode in (CAPTURE_INDEX, CAPTURE_BOTH):
        hit, captured = index_trigger(x, base, control, before_ct, here_ct, per_rev)
        if not hit or (mode == CAPTURE_BOTH and not flag):
            return
    x[base] |= CAPTURED
    x[base + 3] = math.floor(captured + 0.5) & _WORD
