"""How the card prints numbers and reads addresses."""

from __future__ import annotations

import math
import sys
from decimal import Decimal


def finite(value: float) -> float:
    """Value as a double holds it: the card's own floating-point range is wider."""
    if math.isfinite(value):
        return float(value)
    return 0.0 if math.isnan(value) else math.copysign(sys.float_info.max, value)


def format_number(value: float) -> str:
    """Value with up to ten significant digits, no exponent, no trailing zeros; ``0`` for zero.

    Source: answers of real machines (0.0005, 3.444444444, -5797.53).
    """
    if value == int(value) and abs(value) < 2**48:
        return str(int(value))
    text = f"{Decimal(f'{value:.10g}'):f}"
    if "." in text:
        text = text.rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def format_rounded(value: float, step: float) -> str:
    """Value rounded to the nearest multiple of a step (1/32 count, 0.1 count)."""
    rounded = round(value / step) * step
    text = f"{rounded:.5f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def format_hex(value: int) -> str:
    """Address or mask in the short hexadecimal form ``$78002``."""
    return f"${value & 0xFFFFFF:X}"
