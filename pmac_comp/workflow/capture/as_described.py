"""Is the controller set up as the bench file says: clock, control law, units, motors.

Where card and bench file differ, the model would describe another loop than the one that is
measured or compensated: runs and uploads are refused, and the differences are named. Nothing here
moves or writes; putting the bench file's values on is ``commissioning``.
"""

from typing import Final

from pmac_comp.base.errors import MotorNotSafe, SafetyRefusal
from pmac_comp.base.units import US_PER_S
from pmac_comp.files.bench import Bench
from pmac_comp.machine.controller.card.identity import read_servo_period_s
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import plain
from pmac_comp.machine.controller.card.variables import read_many, read_one, same_value
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.programs import ProgramKind
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.motors.feed_override import run_refusals
from pmac_comp.machine.controller.motors.motors import read_motors
from pmac_comp.workflow.bench.view import tuned_motors
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.card_law import law_refusals, limit_remarks
from pmac_comp.workflow.motion.pvt import PROGRAM_NUMBER

CLOCK: Final = ("I10", "I7000", "I7001", "I7002")  # set with the card, not by a running client
ENTRY_RESULT: Final = 0x3501  # X: of the first line of the encoder conversion table, I8000 (p. 232)
_OF_COMPENSATION: Final = ("05", "06", "07", "29", "59", "85", "86", "87")  # of the motor
_SOFTWARE_1T, _NO_EXTENSION = 0x0, 0xC  # methods: first hex digit of the entry
_LOWEST_CHANNEL: Final = 0x78000  # of a servo IC; second lines of entries lie below
RUN_SYSTEM: Final = 1  # coordinate system of every run
_SHOWN: Final = 8
_CLOCK_FRAC: Final = 0.01  # rounded figures of bench files lie closer; doctor remarks on less


def require_as_described(axis: Axis) -> None:
    """Refuse to measure on a card that is set up differently from the bench file.

    Raises
    ------
    SafetyRefusal
        All reasons together; nothing was changed.
    """
    found = [*description_refusals(axis), *program_refusals(axis.link)]
    raise_all([*found, *run_refusals(axis.link, RUN_SYSTEM)], "The run")


def description_refusals(axis: Axis) -> list[SafetyRefusal]:
    """Where clock, control law, units or motors of the card are not those of the bench file.

    What was computed for the one is wrong on the other.
    """
    return [
        *clock_refusals(axis.link, axis.bench),
        *variable_refusals(axis.link, axis.bench),
        *law_refusals(axis.link, axis.bench),
        *motor_refusals(axis.link, axis.bench),
        *swap_refusals(axis.bench),
        *conversion_refusals(axis.link, axis.bench),
    ]


def differing_variables(link: Link, bench: Bench) -> dict[str, tuple[float, float]]:
    """I-variables of the bench file that stand otherwise: value on the card, value in the file.

    Those that a compensation sets itself while it is on are left out.
    """
    motor = bench.encoder.motor_number
    own = {"I8", "I51", *(f"I{motor}{tail}" for tail in _OF_COMPENSATION)}
    wanted = {k: v for k, v in bench.controller.ivariables.items() if k not in own}
    found = read_many(link, list(wanted)) if wanted else {}
    return {
        name: (found[name], value)
        for name, value in wanted.items()
        if not same_value(found[name], value)
    }


def variables_text(differing: dict[str, tuple[float, float]]) -> str:
    """The first few differences, for a person."""
    items = [
        f"{name} = {plain(card)} ({plain(value)})" for name, (card, value) in differing.items()
    ]
    more = f" and {len(items) - _SHOWN} more" if len(items) > _SHOWN else ""
    return ", ".join(items[:_SHOWN]) + more


def variable_refusals(link: Link, bench: Bench) -> list[SafetyRefusal]:
    """Refusal where I-variables differ from the bench file."""
    differing = differing_variables(link, bench)
    if not differing:
        return []
    return [
        SafetyRefusal(
            "I-variables on the card differ from the bench file (its value in brackets): "
            f"{variables_text(differing)}.",
            code="PC-COM-001",
            hint="Correct [controller.ivariables] where the card is right, or put the file's "
            "values on the card with `pmac-comp setup URL --bench FILE`.",
        )
    ]


def clock_refusals(link: Link, bench: Bench) -> list[SafetyRefusal]:
    """Refusal where the card's servo period is another: the bench file is of another axis."""
    period_s = read_servo_period_s(link)
    if abs(period_s / bench.servo_period_s - 1.0) < _CLOCK_FRAC:
        return []
    return [
        SafetyRefusal(
            f"A servo cycle of the card takes {period_s * US_PER_S:.1f} us (I10), in the bench "
            f"file it is {bench.servo_period_s * US_PER_S:.1f} us.",
            code="PC-COM-007",
            hint="Name the bench file of this axis with --bench, or correct servo_period_us and "
            "I10 in it; nothing was moved.",
        )
    ]


def motor_refusals(link: Link, bench: Bench) -> list[SafetyRefusal]:
    """Refusals where a motor of the bench file is not activated: its position stands still."""
    readings = read_motors(link, bench.motor_numbers)
    return [
        MotorNotSafe(
            f"Motor #{number} of the bench file is not activated (I{number}00 = 0).",
            code="PC-COM-002",
            hint="Check motor_number of [encoder] and [scale]; a scale needs an activated motor "
            "that reads it and is never enabled.",
        )
        for number, reading in readings.items()
        if not reading.status.is_activated
    ]


def swap_refusals(bench: Bench) -> list[SafetyRefusal]:
    """Refusal where the gains of the bench file belong to another motor than would be enabled."""
    tuned, motor = tuned_motors(bench), bench.encoder.motor_number
    if not tuned or motor in tuned:
        return []
    return [
        MotorNotSafe(
            f"The bench file has gains of motor #{tuned[0]} (I{tuned[0]}30), but [encoder] "
            f"motor_number is {motor}: motor #{motor} would be enabled.",
            code="PC-COM-006",
            hint="Check motor_number of [encoder] and [scale]; they may be swapped.",
        )
    ]


def conversion_refusals(link: Link, bench: Bench) -> list[SafetyRefusal]:
    """Refusal where the encoder conversion extends counts and the bench file says otherwise."""
    motor = bench.encoder.motor_number
    line = int(read_one(link, f"I{motor}03")) - ENTRY_RESULT
    if not 0 <= line <= 191:
        return []  # the loop is closed by something else than a conversion entry
    entry = int(read_one(link, f"I{8000 + line}"))
    if entry & 0x7FFFF < _LOWEST_CHANNEL:
        return []
    extended = {_SOFTWARE_1T: True, _NO_EXTENSION: bool(entry & 0x80000)}.get(entry >> 20)
    if extended is None or extended == (bench.encoder.extension == "1/T"):
        return []
    does, said = ("extends", "none") if extended else ("does not extend", "1/T")
    return [
        SafetyRefusal(
            f"The conversion of motor #{motor} (I{8000 + line} = ${entry:06X}) {does} counts; the "
            f'bench file says extension = "{said}".',
            code="PC-COM-003",
            hint="Correct [encoder] extension: the model rounds the encoder as it says.",
        )
    ]


def program_refusals(link: Link) -> list[SafetyRefusal]:
    """Refusal where the motion program of our runs is somebody else's."""
    lines = programs.listing(link, ProgramKind.PROG, PROGRAM_NUMBER)
    if lines is None or programs.canonical(lines)[:1] in ((), ("DWE100",)):
        return []
    return [
        SafetyRefusal(
            f"PROG {PROGRAM_NUMBER} holds a program that is not ours; a run would replace it.",
            code="PC-COM-004",
            hint=f"Keep it under another number and empty PROG {PROGRAM_NUMBER}.",
        )
    ]


def place_remarks(link: Link, bench: Bench) -> tuple[str, ...]:
    """What a person should know of the axis's zero and of its limits before it moves."""
    return (*_reference_remarks(link, bench), *limit_remarks(link, bench))


def _reference_remarks(link: Link, bench: Bench) -> tuple[str, ...]:
    """That zero lies where the motor stood at power-up, if it was not homed since.

    Tables, the law's dependence on position and the travel limits all count from the motor's zero.
    """
    motor = bench.encoder.motor_number
    if read_motors(link, [motor])[motor].status.is_homed:
        return ()
    return (
        f"motor #{motor} has not been homed since power-up: without an absolute encoder its zero "
        "is where it stood then, and tables, law and travel limits count from there",
    )
