"""Numbers as text and as register words, the same for host and controller.

What lives here: decimal text without exponents, ``$`` hexadecimal, 24- and 48-bit integers and the
48-bit floating-point register. Imports only numpy and the error tree.

Source: Turbo PMAC User Manual pp. 241-248 (floating-point register), Software Reference Manual
pp. 486-489; text forms as real configuration backups show them.
"""

import math
import re
from decimal import Decimal

import numpy as np

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.base.errors import LocalProtocolError, RemoteProtocolError

WORD_48 = 1 << 48
_MAX_NUMBER_TEXT = 40
_MANTISSA_BITS = 35
_EXPONENT_BIAS = 2047
_DECIMAL = re.compile(r"-?(\d+\.?\d*|\.\d+)")
_HEXADECIMAL = re.compile(r"\$[0-9A-Fa-f]+")


# Text --------------------------------------------------------------------------------------------


def number_text(value: float) -> str:
    """Shortest plain decimal text that reads back as exactly ``value``.

    The controller's parser knows no exponent: ``1e-07`` would be read as 1 followed by rubbish.

    Raises
    ------
    LocalProtocolError
        For NaN, infinities, and values that need more than 40 characters.
    """
    if isinstance(value, int) and not isinstance(value, bool):
        text = str(value)
    elif not math.isfinite(value):
        raise LocalProtocolError(f"{value} cannot be sent to a controller")
    else:
        text = np.format_float_positional(value, trim="-")
    if len(text) > _MAX_NUMBER_TEXT:
        raise LocalProtocolError(
            f"{value!r} needs {len(text)} characters as a plain decimal",
            hint="Scale the quantity so that it lies between 1e-20 and 1e20.",
        )
    return "0" if text == "-0" else text


def hex_text(value: int) -> str:
    """``$`` and upper-case hexadecimal without leading zeros, as the card prints addresses."""
    if value < 0:
        raise LocalProtocolError(f"{value} is negative and has no $ form")
    return f"${value:X}"


def read_number(text: str) -> int | float:
    """Value of a number the controller printed: decimal, or ``$`` hexadecimal.

    Integers come back as int, so that no digit of a 48-bit word is lost.

    Raises
    ------
    RemoteProtocolError
        If the text is anything else.
    """
    stripped = text.strip()
    digits = stripped[1:] if stripped.startswith("-") else stripped
    if digits.isascii() and digits.isdecimal():
        return int(stripped)
    if _HEXADECIMAL.fullmatch(stripped):
        return int(stripped[1:], 16)
    if not _DECIMAL.fullmatch(stripped):
        raise RemoteProtocolError(f"'{text}' is no number")
    return float(stripped) if "." in stripped else int(stripped)


def card_number_text(value: float) -> str:
    """A value as the card prints it: no exponent, no trailing zeros, 12 digits at most.

    Digits behind the last are cut, not rounded: a real backup shows 0.19999992847 for
    1677721/2^23 and 0.9998474121 for 32763/32768.
    """
    magnitude = abs(value)
    digits_before = len(str(int(magnitude)))
    places = max(0, 12 - digits_before)
    # The decimal expansion of a binary fraction is exact here, so cutting it is well defined.
    text = f"{Decimal(magnitude).quantize(Decimal(1).scaleb(-places), 'ROUND_DOWN'):f}"
    if "." in text:
        text = text.rstrip("0").rstrip(".")
    return f"-{text}" if value < 0 and text != "0" else text


# Registers ---------------------------------------------------------------------------------------


def signed_24(word: int) -> int:
    """Two's-complement value of a 24-bit word: FFFFFF reads as -1."""
    return ((word + 0x800000) & 0xFFFFFF) - 0x800000


def signed_48(word: int) -> int:
    """Two's-complement value of a 48-bit word."""
    return ((word + WORD_48 // 2) & (WORD_48 - 1)) - WORD_48 // 2


def split_48(value: int) -> tuple[int, int]:
    """High (X) and low (Y) 24-bit words of a 48-bit integer."""
    if not -(WORD_48 // 2) <= value < WORD_48:
        raise LocalProtocolError(f"{value} does not fit 48 bits")
    return (value >> 24) & 0xFFFFFF, value & 0xFFFFFF


def join_48(high: int, low: int) -> int:
    """48-bit signed integer of an X word and a Y word."""
    return signed_48(((high & 0xFFFFFF) << 24) | (low & 0xFFFFFF))


def encode_float_48(value: float) -> int:
    """48-bit register of a floating-point value, rounded to the 36-bit mantissa.

    The word is mantissa (36 bit, two's complement) then exponent (12 bit, offset 2047); zero is
    all zeros. 1.0 is ``400000000800``.

    Raises
    ------
    LocalProtocolError
        For NaN, infinities and magnitudes beyond the exponent.
    """
    if not math.isfinite(value):
        raise LocalProtocolError(f"{value} has no register form")
    if value == 0.0:
        return 0
    fraction, exponent = math.frexp(value)
    mantissa = round(fraction * (1 << _MANTISSA_BITS))
    if mantissa == 1 << _MANTISSA_BITS:
        mantissa, exponent = mantissa >> 1, exponent + 1
    elif mantissa == -(1 << (_MANTISSA_BITS - 1)):
        mantissa, exponent = mantissa << 1, exponent - 1  # negative mantissas run down to -1
    biased = exponent + _EXPONENT_BIAS
    if not 0 <= biased <= 0xFFF:
        raise LocalProtocolError(f"{value!r} is beyond the register's exponent")
    return ((mantissa & 0xFFFFFFFFF) << 12) | biased


def decode_float_48(word: int) -> float:
    """Value of a 48-bit floating-point register; words that are not normalised are read too.

    The register's exponent reaches further than a double's: what is beyond comes back as an
    infinity, which no later step accepts.
    """
    mantissa = (word >> 12) & 0xFFFFFFFFF
    mantissa -= (mantissa >> _MANTISSA_BITS) << (_MANTISSA_BITS + 1)
    try:
        return math.ldexp(mantissa, (word & 0xFFF) - _EXPONENT_BIAS - _MANTISSA_BITS)
    except OverflowError:
        return math.copysign(math.inf, mantissa)


def register_value(value: float) -> float:
    """What a P- or Q-variable holds after ``value`` was assigned to it."""
    return decode_float_48(encode_float_48(value))


def signed_24_array(words: IntArray) -> IntArray:
    """Signed values of 24-bit words, any shape."""
    return ((np.asarray(words, dtype=np.int64) + 0x800000) & 0xFFFFFF) - 0x800000


def join_48_array(high: IntArray, low: IntArray) -> IntArray:
    """Signed 48-bit values of X words and Y words, any shape."""
    return (signed_24_array(high) << 24) | (np.asarray(low, dtype=np.int64) & 0xFFFFFF)


def float_48_array(high: IntArray, low: IntArray) -> FloatArray:
    """Values of 48-bit floating-point registers given as X and Y words, any shape."""
    joined = join_48_array(high, low)
    exponent = ((joined & 0xFFF) - _EXPONENT_BIAS - _MANTISSA_BITS).astype(np.int32)
    with np.errstate(over="ignore"):
        values = np.ldexp((joined >> 12).astype(np.float64), exponent)
    return np.asarray(values, dtype=np.float64)
