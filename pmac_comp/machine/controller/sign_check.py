"""A guarded test on the connected controller: which way a correction moves the motor.

The manual's statements about the sign of the compensation register do not agree with one another
(p. 303, 382, 516; User Manual p. 189). So before the first use the sign is measured: a small offset
is put in slowly, the encoder is watched, the offset is taken out again.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from pmac_comp.base.errors import MotorNotSafe, PmacCompError
from pmac_comp.machine.controller import registers as reg
from pmac_comp.machine.controller.gather import note_failure
from pmac_comp.machine.controller.law_bank import MASTER_WORD_ADDRESS
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.motors import read_motor, require_stationary
from pmac_comp.machine.controller.numbers import parse_integer
from pmac_comp.machine.controller.variables import read_many, read_one

STEPS: Final = 20
STEP_PAUSE_s: Final = 0.01
SETTLE_s: Final = 0.5
LEAST_RESPONSE: Final = 0.6  # of the offset; less means that something else holds the motor


@dataclass(frozen=True)
class SignResult:
    """What a test found.

    Parameters
    ----------
    door : str
        ``compensation register`` or ``master word``.
    offset_ct : float
        Offset put in, counts.
    moved_ct : float
        How far the encoder went.
    shown_ct : float
        How far P went.
    """

    door: str
    offset_ct: float
    moved_ct: float
    shown_ct: float

    @property
    def sign(self) -> int:
        """+1 if a positive value moves the motor up, -1 if down."""
        return 1 if self.moved_ct * self.offset_ct > 0 else -1

    @property
    def hidden_from_p(self) -> bool:
        """Whether P does not show the offset."""
        return abs(self.shown_ct) < 0.5 * abs(self.moved_ct)


def check_register_sign(link: Link, motor: int, *, offset_ct: float = 10.0) -> SignResult:
    """Sign of the compensation register D:base+$10, with tables off (I51 = 0).

    Raises
    ------
    MotorNotSafe
        Not in closed loop, not at rest, tables on, or no clear answer.
    """
    if read_one(link, "I51") != 0:
        raise MotorNotSafe(
            "Tables act (I51 = 1); the register is theirs.", code="PC-SGN-001", hint="I51=0 first."
        )
    unit = 32.0 * read_one(link, f"I{motor}08")
    address = reg.motor_register(motor, reg.COMPENSATION)

    def put(value_ct: float) -> None:
        raw = round(value_ct * unit) & 0xFFFFFFFFFFFF
        link.command(f"WL${address:X},${raw:012X}")

    return _measure(link, motor, offset_ct, put, "compensation register")


def check_master_sign(link: Link, motor: int, *, offset_ct: float = 10.0) -> SignResult:
    """Sign of the master word X:$10F8 of the route ``law`` (law disarmed, word zero).

    Raises
    ------
    MotorNotSafe
        As ``check_register_sign``; also if the motor does not follow the word.
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

    return _measure(link, motor, offset_ct, put, "master word")


def _measure(
    link: Link, motor: int, offset_ct: float, put: Callable[[float], None], door: str
) -> SignResult:
    if not read_motor(link, motor).status.is_closed_loop:
        raise MotorNotSafe(
            f"Motor #{motor} is not in closed loop.",
            code="PC-SGN-004",
            hint=f"Enable it (`pmac-comp terminal URL -c '#{motor}J/'`) and run the command again.",
        )
    require_stationary(link, [motor])
    before, reached = _positions(link, motor), 0
    try:
        for k in range(1, STEPS + 1):
            reached = k
            put(offset_ct * k / STEPS)
            link.clock.sleep_s(STEP_PAUSE_s)
        link.clock.sleep_s(SETTLE_s)
        after = _positions(link, motor)
    except PmacCompError as error:
        note_failure(error, lambda: _take_out(link, put, offset_ct, reached))
        raise
    except KeyboardInterrupt:
        _take_out(link, put, offset_ct, reached)
        raise
    _take_out(link, put, offset_ct, reached)
    moved, shown = (b - a for a, b in zip(before, after, strict=True))
    if abs(moved) < LEAST_RESPONSE * abs(offset_ct):
        raise MotorNotSafe(
            f"An offset of {offset_ct:g} counts in the {door} moved motor #{motor} by "
            f"{moved:.2f} counts only.",
            code="PC-SGN-005",
            hint="Friction may hold the motor: give the integrator time, or use a larger offset.",
        )
    return SignResult(door, offset_ct, moved, shown)


def _take_out(link: Link, put: Callable[[float], None], offset_ct: float, reached: int) -> None:
    """As slowly as it was put in: at once it would kick the axis."""
    for k in range(reached - 1, -1, -1):
        put(offset_ct * k / STEPS)
        link.clock.sleep_s(STEP_PAUSE_s)


def _positions(link: Link, motor: int) -> tuple[float, float]:
    """Encoder position and P, counts."""
    unit = 32.0 * read_one(link, f"I{motor}08")
    raw = parse_integer(link.query(f"RL${reg.motor_register(motor, reg.ACTUAL):X}")[0])
    return raw / unit, read_motor(link, motor).position_ct
