"""Status words of a coordinate system: its program and modes, and what it has of its motors.

Source: Turbo PMAC Software Reference Manual p. 284-285.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pmac_comp.simulator.language.statements import AXES
from pmac_comp.simulator.memory import registers as r

if TYPE_CHECKING:
    from pmac_comp.simulator.programs.coordinate_system import CoordinateSystem

# In position, warning, fatal error and amplifier fault stand in the same order in both words.
_ERRORS2 = r.S2_WARNING_ERROR | r.S2_FATAL_ERROR | r.S2_AMPLIFIER_FAULT
_FOLLOWED_SHIFT = 17
_MODE_BITS = {
    "linear": 0,
    "rapid": r.CS2_MODE1,
    "spline": r.CS2_MODE4 | r.CS2_MODE0,
    "pvt": r.CS2_MODE4 | r.CS2_MODE1,
}


def follow_motors(system: CoordinateSystem) -> None:
    """Write the bits that follow the motors: in position if all are, errors if any has one."""
    words = system.card.memory.y
    any_of, all_of = 0, -1 if system.axes else 0
    for motor in system.axes:
        status2 = int(words[r.motor_base(motor) + r.M_STATUS2])
        any_of |= status2
        all_of &= status2
    bits = any_of & _ERRORS2 | all_of & r.S2_IN_POSITION
    cell = system.base + r.C_STATUS2_ADDRESS
    followed = (_ERRORS2 | r.S2_IN_POSITION) << _FOLLOWED_SHIFT
    words[cell] = int(words[cell]) & ~followed | bits << _FOLLOWED_SHIFT


def write_program(system: CoordinateSystem) -> None:
    """Write whether the program runs, and in which modes."""
    memory = system.card.memory
    word1 = _mode_word(system)
    if system.running and not system.returned:  # p. 285: 0 once RETURN is reached
        word1 |= r.CS1_RUNNING
        if not system.single:
            word1 |= r.CS1_CONTINUOUS
        if system.single or system.quitted:
            word1 |= r.CS1_SINGLE_STEP
        elif not system.isx(92):
            word1 |= r.CS1_CONTINUOUS_REQUEST
    memory.x[system.base + r.C_STATUS13] = word1
    word2 = int(memory.y[system.base + r.C_STATUS2_ADDRESS])
    word2 &= ~(r.CS2_MODE0 | r.CS2_MODE1 | r.CS2_MODE4)
    if system.running:
        word2 &= ~r.CS2_RUNTIME_ERROR
    memory.y[system.base + r.C_STATUS2_ADDRESS] = word2 | _MODE_BITS[system.modal.mode]


def _mode_word(system: CoordinateSystem) -> int:
    """Word 1 of the status without what runs: feedrate axes, incremental axes, TM (p. 284-285)."""
    word = r.CS1_RADIUS_INCREMENTAL
    if system.modal.tm_ms is not None:
        word |= r.CS1_TIMED
    for place, letter in enumerate(AXES):
        if letter in system.modal.feed_axes:
            word |= r.CS1_FIRST_FEED_AXIS << (2 * place)
        if letter in system.modal.incremental:
            word |= r.CS1_FIRST_INCREMENTAL_AXIS << (2 * place)
    return word
