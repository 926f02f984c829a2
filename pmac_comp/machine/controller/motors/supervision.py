"""Watching a run while it is gathered: motors that trip, encoder and scale that disagree.

Pure functions on blocks of samples; the caller stops the motion and closes the capture. What is
looked for in the two position signals: a dead scale, a swapped sign, a wrong unit, a slip, a dead
encoder. Positions come in the caller's own unit (both the same).
"""

from dataclasses import dataclass, field
from enum import Enum
from typing import Final

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.motors.motors import read_motors

DEAD: Final = 0.02
AGREED: Final = 0.2  # of the limit
RATIO_BAND: Final = 0.2


class SensorFault(Enum):
    """What encoder and scale say about each other."""

    NONE = "encoder and scale agree"
    SCALE_DEAD = "the scale does not move while the encoder does"
    ENCODER_DEAD = "the encoder does not move while the scale does"
    SIGN = "encoder and scale count in opposite directions"
    UNIT = "encoder and scale differ in resolution"
    SLIP = "encoder and scale parted: coupling or scale head slipped"


@dataclass
class SensorWatch:
    """Compares two positions of the same axis, block by block.

    Parameters
    ----------
    limit : float
        Largest difference allowed, in the unit of the positions; well above the errors that are
        to be measured.
    """

    limit: float
    _first: tuple[float, float] | None = None
    _motor: list[FloatArray] = field(default_factory=list)
    _scale: list[FloatArray] = field(default_factory=list)

    def feed(self, motor: FloatArray, scale: FloatArray) -> SensorFault:
        """Add a block and judge everything since the start.

        Returns
        -------
        SensorFault
            NONE while the difference of the travelled distances stays within the limit.
        """
        if not len(motor):
            return SensorFault.NONE
        if self._first is None:
            self._first = float(motor[0]), float(scale[0])
        moved = np.asarray(motor, dtype=float) - self._first[0]
        seen = np.asarray(scale, dtype=float) - self._first[1]
        self._motor.append(moved)
        self._scale.append(seen)
        if float(np.max(np.abs(moved - seen))) <= self.limit:
            return SensorFault.NONE
        return _parted(np.concatenate(self._motor), np.concatenate(self._scale), self.limit)


def _parted(moved: FloatArray, seen: FloatArray, limit: float) -> SensorFault:
    """A sensor that dies shows since both last agreed, anything else over the whole run."""
    agreed = np.flatnonzero(np.abs(moved - seen) <= AGREED * limit)
    since = int(agreed[-1]) if agreed.size else 0
    late = diagnose_sensors(moved[since:] - moved[since], seen[since:] - seen[since])
    dead = {SensorFault.SCALE_DEAD, SensorFault.ENCODER_DEAD}
    return late if late in dead else diagnose_sensors(moved, seen)


def diagnose_sensors(moved: FloatArray, seen: FloatArray) -> SensorFault:
    """Name what parts two positions that both start at zero.

    A straight line through both tells a unit or a sign; a line that fits before and after with
    another offset is a slip.
    """
    span_motor, span_scale = float(np.ptp(moved)), float(np.ptp(seen))
    if span_scale <= DEAD * span_motor:
        return SensorFault.SCALE_DEAD
    if span_motor <= DEAD * span_scale:
        return SensorFault.ENCODER_DEAD
    steps_motor, steps_scale = np.diff(moved), np.diff(seen)
    # The median of the steps' ratio is not moved by a slip, which is a few large steps.
    strong = np.abs(steps_motor) > 0.2 * np.max(np.abs(steps_motor))
    ratio = float(np.median(steps_scale[strong] / steps_motor[strong]))
    if ratio < 0.0:
        return SensorFault.SIGN
    if abs(ratio) <= DEAD:
        return SensorFault.SCALE_DEAD
    if abs(ratio - 1.0) > RATIO_BAND:
        return SensorFault.UNIT
    return SensorFault.SLIP


def trips(link: Link, motors: list[int]) -> tuple[str, ...]:
    """Why motors stopped, in words; empty while all are well."""
    found = []
    for motor, reading in read_motors(link, motors).items():
        reasons = reading.status.trips
        if reading.status.is_killed and not reasons:
            reasons = ("killed",)
        found += [f"motor #{motor}: {reason}" for reason in reasons]
    return tuple(found)
