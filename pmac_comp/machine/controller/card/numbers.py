"""Values in the nine digits that survive the way to a P-variable and back.

The reading of the card's numbers is ``machine.wire.numbers``; here is only what the controller
layer rounds and compares. Imports ``base`` and ``machine.wire``.
"""

import math
from typing import Final

import numpy as np

from pmac_comp.base.errors import LocalProtocolError, NonFinite, RemoteProtocolError
from pmac_comp.machine.wire.numbers import read_number

SIGNIFICANT_DIGITS: Final = 9
DECIMALS: Final = 10
MANTISSA_LIMIT: Final = 1 << 35


def nine_digits(value: float) -> str:
    """Plain decimal text of a value with at most nine digits and ten decimals, no exponent.

    The 48-bit registers hold 10.5 digits (Software Reference Manual p. 486) and are printed with
    at most eleven decimals, the last ones cut (real backups); this much survives the way there and
    back.

    Raises
    ------
    NonFinite
        NaN or infinity.
    """
    if not math.isfinite(value):
        raise NonFinite(f"{value} cannot be sent to the controller.", code="PC-NUM-001")
    value = round(value, DECIMALS)
    if value == 0.0:
        return "0"
    text = np.format_float_positional(
        value, precision=SIGNIFICANT_DIGITS, fractional=False, trim="-"
    )
    return "0" if text in {"-0", "0"} else str(text)


def plain(value: float) -> str:
    """Decimal text of an integer or a float for a command; integers keep all digits.

    Raises
    ------
    LocalProtocolError
        An integer with more bits than the register holds.
    """
    if math.isfinite(value) and value == int(value):
        number = int(value)
        if abs(number) >= MANTISSA_LIMIT:
            raise LocalProtocolError(
                f"{number} has more digits than a register holds.", code="PC-NUM-002"
            )
        return str(number)
    return nine_digits(float(value))


def parse_integer(text: str) -> int:
    """Integer of a decimal or ``$hex`` answer; raises RemoteProtocolError otherwise."""
    if text.isascii() and text.isdigit():
        return int(text)
    value = read_number(text)
    if value != int(value):
        raise RemoteProtocolError(
            f"The controller answered {text!r} where an integer was expected.", code="PC-NUM-003"
        )
    return int(value)
