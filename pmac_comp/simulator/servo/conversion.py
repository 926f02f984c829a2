"""Methods of the encoder conversion table: setup lines in, decoded entries, result words out.

What lives here: decoding of the setup lines and the conversion of every servo cycle. What may not:
encoder channels (`encoder`), motors. Imports numba, ``memory`` and ``registers``.

Result words carry 1/32 count in bits 0-4 unless the manual says otherwise. An entry that the
manual does not know (an extended type above 4, a width of nothing) ends the table there, and the
configuration-error bit of the global status tells so. The mode switch of methods 8 and F/0 chooses
between the two kinds of servo IC; the card has the newer one.

Source: Turbo PMAC Software Reference Manual p. 232-253.
"""

import math

import numpy as np
from numba import njit

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.simulator.memory.memory import Space, signed24
from pmac_comp.simulator.memory.registers import ECT_BASE, ECT_LINES

# Columns of a decoded entry.
(
    E_METHOD,
    E_SOURCE,
    E_OUT,  # result register, X
    E_FIRST,  # first line of the entry
    E_SHIFT,
    E_WIDTH,
    E_LSB,
    E_NEXT,  # where a parallel word goes on: 0 the next Y, 1 the X beside it
    E_LIMIT,  # largest change a cycle, -1 for none
    E_GAIN,
    E_SECOND,  # integral gain, bias or second address
    N_ENTRY,
) = range(12)
# What an entry remembers, by result line.
(R_INPUT, R_OUTPUT, R_INTEGRAL, R_HIGH, R_LOW, N_REMEMBERED) = range(6)
(
    METHOD_TIMER,  # these two first: they are told from the others by their number
    METHOD_COUNT,
    METHOD_ADC,
    METHOD_PARALLEL,
    METHOD_TIME_BASE,
    METHOD_INTEGRATED_ADC,
    METHOD_FLAGS,
    METHOD_FROZEN,
    METHOD_RUNNING,
    METHOD_ARMED,
    METHOD_EXPONENTIAL,
    METHOD_TRACKING,
    METHOD_SUM,
    METHOD_INTERPOLATOR,
    METHOD_MAGNITUDE,
    METHOD_BIAS,
    METHOD_BYTES,
    METHOD_RESOLVER,
) = range(18)
_WORD = 0xFFFFFF
_TRIGGERED = 1 << 11  # capture flag in the status word of a channel
_LINES = (1, 1, 2, 3, 2, 2, 2, 3, 1, 2, 2, 2, 1, 3, 1, 2)  # lines by method digit, at least


@njit(cache=True)
def _signed12(value: int) -> int:
    value &= 0xFFF
    return value - 0x1000 if value >= 0x800 else value


@njit(cache=True)
def decode_table(x: Space, y: Space, entries: IntArray) -> tuple[int, bool]:
    """Decode the setup lines; (number of entries, whether one was not understood)."""
    n = 0
    line = 0
    while line < ECT_LINES:
        setup = int(y[ECT_BASE + line])
        if setup == 0:
            break
        entry = entries[n]
        entry[:] = 0
        entry[E_FIRST] = ECT_BASE + line
        entry[E_SOURCE] = min(setup & 0x7FFFF, 0x7FFF0)  # neighbours are read, too
        entry[E_LIMIT] = -1
        lines = _lines_of(setup, int(y[ECT_BASE + line + 1]))
        if lines == 0 or line + lines > ECT_LINES:
            return n, True
        if not _decode_entry(y, entry, setup):
            return n, True
        entry[E_OUT] = ECT_BASE + line + lines - 1
        n += 1
        line += lines
    return n, False


@njit(cache=True)
def _lines_of(setup: int, second: int) -> int:
    """Lines of the entry that starts with this one, 0 if the manual knows no such entry."""
    method = setup >> 20
    if method == 13 and setup & 0x80000:
        return 5
    if method == 15:
        kind = second >> 20
        if kind == 1:
            return 5
        if kind == 2:
            return 2
        return 3 if kind <= 4 else 0
    return int(_LINES[method])


@njit(cache=True)
def _decode_entry(y: Space, entry: IntArray, setup: int) -> bool:
    """Fill in method and settings of one entry; False if they make no sense."""
    method = setup >> 20
    bit19 = (setup >> 19) & 1
    first = entry[E_FIRST]
    second = int(y[first + 1])
    third = int(y[first + 2])
    if method == 0:
        entry[E_METHOD] = METHOD_TIMER
    elif method == 1:
        entry[E_METHOD] = METHOD_ADC
        entry[E_WIDTH] = bit19
    elif method in {2, 3, 6, 7}:
        entry[E_METHOD] = METHOD_PARALLEL
        entry[E_SHIFT] = 0 if bit19 else 5
        entry[E_WIDTH] = second >> 12
        entry[E_LSB] = second & 0xFFF
        entry[E_NEXT] = 1 if method >= 6 else 0
        entry[E_LIMIT] = third if method in {3, 7} else -1
        return bool(1 <= entry[E_WIDTH] <= 24 and entry[E_LSB] <= 0x2F)
    elif method == 4:
        entry[E_METHOD] = METHOD_TIME_BASE
        entry[E_GAIN] = signed24(second)
    elif method == 5:
        entry[E_METHOD] = METHOD_INTEGRATED_ADC
        entry[E_WIDTH] = bit19
        entry[E_SECOND] = signed24(second)
    elif method == 8:
        entry[E_METHOD] = METHOD_FLAGS
        entry[E_SECOND] = 0 if bit19 else 4
    elif method in {9, 10, 11}:
        entry[E_METHOD] = METHOD_FROZEN + method - 9
        entry[E_GAIN] = signed24(second)
    elif method == 12:
        entry[E_METHOD] = METHOD_TIMER if bit19 else METHOD_COUNT
    elif method == 13:
        entry[E_METHOD] = METHOD_TRACKING if bit19 else METHOD_EXPONENTIAL
        entry[E_LIMIT] = second
        entry[E_GAIN] = signed24(third)
        entry[E_SECOND] = signed24(int(y[first + 4])) if bit19 else 0
    elif method == 14:
        entry[E_METHOD] = METHOD_SUM
        entry[E_SHIFT] = setup  # mode bits and the two offsets
    else:
        return bool(_decode_extended(entry, bit19, second, third))
    return True


@njit(cache=True)
def _decode_extended(entry: IntArray, bit19: int, second: int, third: int) -> bool:
    kind = second >> 20
    entry[E_WIDTH] = bit19
    entry[E_SECOND] = min(second & 0x7FFFF, 0x7FFF0)
    entry[E_GAIN] = third  # bias of sine and cosine
    if kind == 0:
        entry[E_METHOD] = METHOD_INTERPOLATOR
    elif kind == 1:
        entry[E_METHOD] = METHOD_BIAS if second & 1 else METHOD_MAGNITUDE
        entry[E_SHIFT] = second & 2
    elif kind == 4:
        entry[E_METHOD] = METHOD_RESOLVER
    else:
        entry[E_METHOD] = METHOD_BYTES
        entry[E_SHIFT] = 0 if bit19 else 5
        entry[E_WIDTH] = (second >> 12) & 0xFF
        entry[E_NEXT] = 8 * ((second >> 8) & 0xF)
        entry[E_LSB] = second & 0xFF
        entry[E_LIMIT] = third if kind == 3 else -1
        sane = 1 <= entry[E_WIDTH] <= 24 and entry[E_NEXT] <= 16 and entry[E_LSB] <= 7
        return bool(sane)
    return True


@njit(cache=True)
def convert(x: Space, y: Space, entries: IntArray, n: int, memory: FloatArray) -> None:
    """Execute the decoded table top to bottom; results go to the X registers.

    ``memory`` has one row per line of the table (``R_...``), used by the line of the result.
    """
    for i in range(n):
        method = entries[i, E_METHOD]
        if method > METHOD_COUNT:
            # Apart, because views of rows cost more than all that most entries need.
            _convert_other(x, y, entries[i], memory)
            continue
        source = entries[i, E_SOURCE]
        result = (int(x[source + 2]) >> 1) << 5
        if method == METHOD_TIMER and y[source] > 0:
            result += min(int(y[source + 1]) * 32 // int(y[source]), 31)
        x[entries[i, E_OUT]] = result & _WORD


@njit(cache=True)
def _convert_other(x: Space, y: Space, entry: IntArray, memory: FloatArray) -> None:
    method, source, out = entry[E_METHOD], entry[E_SOURCE], entry[E_OUT]
    own = memory[out - ECT_BASE]
    result = 0
    if method == METHOD_PARALLEL:
        result = _follow(entry, own, _parallel_word(x, y, entry))
    elif method == METHOD_SUM:
        result = _sum(x, entry, int(x[out]))
    elif method == METHOD_ADC:
        result = (_adc(y, entry) >> 8) << 5
    elif method in (METHOD_EXPONENTIAL, METHOD_TRACKING):
        result = _filtered(entry, own, int(x[source]))
    elif method == METHOD_TIME_BASE:
        change = signed24(int(x[source]) - int(x[entry[E_FIRST]]))
        x[entry[E_FIRST]] = x[source]
        result = 2 * entry[E_GAIN] * change
    elif method == METHOD_INTEGRATED_ADC:
        result = _integrated(y, entry, own)
    elif method in (METHOD_FROZEN, METHOD_RUNNING, METHOD_ARMED):
        result = _triggered(x, y, entry)
    elif method == METHOD_FLAGS:
        result = (int(x[source + 2]) >> 1) << 5
        result += (int(x[source + entry[E_SECOND]]) >> 19) & 31
    elif method == METHOD_BYTES:
        result = _follow(entry, own, _byte_word(y, entry))
    else:
        result = _sine_cosine(x, y, entry, own)
    x[out] = result & _WORD


@njit(cache=True)
def _adc(y: Space, entry: IntArray) -> int:
    """24-bit word of a converter, signed unless the mode switch says otherwise."""
    word = int(y[entry[E_SOURCE]])
    return word if entry[E_WIDTH] else int(signed24(word))


@njit(cache=True)
def _integrated(y: Space, entry: IntArray, own: FloatArray) -> int:
    """Sum of the readings less their bias, whose unit is 1/256 of a 16-bit converter's bit."""
    reading = (_adc(y, entry) >> 8) * 256 - entry[E_SECOND]
    if entry[E_WIDTH] and reading < 0:
        reading = 0  # "the result after the bias is not permitted to be less than zero"
    own[R_OUTPUT] += reading / 8.0
    if own[R_OUTPUT] >= 8388608.0:
        own[R_OUTPUT] -= 16777216.0
    elif own[R_OUTPUT] < -8388608.0:
        own[R_OUTPUT] += 16777216.0
    result: int = math.floor(own[R_OUTPUT])
    return result


@njit(cache=True)
def _parallel_word(x: Space, y: Space, entry: IntArray) -> int:
    """Bits of a parallel source; beyond bit 23 they come from the next word."""
    source = entry[E_SOURCE]
    beyond = int(x[source]) if entry[E_NEXT] else int(y[source + 1])
    return int(((beyond << 24) | int(y[source])) >> entry[E_LSB])


@njit(cache=True)
def _byte_word(y: Space, entry: IntArray) -> int:
    """Bits of a source whose bytes lie in consecutive Y words."""
    word = 0
    for k in range(3):
        word |= ((int(y[entry[E_SOURCE] + k]) >> entry[E_NEXT]) & 0xFF) << (8 * k)
    return int(word >> entry[E_LSB])


@njit(cache=True)
def _follow(entry: IntArray, own: FloatArray, word: int) -> int:
    """Result of a parallel source: rolls over, changes no faster than the filter lets it."""
    span = 1 << entry[E_WIDTH]
    word &= span - 1
    change = (word - int(own[R_INPUT])) & (span - 1)
    if change >= span >> 1:
        change -= span
    if entry[E_LIMIT] >= 0:
        change = min(max(change, -entry[E_LIMIT]), entry[E_LIMIT])
    own[R_INPUT] = (int(own[R_INPUT]) + change) & (span - 1)
    own[R_OUTPUT] = signed24(int(own[R_OUTPUT]) + (change << entry[E_SHIFT]))
    return int(own[R_OUTPUT])


@njit(cache=True)
def _wrapped(value: float) -> float:
    return value - 16777216.0 * math.floor(value / 16777216.0 + 0.5)


@njit(cache=True)
def _filtered(entry: IntArray, own: FloatArray, word: int) -> int:
    """Exponential or tracking filter; the state keeps the fraction the result word cannot."""
    change = signed24(word - int(own[R_INPUT]))
    change = min(max(change, -entry[E_LIMIT]), entry[E_LIMIT])
    own[R_INPUT] = signed24(int(own[R_INPUT]) + change)
    error = _wrapped(own[R_INPUT] - own[R_OUTPUT])
    own[R_INTEGRAL] += entry[E_SECOND] / 8388608.0 * error
    step = entry[E_GAIN] / 8388608.0 * error + own[R_INTEGRAL]
    own[R_OUTPUT] = _wrapped(own[R_OUTPUT] + step)
    result: int = math.floor(own[R_OUTPUT])
    return result


@njit(cache=True)
def _triggered(x: Space, y: Space, entry: IntArray) -> int:
    """Triggered time base; the first result line holds the position in 1/256 count.

    A trigger turns the method digit from armed to running, in the setup line, too.
    """
    source, first = entry[E_SOURCE], entry[E_FIRST]
    extended = (int(x[source + 2]) >> 1) << 8
    if y[source] > 0:
        extended += min(int(y[source + 1]) * 256 // int(y[source]), 255)
    before = int(x[first])
    x[first] = extended & _WORD
    if entry[E_METHOD] == METHOD_FROZEN:
        x[source] &= ~_TRIGGERED  # reading the captured position makes ready for the next
        return 0
    if entry[E_METHOD] == METHOD_ARMED:
        if not x[source] & _TRIGGERED:
            return 0
        entry[E_METHOD] = METHOD_RUNNING
        y[first] = (int(y[first]) & 0x0FFFFF) | 0xA00000
        before = int(x[source + 3]) << 8
    return int(2 * entry[E_GAIN] * signed24(extended - before))


@njit(cache=True)
def _sine_cosine(x: Space, y: Space, entry: IntArray, own: FloatArray) -> int:
    """Entries that read a pair of converters: interpolator, resolver and their diagnostics."""
    method = entry[E_METHOD]
    place = entry[E_SECOND] if method == METHOD_INTERPOLATOR else entry[E_SOURCE]
    raw_sine, raw_cosine = signed24(int(y[place])), signed24(int(y[place + 1]))
    if method == METHOD_BIAS:
        return int(_bias_word(y, entry, own, raw_sine >> 12, raw_cosine >> 12))
    sine = raw_sine / 8388608.0 + _signed12(entry[E_GAIN] >> 12) / 2048.0
    cosine = raw_cosine / 8388608.0 + _signed12(entry[E_GAIN]) / 2048.0
    if method == METHOD_MAGNITUDE:
        return int(min((sine * sine + cosine * cosine) * 8388608.0, 16777215.0))
    if method == METHOD_INTERPOLATOR:
        turn = math.atan2(sine, cosine) / (2.0 * math.pi) * 4096.0
        # The counter says which line it is: four counts a line, each a quarter from its mark on.
        about = (int(x[entry[E_SOURCE] + 2]) >> 1) * 1024.0 + 512.0
        return math.floor(turn + 4096.0 * math.floor((about - turn) / 4096.0 + 0.5))
    if signed24(int(y[entry[E_SECOND]])) < 0:  # phase of the excitation
        sine, cosine = -sine, -cosine
    turn = math.atan2(sine, cosine) / (2.0 * math.pi) * 131072.0
    turn = -turn if entry[E_WIDTH] else turn
    change = turn - own[R_INPUT]
    change -= 131072.0 * math.floor(change / 131072.0 + 0.5)
    own[R_INPUT] = turn
    own[R_OUTPUT] = _wrapped(own[R_OUTPUT] + change)
    result: int = math.floor(own[R_OUTPUT])
    return result


@njit(cache=True)
def _bias_word(y: Space, entry: IntArray, own: FloatArray, sine: int, cosine: int) -> int:
    """Bias terms from the extremes seen so far; bit 1 of the second line starts anew."""
    if not entry[E_SHIFT]:
        own[R_INPUT] = own[R_OUTPUT] = sine
        own[R_HIGH] = own[R_LOW] = cosine
        entry[E_SHIFT] = 2
        y[entry[E_FIRST] + 1] |= 2
    own[R_INPUT], own[R_OUTPUT] = max(own[R_INPUT], sine), min(own[R_OUTPUT], sine)
    own[R_HIGH], own[R_LOW] = max(own[R_HIGH], cosine), min(own[R_LOW], cosine)
    first = -math.floor((own[R_INPUT] + own[R_OUTPUT]) / 2.0)
    second = -math.floor((own[R_HIGH] + own[R_LOW]) / 2.0)
    return int(((first & 0xFFF) << 12) | (second & 0xFFF))


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
    entries = np.zeros((ECT_LINES, N_ENTRY), dtype=np.int64)
    return entries, np.zeros((ECT_LINES, N_REMEMBERED))
