"""Motors: where they are, what their status says, how to move, stop, enable and kill them.

Positions are counts of the motor. Commands go to one motor by ``#n`` in the same line, so that no
other conversation's addressing matters. Source: Software Reference Manual p. 280-291, 322-340,
382, 401.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntFlag
from functools import lru_cache
from typing import Final

from pmac_comp.base.errors import MotorNotSafe, RemoteProtocolError
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import nine_digits
from pmac_comp.machine.controller.change.card_time import CardDeadline
from pmac_comp.machine.wire.numbers import read_number

Reader = Callable[["Link", Sequence[int]], "dict[int, MotorReading]"]
"""Reads motors, perhaps together with something else that the caller wants to know then."""
POLL_s: Final = 0.02
STATIONARY_SPACING_s: Final = 0.02
QUICK_SPACING_s: Final = 0.5 * STATIONARY_SPACING_s  # over a switch, if nothing seems to move
PART_SPACING_s: Final = 0.125 * STATIONARY_SPACING_s  # of it before the switch, and again after it
LONGEST_SPACING_s: Final = 0.1  # between two looks
_INSIDE_FRAC: Final = 0.01  # of the travel between the limits: well inside one of them
_SYSTEM_SHIFT: Final = 20  # bits 20-23 of the second status word: number less one


class Word1(IntFlag):
    """First status word (p. 280-284)."""

    ACTIVATED = 1 << 23
    NEGATIVE_LIMIT = 1 << 22
    POSITIVE_LIMIT = 1 << 21
    EXTENDED_SERVO = 1 << 20
    AMPLIFIER_ENABLED = 1 << 19
    OPEN_LOOP = 1 << 18
    MOVE_TIMER = 1 << 17
    INTEGRATION_MODE = 1 << 16
    DWELL = 1 << 15
    DATA_BLOCK_ERROR = 1 << 14
    DESIRED_VELOCITY_ZERO = 1 << 13
    ABORT_DECELERATION = 1 << 12
    BLOCK_REQUEST = 1 << 11
    HOME_SEARCH = 1 << 10
    USER_PHASE = 1 << 9
    USER_SERVO = 1 << 8
    FOLLOWING_OFFSET_MODE = 1 << 5
    FOLLOWING = 1 << 4


class Word2(IntFlag):
    """Second status word (p. 284-286)."""

    ASSIGNED = 1 << 15
    HOMEZ = 1 << 14
    FOREGROUND_IN_POSITION = 1 << 13
    STOPPED_ON_DESIRED_LIMIT = 1 << 12
    STOPPED_ON_LIMIT = 1 << 11
    HOME_COMPLETE = 1 << 10
    PHASE_ERROR = 1 << 8
    TRIGGER_MOVE = 1 << 7
    INTEGRATED_FATAL = 1 << 6
    I2T_FAULT = 1 << 5
    BACKLASH_NEGATIVE = 1 << 4
    AMPLIFIER_FAULT = 1 << 3
    FATAL_FOLLOWING_ERROR = 1 << 2
    WARNING_FOLLOWING_ERROR = 1 << 1
    IN_POSITION = 1 << 0


_TRIPS: Final = {
    Word2.AMPLIFIER_FAULT: "amplifier fault",
    Word2.FATAL_FOLLOWING_ERROR: "fatal following error",
    Word2.INTEGRATED_FATAL: "integrated following error",
    Word2.I2T_FAULT: "current limit (I2T)",
    Word2.PHASE_ERROR: "phasing error",
    Word2.STOPPED_ON_LIMIT: "stopped on a position limit",
    Word2.STOPPED_ON_DESIRED_LIMIT: "stopped on the desired-position limit",
}


@dataclass(frozen=True)
class MotorStatus:
    """Twelve hexadecimal digits of ``?``, decoded."""

    word1: Word1
    word2: Word2

    @classmethod
    @lru_cache(maxsize=256)
    def parse(cls, text: str) -> "MotorStatus":
        """Status from the answer to ``?``; raises RemoteProtocolError otherwise."""
        digits = text.strip()
        if len(digits) != 12 or not set(digits) <= set("0123456789ABCDEFabcdef"):
            raise RemoteProtocolError(f"A motor status of {text!r} is not understood.")
        return cls(Word1(int(digits[:6], 16)), Word2(int(digits[6:], 16)))

    @property
    def is_activated(self) -> bool:
        """Whether Ixx00 is 1."""
        return Word1.ACTIVATED in self.word1

    @property
    def is_killed(self) -> bool:
        """Whether the amplifier is off."""
        return Word1.AMPLIFIER_ENABLED not in self.word1

    @property
    def is_closed_loop(self) -> bool:
        """Whether the position loop acts."""
        return not self.is_killed and Word1.OPEN_LOOP not in self.word1

    @property
    def is_commanded_still(self) -> bool:
        """Whether the trajectory stands: velocity zero and no move, dwell or search runs."""
        busy = Word1.MOVE_TIMER | Word1.HOME_SEARCH | Word1.ABORT_DECELERATION
        return Word1.DESIRED_VELOCITY_ZERO in self.word1 and not self.word1 & busy

    @property
    def is_in_position(self) -> bool:
        """Whether the card says in position."""
        return Word2.IN_POSITION in self.word2

    @property
    def is_homed(self) -> bool:
        """Whether a homing search has ended since power-up."""
        return Word2.HOME_COMPLETE in self.word2

    @property
    def trips(self) -> tuple[str, ...]:
        """Faults that stopped the motor, in words."""
        return tuple(text for bit, text in _TRIPS.items() if bit in self.word2)

    @property
    def is_only_on_limit(self) -> bool:
        """Whether nothing but a position limit stopped the motor."""
        limits = {Word2.STOPPED_ON_LIMIT, Word2.STOPPED_ON_DESIRED_LIMIT}
        stopped = {bit for bit in _TRIPS if bit in self.word2}
        return bool(stopped) and stopped <= limits

    @property
    def coordinate_system(self) -> int:
        """Number of the coordinate system whose time base the motor obeys; 1 if it is in none."""
        return (int(self.word2) >> _SYSTEM_SHIFT) + 1 if Word2.ASSIGNED in self.word2 else 1

    def names(self) -> list[str]:
        """Names of all bits that are set."""
        bits = [*Word1.__members__.values(), *Word2.__members__.values()]
        words = [self.word1] * len(Word1.__members__) + [self.word2] * len(Word2.__members__)
        return [str(bit.name) for bit, word in zip(bits, words, strict=True) if int(bit) & word]


@dataclass(frozen=True)
class MotorReading:
    """One motor at one moment, counts."""

    motor: int
    status: MotorStatus
    position_ct: float
    velocity_ct_per_sc: float
    following_error_ct: float


def read_motors(link: Link, motors: Sequence[int]) -> dict[int, MotorReading]:
    """Status, position, velocity and following error of motors, one question for eight."""
    readings: dict[int, MotorReading] = {}
    for start in range(0, len(motors), 8):
        group = motors[start : start + 8]
        readings |= parse_readings(group, link.query(reading_text(group)))
    return readings


def reading_text(motors: Sequence[int]) -> str:
    """Question for status, position, velocity and following error of motors."""
    return "".join(f"#{m}?#{m}P#{m}V#{m}F" for m in motors)


def parse_readings(motors: Sequence[int], lines: Sequence[str]) -> dict[int, MotorReading]:
    """Readings from the answer to ``reading_text``; raises RemoteProtocolError."""
    if len(lines) != 4 * len(motors):
        raise RemoteProtocolError(f"{len(motors)} motors answered {len(lines)} lines.")
    readings: dict[int, MotorReading] = {}
    for k, motor in enumerate(motors):
        status, *numbers = lines[4 * k : 4 * k + 4]
        values = [float(read_number(text)) for text in numbers]
        readings[motor] = MotorReading(motor, MotorStatus.parse(status), *values)
    return readings


def read_motor(link: Link, motor: int) -> MotorReading:
    """One motor now."""
    return read_motors(link, [motor])[motor]


@dataclass(frozen=True)
class Standstill:
    """First of the two looks that prove that motors stand; other requests may lie between.

    Parameters
    ----------
    first : dict of int to MotorReading
        The readings.
    at_s : float
        When they were taken, on the clock of the conversation.
    travelled_ct, watched_s
        How far motors went in an earlier part of the proof, and how long that was: a switch that
        moves them a little may cut the proof in two.
    """

    first: dict[int, MotorReading]
    at_s: float
    travelled_ct: Mapping[int, float] = field(default_factory=dict)
    watched_s: float = 0.0


@dataclass(frozen=True)
class Rest:
    """What two looks say.

    Parameters
    ----------
    reasons : tuple of str
        Why motors are not at rest, empty when all stand.
    readings : dict of int to MotorReading
        The second look.
    travelled_ct, watched_s
        How far motors went, and in which time.
    """

    reasons: tuple[str, ...]
    readings: dict[int, MotorReading]
    travelled_ct: Mapping[int, float]
    watched_s: float

    def goes_on(self, look: Standstill) -> Standstill:
        """A look after a switch, from which the proof goes on if it was not whole yet."""
        if self.watched_s >= STATIONARY_SPACING_s:
            return look
        return replace(look, travelled_ct=self.travelled_ct, watched_s=self.watched_s)


def begin_standstill(link: Link, motors: Sequence[int]) -> Standstill:
    """Look where motors are, for ``moving_motors`` later."""
    return Standstill(read_motors(link, motors), link.clock.now_s())


def look_again(
    link: Link,
    motors: Sequence[int],
    *looks: Standstill | None,
    spacing_s: float = STATIONARY_SPACING_s,
    reader: Reader | None = None,
) -> Rest:
    """Whether motors are at rest; ``reader`` takes the second look.

    A motor is at rest if it is killed and its position does not change, or if its trajectory
    stands. Two readings are compared, at least ``spacing_s`` apart; the first may be the earliest
    of ``looks`` that is fresh: over a longer time slow drift would count as motion. After a short
    spacing a motor that goes faster than a still one may is looked at once more after the full one:
    a short spacing finds the same speed, from fewer counts.
    """
    begun = next((k for k in looks if k is not None and is_fresh(link, motors, k)), None)
    begun = begun or begin_standstill(link, motors)
    wait_s = max(PART_SPACING_s, spacing_s - begun.watched_s)
    found = _second_look(link, motors, begun, wait_s, reader or read_motors)
    share = found.watched_s / STATIONARY_SPACING_s
    if share < 1.0 and any(
        found.travelled_ct[m] > share * _allowed_ct(found.readings[m]) for m in motors
    ):
        return _second_look(link, motors, begun, STATIONARY_SPACING_s, reader or read_motors)
    return found


def _second_look(
    link: Link, motors: Sequence[int], begun: Standstill, wait_s: float, reader: Reader
) -> Rest:
    link.clock.sleep_s(max(0.0, wait_s - (link.clock.now_s() - begun.at_s)))
    watched_s = begun.watched_s + link.clock.now_s() - begun.at_s
    second = reader(link, motors)
    travelled_ct = {
        m: begun.travelled_ct.get(m, 0.0) + abs(second[m].position_ct - begun.first[m].position_ct)
        for m in motors
    }
    reasons = [_motion(begun.first[m], second[m], travelled_ct[m], watched_s) for m in motors]
    return Rest(tuple(r for r in reasons if r), second, travelled_ct, watched_s)


def _allowed_ct(reading: MotorReading) -> float:
    # Closed loop at rest: encoder noise and the settling of the integrator stay within this.
    return 20.0 if reading.status.is_closed_loop else 2.0


def moving_motors(link: Link, motors: Sequence[int], *looks: Standstill | None) -> tuple[str, ...]:
    """Why motors are not at rest, one text per reason; empty when all stand."""
    return look_again(link, motors, *looks).reasons


def is_fresh(link: Link, motors: Sequence[int], look: Standstill) -> bool:
    """Whether a look is young enough to be the first of two, and of all motors."""
    age_s = link.clock.now_s() - look.at_s
    return age_s <= LONGEST_SPACING_s and not set(motors) - set(look.first)


def executing_moves(readings: Mapping[int, MotorReading]) -> tuple[str, ...]:
    """Why motors are not at rest, as far as one reading tells."""
    found = (_motion(reading, reading, 0.0, 0.0) for reading in readings.values())
    return tuple(reason for reason in found if reason)


def _motion(
    first: MotorReading, second: MotorReading, travelled_ct: float, watched_s: float
) -> str:
    name = f"motor #{second.motor}"
    for reading in (first, second):
        active = reading.status.is_activated and reading.status.is_closed_loop
        if active and not reading.status.is_commanded_still:
            return f"{name} is executing a move"
    if travelled_ct > _allowed_ct(second):
        return f"{name} moves by itself ({travelled_ct:.1f} counts within {watched_s:.2g} s)"
    return ""


def require_stationary(link: Link, motors: Sequence[int]) -> None:
    """Refuse while a motor moves; raises MotorNotSafe."""
    reasons = moving_motors(link, motors)
    if reasons:
        raise MotorNotSafe(
            "; ".join(reasons) + ".", code="PC-MOT-001", hint="Stop the motion and try again."
        )


def enable(link: Link, motor: int, *, timeout_s: float = 2.0) -> MotorReading:
    """Close the loop of a motor where it stands; raises MotorNotSafe if it does not stay closed.

    The bit of a trajectory that stands follows a servo cycle later: who looked before would take
    the motor for one that executes a move.
    """
    link.command(f"#{motor}J/")
    deadline = CardDeadline(link, timeout_s)
    while True:
        reading = read_motor(link, motor)
        is_closed = reading.status.is_closed_loop and not reading.status.trips
        if is_closed and (reading.status.is_commanded_still or deadline.expired()):
            return reading
        if deadline.expired():
            if reading.status.is_closed_loop and reading.status.is_only_on_limit:
                raise _on_limit(link, reading)
            reasons = ", ".join(reading.status.trips) or "the amplifier stays off"
            raise MotorNotSafe(
                f"Motor #{motor} does not close its loop: {reasons}.",
                code="PC-MOT-003",
                hint="Check amplifier power, its enable and fault lines, and the limit switches.",
            )
        link.clock.sleep_s(POLL_s)


def _on_limit(link: Link, reading: MotorReading) -> MotorNotSafe:
    """What is said of a motor that closes its loop beyond a limit, where it goes only one way."""
    motor, at_ct = reading.motor, reading.position_ct
    high_ct, low_ct = (read_number(text) for text in link.query(f"I{motor}13I{motor}14"))
    inside_ct = _INSIDE_FRAC * float(high_ct - low_ct)
    if high_ct and at_ct >= high_ct:
        where, back_ct = f"above its software limit I{motor}13 = {high_ct:.0f}", high_ct - inside_ct
    elif low_ct and at_ct <= low_ct:
        where, back_ct = f"below its software limit I{motor}14 = {low_ct:.0f}", low_ct + inside_ct
    else:
        return MotorNotSafe(
            f"Motor #{motor} closes its loop and is held by a limit switch, at {at_ct:.0f} counts.",
            code="PC-MOT-043",
            hint=f"Jog it off the switch first (`pmac-comp terminal URL -c '#{motor}J:COUNTS'`, "
            "away from the end of the travel), or check the switch where it does not stand there.",
        )
    return MotorNotSafe(
        f"Motor #{motor} closes its loop, but stands at {at_ct:.0f} counts, {where}.",
        code="PC-MOT-042",
        hint=f"Jog it back inside first: `pmac-comp terminal URL -c '#{motor}J={back_ct:.0f}'`. "
        f"If it may stand there, I{motor}13 and I{motor}14 are wrong (0 switches one off).",
    )


def kill(link: Link, motor: int) -> None:
    """Switch the amplifier of a motor off."""
    link.command(f"#{motor}K")


def jog_to(link: Link, motor: int, position_ct: float) -> None:
    """Start a jog to a position in counts."""
    link.command(f"#{motor}J={nine_digits(position_ct)}")


def wait_in_position(
    link: Link, motor: int, *, timeout_s: float, during: Callable[[], None] | None = None
) -> MotorReading:
    """Wait until a motor is in position; ``during`` is called after each look that finds it going.

    Raises
    ------
    MotorNotSafe
        The motor tripped or was killed on the way, or is not in position in time: then it is left
        as it is.
    """
    deadline = CardDeadline(link, timeout_s)
    while True:
        reading = read_motor(link, motor)
        if reading.status.trips or reading.status.is_killed:
            why = ", ".join(reading.status.trips) or "it was killed"
            raise MotorNotSafe(
                f"Motor #{motor} stopped before its target: {why}.",
                code="PC-MOT-004",
                hint="Find out what stopped it before it is enabled again; `pmac-comp status` "
                "shows the motors.",
            )
        if reading.status.is_in_position and reading.status.is_commanded_still:
            return reading
        if during is not None:
            during()
        if deadline.expired():
            raise MotorNotSafe(
                f"Motor #{motor} was not in position after {timeout_s:g} s "
                f"(following error {reading.following_error_ct:.1f} counts).",
                code="PC-MOT-002",
                hint=_late_hint(reading),
            )
        link.clock.sleep_s(POLL_s)


def _late_hint(reading: MotorReading) -> str:
    if reading.status.is_commanded_still:
        return "Check Ixx28, the integrator and friction."
    system = reading.status.coordinate_system
    return (
        "Its command had not arrived either. Look at the feed rate override: `pmac-comp terminal "
        f"URL -c '&{system}%'` should say 100; and at the jog speed (Ixx22)."
    )


def move_to(
    link: Link,
    motor: int,
    position_ct: float,
    *,
    timeout_s: float = 60.0,
    during: Callable[[], None] | None = None,
) -> MotorReading:
    """Jog to a position in counts and wait until it is reached; ``during`` watches, and may raise.

    It is called once before the jog.
    """
    if during is not None:
        during()
    jog_to(link, motor, position_ct)
    link.clock.sleep_s(POLL_s)
    return wait_in_position(link, motor, timeout_s=timeout_s, during=during)
