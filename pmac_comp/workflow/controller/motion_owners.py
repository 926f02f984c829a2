"""Whose compensated motions stand on a card that carries several axes.

What lives here: of which axis PROG 704 and 705 are. What may not: changing anything. Both programs
move axis X of coordinate system 1, so that a card holds compensated motions of one axis at a time.
"""

from collections.abc import Sequence
from typing import Final

from pmac_comp.base.errors import SafetyRefusal
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.programs import ProgramKind
from pmac_comp.machine.controller.contents.settings import plain_axes, read_axes, read_body
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.compensation.cam import CAM_PROGRAM
from pmac_comp.workflow.compensation.program import COMPENSATED_PROGRAM

MOTIONS: Final = ((ProgramKind.PROG, CAM_PROGRAM), (ProgramKind.PROG, COMPENSATED_PROGRAM))


def is_motion_of(axis: Axis, number: int, lines: Sequence[str]) -> bool:
    """Whether a program is a compensated motion of this axis."""
    motor = _motor_of(axis, number, lines)
    return motor is not None and motor in {0, axis.motor}


def motions_of_others(axis: Axis) -> dict[int, int]:
    """Programs with a compensated motion of another axis, and the motors that they move."""
    found = {number: read_body(axis.link, kind, number) for kind, number in MOTIONS}
    motors = {number: _motor_of(axis, number, lines) for number, lines in found.items()}
    return {number: motor for number, motor in motors.items() if motor and motor != axis.motor}


def motion_refusals(axis: Axis) -> list[SafetyRefusal]:
    """Refusals of a motion where one of another axis stands."""
    return [
        SafetyRefusal(
            f"PROG {number} is the compensated motion of motor #{motor}: it and a motion of motor "
            f"#{axis.motor} would move the same axis X of coordinate system 1.",
            code="PC-DEP-064",
            hint=f"Take that compensation off first: `pmac-comp remove` with the bench file of "
            f"motor #{motor}; or use --route law, servo or table for one of the two axes.",
        )
        for number, motor in motions_of_others(axis).items()
    ]


def _motor_of(axis: Axis, number: int, lines: Sequence[str]) -> int | None:
    """Motor of a compensated motion, 0 where nothing tells, None where it is another program.

    A cam of an earlier version does not name its motor, but was uploaded with its axes.
    """
    motor = programs.motor_of_motion(lines)
    if motor != 0 or number != CAM_PROGRAM:
        return motor
    axes = plain_axes(read_axes(axis.link, systems=(1,)))
    return next((m for _, m, text in axes if text == "X"), 0)
