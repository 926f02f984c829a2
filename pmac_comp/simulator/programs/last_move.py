"""The move that was calculated last: Q and its like take it back if it is not the next one.

A program is calculated up to two moves ahead here, because blended moves need that. On a card at
most one move follows the executing one when the program is told to stop; a further one has to be
calculated again when the program goes on.
Source: Turbo PMAC Software Reference Manual p. 388.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pmac_comp.simulator.programs.motion_planner import Planner

if TYPE_CHECKING:
    from pmac_comp.simulator.programs.coordinate_system import CoordinateSystem, Frame

KINDS = ("move", "dwell", "delay")


@dataclass(frozen=True)
class LastMove:
    """A move, and how everything stood before it was calculated.

    Parameters
    ----------
    frame : Frame
        Level of the program.
    statement : int
        Index of its statement.
    arguments : tuple of float
        Values the statement was given.
    planner : Planner
        As it was.
    targets : dict of str to float
        Axis positions.
    tags : tuple of int
        Pieces of motion that belong to the move.
    segments : dict of int to int
        Number of segments that it put into the queue of each motor.
    """

    frame: Frame
    statement: int
    arguments: tuple[float, ...]
    planner: Planner
    targets: dict[str, float]
    tags: tuple[int, ...]
    segments: dict[int, int]


class Calculation:
    """Watches how one move is calculated.

    Parameters
    ----------
    system : CoordinateSystem
        Before the statement of the move is executed.
    planner : Planner
        Its planner.
    """

    def __init__(self, system: CoordinateSystem, planner: Planner) -> None:
        self._planner = planner.copy()
        self._targets = dict(system.targets)
        self._tags = len(system.queued)
        self._segments = _pending(system)

    def done(
        self, system: CoordinateSystem, frame: Frame, statement: int, arguments: tuple[float, ...]
    ) -> LastMove:
        """What was calculated, after the statement was executed."""
        pending = _pending(system)
        return LastMove(
            frame,
            statement,
            arguments,
            self._planner,
            self._targets,
            tuple(system.queued[self._tags :]),
            {motor: count - self._segments[motor] for motor, count in pending.items()},
        )


def _pending(system: CoordinateSystem) -> dict[int, int]:
    return {motor: system.card.servo.queue.pending(motor) for motor in system.motors}
