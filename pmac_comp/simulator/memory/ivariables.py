"""Table of the I-variables: where each one lives, its width, its default, how it is printed.

I-variables are registers: the servo task reads gains where the memory map has them. A variable the
simulated card does not act on keeps its default and refuses another value (`fixed`), so that a
set-up which would behave differently on a real card is not accepted in silence.

Source: Turbo PMAC Software Reference Manual p. 35-252 (variables), p. 495-512 (registers).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory.vm import I_ABSENT, I_FLOAT, I_LONG, I_X, I_Y, IT_COLUMNS

COUNT: Final = 8192
CHANNEL_ICS: Final = (
    0x78000,
    0x78100,
    0x78200,
    0x78300,
    0x79200,
    0x79300,
    0x7A200,
    0x7A300,
)


@dataclass(frozen=True)
class IVariable:
    """One I-variable.

    Parameters
    ----------
    kind : int
        Register kind of `vm` (`I_ABSENT`: a constant without register).
    address, offset, width, signed
        Place of its bits.
    scale : float
        Value of one stored unit.
    default : float
        Factory value.
    is_hex : bool
        Printed in hexadecimal when I9 bit 1 is set.
    fixed : bool
        Keeps its default; any other value is refused.
    quiet : bool
        Not cached by the servo task, which reads the register each cycle.
    """

    kind: int
    address: int = 0
    offset: int = 0
    width: int = 24
    signed: bool = False
    scale: float = 1.0
    default: float = 0.0
    is_hex: bool = False
    fixed: bool = False
    quiet: bool = False


def _x(address: int, width: int = 24, **options: float | bool) -> IVariable:
    return IVariable(I_X, address, width=width, **options)  # type: ignore[arg-type]


def _y(address: int, width: int = 24, **options: float | bool) -> IVariable:
    return IVariable(I_Y, address, width=width, **options)  # type: ignore[arg-type]


def _float(address: int, default: float = 0.0, *, fixed: bool = False) -> IVariable:
    return IVariable(I_FLOAT, address, default=default, fixed=fixed)


def _long(address: int) -> IVariable:
    return IVariable(I_LONG, address)


def _fixed(default: float = 0.0, *, is_hex: bool = False) -> IVariable:
    return IVariable(I_ABSENT, default=default, is_hex=is_hex, fixed=True, quiet=True)


def _global_table() -> dict[int, IVariable]:
    def own(number: int, width: int = 24, default: float = 0.0) -> IVariable:
        return _x(r.INTERNAL_GLOBAL + number, width, default=default, quiet=True)

    table: dict[int, IVariable] = {
        0: own(0, 8),
        1: own(1, 2),
        2: own(2, 2, 1),
        3: own(3, 2, 1),
        4: own(4, 2, 1),
        5: own(5, 2, 1),
        6: own(6, 2, 1),
        7: _y(r.PHASE_EXTENSION, 4),
        8: _y(r.RTI_PERIOD, 8, default=2),
        9: own(9, 2, 2),
        10: _x(r.I10_REGISTER, 23, default=3713991),
        11: own(11),
        12: _fixed(),
        13: _x(r.INTERNAL_GLOBAL + 13, 1),
        14: _fixed(),
        15: own(15, 1),
        16: _x(0x1091, default=5, quiet=True),
        17: _x(0x1092, default=10, quiet=True),
        18: _x(0x1093, default=10, quiet=True),
        19: _fixed(7007),
        24: IVariable(
            I_X, r.INTERNAL_GLOBAL + 24, default=0x60000, is_hex=True, fixed=True, quiet=True
        ),
        30: own(30, 1),
        35: _fixed(),
        36: own(36, 1),
        37: _x(r.INTERNAL_GLOBAL + 37, is_hex=True, quiet=True),
        38: _fixed(),
        39: _fixed(),
        40: own(40),
        41: own(41, 4),
        42: own(42, 1),
        43: _fixed(),
        45: _fixed(),
        46: _fixed(),
        47: own(47, 8),
        48: own(48, 1),
        49: own(49, 1),
        50: own(50, 8),
        51: IVariable(I_X, r.GLOBAL_STATUS, offset=14, width=1),
        52: own(52, 4, 7),
        53: own(53, 4),
        54: own(54, 4, 12),
        55: _fixed(),
        57: own(57, 1),
        58: own(58, 1, 1),
        59: own(59, 2),
        60: _x(r.INTERNAL_GLOBAL + 60, 8, default=15),
        61: _x(r.INTERNAL_GLOBAL + 61, 8, default=8),
        62: own(62, 1),
        63: own(63, 1, 1),
        64: own(64, 1, 1),
        65: own(65, 24),
        68: own(68, 4, 15),
    }
    hexes = {*range(20, 24), 37, 67, *range(69, 78), *range(90, 100)}
    for number in range(100):
        table.setdefault(number, _fixed(is_hex=number in hexes))
    return table


def channel_address(motor: int) -> int:
    """First register of the servo IC channel that belongs to a motor by default."""
    ic, channel = divmod(motor - 1, 4)
    return CHANNEL_ICS[ic] + 8 * channel


def _motor_table(motor: int) -> dict[int, IVariable]:
    b = r.motor_base(motor)
    own = r.internal_motor(motor)
    status = b + r.M_STATUS1

    def bits(offset: int, width: int, default: float = 0.0) -> IVariable:
        return IVariable(I_X, status, offset=offset, width=width, default=default)

    def coefficient(address: int) -> IVariable:
        # Notch terms: 24-bit words with 22 fractional bits, -2..+2 (p. 113).
        return _y(address, 24, signed=True, scale=2.0**-22)

    table = {
        0: bits(23, 1, 1.0 if motor == 1 else 0.0),
        1: _fixed(),
        2: _x(b + r.M_IXX02, default=channel_address(motor) + 2, is_hex=True),
        3: _x(b + r.M_IXX03_IXX08, default=r.ECT_BASE + motor - 1, is_hex=True),
        4: _x(b + r.M_IXX04_IXX67, default=r.ECT_BASE + motor - 1, is_hex=True),
        5: _x(b + r.M_IXX05, default=0x35C0, is_hex=True),
        6: bits(4, 2),
        7: _x(b + r.M_IXX07, signed=True, default=96),
        8: _y(b + r.M_IXX03_IXX08, default=96),
        9: _y(b + r.M_IXX65_IXX09, default=96),
        10: _x(own + r.R_IXX10_IXX95, is_hex=True, fixed=True),
        11: _x(b + r.M_IXX11, 23, default=32000),
        12: _y(b + r.M_IXX28_IXX12, 23, default=16000),
        13: _long(b + r.M_IXX13),
        14: _long(b + r.M_IXX14),
        15: _float(b + r.M_IXX15, 0.25),
        16: _float(b + r.M_IXX16, 32.0),
        17: _float(b + r.M_IXX17, 0.5),
        18: _fixed(),
        19: _float(b + r.M_IXX19, 0.15625),
        20: _y(b + r.M_IXX21_IXX20, 23),
        21: _x(b + r.M_IXX21_IXX20, 23, default=50),
        22: _float(b + r.M_IXX22, 32.0),
        23: _float(b + r.M_IXX23, 32.0),
        24: _y(b + r.M_IXX25_IXX24, default=1, is_hex=True),
        25: _x(b + r.M_IXX25_IXX24, default=channel_address(motor), is_hex=True),
        26: _x(b + r.M_IXX26_IXX80, signed=True),
        27: _long(b + r.M_IXX27),
        28: _x(b + r.M_IXX28_IXX12, 23, default=160),
        29: _y(b + r.M_IXX79_IXX29, 16, signed=True, quiet=True),
        30: _y(b + r.M_IXX30, 24, signed=True, default=2000),
        31: _x(b + r.M_IXX31, 24, signed=True, default=1280),
        32: _x(b + r.M_IXX32_IXX60, 24, signed=True, default=1280),
        33: _x(b + r.M_IXX33_IXX63, 23, default=1280),
        34: bits(16, 1, 1.0),
        35: _y(b + r.M_IXX35, 24, signed=True),
        36: coefficient(b + r.M_IXX36),
        37: coefficient(b + r.M_IXX37),
        38: coefficient(b + r.M_IXX38),
        39: coefficient(b + r.M_IXX39),
        40: _x(own + r.R_IXX40, 23, scale=2.0**-23),
        41: _x(b + r.M_IXX41),
        57: _x(b + r.M_IXX57_IXX58, 16, signed=True),
        58: _y(b + r.M_IXX57_IXX58, 23),
        59: bits(8, 2),
        60: _y(b + r.M_IXX32_IXX60, 8),
        63: _y(b + r.M_IXX33_IXX63, 24, signed=True, default=4194304),
        64: _y(b + r.M_IXX64, 24, signed=True),
        65: _x(b + r.M_IXX65_IXX09, 16, default=16),
        67: _y(b + r.M_IXX04_IXX67, 23, default=4194304),
        68: _y(b + r.M_IXX68, 15, quiet=True),
        69: _y(b + r.M_IXX69, 15, offset=8, default=20480),
        79: _x(b + r.M_IXX79_IXX29, 16, signed=True, fixed=True),
        80: _y(b + r.M_IXX26_IXX80, 3),
        85: _x(b + r.M_IXX85_IXX87, 24),
        86: _x(b + r.M_IXX86, 24, signed=True),
        87: _y(b + r.M_IXX85_IXX87, 24, default=64),
        88: _y(b + r.M_IXX88, 8),
        90: _y(own + r.R_IXX62_IXX90, 1, default=1),
        92: _y(b + r.M_IXX92, 23, default=10),
        95: _y(own + r.R_IXX10_IXX95, is_hex=True, fixed=True),
        96: IVariable(I_X, status, offset=0, width=2, fixed=True),
        97: bits(2, 2),
    }
    table[66] = _x(own + r.R_IXX62_IXX90, 16, default=6527, quiet=True)
    hexes = {42, 43, 44, 55, 81, 82, 83, 84, 91, 95}
    for number in range(100):
        table.setdefault(number, _fixed(is_hex=number in hexes))
    return table


def _cs_table(cs: int) -> dict[int, IVariable]:
    b = r.cs_base(cs)
    table = {
        11: IVariable(I_X, b + r.C_TIMERS, signed=True, quiet=True),
        12: IVariable(I_Y, b + r.C_TIMERS, signed=True, quiet=True),
        13: _x(b + r.C_INTERNAL, 8, quiet=True),
        87: _y(b + r.C_ISX88_ISX87, 23, quiet=True),
        88: _x(b + r.C_ISX88_ISX87, 23, default=50, quiet=True),
        89: _float(b + r.C_ISX89, 1000.0),
        90: _float(b + r.C_ISX90, 1000.0),
        91: _x(b + r.C_ISX91_BITS, 16, quiet=True),
        92: IVariable(I_Y, b + r.C_ISX91_BITS, offset=23, width=1, quiet=True),
        93: _x(b + r.C_TIMEBASE_SOURCE, 19, default=b, is_hex=True),
        94: _y(b + r.C_SLEWS, 23, default=1644),
        95: _x(b + r.C_SLEWS, 23, default=1644),
        98: _float(b + r.C_ISX98),
        99: _fixed(0.9998474121),
    }
    for number in range(11, 100):
        table.setdefault(number, _fixed(is_hex=number == 93))
    return table


def _gather_table() -> dict[int, IVariable]:
    table = {5000: _x(r.INTERNAL_GATHER, 2)}
    for k in range(48):
        table[5001 + k] = _x(r.GATHER_SOURCES + k, is_hex=True)
    table[5049] = _y(r.GATHER_PERIOD, 23, default=1)
    table[5050] = _x(r.GATHER_MASKS, is_hex=True)
    table[5051] = _x(r.GATHER_MASKS + 1, is_hex=True)
    for number in (*range(5061, 5077), *range(5081, 5097)):
        table[number] = _fixed(is_hex=True)
    return table


def servo_ic_register(number: int) -> tuple[int, int]:
    """Space (`I_X` or `I_Y`) and address of I7000-I7199 (servo ICs 0 and 1)."""
    ic, index = divmod(number - 7000, 100)
    return (I_X if ic == 0 else I_Y), r.INTERNAL_SERVO_IC + index


def _servo_ic_table() -> dict[int, IVariable]:
    # Clock settings, then ten variables per channel (p. 206-227).
    clock = {0: 6527.0, 1: 0.0, 2: 3.0, 3: 2258.0, 4: 15.0, 5: 0x7FFFC0, 6: 0xFFFFFE, 7: 0.0}
    channel = {0: 7.0, 1: 0.0, 2: 1.0, 3: 0.0, 6: 0.0, 7: 0.0, 8: 0.0}
    table: dict[int, IVariable] = {}
    for ic in range(2):
        for index in range(100):
            number = 7000 + 100 * ic + index
            kind, address = servo_ic_register(number)
            group, k = divmod(index, 10)
            if group == 0 and k in clock:
                default = 3.0 if (ic, k) == (1, 7) else clock[k]
                table[number] = IVariable(kind, address, default=default, is_hex=k in (5, 6))
            elif 1 <= group <= 4 and k in channel:
                table[number] = IVariable(kind, address, width=4, default=channel[k])
    return table


def _build() -> dict[int, IVariable]:
    table = _global_table()
    for motor in range(1, r.MOTORS + 1):
        table |= {100 * motor + k: v for k, v in _motor_table(motor).items()}
    for cs in range(1, r.COORDINATE_SYSTEMS + 1):
        table |= {5000 + 100 * cs + k: v for k, v in _cs_table(cs).items()}
    table |= _gather_table()
    table |= _servo_ic_table()
    table[4900] = _fixed(0xFFFF, is_hex=True)
    table[4904] = IVariable(I_X, r.INTERNAL_GLOBAL + 0xF4, default=0, fixed=True, quiet=True)
    table[4908] = IVariable(I_X, r.MEMORY_END, is_hex=True, fixed=True, quiet=True)
    for k in range(r.ECT_LINES):
        default = float(channel_address(k + 1)) if k < 8 else 0.0
        table[8000 + k] = _y(r.ECT_BASE + k, default=default, is_hex=True)
    for number in range(COUNT):
        table.setdefault(number, _fixed())
    return table


TABLE: Final[dict[int, IVariable]] = _build()


def lock_group(number: int) -> int:
    """Bit of I41 that locks an I-variable, 0 if none (p. 57)."""
    for bit, first, last in ((1, 100, 4899), (2, 5100, 6699), (4, 6800, 7999), (8, 8000, 8191)):
        if first <= number <= last:
            return bit
    return 0


def compiled_table() -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Arrays ``imap`` and ``iscale`` that the virtual machine takes.

    Variables that refuse other values are constants for programs, too: they read their register
    or default, and stores through the machine leave them as they are.
    """
    imap = np.zeros((COUNT, IT_COLUMNS), dtype=np.int64)
    iscale = np.ones(COUNT)
    for number, v in TABLE.items():
        imap[number] = (v.kind, v.address, v.offset, v.width, int(v.signed), int(v.quiet))
        iscale[number] = v.default if v.kind == I_ABSENT else v.scale
    return imap, iscale
