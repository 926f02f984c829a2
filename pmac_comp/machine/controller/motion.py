"""Motion programs made from sampled trajectories, and running them.

PVT segments (Software Reference Manual p. 463) follow any smooth trajectory: each line gives the
position and the velocity at the end of its segment, the card draws the cubic between. How far that
cubic and the rounding of the numbers are from the trajectory is stated, not assumed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from pmac_comp.base.arrays import FloatArray, finite_array
from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import ConfigError, MotorNotSafe, ReplyTimeout
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.motors import read_motor
from pmac_comp.machine.controller.programs import Program, ProgramKind

SEGMENT_ms: Final = 10.0
TIME_STEP_ms: Final = 0.00025  # resolution of PVT times with I42 = 0
SEGMENT_MAX_ms: Final = 4095.9998
POSITION_DECIMALS: Final = 3
VELOCITY_DECIMALS: Final = 2
PROGRAM_NUMBER: Final = 710
RUNNING: Final = 1 << 0  # first word of ??
RUN_TIME_ERROR: Final = 1 << 22  # second word of ??
AMPLIFIER_FAULT: Final = 1 << 20
FATAL_FOLLOWING_ERROR: Final = 1 << 19
POLL_s: Final = 0.02


@dataclass(frozen=True)
class MotionProgram:
    """A motion program with its error.

    Parameters
    ----------
    program : Program
        Text.
    duration_s : float
        Duration of the trajectory, without approach and dwells.
    worst_error_ct : float
        Largest distance between what the card will draw and the trajectory, in counts.
    start_ct : float
        Where it starts.
    lead_in_s : float
        Time between start of the program and start of the trajectory, about.
    """

    program: Program
    duration_s: float
    worst_error_ct: float
    start_ct: float
    lead_in_s: float


def pvt_program(
    position_ct: FloatArray,
    servo_period_s: float,
    *,
    number: int = PROGRAM_NUMBER,
    segment_ms: float = SEGMENT_ms,
    time_axis_ct_per_ms: float | None = None,
    approach_ms: float = 1000.0,
) -> MotionProgram:
    """Program that follows a trajectory of the motor in counts.

    Parameters
    ----------
    position_ct : FloatArray, shape (n,), counts
        Positions at every servo cycle, starting and ending at rest.
    servo_period_s : float
        Servo period.
    number : int
        Program number.
    segment_ms : float
        Time of a segment; rounded to 1/4 us.
    time_axis_ct_per_ms : float, optional
        Adds an axis Y that runs at this constant speed: the time base of an electronic cam.
    approach_ms : float
        Time of the move to the start.

    Returns
    -------
    MotionProgram
        With the largest deviation of the drawn cubic, rounding included.

    Raises
    ------
    ConfigError
        Fewer than four samples, or a segment time the card does not take.
    """
    position = finite_array("position_ct", position_ct, min_size=4)
    step_ms = round(segment_ms / TIME_STEP_ms) * TIME_STEP_ms
    if not 0.5 <= step_ms <= SEGMENT_MAX_ms:
        raise ConfigError(f"A PVT segment of {segment_ms} ms is not possible.", code="PC-MOV-001")
    time_ms = np.arange(len(position)) * servo_period_s * 1e3
    # At rest at both ends: the end velocities are zero, not free.
    curve = CubicSpline(time_ms, position, bc_type="clamped")
    n_segments = int(np.ceil(time_ms[-1] / step_ms - 1e-9))
    knots_ms = np.arange(n_segments + 1) * step_ms
    inside = np.minimum(knots_ms, time_ms[-1])
    points = np.round(curve(inside), POSITION_DECIMALS)
    speeds = np.round(curve(inside, 1) * 1e3, VELOCITY_DECIMALS)
    speeds[0] = speeds[-1] = 0.0
    drawn = CubicHermiteSpline(knots_ms, points, speeds / 1e3)(time_ms)
    clock = [""] * (n_segments + 1)
    if time_axis_ct_per_ms is not None:
        clock = [
            f"Y{_text(k * step_ms * time_axis_ct_per_ms, 3)}:{_text(1e3 * time_axis_ct_per_ms, 3)}"
            for k in range(n_segments + 1)
        ]
    lines = [
        "ABS",
        "LINEAR",
        "TA200",
        "TS50",
        f"TM{_text(approach_ms, 0)}",
        f"X{_text(points[0], 3)}{'Y0' if time_axis_ct_per_ms is not None else ''}",
        "DWELL500",
        f"PVT{_text(step_ms, 5)}",
        *(
            f"X{_text(x, POSITION_DECIMALS)}:{_text(v, VELOCITY_DECIMALS)}{y}"
            for x, v, y in zip(points[1:], speeds[1:], clock[1:], strict=True)
        ),
        "DWELL200",
    ]
    return MotionProgram(
        Program(ProgramKind.PROG, number, tuple(lines)),
        duration_s=float(knots_ms[-1]) / 1e3,
        worst_error_ct=float(np.max(np.abs(drawn - position))),
        start_ct=float(points[0]),
        lead_in_s=(approach_ms + 200.0 + 500.0) / 1e3,
    )


def _text(value: float, decimals: int) -> str:
    text = f"{value:.{decimals}f}"
    if "." in text:
        text = text.rstrip("0").rstrip(".")
    return "0" if text in {"-0", ""} else text


def axis_lines(motor: int, *, cs: int = 1, time_motor: int | None = None) -> list[str]:
    """Commands that make a motor axis X in counts, and a free motor axis Y for time."""
    lines = [
        f"&{cs}UNDEFINE ALL",
        f"&{cs}#{motor}->X",
        f"I{50 + cs}13=0",
        f"I{50 + cs}90=1000",
        "I42=0",
    ]
    if time_motor is not None:
        lines.insert(2, f"&{cs}#{time_motor}->Y")
    return lines


@dataclass(frozen=True)
class ProgramStatus:
    """What ``??`` says about a coordinate system."""

    running: bool
    run_time_error: bool
    faults: tuple[str, ...]


def program_status(link: Link, cs: int = 1) -> ProgramStatus:
    """Status of a coordinate system."""
    digits = link.query(f"&{cs}??")[0].strip()
    word1, word2 = int(digits[:6], 16), int(digits[6:12], 16)
    faults = [
        text
        for bit, text in (
            (AMPLIFIER_FAULT, "amplifier fault"),
            (FATAL_FOLLOWING_ERROR, "fatal following error"),
        )
        if word2 & bit
    ]
    return ProgramStatus(bool(word1 & RUNNING), bool(word2 & RUN_TIME_ERROR), tuple(faults))


def start(link: Link, number: int, *, cs: int = 1) -> None:
    """Point to a program and run it; refusals ERR010 to ERR017 say why not (p. 391)."""
    link.command(f"&{cs}B{number}R")


def abort(link: Link, *, cs: int = 1) -> None:
    """Abort a program; its motors decelerate with Ixx15."""
    link.command(f"&{cs}A")


def wait_for_end(
    link: Link,
    *,
    cs: int = 1,
    timeout_s: float,
    on_poll: Callable[[], None] | None = None,
) -> None:
    """Wait until a program has ended.

    Raises
    ------
    MotorNotSafe
        Run-time error or fault: the program has stopped.
    ReplyTimeout
        Still running after the time; it was aborted.
    """
    deadline = Deadline.after(link.clock, timeout_s)
    while True:
        status = program_status(link, cs)
        if status.run_time_error or status.faults:
            why = ", ".join(status.faults) or "run-time error"
            raise MotorNotSafe(f"The motion program stopped: {why}.", code="PC-MOV-002")
        if not status.running:
            return
        if deadline.expired():
            abort(link, cs=cs)
            raise ReplyTimeout(
                f"The motion program still ran after {timeout_s:g} s and was aborted.",
                code="PC-MOV-003",
            )
        if on_poll is not None:
            on_poll()
        link.clock.sleep_s(POLL_s)


def run(link: Link, motion: MotionProgram, motor: int, *, cs: int = 1) -> None:
    """Run a downloaded program to its end; the motor must be in closed loop."""
    if not read_motor(link, motor).status.is_closed_loop:
        raise MotorNotSafe(f"Motor #{motor} is not in closed loop.", code="PC-MOV-004")
    start(link, motion.program.number, cs=cs)
    wait_for_end(link, cs=cs, timeout_s=2.0 * (motion.duration_s + motion.lead_in_s) + 10.0)
