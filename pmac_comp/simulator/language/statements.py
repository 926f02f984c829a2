"""Statements of motion and PLC programs: what a line holds once it has been read.

A statement keeps the bytecode of its expressions and two spellings: short (``DWE``, I9 bit 0 = 0)
and long (``DWELL``). Source: Turbo PMAC Software Reference Manual p. 405-485.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from pmac_comp.simulator.language.expressions import Code

AXES = "ABCUVWXYZ"
MOTION, PLC = "PROG", "PLC"


@dataclass
class Statement:
    """One statement of a program.

    Parameters
    ----------
    kind : str
        What it does; the assembler and the program runners switch on it.
    code : Code
        Bytecode that leaves the arguments on the stack (or, for assignments, stores them).
    arguments : int
        How many values the code leaves.
    short, long : str
        Listing text.
    data : Any
        Anything else the runner needs.
    starts_line : bool
        First of its text line.
    """

    kind: str
    code: Code = field(default_factory=Code)
    arguments: int = 0
    short: str = ""
    long: str = ""
    data: Any = None
    starts_line: bool = True

    @property
    def words(self) -> int:
        """Long words of program memory it takes."""
        if self.kind == "line_end":
            return 0
        return max(1, self.code.tokens) if self.kind != "move" else len(self.data)
