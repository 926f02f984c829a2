"""The axes of a coordinate system: what moves them, and where they are.

Axis positions in axis units follow from motor positions by the axis definitions, and the other way
round. Source: Turbo PMAC Software Reference Manual p. 108, 276, 294, 387.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pmac_comp.simulator.language.statements import AXES
from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.memory import read_long, write_float48
from pmac_comp.simulator.programs.axes import AxisDefinition

if TYPE_CHECKING:
    from pmac_comp.simulator.card.card import Card

_ROTARY_AXES = "ABC"


class AxisPositions:
    """Axis definitions of one coordinate system and the target positions of its axes.

    Parameters
    ----------
    card : Card
        The card.
    number : int
        Number of the coordinate system, 1-16.
    """

    def __init__(self, card: Card, number: int) -> None:
        self.card = card
        self.number = number
        self.axes: dict[int, AxisDefinition] = {}
        self.targets: dict[str, float] = {}
        self._units: dict[int, float] = {}

    @property
    def base(self) -> int:
        """Address of the register block."""
        return r.cs_base(self.number)

    @property
    def motors(self) -> list[int]:
        """Motors assigned to this coordinate system."""
        return sorted(self.axes)

    def isx(self, index: int) -> float:
        """I-variable Isx of this coordinate system by its last two digits."""
        return self.card.variables.read_i(5000 + 100 * self.number + index)

    def match(self) -> None:
        """PMATCH: axis positions from the commanded positions of the motors (p. 387)."""
        rows: list[tuple[AxisDefinition, float]] = []
        for motor, definition in self.axes.items():
            counts = self.card.servo.queue.last_position(motor)[0] / self.card.servo.unit(motor)
            rows.append((definition, counts + self.card.bias(motor)))
        letters = sorted({letter for definition, _ in rows for letter, _ in definition.terms})
        if letters:
            self.targets.update(_solve(letters, rows))
        self.write_targets()

    def write_targets(self) -> None:
        """Target positions of the axes to their registers."""
        memory = self.card.memory
        for letter, value in self.targets.items():
            address = self.base + r.C_TARGETS + AXES.index(letter)
            write_float48(memory.x, memory.y, address, value)

    def motor_targets(self, targets: dict[str, float]) -> dict[int, float]:
        """Motor positions in units of axis positions."""
        found: dict[int, float] = {}
        for motor, definition in self.axes.items():
            counts = definition.offset - self.card.bias(motor)
            for letter, scale in definition.terms:
                counts += scale * targets.get(letter, 0.0)
            found[motor] = counts * self.unit(motor)
        return found

    def hold_units(self, motors: list[int]) -> None:
        """Read the units per count of these motors once, for a run; none forgets them."""
        self._units = {motor: self.card.servo.unit(motor) for motor in motors}

    def unit(self, motor: int) -> float:
        """Units per count of a motor; Ixx08 changes only while it is killed, so not in a run."""
        unit = self._units.get(motor)
        return unit if unit is not None else self.card.servo.unit(motor)

    def motor_rates(self, rates: dict[str, float]) -> dict[int, float]:
        """Motor velocities in units per cycle of axis velocities in axis units per ms."""
        cycle_ms = self.card.servo.cycle_ms
        return {
            motor: sum([s * rates.get(letter, 0.0) for letter, s in definition.terms])
            * self.unit(motor)
            * cycle_ms
            for motor, definition in self.axes.items()
        }

    def rename(self, letter: str, value: float) -> None:
        """Give the present axis position a new value: position bias, no motion (p. 294)."""
        self.match()
        if letter not in self.targets:
            raise CardError(3)
        change = value - self.targets[letter]
        for motor, definition in self.axes.items():
            scale = dict(definition.terms).get(letter, 0.0)
            self.card.add_bias(motor, scale * change)
        self.targets[letter] = value
        self.write_targets()

    def distance_to(self, letter: str, start: float, value: float) -> float:
        """Distance of an absolute move; rotary axes A, B, C take Ixx27 into account (p. 108)."""
        distance = value - start
        motor = next((m for m, d in self.axes.items() if dict(d.terms).get(letter)), None)
        if letter not in _ROTARY_AXES or motor is None:
            return distance
        memory, base = self.card.memory, r.motor_base(motor)
        range_ct = int(read_long(memory.x, memory.y, base + r.M_IXX27))
        if not range_ct:
            return distance
        scale = abs(dict(self.axes[motor].terms)[letter])
        turn = abs(range_ct) / scale
        if range_ct > 0:
            return (distance + 0.5 * turn) % turn - 0.5 * turn
        # The sign of the destination is the direction; what lies in the band is no move.
        band = int(memory.x[base + r.M_IXX28_IXX12]) / 16.0 / scale
        way = distance % turn
        if min(way, turn - way) < band:
            return 0.0
        return way if value >= 0.0 else way - turn

    def cycles(self, time_ms: float) -> float:
        """Servo cycles of a time at 100 % override."""
        return time_ms / self.card.servo.cycle_ms


def _solve(letters: list[str], rows: list[tuple[AxisDefinition, float]]) -> dict[str, float]:
    """Axis positions of motor positions in counts (least squares where axes share motors)."""
    matrix = np.array(
        [[dict(d.terms).get(letter, 0.0) for letter in letters] for d, _ in rows], dtype=float
    )
    right = np.array([counts - d.offset for d, counts in rows])
    solution, *_ = np.linalg.lstsq(matrix, right, rcond=None)
    return {letter: float(v) for letter, v in zip(letters, solution, strict=True)}
