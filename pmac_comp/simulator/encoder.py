"""Encoder channels and the encoder conversion table.

What lives here: how plant positions become counter registers, and how table entries turn registers
into feedback words. What may not: motors. Imports numba, ``memory`` and ``registers``.

Result words carry 1/32 count in bits 0-4. Methods the simulated card knows: 0 (1/T extension),
1 (A/D), 2/3 and 6/7 (parallel words, plain and filtered), C (no extension, or hardware 1/T),
D (exponential filter), E (sum, difference, integration). Any other method ends the table there,
and the configuration-error bit of the global status tells so.

Source: Turbo PMAC Software Reference Manual p. 232-245, Turbo PMAC User Manual p. 136-146.
"""

import math

import numpy as np
from numba import njit

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.simulator.memory import Space
from pmac_comp.simulator.registers import ECT_BASE, ECT_LINES

# Columns of a decoded entry.
(E_METHOD, E_SOURCE, E_OUT, E_SHIFT, E_WIDTH, E_LSB, E_LIMIT, E_GAIN, N_ENTRY) = range(9)
_WORD = 0xFFFFFF
# Extension registers: time since the last count over time between counts, in these units.
_TIMER_ONE = 0x10000

_M_TIMER, _M_ADC, _M_PARALLEL, _M_COUNT, _M_FILTER, _M_SUM = 0, 1, 2, 12, 13, 14


@njit(cache=True)
def _signed24(value: int) -> int:
    value &= _WORD
    return value - 0x1000000 if value >= 0x800000 else value


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
        direction = 1 if _signed24(raw - before) < 0 else 0
    x[base + 2] = ((count << 1) & 0xFFFFFE) | direction
    y[base] = _TIMER_ONE
    y[base + 1] = int((edge - whole) * _TIMER_ONE)
    return count


@njit(cache=True)
def decode_table(x: Space, y: Space, entries: IntArray) -> tuple[int, bool]:
    """Decode the setup lines; (number of entries, whether one was not understood)."""
    n = 0
    line = 0
    while line < ECT_LINES:
        setup = int(y[ECT_BASE + line])
        if setup == 0:
            break
        method = setup >> 20
        bit19 = (setup >> 19) & 1
        source = min(setup & 0x7FFFF, 0x7FFF0)  # three neighbours are read, too
        lines = 1
        entry = entries[n]
        entry[:] = 0
        entry[E_SOURCE] = source
        if method == 0:
            entry[E_METHOD] = _M_TIMER
        elif method == 1:
            entry[E_METHOD] = _M_ADC
            entry[E_WIDTH] = bit19
        elif method in {2, 3, 6, 7}:
            lines = 2 if method in {2, 6} else 3
            if line + lines > ECT_LINES:
                return n, True
            second = int(y[ECT_BASE + line + 1])
            entry[E_METHOD] = _M_PARALLEL
            entry[E_SHIFT] = 0 if bit19 else 5
            entry[E_WIDTH] = second >> 12
            entry[E_LSB] = second & 0xFFF
            if entry[E_WIDTH] < 1 or entry[E_WIDTH] > 24 or entry[E_LSB] > 0x2F:
                return n, True
            if lines == 3:
                entry[E_LIMIT] = int(y[ECT_BASE + line + 2])
        elif method == 12:
            entry[E_METHOD] = _M_TIMER if bit19 else _M_COUNT
        elif method == 13 and not bit19:
            lines = 3
            if line + lines > ECT_LINES:
                return n, True
            entry[E_METHOD] = _M_FILTER
            entry[E_LIMIT] = int(y[ECT_BASE + line + 1])
            entry[E_GAIN] = int(y[ECT_BASE + line + 2])
        elif method == 14:
            entry[E_METHOD] = _M_SUM
            entry[E_SHIFT] = setup  # mode bits and the two offsets
        else:
            return n, True
        entry[E_OUT] = ECT_BASE + line + lines - 1
        n += 1
        line += lines
    return n, False


@njit(cache=True)
def convert(x: Space, y: Space, entries: IntArray, n: int, memory: FloatArray) -> None:
    """Execute the decoded table top to bottom; results go to the X registers.

    ``memory`` has one row (previous raw word, exact filter state) per entry.
    """
    for i in range(n):
        entry = entries[i]
        method = entry[E_METHOD]
        source = entry[E_SOURCE]
        out = entry[E_OUT]
        result = 0
        if method in (_M_TIMER, _M_COUNT):
            result = (int(x[source + 2]) >> 1) << 5
            if method == _M_TIMER and y[source] > 0:
                result += min(int(y[source + 1]) * 32 // int(y[source]), 31)
        elif method == _M_ADC:
            word = int(y[source]) >> 8
            if entry[E_WIDTH] == 0 and word >= 0x8000:
                word -= 0x10000
            result = word << 5
        elif method == _M_PARALLEL:
            result = _parallel(x, y, entry, memory[i])
        elif method == _M_FILTER:
            # The state keeps the fraction that the 24-bit result word cannot.
            change = _signed24(int(x[source]) - math.floor(memory[i, 0]))
            if entry[E_LIMIT] > 0:
                change = min(max(change, -entry[E_LIMIT]), entry[E_LIMIT])
            memory[i, 0] += change * (entry[E_GAIN] / 8388608.0)
            result = math.floor(memory[i, 0])
        else:
            result = _sum(x, entry, int(x[out]))
        x[out] = result & _WORD


@njit(cache=True)
def _parallel(x: Space, y: Space, entry: IntArray, memory: FloatArray) -> int:
    source = entry[E_SOURCE]
    lsb = entry[E_LSB]
    # Bit positions $18-$2F name the X register.
    word = int(y[source]) >> lsb if lsb < 24 else int(x[source]) >> (lsb - 24)
    span = 1 << entry[E_WIDTH]
    word &= span - 1
    change = (word - int(memory[0])) & (span - 1)
    if change >= span >> 1:
        change -= span
    if entry[E_LIMIT] > 0:
        change = min(max(change, -entry[E_LIMIT]), entry[E_LIMIT])
    memory[0] = (int(memory[0]) + change) & (span - 1)
    memory[1] = _signed24(int(memory[1]) + (change << entry[E_SHIFT]))
    return int(memory[1])


@njit(cache=True)
def _sum(x: Space, entry: IntArray, present: int) -> int:
    setup = entry[E_SHIFT]
    first = int(x[ECT_BASE + (setup & 0xFF) % ECT_LINES])
    second = int(x[ECT_BASE + ((setup >> 8) & 0xFF) % ECT_LINES])
    total = -first if setup & 0x10000 else first
    if not setup & 0x40000:
        total += -second if setup & 0x20000 else second
    return present + total if setup & 0x80000 else total


def new_table() -> tuple[IntArray, FloatArray]:
    """Arrays for ``decode_table`` and ``convert``."""
    return np.zeros((ECT_LINES, N_ENTRY), dtype=np.int64), np.zeros((ECT_LINES, 2))
