"""Numbers in the plain decimal form that a Turbo PMAC reads and prints.

No exponent, no locale, no negative zero: ``1e-07`` would be read as 1 followed by an error. Imports
``base`` only.
"""

import math
from typing import Final

import numpy as np

from pmac_comp.base.errors import LocalProtocolError, NonFinite, RemoteProtocolError

SIGNIFICANT_DIGITS: Final = 9
WORD_24: Final = 1 << 24
WORD_48: Final = 1 << 48


def nine_digits(value: float) -> str:
    """Plain decimal text of a value with nine significant digits, no exponent.

    The 48-bit registers hold 10.5 digits and print ten, so nine survive the way there and back
    (Software Reference Manual p. 486).

    Raises
    ------
    NonFinite
        NaN or infinity.
    """
    if not math.isfinite(value):
        raise NonFinite(f"{value} cannot be sent to the controller.", code="PC-NUM-001")
    if value == 0.0:
        return "0"
    text = np.format_float_positional(
        value, precision=SIGNIFICANT_DIGITS, fractional=False, trim="-"
    )
    return "0" if text in {"-0", "0"} else str(text)


def plain(value: float) -> str:
    """Decimal text of an integer or a float for a command; integers keep all digits."""
    if isinstance(value, int | np.integer) or (math.isfinite(value) and value == int(value)):
        number = int(value)
        if abs(number) < 10**SIGNIFICANT_DIGITS:
            return str(number)
        if abs(number) >= 1 << 35:
            raise LocalProtocolError(f"{number} has more digits than a register holds.")
        return str(number)
    return nine_digits(float(value))


def parse_number(text: str) -> float:
    """Value of a decimal or ``$hex`` answer.

    Raises
    ------
    RemoteProtocolError
        The text is no number.
    """
    item = text.strip()
    try:
        if item.startswith("$"):
            return float(int(item[1:], 16))
        if not item or not set(item) <= set("+-.0123456789"):
            raise ValueError(item)  # noqa: TRY301 - one place turns both into the same error
        return float(item)
    except ValueError as error:
        raise RemoteProtocolError(
            f"The controller answered {text!r} where a number was expected.", code="PC-NUM-002"
        ) from error


def parse_integer(text: str) -> int:
    """Integer of a decimal or ``$hex`` answer; raises RemoteProtocolError otherwise."""
    value = parse_number(text)
    if value != int(value):
        raise RemoteProtocolError(
            f"The controller answered {text!r} where an integer was expected.", code="PC-NUM-003"
        )
    return int(value)


def signed(value: int, modulus: int = WORD_24) -> int:
    """Two's-complement reading of a raw word: -1 reads as -1."""
    value %= modulus
    return value - modulus if value >= modulus // 2 else value
