"""Which motors run through the card's open servo, and whether it works in a block of ours.

A card has one open servo; every motor with bit 0 of Ixx59 runs through it. Ours
(``firmware_plc/feedforward_servo.txt``) carries the law for one of them and is the plain loop for
the others, but it writes its hand-over registers and scratch for all. Sources: Software Reference
Manual p. 123, User Manual p. 169-179.
"""

from collections.abc import Sequence

from pmac_comp.base.errors import MotorNotSafe, SafetyRefusal
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.variables import read_many, read_one
from pmac_comp.machine.controller.contents.law_bank import OF_EVERY_MOTOR, Index, LawBlock
from pmac_comp.machine.controller.contents.settings import MOTORS
from pmac_comp.machine.controller.motors.motors import read_motors


def motors_in_open_servo(link: Link) -> tuple[int, ...]:
    """Numbers of the activated motors that run through the open servo."""
    found = read_many(link, [f"I{m}{tail}" for m in range(1, MOTORS + 1) for tail in ("00", "59")])
    return tuple(
        m for m in range(1, MOTORS + 1) if int(found[f"I{m}00"]) and int(found[f"I{m}59"]) & 1
    )


def is_in_open_servo(link: Link, motor: int) -> bool:
    """Whether a motor runs through the open servo; a number that no motor has does not."""
    return 1 <= motor <= MOTORS and bool(int(read_one(link, f"I{motor}59")) & 1)


def scratch_refusals(link: Link, block: LawBlock, motor: int) -> list[SafetyRefusal]:
    """Refusal of PLC 0 where the open servo of other motors writes into the same block.

    It is known by its scratch, which PLC 0 leaves alone: limits of the loop in counts, never 0
    once a motor has run through it in closed loop.
    """
    others = [m for m in motors_in_open_servo(link) if m != motor]
    if not others or not _has_scratch(link, block):
        return []
    scratch, last = block.p(Index.SCRATCH_SERVO), block.p(OF_EVERY_MOTOR[-1])
    return [
        MotorNotSafe(
            f"The open servo runs for motor {_names(others)} and writes "
            f"P{scratch} to P{last} in every servo cycle: PLC 0 works with the same variables.",
            code="PC-LAW-052",
            hint="Use --route servo, which carries the law of this motor as well, or another "
            "p_block for this axis, and compute again. Where that servo uses other variables and "
            f"these are left over: `pmac-comp terminal URL -c 'P{scratch}=0'`.",
        )
    ]


def scratch_remarks(link: Link, block: LawBlock, motor: int) -> tuple[str, ...]:
    """That nothing shows yet which variables an open servo uses that waits for other motors."""
    killed = [
        m
        for m, reading in read_motors(link, motors_in_open_servo(link)).items()
        if m != motor and not reading.status.is_closed_loop
    ]
    if not killed or _has_scratch(link, block):
        return ()
    return (
        f"motor {_names(killed)} will run through the card's open servo: with the servo of "
        "firmware_plc and this p_block it would write into what PLC 0 works with; one of the two "
        "needs another p_block then",
    )


def _names(numbers: Sequence[int]) -> str:
    return ", ".join(f"#{m}" for m in numbers)


def _has_scratch(link: Link, block: LawBlock) -> bool:
    return read_one(link, f"P{block.p(Index.SCRATCH_SERVO)}") != 0.0
