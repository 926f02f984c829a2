"""The electronic cam: a table over time, read by an unused motor that counts it.

What lives here: the motor that counts time, the table and the program of one known motion, and
running it. What may not: the transactions (``machine.controller``), the exact correction
(``physics.compensate``).

The time motor is an axis of the motion's own program. Its desired position grows by the same
counts in every servo cycle, so the ``D`` source of its table is time, and time starts with the
motion by construction. It has no encoder and no amplifier: its addresses are open registers, its
gains are zero. Sources: Software Reference Manual p. 302-305 (source and target motor, ``D``),
p. 463 (PVT), User Manual p. 81 (electronic cam).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import ConfigError, ReplyTimeout, SafetyRefusal, VerifyMismatch
from pmac_comp.base.progress import Progress
from pmac_comp.base.units import MM_PER_M, MS_PER_S
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.machine.controller.card import registers as reg
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.card.variables import read_many, read_one, same_value
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.transaction import UploadResult
from pmac_comp.machine.controller.change.verdict import untouched
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.comp_table import CompTable, TableKind, same_on_card
from pmac_comp.machine.controller.contents.programs import Program
from pmac_comp.machine.controller.contents.settings import (
    AxisDefinitions,
    Settings,
    differences,
    read_axes,
    read_settings,
    require_settings,
    write_settings,
)
from pmac_comp.machine.controller.contents.table_set import read_table
from pmac_comp.machine.controller.gather import gather
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.motors.motion import wait_for_end
from pmac_comp.machine.controller.settings.settings_upload import SettingsUpload, texts
from pmac_comp.physics.signals.trajectory import Trajectory
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.axis_setup import UNITS, axis_goal
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.law.rendering import (
    CAM_RUN_UP_CYCLES,
    CamShape,
    RenderedTable,
    cam_shape,
    cam_table,
)
from pmac_comp.workflow.motion.motions import Motion, check_motion
from pmac_comp.workflow.motion.pvt import PvtProgram, number_text, pvt_program

CAM_PROGRAM = 705
_OPEN_REGISTER = 0x10F0  # X/Y:$0010F0-$0010FF belong to nobody and are 0 at power-up
# Limits and amplifier fault are not looked at: this motor has neither (p. 102-104).
_NO_FLAGS = 0x120001
_IXX08 = 96
_AT_ZERO_ct = 0.5
_BACK_FRAC = 0.05  # an interrupted cam is run back this much slower than forward
_ABORT_ms = 50.0  # time stops within this after an abort
_SETTLE_s = 0.05
_RUN_SLACK_s = 10.0


@dataclass(frozen=True)
class Cam:
    """Everything of one compensated motion.

    Parameters
    ----------
    motion : Motion
        The motion itself.
    table : RenderedTable
        Table of the time motor that corrects the axis.
    program : Program
        Motion with the time axis Y.
    shape : CamShape
        Counts of time per servo cycle and length.
    """

    motion: Motion
    table: RenderedTable[CompTable]
    program: Program
    shape: CamShape


def render_cam(compensation: Compensation, bench: Bench) -> Cam:
    """Table and program of the motion of a compensation.

    Raises
    ------
    ConfigError
        The file holds no motion, or the motion is too long for a table.
    SafetyRefusal
        The motion passes the limits of the bench.
    """
    position, correction = compensation.motion_position_m, compensation.motion_correction_m
    if position is None or correction is None:
        raise ConfigError(
            "The compensation holds no motion.",
            code="PC-DEP-051",
            hint="Compute it again: "
            "`pmac-comp compensate --bench FILE --model FILE --route cam --command MOTION`.",
        )
    time_s = np.arange(position.size, dtype=np.float64) * bench.servo_period_s
    known = Motion("compensated motion", Trajectory(time_s, position))
    check_motion(known, bench)
    shape = cam_shape(position.size, bench)
    lines = _program_lines(pvt_program(known, bench), shape, bench.servo_period_s)
    program = programs.sealed_motion(CAM_PROGRAM, lines, motor=bench.encoder.motor_number)
    return Cam(known, cam_table(correction, bench), program, shape)


def _program_lines(pvt: PvtProgram, shape: CamShape, period_s: float) -> tuple[str, ...]:
    """Lines of the motion with the time axis Y beside; Y goes once through the whole table.

    Y is incremental and its way is the length of the table: the next run finds the same table.
    Segments may end between two cycles: what is rounded is the time since the start, as each of
    their lengths would lose a part.
    """
    speed = number_text(shape.ct_per_cycle / period_s, 3)
    ramp_ct = shape.ct_per_cycle * CAM_RUN_UP_CYCLES // 2
    run_up = f"PVT{number_text(CAM_RUN_UP_CYCLES * period_s * MS_PER_S, 6)}"
    start = f"X{number_text(pvt.start_ct, 4)}:0"
    lines = ["DWELL100", "ABS(X)", "INC(Y)", run_up, f"{start}Y{ramp_ct}:{speed}"]
    at_ct, end = 0, start
    for segment in pvt.segments:
        end, before_ct = segment.end, at_ct
        at_ct = round(segment.end_cycle * shape.ct_per_cycle)
        lines += [*filter(None, [segment.time]), f"{end}Y{at_ct - before_ct}:{speed}"]
    if shape.rest_cycles:
        rest_ct = shape.rest_cycles * shape.ct_per_cycle
        lines += [
            f"PVT{number_text(shape.rest_cycles * period_s * MS_PER_S, 6)}",
            f"{end}Y{rest_ct}:{speed}",
        ]
    return (*lines, run_up, f"{end}Y{ramp_ct}:0", "DWELL50")


# The motor that counts time -----------------------------------------------------------------------


def time_motor_variables(bench: Bench) -> dict[str, float]:
    """I-variables of a motor without encoder and amplifier that only follows its command."""
    number = bench.controller.cam_motor_number
    abort = round(_rate_ct_per_ms(bench) / _ABORT_ms, 3)
    back = _back_ct_per_ms(bench)
    values = {
        "01": 0, "02": _OPEN_REGISTER, "03": _OPEN_REGISTER, "04": _OPEN_REGISTER,
        "06": 0, "08": _IXX08, "11": 0, "12": 0, "13": 0, "14": 0, "15": abort,
        "19": back / 100.0, "20": 0, "21": 50, "22": back,
        "24": _NO_FLAGS, "29": 0, "30": 0, "31": 0, "32": 0, "33": 0, "35": 0, "59": 0,
        "68": 0, "86": 0,
    }  # fmt: skip
    return {f"I{number}{suffix}": float(value) for suffix, value in values.items()}


def _same(found: dict[str, float], wanted: dict[str, float]) -> bool:
    return all(same_value(found[name], value) for name, value in wanted.items())


def _rate_ct_per_ms(bench: Bench) -> float:
    return bench.safety.max_speed_mm_per_s / MM_PER_M / bench.motor_resolution_m / MS_PER_S


def _back_ct_per_ms(bench: Bench) -> float:
    return round(_BACK_FRAC * _rate_ct_per_ms(bench), 3)


def axis_settings(bench: Bench, present: AxisDefinitions) -> Settings:
    """Both axes in coordinate system 1; definitions of other motors and systems stay."""
    ours = {bench.encoder.motor_number: "X", bench.controller.cam_motor_number: "Y"}
    return Settings(UNITS, axes=axis_goal(present, ours))


def cam_settings(bench: Bench, program: Program, present: AxisDefinitions) -> Settings:
    """All that a cam needs beside its table; the motor is switched on last, and off first."""
    axes = axis_settings(bench, present)
    motor = texts(time_motor_variables(bench))
    active = {f"I{bench.controller.cam_motor_number}00": "1"}
    return replace(
        axes,
        variables={**axes.variables, **motor, **active},
        programs={(program.kind, program.number): program.lines},
    )


def time_motor_off(axis: Axis) -> Settings:
    """What switches a motor off that counts time as a cam has set it; empty where there is none."""
    number = axis.bench.controller.cam_motor_number
    wanted = time_motor_variables(axis.bench)
    active = read_one(axis.link, f"I{number}00")
    if not active or not _same(read_many(axis.link, list(wanted)), wanted):
        return Settings()
    present = read_axes(axis.link)
    kept = tuple(a for a in present if a != (1, number, "Y"))
    return Settings({f"I{number}00": "0"}, axes=None if kept == present else kept)


def in_use_refusals(axis: Axis) -> list[SafetyRefusal]:
    """Refusal if the time motor is in use for something else.

    Raises
    ------
    ConfigError
        The time motor is the axis itself or its scale.
    """
    _require_free_number(axis)
    number = axis.bench.controller.cam_motor_number
    wanted = time_motor_variables(axis.bench)
    active = read_one(axis.link, f"I{number}00")
    if not active or _same(read_many(axis.link, list(wanted)), wanted):
        return []
    return [
        SafetyRefusal(
            f"Motor #{number} is in use (I{number}00 = 1): it cannot count time.",
            code="PC-DEP-052",
            hint="Name an unused motor as cam_motor_number in [controller] of the bench file.",
        )
    ]


def _require_free_number(axis: Axis) -> None:
    number = axis.bench.controller.cam_motor_number
    scale = axis.bench.scale
    if number in {axis.motor, None if scale is None else scale.motor_number}:
        raise ConfigError(
            f"cam_motor_number = {number} is the axis or its scale.",
            code="PC-DEP-050",
            hint="Name an unused motor as cam_motor_number in [controller] of the bench file.",
        )


def has_cam(axis: Axis) -> bool:
    """Whether the card has the table of a cam for the axis."""
    table = read_table(axis.link, TableKind.COMP, axis.bench.controller.cam_motor_number)
    return isinstance(table, CompTable) and table.target == axis.motor


def rest_time_motor(axis: Axis) -> None:
    """Bring the time motor to zero if the card has a cam; a card without one is left alone.

    So is a time motor that is not active, after a reset say: it counts nothing.
    """
    if has_cam(axis) and read_one(axis.link, f"I{axis.bench.controller.cam_motor_number}00"):
        reset_time(axis)


def reset_time(axis: Axis) -> None:
    """Bring the time motor to zero without a step of the correction.

    After a whole run it stands at the end of its table, which is its beginning. After an
    interrupted one it is jogged back slowly first, so that the correction fades.

    Raises
    ------
    ReplyTimeout
        It does not come back.
    """
    number = axis.bench.controller.cam_motor_number
    at_ct = _time_ct(axis)
    table = read_table(axis.link, TableKind.COMP, number)
    if table is not None:
        turns = round(at_ct / table.span_ct)
        if abs(at_ct - turns * table.span_ct) > _AT_ZERO_ct:
            run_time_to(axis, turns * table.span_ct)
    # Feedback stands still: closing the loop anew makes the command equal to it, then zero.
    motors.kill(axis.link, number)
    motors.enable(axis.link, number)
    axis.link.command(f"#{number}HMZ")


def run_time_to(axis: Axis, target_ct: int) -> None:
    """Jog the time motor to a place of its table, so slowly that the axis follows the correction.

    Raises
    ------
    ReplyTimeout
        It does not arrive.
    """
    number = axis.bench.controller.cam_motor_number
    way_ms = abs(_time_ct(axis) - target_ct) / _back_ct_per_ms(axis.bench)
    motors.jog_to(axis.link, number, float(target_ct))
    deadline = Deadline.after(axis.link.clock, way_ms / MS_PER_S + _RUN_SLACK_s)
    while abs(_time_ct(axis) - target_ct) > _AT_ZERO_ct:
        if deadline.expired():
            raise ReplyTimeout(
                f"Motor #{number}, which counts time, did not come to {target_ct} counts.",
                code="PC-DEP-053",
                hint="Look at it with `pmac-comp status`; kill the axis before anything else.",
            )
        axis.link.clock.sleep_s(_SETTLE_s)


def _time_ct(axis: Axis) -> float:
    """Commanded position of the time motor in counts.

    Its feedback never moves and its following error is clamped by Ixx67: only the register says.
    """
    number = axis.bench.controller.cam_motor_number
    address = reg.motor_base(number) + reg.COMMANDED
    raw = parse_integer(axis.link.query(f"RL${address:X}")[0])
    return raw / (32.0 * _IXX08)


# On the controller --------------------------------------------------------------------------------


def deploy_program(axis: Axis, cam: Cam, context: Context) -> UploadResult:
    """Time motor, axes and program as one change; then the motor in closed loop at zero.

    Raises
    ------
    ConfigError
        The time motor is the axis itself or its scale.
    SafetyRefusal
        The motor is in use for something else, or something moves; nothing was changed.
    """
    number = axis.bench.controller.cam_motor_number
    with untouched():
        gather.stop(axis.link)
        refusals = in_use_refusals(axis)
        active = read_one(axis.link, f"I{number}00")
        if active and not refusals:
            rest_time_motor(axis)
        goal = cam_settings(axis.bench, cam.program, read_axes(axis.link))
    moved = [axis.motor, number] if active else [axis.motor]
    with SettingsUpload(
        axis.link, context, goal, route="cam", motors=moved, refusals=refusals
    ) as upload:
        upload.write()
        result = upload.finish()
    reset_time(axis)
    return result


def _define_axes(axis: Axis) -> None:
    """Both axes as the upload left them, after runs of other kinds; nothing if they stand."""
    like = axis_settings(axis.bench, ())
    found = read_settings(axis.link, like)
    goal = axis_settings(axis.bench, found.axes or ())
    if differences(goal, found):
        write_settings(axis.link, found, goal)
        require_settings(axis.link, goal)


@dataclass
class CamAxis(Axis):
    """Axis whose runs are the uploaded program of its cam; other motions are refused."""

    cam: Cam | None = None
    keeps_rests: ClassVar[bool] = True

    def prepare(self, motion: Motion) -> None:
        """Look whether the card still has the table and the program."""
        if self.cam is None or motion.position_m.size != self.cam.motion.position_m.size:
            raise ConfigError(
                "This cam belongs to another motion.",
                code="PC-DEP-054",
                hint="Compute one for this motion: "
                "`pmac-comp compensate --bench FILE --model FILE --route cam --command MOTION`.",
            )
        gather.stop(self.link)
        self.release_axis()
        _define_axes(self)
        programs.verify(self.link, self.cam.program)
        meant = self.cam.table.table
        found = read_table(self.link, TableKind.COMP, meant.motor)
        if found is None or not same_on_card(meant, found):
            raise VerifyMismatch(
                f"The cam of motor #{meant.motor} on the controller is another one.",
                code="PC-DEP-055",
                hint="Upload the compensation again.",
            )
        self.program_number = CAM_PROGRAM

    def _go_to_start(self, motion: Motion) -> None:
        self.finish()
        reset_time(self)
        super()._go_to_start(motion)

    def finish(self) -> None:
        """Wait until the time axis has gone through its table."""
        wait_for_end(self.link, timeout_s=self._longest_s())

    def _longest_s(self) -> float:
        cycles = 0 if self.cam is None else self.cam.shape.total_cycles
        return cycles * self.scales.period_s + _RUN_SLACK_s

    def run(
        self, motion: Motion, *, relaxed: bool = False, progress: Progress | None = None
    ) -> Capture:
        """Run the cam's motion; it starts from rest, there is nothing to relax."""
        if relaxed:
            raise ConfigError("A cam runs its own motion only.", code="PC-DEP-054")
        capture = super().run(motion, progress=progress)
        self.finish()
        return capture


def cam_axis(axis: Axis, compensation: Compensation) -> tuple[CamAxis, Sequence[Motion]]:
    """The axis that runs a cam, and its one motion."""
    cam = render_cam(compensation, axis.bench)
    found = CamAxis(
        axis.link, axis.bench, axis.identity, axis.simulated, axis.address, axis.setup, cam=cam
    )
    return found, (cam.motion,)
