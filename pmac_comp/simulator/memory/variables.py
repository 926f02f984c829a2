"""I, P, Q and M variables as the language sees them: reading, storing, printing.

What lives here: the Python side of the registers that `vm` reaches in compiled code, definitions of
M-variables, factory values. Source: Turbo PMAC Software Reference Manual p. 327-330, 354-359, 383.
"""

from __future__ import annotations

import re
from functools import cache

import numpy as np
from numpy.typing import NDArray

from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory import vm
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.ivariables import TABLE, channel_address, compiled_table, lock_group
from pmac_comp.simulator.memory.memory import FIELD_WIDTHS, Memory, read_float48, write_float48
from pmac_comp.simulator.memory.numbers import finite, format_hex, format_number

_FORMATS = {"U": vm.M_UNSIGNED, "S": vm.M_SIGNED, "D": vm.M_BCD, "C": vm.M_COMPLEMENT}
_FORMAT_NAMES = {code: name for name, code in _FORMATS.items()}
_WHOLE_CELL = {"D": vm.M_D, "L": vm.M_L, "DP": vm.M_DP, "F": vm.M_F}
_WHOLE_NAMES = {code: name for name, code in _WHOLE_CELL.items()}
_NIBBLE = 4  # all fields but single bits begin at a multiple of this


class Variables:
    """The four kinds of variables over one memory."""

    def __init__(self, memory: Memory) -> None:
        self.memory = memory
        self.imap, self.iscale = _shared_table()

    # --- values ---------------------------------------------------------------------------------

    def read(self, kind: str, number: int, cs: int = 1) -> float:
        """Value of ``I``, ``P``, ``Q`` or ``M`` variable `number` (Q in the window of `cs`)."""
        m = self.memory
        if kind == "P":
            return finite(read_float48(m.x, m.y, r.P_VARIABLES + (number & 8191)))
        if kind == "Q":
            return finite(read_float48(m.x, m.y, self.q_address(cs, number)))
        if kind == "M":
            return finite(vm.read_m(m.x, m.y, number))
        return self.read_i(number)

    def write(self, kind: str, number: int, value: float, cs: int = 1) -> None:
        """Store a variable as an on-line assignment does."""
        m = self.memory
        if kind == "P":
            write_float48(m.x, m.y, r.P_VARIABLES + (number & 8191), value)
        elif kind == "Q":
            write_float48(m.x, m.y, self.q_address(cs, number), value)
        elif kind == "M":
            vm.write_m(m.x, m.y, m.dirty, number, value)
        else:
            self.write_i(number, value)

    def read_i(self, number: int) -> float:
        """Value of an I-variable."""
        m = self.memory
        return float(vm.read_i(m.x, m.y, self.imap, self.iscale, number))

    def int_i(self, number: int) -> int:
        """Value of an I-variable that holds a whole number."""
        return int(self.read_i(number))

    def write_i(self, number: int, value: float) -> None:
        """Store an I-variable.

        Raises
        ------
        CardError
            ERR003 for a variable the simulated card does not act on, unless the value is the one
            it has. Locked groups (I41) are ignored silently, as on the card.
        """
        if int(self.read_i(41)) & lock_group(number):
            return
        if TABLE[number & 8191].fixed:
            if abs(value - self.read_i(number)) > 1e-6 * max(1.0, abs(value)):
                raise CardError(3, f"I{number} is not supported by the simulated card")
            return
        m = self.memory
        vm.write_i(m.x, m.y, m.dirty, self.imap, self.iscale, number, value)

    def write_float(self, address: int, value: float) -> None:
        """Store a 48-bit float register."""
        write_float48(self.memory.x, self.memory.y, address, value)

    def q_address(self, cs: int, number: int) -> int:
        """Cell of a Q-variable seen from a coordinate system."""
        start = int(self.memory.y[r.cs_base(cs)])
        return r.Q_VARIABLES + ((start - r.Q_VARIABLES + number) & 8191)

    def default_i(self, number: int) -> None:
        """Return an I-variable to its factory value (``I130=*``)."""
        entry = TABLE[number & 8191]
        if entry.kind != vm.I_ABSENT:
            m = self.memory
            vm.write_i(m.x, m.y, m.dirty, self.imap, self.iscale, number, entry.default)

    def address_of(self, number: int) -> int:
        """Address of the register of an I-variable (``I103=@I8000``)."""
        entry = TABLE[number & 8191]
        if entry.kind == vm.I_ABSENT:
            raise CardError(3, f"I{number} has no register")
        return entry.address

    # --- printing -------------------------------------------------------------------------------

    def text(self, kind: str, number: int, cs: int = 1) -> str:
        """Value as the answer to a query, short form."""
        value = self.read(kind, number, cs)
        if kind == "I" and TABLE[number & 8191].is_hex and self.int_i(9) & 2:
            return format_hex(int(value))
        return format_number(value)

    def answer(self, kind: str, number: int, cs: int = 1) -> str:
        """Answer to a query in the form I9 asks for."""
        text = self.text(kind, number, cs)
        return f"{kind}{number}={text}" if self.int_i(9) & 1 else text

    # --- M definitions --------------------------------------------------------------------------

    def define_m(self, number: int, kind: int, address: int, packed: int = 0) -> None:
        """Write the definition words of an M-variable."""
        cell = r.M_DEFINITIONS + (number & 8191)
        self.memory.x[cell] = (kind << 20) | packed
        self.memory.y[cell] = address & 0xFFFFFF

    def define_m_text(self, number: int, text: str) -> None:
        """Define an M-variable from text such as ``X:$B0,8,16,S`` or ``*``."""
        if text == "*":
            self.define_m(number, vm.M_SELF, 0)
            return
        match = re.fullmatch(r"(DP|X|Y|D|L|F):?(\$[0-9A-F]+|\d+)((?:,\w+)*)", text)
        if match is None:
            raise CardError(3, f"'{text}' is no M-variable definition")
        kind, address_text, rest = match.groups()
        base16 = address_text.startswith("$")
        address = int(address_text[1:], 16) if base16 else int(address_text)
        if address > 0xFFFFFF:
            raise CardError(3)
        if kind in _WHOLE_CELL:
            if rest:
                raise CardError(3)
            self.define_m(number, _WHOLE_CELL[kind], address)
            return
        packed = _pack_field(rest[1:].split(",") if rest else [])
        self.define_m(number, vm.M_X if kind == "X" else vm.M_Y, address, packed)

    def definition(self, number: int) -> str:
        """Text of an M-variable definition as ``M5->`` answers it."""
        cell = r.M_DEFINITIONS + (number & 8191)
        word, address = int(self.memory.x[cell]), int(self.memory.y[cell])
        kind = word >> 20
        if kind == vm.M_SELF or kind > vm.M_F:
            text = "*"
        elif kind in _WHOLE_NAMES:
            text = f"{_WHOLE_NAMES[kind]}:${address:X}"
        else:
            text = ("X" if kind == vm.M_X else "Y") + f":${address:X}" + _field_text(word)
        return f"M{number}->{text}" if self.int_i(9) & 1 else text

    # --- factory state --------------------------------------------------------------------------

    def set_factory_values(self) -> None:
        """Give every I-variable its default, and Q windows their start."""
        for number in range(8192):
            self.default_i(number)
        for cs in range(1, r.COORDINATE_SYSTEMS + 1):
            self.memory.y[r.cs_base(cs)] = r.Q_VARIABLES + 512 * (cs - 1)
        self.memory.x[r.P_BASE] = r.P_VARIABLES

    def set_factory_memory(self) -> None:
        """Give a cleared memory its factory values and suggested definitions."""
        x, y = _factory_words()
        self.memory.x[: len(x)] = x
        self.memory.y[: len(y)] = y
        self.memory.touch()

    def set_suggested_definitions(self) -> None:
        """Define the M-variables as the maker suggests for Turbo PMAC2; the rest are ``*``."""
        for number in range(8192):
            self.define_m(number, vm.M_SELF, 0)
        for number, text in suggested_definitions().items():
            self.define_m_text(number, text)


@cache
def _shared_table() -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    return compiled_table()


@cache
def _factory_words() -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Words of a memory with factory values and suggested definitions only."""
    variables = Variables(Memory())
    variables.set_factory_values()
    variables.set_suggested_definitions()
    end = r.USER_BUFFER_START
    return variables.memory.x[:end].copy(), variables.memory.y[:end].copy()


def _pack_field(parts: list[str]) -> int:
    """Pack ``offset[,width[,format]]`` or ``24[,format]`` into the definition word."""
    try:
        first = int(parts[0]) if parts else 0
    except ValueError as error:
        raise CardError(3) from error
    if first == 24:
        offset, width, rest = 0, 24, parts[1:]
    elif len(parts) >= 2 and parts[1].isdigit():
        offset, width, rest = first, int(parts[1]), parts[2:]
    else:
        offset, width, rest = first, 1, parts[1:]
    if len(rest) > 1 or width not in FIELD_WIDTHS or offset + width > 24:
        raise CardError(3)
    if width > 1 and offset % _NIBBLE:  # p. 360
        raise CardError(3)
    form = rest[0] if rest else "U"
    if form not in _FORMATS:
        raise CardError(3)
    return (_FORMATS[form] << 12) | (width << 6) | offset


def _field_text(word: int) -> str:
    offset, width, form = word & 63, (word >> 6) & 63, (word >> 12) & 15
    if width == 24:
        text = ",24"
    elif width == 1 and form == vm.M_UNSIGNED:
        return f",{offset}"
    else:
        text = f",{offset},{width}"
    return text if form == vm.M_UNSIGNED else f"{text},{_FORMAT_NAMES[form]}"


_MOTOR_M = {
    30: "Y+40,11",
    31: "X+30,21",
    32: "X+30,22",
    33: "X+30,13",
    35: "X+30,15",
    37: "X+30,17",
    38: "X+30,18",
    39: "X+30,19",
    40: "Y+40,0",
    41: "Y+40,1",
    42: "Y+40,2",
    43: "Y+40,3",
    44: "Y+40,13",
    45: "Y+40,10",
    46: "Y+40,6",
    47: "Y+40,5",
    48: "Y+40,8",
    49: "Y+40,9",
    61: "D+8",
    62: "D+B",
    63: "D+47",
    64: "D+4C",
    66: "X+1D,24,S",
    67: "D+D",
    68: "X+3F,8,16,S",
    69: "D+10",
    72: "L+57",
    73: "Y+4E,24,S",
    74: "D+6F",
    79: "X+2E,8,16,S",
    91: "L+4F",
    92: "L+50",
    93: "L+51",
    94: "L+52",
}
_CHANNEL_M = {
    1: ("X", 1, "24,S"),
    2: ("Y", 2, "8,16,S"),
    3: ("X", 3, "24,S"),
    14: ("X", 5, "14"),
    17: ("X", 0, "11"),
    20: ("X", 0, "16"),
    21: ("X", 0, "17"),
    22: ("X", 0, "18"),
    23: ("X", 0, "15"),
}


def suggested_definitions() -> dict[int, str]:
    """Maker's suggested M-variable definitions: motors 1-32, coordinate systems, clocks."""
    table = {70: "X:$FFFF8C,24", 71: "X:$37,24", 72: "Y:$37,24", 73: "Y:$B,24", 100: "X:$0,24"}
    for motor in range(1, r.MOTORS + 1):
        for k, place in _MOTOR_M.items():
            kind, rest = place.split("+")
            offset, _, field = rest.partition(",")
            address = r.motor_base(motor) + int(offset, 16)
            table[100 * motor + k] = f"{kind}:${address:X}" + (f",{field}" if field else "")
        if motor <= 8:
            for k, (kind, step, field) in _CHANNEL_M.items():
                table[100 * motor + k] = f"{kind}:${channel_address(motor) + step:X},{field}"
    for cs in range(1, r.COORDINATE_SYSTEMS + 1):
        base = r.cs_base(cs)
        table[5000 + 100 * cs + 87] = f"Y:${base + 0x3F:X},17"
        table[5000 + 100 * cs + 80] = f"X:${base + 0x40:X},0"
        table[5000 + 100 * cs + 97] = f"X:${base:X},0,24,S"
        table[5000 + 100 * cs + 98] = f"X:${base + 2:X},0,24,S"
    return table
