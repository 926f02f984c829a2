"""Switching the tables on and off (I51) with motors at rest, and the look at what it did."""

from collections.abc import Sequence
from typing import Final

from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import MotorNotSafe, VerifyMismatch
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.motors.motors import (
    MotorStatus,
    Standstill,
    parse_readings,
    read_motors,
    reading_text,
)
from pmac_comp.machine.wire.numbers import read_number

FEW: Final = 12  # motors whose readings fit one command line
WATCH_CYCLES: Final = 100
WATCH_POLLS: Final = 4


def switch_tables(link: Link, value: int, motors: Sequence[int]) -> Standstill | None:
    """Set I51 with the motors' status in the same line, before and after.

    Returns
    -------
    Standstill or None
        Where the motors were afterwards; None for so many that one line cannot ask it.

    Raises
    ------
    MotorNotSafe
        A motor moved: what was switched on is off again, what was switched off stays off.
    VerifyMismatch
        I51 does not read back.
    """
    status = "".join(f"#{m}?" for m in motors)
    few = len(motors) <= FEW
    n_after = 4 * len(motors) if few else len(motors)
    lines = link.command(f"{status}I51={value}I51{reading_text(motors) if few else status}")
    at_s = link.clock.now_s()
    n = len(motors)
    if len(lines) != n + 1 + n_after:
        raise VerifyMismatch(
            f"I51={value} was answered with {len(lines)} lines.", code="PC-UPL-003"
        )
    if int(read_number(lines[n])) != value:
        raise VerifyMismatch(
            f"I51 is {lines[n]} after I51={value}.",
            code="PC-UPL-003",
            hint="Something on the controller writes I51: a PLC or another client. Find it, then "
            "run `pmac-comp recover`.",
        )
    readings = parse_readings(motors, lines[n + 1 :]) if few else {}
    after = [r.status for r in readings.values()] if few else map(MotorStatus.parse, lines[n + 1 :])
    words = [*map(MotorStatus.parse, lines[:n]), *after]
    moving = [
        f"motor #{m}"
        for m, w in zip([*motors, *motors], words, strict=True)
        if w.is_activated and w.is_closed_loop and not w.is_commanded_still
    ]
    if not moving:
        return Standstill(readings, at_s) if few else None
    if value == 1:
        link.command("I51=0")
    raise MotorNotSafe(
        f"{moving[0]} started to move when compensation was to be switched.",
        code="PC-UPL-004",
        hint="Stop the motion, then run `pmac-comp recover`.",
    )


def watch(link: Link, context: Context, motors: Sequence[int]) -> None:
    """Following errors for 100 servo cycles after enabling.

    Raises
    ------
    MotorNotSafe
        A motor left its place by more than twice the largest step; I51 is 0 again.
    """
    if not motors:
        return
    bound_ct = 2.0 * context.limits.max_step_ct
    begin = {m: r.following_error_ct for m, r in read_motors(link, motors).items()}
    deadline = Deadline.after(link.clock, WATCH_CYCLES * context.servo_period_s)
    while not deadline.expired():
        link.clock.sleep_s(WATCH_CYCLES * context.servo_period_s / WATCH_POLLS)
        for motor, reading in read_motors(link, motors).items():
            jump = abs(reading.following_error_ct - begin[motor])
            if jump > bound_ct and reading.status.is_closed_loop:
                link.command("I51=0")
                raise MotorNotSafe(
                    f"Motor #{motor} left its place by {jump:.1f} counts after enabling; "
                    "compensation was switched off again.",
                    code="PC-UPL-008",
                    hint="Something pushes the axis, or a table is not the one meant: look at "
                    "`pmac-comp diff`, then `pmac-comp recover`.",
                )
