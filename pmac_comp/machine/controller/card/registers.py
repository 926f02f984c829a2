"""Addresses the host reads and writes, typed in from the manual.

Source: Software Reference Manual p. 495-512, 526. This is the host's own table; the simulated
card has another one, typed in separately.
"""

from dataclasses import dataclass
from typing import Final

from pmac_comp.base.errors import ConfigError

SERVO_COUNTER: Final = 0x000000  # X, 24 bits, +1 per servo interrupt
GLOBAL_STATUS: Final = 0x000006  # X and Y
GATHER_POINTERS: Final = 0x003120  # X start, Y storage
BLCOMP_POINTERS: Final = 0x003152  # motors 1..32
TCOMP_POINTERS: Final = 0x003172
COMP_POINTERS: Final = 0x003192
OPEN_REGISTERS: Final = range(0x10F0, 0x1100)  # X and Y, of nobody; 0 at power-up
DPRAM_BASE: Final = 0x060000
GATHER_RING: Final = 0x060450  # first cell of gather data in dual-ported RAM
GATHER_RING_HEADER: Final = 0x06044F  # Y size, X storage pointer
DPRAM_END: Final = {"small": 0x060FFF, "large": 0x063FFF}
MOTOR_STEP: Final = 0x80
CHANNEL_STEP: Final = 0x8

# Offsets in a motor block (p. 497-503).
COMMANDED: Final = 0x08  # D, 1/(32 Ixx08) count
ACTUAL: Final = 0x0B
MASTER: Final = 0x0D
COMPENSATION: Final = 0x10
FOLLOWING_ERROR: Final = 0x11
OUTPUT: Final = 0x3F  # X, 24 bits, DAC * 256

X_WORD: Final = 0x400000
LONG: Final = 0x800000


def motor_base(motor: int) -> int:
    """Address of the register block of a motor.

    Raises
    ------
    ConfigError
        There are motors 1 to 32 only.
    """
    if not 1 <= motor <= 32:
        raise ConfigError(
            f"There is no motor #{motor}; motors are 1 to 32.",
            code="PC-REG-001",
            hint="Check motor_number of [encoder] and [scale] in the bench file.",
        )
    return MOTOR_STEP * motor


def motor_register(motor: int, offset: int) -> int:
    """Address of a register of a motor."""
    return motor_base(motor) + offset


def dpram_offset(address: int) -> int:
    """Host byte offset of a cell of the dual-ported RAM: four bytes per address."""
    return 4 * (address - DPRAM_BASE)


@dataclass(frozen=True)
class GatherAddress:
    """Source word of I5001-I5048: kind in the first hex digit, address below (p. 170)."""

    word: int

    def __post_init__(self) -> None:
        if not 0 <= self.word < 1 << 24:
            raise ConfigError(f"${self.word:X} is no gather source.", code="PC-REG-002")

    @property
    def n_words(self) -> int:
        """24-bit words per sample: 1 or 2."""
        return 2 if self.word & LONG else 1
