"""Motor, coordinate-system and global data that the card copies into its dual-ported RAM.

I48 copies motor registers every I47 servo cycles, I57 the same in the background; I49 copies global
and coordinate-system registers every I50 cycles. The host keeps the card off a buffer while it
reads (bit 15 of its control word); with a period of 0 that bit is its request, which the card
takes back when the data are there.

A 24-bit register is one cell, sign-extended; a 48-bit one is two, low word first.
Source: Turbo PMAC Software Reference Manual p. 60-64 (I47-I57), 515-525 (map).
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Final

from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.memory import read_long, read_word_signed, write_dpram32

if TYPE_CHECKING:
    from pmac_comp.simulator.card.card import Card

MOTOR_CONTROL: Final = 0x06001A  # X bit 15: the host reads; X:+1 bit 15: data ready; +2 mask
MOTOR_DATA: Final = 0x06001D
_MOTOR_CELLS = 12
GLOBAL_CONTROL: Final = 0x06019D  # Y number of coordinate systems, X bit 15; X:+1 bit 15
_GLOBAL_STATUS = 0x0601A2
SYSTEM_DATA: Final = 0x0601A7
_SYSTEM_CELLS = 0x20
_HOST_READS = _READY = 1 << 15
_AXES = 9
_NEVER = sys.maxsize


class DpramReports:
    """The reports of one card.

    Parameters
    ----------
    card : Card
        The card.
    """

    def __init__(self, card: Card) -> None:
        self._card = card
        self._since_motors = 0
        self._background_from = 0

    def _i(self, number: int) -> int:
        return int(self._card.memory.x[r.INTERNAL_GLOBAL + number])

    @property
    def _present(self) -> bool:
        return self._card.dpram != "none"

    @property
    def in_background(self) -> bool:
        """Whether a background cycle has to look at the reports."""
        return self._present and bool(self._i(49) or self._i(57))

    def cycles_to_next(self) -> int:
        """Servo cycles until the next report of the servo task."""
        if not self._i(48) or not self._present:
            return _NEVER
        return max(1, self._i(47) - self._since_motors)

    def passed(self, cycles: int) -> None:
        """Servo cycles have passed: copy what is due in the servo task."""
        if not self._i(48) or not self._present:
            return
        self._since_motors += cycles
        if self._since_motors >= self._i(47):
            self._since_motors = 0
            self._report_motors(self._i(47))

    def background(self, cycle: int) -> None:
        """One background cycle: copy what is due in the background."""
        if not self._present:
            return
        if self._i(57):
            self._card.memory.x[r.INTERNAL_GLOBAL + 48] = 0  # p. 61
        if cycle - self._background_from < self._i(50):
            return
        self._background_from = cycle
        if self._i(57):
            self._report_motors(self._i(50))
        if self._i(49):
            self._report_global(self._i(50))

    def _may_write(self, control: int, period: int) -> bool:
        """Whether the host leaves the buffer to the card; takes a request back."""
        words = self._card.memory.x
        bit = int(words[control]) & _HOST_READS
        if period == 0 and bit:
            words[control] = int(words[control]) & ~_HOST_READS
        return bool(bit) == (period == 0)

    def _stamp(self, cell: int) -> None:
        """Servo counter and the sign that the data are ready."""
        memory = self._card.memory
        counter = int(memory.x[r.SERVO_COUNTER])
        memory.y[cell] = counter & 0xFFFF
        memory.x[cell] = _READY | counter >> 16

    # --- motors ---------------------------------------------------------------------------------

    def _report_motors(self, period: int) -> None:
        if not self._may_write(MOTOR_CONTROL, period):
            return
        memory = self._card.memory
        mask = int(memory.y[MOTOR_CONTROL + 2]) & 0xFFFF
        mask |= (int(memory.x[MOTOR_CONTROL + 2]) & 0xFFFF) << 16
        for motor in range(1, r.MOTORS + 1):
            if mask >> (motor - 1) & 1:
                self._report_motor(motor)
        self._stamp(MOTOR_CONTROL + 1)

    def _report_motor(self, motor: int) -> None:
        m, base = self._card.memory, r.motor_base(motor)

        def long(offset: int) -> int:
            return int(read_long(m.x, m.y, base + offset))

        actual, bias, table = long(r.M_ACTUAL), long(r.M_BIAS), long(r.M_COMPENSATION)
        master, backlash = long(r.M_MASTER), self._card.servo.backlash(motor)
        hidden = master if int(m.x[base + r.M_STATUS1]) & r.S1_FOLLOWING_OFFSET else 0
        cell = MOTOR_DATA + _MOTOR_CELLS * (motor - 1)
        self._long(cell, long(r.M_COMMANDED) + master - table - actual - backlash)
        self._word(cell + 2, int(read_word_signed(m.x, base + r.M_COMMAND)))
        self._word(cell + 3, int(read_word_signed(m.x, base + r.M_STATUS1)))
        self._word(cell + 4, int(read_word_signed(m.y, base + r.M_STATUS2)))
        self._long(cell + 5, bias)
        self._word(cell + 7, long(r.M_VELOCITY_FILTERED))
        self._long(cell + 8, master)
        self._long(cell + 10, actual + backlash + bias + table - hidden)

    # --- global and coordinate systems ----------------------------------------------------------

    def _report_global(self, period: int) -> None:
        if not self._may_write(GLOBAL_CONTROL, period):
            return
        m = self._card.memory
        self._word(_GLOBAL_STATUS, int(read_word_signed(m.x, r.GLOBAL_STATUS)))
        self._word(_GLOBAL_STATUS + 1, int(read_word_signed(m.y, r.GLOBAL_STATUS)))
        count = min(int(m.y[GLOBAL_CONTROL]) & 0x1F, r.COORDINATE_SYSTEMS)
        for cs in range(1, count + 1):
            self._report_system(cs)
        self._stamp(GLOBAL_CONTROL + 1)

    def _report_system(self, cs: int) -> None:
        m, base = self._card.memory, r.cs_base(cs)
        system = self._card.systems[cs]
        system.update_status()
        cell = SYSTEM_DATA + _SYSTEM_CELLS * (cs - 1)
        self._long(cell, int(read_long(m.x, m.y, base + r.C_ISX89)))
        self._word(cell + 2, int(read_word_signed(m.x, base + r.C_TIMEBASE)))
        self._word(cell + 3, int(read_word_signed(m.x, base + r.C_TIMEBASE_SOURCE)))
        self._long(cell + 4, int(read_long(m.x, m.y, base + r.C_STATUS13)))
        for axis in range(_AXES):
            target = int(read_long(m.x, m.y, base + r.C_TARGETS + axis))
            self._long(cell + 6 + 2 * axis, target)
        self._word(cell + 24, int(read_word_signed(m.y, base + r.C_STATUS2_ADDRESS)))
        waiting = self._card.rotary.buffers.get(cs)
        self._word(cell + 25, len(waiting.lines) if waiting is not None else 0)
        self._word(cell + 26, round(2.0 * system.move_time_ms()))  # half milliseconds, as D:+$00
        self._word(cell + 27, 0)
        try:
            offset = system.counter()[1]
        except CardError:
            offset = 0  # not pointing to a program
        self._word(cell + 28, offset)

    # --- cells ----------------------------------------------------------------------------------

    def _word(self, cell: int, value: int) -> None:
        value &= 0xFFFFFF
        signed = value - 0x1000000 if value & 0x800000 else value
        write_dpram32(self._card.memory.x, self._card.memory.y, cell, signed)

    def _long(self, cell: int, value: int) -> None:
        self._word(cell, value)
        self._word(cell + 1, value >> 24)
