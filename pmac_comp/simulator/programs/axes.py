"""Axis definitions of coordinate systems: ``#1->10000X+5``.

Source: Turbo PMAC Software Reference Manual p. 276-277, 400, 497-503.
"""

from __future__ import annotations

from dataclasses import dataclass

from pmac_comp.simulator.language.scanner import Scanner
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.numbers import format_number

# Axis code of status word 2, bits 16-18.
AXIS_CODES = {"A": 1, "B": 2, "C": 3, "U": 4, "V": 4, "W": 4, "X": 7, "Y": 7, "Z": 7}


@dataclass(frozen=True)
class AxisDefinition:
    """Motor position in counts = sum of scale times axis position, plus an offset.

    Parameters
    ----------
    terms : tuple of (str, float)
        Axis letter and counts per axis unit.
    offset : float
        Counts.
    """

    terms: tuple[tuple[str, float], ...]
    offset: float = 0.0

    @property
    def code(self) -> int:
        """Axis code of status word 2."""
        return AXIS_CODES[self.terms[0][0]]

    def text(self) -> str:
        """Form in which it is reported."""
        parts: list[str] = []
        for letter, scale in self.terms:
            number = "" if scale == 1.0 else "-" if scale == -1.0 else format_number(scale)
            sign = "+" if parts and scale > 0 else ""
            parts.append(f"{sign}{number}{letter}")
        if self.offset:
            sign = "+" if self.offset > 0 else ""
            parts.append(f"{sign}{format_number(self.offset)}")
        return "".join(parts)


def read_definition(scanner: Scanner) -> AxisDefinition | None:
    """Take the right side of ``#n->``; None for ``0``, which clears the definition.

    Raises
    ------
    CardError
        ERR003 for what the simulated card does not support (``I``) or does not understand.
    """
    terms: list[tuple[str, float]] = []
    offset = 0.0
    first = True
    while first or scanner.peek() in ("+", "-"):
        sign = 1.0
        if scanner.take("-"):
            sign = -1.0
        elif not first:
            scanner.expect("+")
        first = False
        number = scanner.number()
        letter = scanner.take(*AXIS_CODES)
        if letter is not None:
            terms.append((letter, sign * (1.0 if number is None else number)))
        elif number is not None:
            offset += sign * number
        else:
            raise CardError(3, f"axis definition expected at '{scanner.rest}'")
    if not terms:
        if offset:
            raise CardError(3)
        return None
    return AxisDefinition(tuple(terms), offset)
