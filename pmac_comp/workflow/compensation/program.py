"""The route ``program``: one known motion with its correction drawn into its motion program.

What lives here: the program of a compensation, its upload, and running it. What may not: the
transaction (``machine.controller``), the exact correction (``physics.compensate``).

The correction is part of the motion, so nothing is switched: without compensation the same motion
runs from a program that is only measured.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pmac_comp.base.errors import ConfigError
from pmac_comp.base.progress import Progress
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.transaction import UploadResult
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.programs import Program
from pmac_comp.machine.controller.gather import gather
from pmac_comp.machine.controller.settings.program_upload import upload_program
from pmac_comp.physics.signals.trajectory import Trajectory
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.compensation.repeated import as_compensated, with_offset
from pmac_comp.workflow.motion.motions import Motion, check_motion
from pmac_comp.workflow.motion.pvt import pvt_program

COMPENSATED_PROGRAM = 704


@dataclass(frozen=True)
class DrawnMotion:
    """One motion with its correction in the program.

    Parameters
    ----------
    motion : Motion
        What is meant.
    drawn : Motion
        What the program draws: the motion plus the correction.
    program : Program
        Text for the card.
    shape_error_um : float
        Largest departure of the PVT cubics from what is to be drawn.
    rounding_um : float
        Largest rounding of a position in the program's text.
    """

    motion: Motion
    drawn: Motion
    program: Program
    shape_error_um: float
    rounding_um: float

    @property
    def largest_um(self) -> float:
        """Largest correction in um."""
        return float(np.max(np.abs(self.drawn.position_m - self.motion.position_m)) * UM_PER_M)


def motion_of(compensation: Compensation, bench: Bench) -> Motion:
    """The one motion of a compensation for ``cam`` or ``program``.

    Raises
    ------
    ConfigError
        The file holds no motion.
    """
    position = compensation.motion_position_m
    if position is None or compensation.motion_correction_m is None:
        raise ConfigError(
            "The compensation holds no motion.",
            code="PC-DEP-051",
            hint="Compute it with --command FILE, or use --route law for motions of any kind.",
        )
    time_s = np.arange(position.size, dtype=np.float64) * bench.servo_period_s
    return Motion("compensated motion", Trajectory(time_s, position))


def draw_motion(compensation: Compensation, bench: Bench) -> DrawnMotion:
    """Program of the motion of a compensation; SafetyRefusal where it passes the limits."""
    motion = motion_of(compensation, bench)
    correction = compensation.motion_correction_m
    if correction is None:
        raise ConfigError(
            "The compensation holds no correction.",
            code="PC-DEP-056",
            hint="Compute it again: "
            "`pmac-comp compensate --bench FILE --model FILE --route program --command MOTION`.",
        )
    drawn = with_offset(motion, correction)
    check_motion(drawn, bench)
    pvt = pvt_program(drawn, bench)
    lines = ("DWELL100", *pvt.lines, "DWELL50")
    program = programs.sealed_motion(COMPENSATED_PROGRAM, lines, motor=bench.encoder.motor_number)
    rounding = pvt.rounding_ct * bench.motor_resolution_m * UM_PER_M
    return DrawnMotion(motion, drawn, program, pvt.shape_error_m * UM_PER_M, rounding)


def deploy_motion(axis: Axis, compensation: Compensation, context: Context) -> UploadResult:
    """Upload the program of a compensation, read back token by token."""
    return upload_program(axis.link, context, draw_motion(compensation, axis.bench).program)


def run_drawn(axis: "ProgramAxis", progress: Progress | None = None) -> Capture:
    """Run the uploaded program; the capture has the motion as command, the drawn as desired."""
    drawn = axis.drawn
    if drawn is None:
        raise ConfigError("This axis has no compensated program.", code="PC-DEP-057")
    return as_compensated(axis.run(drawn.drawn, progress=progress), drawn.motion, drawn.drawn)


@dataclass
class ProgramAxis(Axis):
    """Axis whose run of one drawn motion is the uploaded program; others are downloaded as ever."""

    drawn: DrawnMotion | None = None
    keeps_rests: ClassVar[bool] = True

    def prepare(self, motion: Motion) -> None:
        """Look whether the card still has the program that was uploaded."""
        if self.drawn is None or motion is not self.drawn.drawn:
            super().prepare(motion)
            return
        gather.stop(self.link)
        self.define_axis()
        programs.verify(self.link, self.drawn.program)
        self.program_number = COMPENSATED_PROGRAM


def program_axis(axis: Axis, compensation: Compensation) -> tuple[ProgramAxis, tuple[Motion, ...]]:
    """The axis that runs the uploaded program of a compensation, and its one motion."""
    drawn = draw_motion(compensation, axis.bench)
    found = ProgramAxis(
        axis.link, axis.bench, axis.identity, axis.simulated, axis.address, axis.setup, drawn=drawn
    )
    return found, (drawn.motion,)
