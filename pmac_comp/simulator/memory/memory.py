"""The two 24-bit data spaces of the simulated card, and the number formats laid over them.

Every word is kept raw (0..0xFFFFFF) in an ``int32`` array per space, so that the servo task, the
language, the gather engines and the dual-ported RAM windows all read and write the same cells.
Source: Turbo PMAC Software Reference Manual p. 495-512 (memory map), Turbo PMAC User Manual
p. 241-248 (48-bit float), p. 401-402 (dual-ported RAM cells).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Space = NDArray[np.int32]
WORDS = 0x80000
LONG_MASK = 0xFFFFFFFFFFFF
LARGEST_LONG = LONG_MASK >> 1  # of a 48-bit register
DPRAM_START = 0x060000
DPRAM_END_SMALL = 0x061000
DPRAM_END_LARGE = 0x064000
FIELD_WIDTHS = (1, 4, 8, 12, 16, 20, 24)  # of a part of a word that an M-variable names


@njit(cache=True)
def signed24(value: int) -> int:
    """Signed integer that the low 24 bits of a value are."""
    value &= 0xFFFFFF
    return value - 0x1000000 if value >= 0x800000 else value


@njit(cache=True)
def read_word_signed(space: Space, address: int) -> int:
    """Return the 24-bit word at `address` of one space as a signed integer."""
    word = np.int64(space[address])
    return int(word - 0x1000000 if word >= 0x800000 else word)


@njit(cache=True)
def read_long(x: Space, y: Space, address: int) -> int:
    """Return the signed 48-bit integer X:Y (X is the high half)."""
    high = np.int64(x[address])
    if high >= 0x800000:
        high -= 0x1000000
    return int(high * 16777216 + np.int64(y[address]))


@njit(cache=True)
def write_long(x: Space, y: Space, address: int, value: int) -> None:
    """Store the low 48 bits of an integer as X:Y."""
    bits = np.int64(value)
    y[address] = bits & 0xFFFFFF
    x[address] = (bits >> 24) & 0xFFFFFF


def saturated_long(value: float) -> int:
    """Nearest integer that a 48-bit register holds."""
    return round(min(max(value, -LARGEST_LONG), LARGEST_LONG))


@njit(cache=True)
def decode_float48(high: int, low: int) -> float:
    """Decode a 48-bit float: 36-bit two's complement mantissa, 12-bit exponent (normal or not)."""
    mantissa_high = np.int64(high)
    if mantissa_high >= 0x800000:
        mantissa_high -= 0x1000000
    mantissa = mantissa_high * 4096 + (np.int64(low) >> 12)
    if mantissa == 0:
        return 0.0
    exponent = np.int64(low) & 0xFFF
    return math.ldexp(float(mantissa), int(exponent - 2047 - 35))


@njit(cache=True)
def encode_float48(value: float) -> tuple[int, int]:
    """Return (X, Y) of `value` in the card's 48-bit float, rounded to nearest and saturated."""
    if value == 0.0 or math.isnan(value):
        return 0, 0
    fraction, exponent = math.frexp(value)
    mantissa = np.int64(math.floor(fraction * 34359738368.0 + 0.5))
    if mantissa == 34359738368:
        mantissa = np.int64(17179869184)
        exponent += 1
    elif mantissa == -17179869184:
        mantissa = np.int64(-34359738368)
        exponent -= 1
    biased = np.int64(exponent) + 2047
    if biased < 0:
        return 0, 0
    if biased > 4095:
        biased = np.int64(4095)
        mantissa = np.int64(34359738367) if value > 0 else np.int64(-34359738368)
    return int((mantissa >> 12) & 0xFFFFFF), int(((mantissa & 0xFFF) << 12) | biased)


@njit(cache=True)
def read_float48(x: Space, y: Space, address: int) -> float:
    """Return the 48-bit float at L:`address`."""
    return float(decode_float48(x[address], y[address]))


@njit(cache=True)
def write_float48(x: Space, y: Space, address: int, value: float) -> None:
    """Store a 48-bit float at L:`address`."""
    high, low = encode_float48(value)
    x[address] = high
    y[address] = low


@njit(cache=True)
def read_dpram32(x: Space, y: Space, address: int) -> int:
    """Return the raw 32-bit cell of dual-ported RAM (Y low 16 bits, X high 16 bits)."""
    return int((np.int64(x[address]) & 0xFFFF) * 65536 + (np.int64(y[address]) & 0xFFFF))


@njit(cache=True)
def write_dpram32(x: Space, y: Space, address: int, value: int) -> None:
    """Store the low 32 bits of an integer in a cell of dual-ported RAM."""
    bits = np.int64(value)
    y[address] = bits & 0xFFFF
    x[address] = (bits >> 16) & 0xFFFF


class Memory:
    """X and Y spaces, program words and the change counter of one card.

    Attributes
    ----------
    x, y : ndarray of int32, shape (0x80000,)
        Raw 24-bit words.
    dirty : ndarray of int64, shape (1,)
        Bumped whenever the host side or a program writes a register that the servo task may have
        decoded and cached.
    program : dict
        P-space words written by ``WP`` (user-written servo and compiled code).
    """

    def __init__(self) -> None:
        self.x: NDArray[np.int32] = np.zeros(WORDS, dtype=np.int32)
        self.y: NDArray[np.int32] = np.zeros(WORDS, dtype=np.int32)
        self.dirty: NDArray[np.int64] = np.zeros(1, dtype=np.int64)
        self.program: dict[int, int] = {}

    def touch(self) -> None:
        """Tell the servo task that some register was written."""
        self.dirty[0] += 1

    def clear(self) -> None:
        """Zero both spaces, as at power-up before the flash image is copied."""
        self.x[:] = 0
        self.y[:] = 0
        self.program.clear()
        self.touch()

    def read_bytes(self, offset: int, size: int) -> bytes:
        """Return dual-ported RAM bytes as the host sees them (little-endian 32-bit cells)."""
        first, last = offset // 4, (offset + size + 3) // 4
        cells = np.empty(2 * (last - first), dtype="<u2")
        start, stop = DPRAM_START + first, DPRAM_START + last
        cells[0::2] = self.y[start:stop] & 0xFFFF
        cells[1::2] = self.x[start:stop] & 0xFFFF
        skip = offset - 4 * first
        return cells.tobytes()[skip : skip + size]

    def write_bytes(self, offset: int, data: bytes) -> None:
        """Store host bytes into dual-ported RAM; only the touched 16-bit words change."""
        first, last = offset // 2, (offset + len(data) + 1) // 2
        raw = bytearray(self.read_bytes(2 * first, 2 * (last - first)))
        raw[offset - 2 * first : offset - 2 * first + len(data)] = data
        halves = np.frombuffer(bytes(raw), dtype="<u2")
        for index, half in enumerate(halves, start=first):
            space = self.x if index % 2 else self.y
            space[DPRAM_START + index // 2] = int(half)
        self.touch()
