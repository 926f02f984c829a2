"""What has to stand on the card for a law: program, definitions, following, head of the block.

What lives here: the settings that the law needs, and which of them the card lacks. What may not:
what forbids them (``law_checks``), writing them (``law_install``).
"""

import re
from typing import Final

from pmac_comp.base.errors import CommandRefused
from pmac_comp.files.resources import firmware_path
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.card.variables import read_many, read_one, same_value
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.law_bank import (
    MASTER_SCALE_IXX07,
    MASTER_WORD_ADDRESS,
    BankIndex,
    Index,
    LawBlock,
)
from pmac_comp.machine.controller.contents.programs import Program, ProgramKind
from pmac_comp.machine.controller.contents.settings import MOTORS, Settings, plc_runs, read_settings
from pmac_comp.machine.controller.law.law_state import LawForm, LawHead
from pmac_comp.machine.controller.settings.guard_install import (
    CLOCK,
    GUARD,
    GUARD_DEFINITION,
    foreign_guard,
    guard_program,
    is_foreign,
)
from pmac_comp.machine.controller.settings.settings_upload import texts

DEFAULT_RAMP_s: Final = 0.5
HARDER: Final = 1.5  # than the axis ever accelerates: such a step of the command is no motion
LAW: Final = (ProgramKind.PLC, 0)
_FOLLOWING: Final = re.compile(r"I(\d+)06")
_RESCALED: Final = "scales and largest acceleration of the law were set anew"


def law_program(context_block: LawBlock, motor: int) -> Program:
    """PLC 0 of ``firmware_plc`` for a motor and a block."""
    text = firmware_path("feedforward_law.plc0").read_text(encoding="utf-8")
    return programs.parse_source(
        programs.render(text, motor=motor, first_p=context_block.first)
    ).program


def definitions(motor: int) -> dict[int, str]:
    """M-variables that PLC 0 and the guard use."""
    base = 0x80 * motor
    return {
        7000: "X:$0,24",
        7001: f"D:${base + 0x08:X}",
        7002: f"X:${MASTER_WORD_ADDRESS:X},0,24,S",
        7003: f"X:${base + 0x30:X},18",
        GUARD_DEFINITION: CLOCK,
        7013: f"X:${base + 0x3F:X},8,16,S",
    }


def _following(motor: int) -> dict[str, str]:
    """Position following in offset mode; the switch last, so that going back it is first."""
    return {
        f"I{motor}05": str(MASTER_WORD_ADDRESS),
        f"I{motor}07": str(MASTER_SCALE_IXX07),
        f"I{motor}06": "3",
    }


def following_in(settings: Settings) -> int | None:
    """Motor that settings make follow the master word of the law, if they do."""
    for name, text in settings.variables.items():
        if (found := _FOLLOWING.fullmatch(name)) and parse_integer(text) & 1:
            return int(found[1])
    return None


def followers(link: Link) -> frozenset[int]:
    """Motors that follow the master word of the law, of whichever block."""
    masters, modes = (
        [parse_integer(text) for text in link.query(f"I1{tail},{MOTORS},100")]
        for tail in ("05", "06")
    )
    return frozenset(
        motor
        for motor, (master, mode) in enumerate(zip(masters, modes, strict=True), start=1)
        if master == MASTER_WORD_ADDRESS and mode & 1
    )


def law_standing(link: Link, motor: int) -> Settings:
    """What stands in the places of law and guard."""
    variables = {**_following(motor), "I8": "", f"I{motor}01": "", f"I{motor}29": ""}
    asked = Settings(variables, definitions(motor), {LAW: (), GUARD: ()})
    return read_settings(link, asked)


def holds_law(block: LawBlock, found: Settings) -> bool:
    """Whether PLC 0 holds the law of this block, of any version and motor, running or not."""
    return bool(found.programs[LAW]) and not is_foreign(found, LAW, law_program(block, 1))


def law_stands(link: Link, block: LawBlock) -> bool:
    """Whether PLC 0 holds the law of this block, of any version and motor, running or not."""
    return holds_law(block, plc_0(link))


def plc_0(link: Link) -> Settings:
    """PLC 0 as it stands; nothing where a password hides it, as a law of ours has none."""
    asked = Settings(programs={LAW: ()})
    try:
        return read_settings(link, asked)
    except CommandRefused as error:
        if programs.explain_protection(error):
            return asked
        raise


def running_form(link: Link, context: Context, head: LawHead) -> LawForm:
    """The form that runs; a PLC 0 that was taken off leaves its signature behind.

    What runs in PLC 0 then may be the law of another block.
    """
    if head.form is LawForm.PLC and not (plc_runs(link, 0) and law_stands(link, context.block)):
        return LawForm.NONE
    return head.form


def law_missing(
    link: Link,
    context: Context,
    motor: int,
    head: LawHead,
    found: Settings,
    ramp_s: float,
    every_cycles: int,
) -> tuple[Settings, tuple[str, ...]]:
    """Settings that are not there yet, and what putting them there is called."""
    block = context.block
    law, guard = law_program(block, motor), guard_program(block)
    wanted_following, pace = _following(motor), {"I8": str(every_cycles - 1)}
    whole = programs.canonical(found.programs[LAW]) == law.tokens and head.motor == motor
    paced = parse_integer(found.variables["I8"]) == every_cycles - 1
    follows = all(same_value(float(parse_integer(found.variables[k])), float(parse_integer(v)))
                  for k, v in wanted_following.items())  # fmt: skip
    guarded = programs.canonical(found.programs[GUARD]) == guard.tokens and 1 in found.running
    foreign = foreign_guard(found, block)
    wanted = {
        LAW: None if whole and 0 in found.running else law.lines,
        GUARD: None if guarded or foreign else guard.lines,
    }
    programs_missing = {key: lines for key, lines in wanted.items() if lines is not None}
    scales = _stale_scales(link, context, motor, Index.STEP_PLC)
    variables = (
        scales if whole else _head_values(link, context, head, motor, ramp_s, Index.STEP_PLC)
    )
    goal = Settings(
        {**variables, **({} if paced else pace), **({} if follows else wanted_following)},
        {} if whole else definitions(motor),
        programs_missing,
        running=frozenset(number for _, number in programs_missing),
    )
    notes = (
        "PLC 0 is on the card already" if whole else "PLC 0 was written and listed back",
        "" if follows else f"motor #{motor} follows X:${MASTER_WORD_ADDRESS:X} in offset mode",
        "" if paced else f"PLC 0 runs every {every_cycles} servo cycles (I8 = {every_cycles - 1})",
        _RESCALED if whole and scales else "",
        foreign,
        "" if guarded or foreign else "the guard (PLC 1) was written and listed back",
    )
    return goal, tuple(note for note in notes if note)


def servo_missing(link: Link, context: Context, motor: int, head: LawHead) -> Settings:
    """What is to be set up for an open servo: its head; a law that PLC 0 holds idle goes."""
    idle = {LAW: ()} if law_stands(link, context.block) else {}
    if head.motor == motor and head.slew != 0.0 and head.form is not LawForm.PLC:
        return Settings(_stale_scales(link, context, motor, Index.STEP_SERVO), programs=idle)
    values = _head_values(link, context, head, motor, DEFAULT_RAMP_s, Index.STEP_SERVO)
    return Settings(values, programs=idle)


def _scales(link: Link, context: Context, motor: int, step: Index) -> dict[str, float]:
    """What the law makes of registers, and up to which acceleration the command is a motion."""
    block, period_s = context.block, context.servo_period_s
    i08 = read_one(link, f"I{motor}08")
    return {
        f"P{block.p(step)}": HARDER * context.limits.hardest_ct_per_s2 * period_s**2,
        f"P{block.p(Index.OUT_SCALE)}": 32.0 * i08 / MASTER_SCALE_IXX07,
        f"P{block.p(Index.IN_SCALE)}": 1.0 / (32.0 * i08),
    }


def _stale_scales(link: Link, context: Context, motor: int, step: Index) -> dict[str, str]:
    """Those that stand otherwise: another bench file, an earlier version, the other form's work.

    With a largest acceleration that is too small, a law takes motions up late.
    """
    wanted = _scales(link, context, motor, step)
    found = read_many(link, list(wanted))
    return texts({k: v for k, v in wanted.items() if not same_value(found[k], v)})


def _head_values(
    link: Link, context: Context, head: LawHead, motor: int, ramp_s: float, step: Index
) -> dict[str, str]:
    """Head of the block for a motor, disarmed, with unsealed banks.

    The bank in use stays the one in use: the new law goes into the other one, so that a rollback
    finds the values of the old one.
    """
    block = context.block
    return texts(
        {
            f"P{block.p(Index.TARGET)}": 0,
            # Of a law that a reset took away; where one stands, it is refused to set it up armed.
            **({f"P{block.p(Index.GAIN)}": 0} if head.gain else {}),
            f"P{block.bank(0, BankIndex.SEALED)}": 0,
            f"P{block.bank(1, BankIndex.SEALED)}": 0,
            f"P{block.p(Index.BANK)}": int(head.bank == 1),
            f"P{block.p(Index.CLAMP)}": context.limits.max_correction_ct,
            f"P{block.p(Index.HEARTBEAT)}": -1,
            f"P{block.p(Index.SLEW)}": context.servo_period_s / ramp_s,
            f"P{block.p(Index.MOTOR)}": motor,
            **_scales(link, context, motor, step),
        }
    )
