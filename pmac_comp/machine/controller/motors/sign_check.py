"""A guarded test on the connected controller: which way a correction moves the motor.

The manual's statements about the sign of the compensation register do not agree with one another
(p. 303, 382, 516; User Manual p. 189). So before the first use the sign is measured: a small offset
is put in slowly, the encoder is watched, the offset is taken out again.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from pmac_comp.base.errors import MotorNotSafe, PmacCompError
from pmac_comp.machine.controller.card import registers as reg
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.card.variables import read_many, read_one
from pmac_comp.machine.controller.change.card_time import CardDeadline
from pmac_comp.machine.controller.contents.law_bank import MASTER_WORD_ADDRESS
from pmac_comp.machine.controller.gather.gather import note_failure
from pmac_comp.machine.controller.motors.motors import moving_motors, read_motor, require_stationary

STEPS: Final = 20
STEP_PAUSE_s: Final = 0.01
SETTLE_s: Final = 0.5
RETURN_s: Final = 3.0  # friction holds the motor until the integrator has taken it along
LEAST_RESPONSE: Final = 0.6  # of the offset; less means that something else holds the motor


@dataclass(frozen=True)
class SignResult:
    """What a test found.

    Parameters
    ----------
    offset_ct : float
        Offset put in, counts.
    moved_ct : float
        How far the encoder went.
    """

    offset_ct: float
    moved_ct: float

    @property
    def sign(self) -> int:
        """+1 if a positive value moves the motor up, -1 if down."""
        return 1 if self.moved_ct * self.offset_ct > 0 else -1


def check_master_sign(link: Link, motor: int, *, offset_ct: float = 10.0) -> SignResult:
    """Sign of the master word X:$10F8 of the route ``law`` (law disarmed, word zero).

    Raises
    ------
    MotorNotSafe
        Not in closed loop, not at rest, not following the word, or no clear answer.
    """
    names = [f"I{motor}{k:02d}" for k in (5, 6, 7, 8)]
    source, mode, ixx07, ixx08 = read_many(link, names).values()
    if int(source) != MASTER_WORD_ADDRESS or int(mode) != 3:
        raise MotorNotSafe(
            f"Motor #{motor} does not follow the master word "
            f"(I{motor}05 = {int(source)}, I{motor}06 = {int(mode)}).",
            code="PC-SGN-002",
            hint="The controller was reset, or somebody changed the following that the law set up; "
            "upload again.",
        )
    if parse_integer(link.query(f"RX${MASTER_WORD_ADDRESS:X}")[0]) != 0:
        raise MotorNotSafe(
            "The master word is not zero.",
            code="PC-SGN-003",
            hint="Something else writes it, or a correction was left there: clear it with the "
            f"motor killed (WX${MASTER_WORD_ADDRESS:X},0).",
        )
    unit = 32.0 * ixx08 / ixx07

    def put(value_ct: float) -> None:
        link.command(f"WX${MASTER_WORD_ADDRESS:X},{round(value_ct * unit)}")

    return _measure(link, motor, offset_ct, put)


def _measure(link: Link, motor: int, offset_ct: float, put: Callable[[float], None]) -> SignResult:
    if not read_motor(link, motor).status.is_closed_loop:
        raise MotorNotSafe(
            f"Motor #{motor} is not in closed loop.",
            code="PC-SGN-004",
            hint=f"Enable it (`pmac-comp terminal URL -c '#{motor}J/'`) and run the command again.",
        )
    require_stationary(link, [motor])
    before_ct, reached = _position_ct(link, motor), 0
    try:
        for k in range(1, STEPS + 1):
            reached = k
            put(offset_ct * k / STEPS)
            link.clock.sleep_s(STEP_PAUSE_s)
        link.clock.sleep_s(SETTLE_s)
        after_ct = _position_ct(link, motor)
    except PmacCompError as error:
        note_failure(error, lambda: _take_out(link, put, offset_ct, reached))
        raise
    except KeyboardInterrupt:
        _take_out(link, put, offset_ct, reached)
        raise
    _take_out(link, put, offset_ct, reached)
    moved_ct = after_ct - before_ct
    _await_return(link, motor, after_ct, LEAST_RESPONSE * moved_ct)
    if abs(moved_ct) < LEAST_RESPONSE * abs(offset_ct):
        raise MotorNotSafe(
            f"An offset of {offset_ct:g} counts in the master word moved motor #{motor} by "
            f"{moved_ct:.2f} counts only.",
            code="PC-SGN-005",
            hint="Friction may hold the motor: give the integrator time, or use a larger offset.",
        )
    return SignResult(offset_ct, moved_ct)


def _take_out(link: Link, put: Callable[[float], None], offset_ct: float, reached: int) -> None:
    """As slowly as it was put in: at once it would kick the axis."""
    for k in range(reached - 1, -1, -1):
        put(offset_ct * k / STEPS)
        link.clock.sleep_s(STEP_PAUSE_s)


def _await_return(link: Link, motor: int, from_ct: float, least_ct: float) -> None:
    """Wait until the motor went back by as much and stands, or no longer than that may take.

    Inside its friction it stands first: whoever looked then took it for settled, and what came next
    was refused because the motor moved.
    """
    deadline = CardDeadline(link, RETURN_s)
    while not deadline.expired():
        back_ct = from_ct - _position_ct(link, motor)
        has_returned = abs(back_ct) >= abs(least_ct) and back_ct * least_ct >= 0.0
        if has_returned and not moving_motors(link, [motor]):
            return
        link.clock.sleep_s(STEP_PAUSE_s)


def _position_ct(link: Link, motor: int) -> float:
    """Encoder position."""
    unit = 32.0 * read_one(link, f"I{motor}08")
    return parse_integer(link.query(f"RL${reg.motor_register(motor, reg.ACTUAL):X}")[0]) / unit
