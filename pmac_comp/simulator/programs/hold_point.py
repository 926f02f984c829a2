"""Where a program was stopped, and whether its motors are there when it is resumed.

In feed hold a motor may be jogged away from its trajectory; what was left of that waits here. R
resumes only when every motor is back (``J=`` goes there), otherwise it answers ERR017. The same
holds after Q and after a step. Source: Turbo PMAC Software Reference Manual p. 325, 335, 388, 391.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory.errors import CardError

if TYPE_CHECKING:
    from pmac_comp.simulator.card.card import Card


@dataclass(frozen=True)
class _Left:
    """The trajectory a motor left in feed hold."""

    segments: FloatArray
    cursor: FloatArray
    index: IntArray
    position: float


class HoldPoint:
    """Stopped positions of one coordinate system.

    Parameters
    ----------
    card : Card
        The card.
    cs : int
        Number of the coordinate system.
    """

    def __init__(self, card: Card, cs: int) -> None:
        self._card = card
        self._cs = cs
        self._left: dict[int, _Left] = {}
        self._stopped: dict[int, float] = {}

    @property
    def is_left(self) -> bool:
        """Whether a motor was moved since the feed hold."""
        return bool(self._left)

    def forget(self) -> None:
        """The program ended or was aborted: nothing is to be resumed."""
        self._left.clear()
        self._stopped.clear()

    def stopped(self, motors: list[int]) -> None:
        """Q or a step has come to its end here."""
        queue = self._card.servo.queue
        self._stopped = {motor: queue.last_position(motor)[0] for motor in motors}

    def leave(self, motor: int) -> None:
        """A motor is about to be moved in feed hold; ERR001 while it is still slowing down."""
        if motor in self._left:
            return
        servo = self._card.servo
        if int(self._card.memory.x[r.cs_base(self._cs) + r.C_TIMEBASE]) != 0:
            raise CardError(1)
        queue = servo.queue
        position = queue.state(motor)[0]
        self._left[motor] = _Left(
            queue.segments[motor].copy(),
            queue.cursor[motor].copy(),
            queue.index[motor].copy(),
            position,
        )
        queue.place(motor, position)
        servo.set_prejog(motor, position / servo.unit(motor))

    def return_to(self) -> None:
        """Take up what was left.

        Raises
        ------
        CardError
            ERR017 when a motor is not where the program stopped.
        """
        servo, queue = self._card.servo, self._card.servo.queue
        for motor, left in self._left.items():
            self._require(motor, left.position)
        for motor, position in self._stopped.items():
            self._require(motor, position)
        cell = r.cs_base(self._cs) + r.C_STATUS13
        servo.memory.y[cell] &= ~r.CS3_RESUME_ERROR & 0xFFFFFF
        for motor, left in self._left.items():
            queue.segments[motor] = left.segments
            queue.cursor[motor] = left.cursor
            queue.index[motor] = left.index
            servo.memory.touch()
        self.forget()

    def _require(self, motor: int, position: float) -> None:
        servo, memory = self._card.servo, self._card.memory
        band_16 = int(memory.x[r.motor_base(motor) + r.M_IXX28_IXX12])
        away = abs(servo.queue.state(motor)[0] - position)
        if servo.is_moving(motor) or away > band_16 * servo.unit(motor) / 16.0:
            memory.y[r.cs_base(self._cs) + r.C_STATUS13] |= r.CS3_RESUME_ERROR
            raise CardError(17)
