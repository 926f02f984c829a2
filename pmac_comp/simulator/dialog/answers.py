"""What the card answers to status queries and reporting control characters.

Source: Turbo PMAC Software Reference Manual p. 254-263, 280-291, 322, 382, 401.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory.memory import Memory
from pmac_comp.simulator.memory.numbers import format_number, format_rounded

if TYPE_CHECKING:
    from pmac_comp.simulator.servo.servo import Servo

_POSITION_STEP = 1 / 32
_TENTH = 0.1


class Answers:
    """Texts of status queries, all read from memory."""

    def __init__(self, memory: Memory, servo: Servo) -> None:
        self.memory = memory
        self.servo = servo

    def motor_words(self, motor: int) -> str:
        """Twelve digits of ``?``."""
        base = r.motor_base(motor)
        m = self.memory
        return f"{int(m.x[base + r.M_STATUS1]):06X}{int(m.y[base + r.M_STATUS2]):06X}"

    def cs_words(self, cs: int) -> str:
        """Eighteen digits of ``??``."""
        base = r.cs_base(cs)
        m = self.memory
        word1, word3 = int(m.x[base + r.C_STATUS13]), int(m.y[base + r.C_STATUS13])
        return f"{word1:06X}{int(m.y[base + r.C_STATUS2_ADDRESS]):06X}{word3:06X}"

    def global_words(self) -> str:
        """Twelve digits of ``???``."""
        m = self.memory
        return f"{int(m.x[r.GLOBAL_STATUS]):06X}{int(m.y[r.GLOBAL_STATUS]):06X}"

    def position(self, motor: int) -> str:
        """Answer to ``P``."""
        return format_rounded(self.servo.position(motor), _POSITION_STEP)

    def velocity(self, motor: int) -> str:
        """Answer to ``V``."""
        return format_rounded(self.servo.velocity(motor), _TENTH)

    def following_error(self, motor: int) -> str:
        """Answer to ``F``, 0 while the loop is open."""
        if self.servo.is_open_loop(motor):
            return "0"
        return format_rounded(self.servo.following_error(motor), _TENTH)

    def override(self, cs: int) -> str:
        """Answer to ``%``."""
        base = r.cs_base(cs)
        held = int(self.memory.y[base + r.C_TIMEBASE_SOURCE]) & 1
        i10 = int(self.memory.x[r.I10_REGISTER])
        if held or i10 == 0:
            return "0"
        return format_number(100.0 * int(self.memory.x[base + r.C_TIMEBASE_COMMAND]) / i10)

    def report(self, character: int, group: int) -> str | None:
        """Line that answers a reporting control character, None if it reports nothing."""
        motors = range(8 * group + 1, 8 * group + 9)
        per_motor = {
            0x02: self.motor_words,
            0x06: self.following_error,
            0x10: self.position,
            0x16: self.velocity,
        }
        if character in per_motor:
            return " ".join(per_motor[character](m) for m in motors)
        if character == 0x03:
            return " ".join(self.cs_words(cs)[:12] for cs in range(1, 17))
        return self.global_words() if character == 0x07 else None
