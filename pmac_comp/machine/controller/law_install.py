"""The law on the controller: program, definitions, following, sign of life.

What lives here: what has to stand on the card before a law can be uploaded, as one transaction
that leaves everything as it was if it does not end. What may not: coefficients (``law_upload``),
the gain (``law_arming``).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from pmac_comp.base.errors import (
    CommandRefused,
    ControllerState,
    MotorNotSafe,
    SafetyRefusal,
    VerifyMismatch,
)
from pmac_comp.files.resources import firmware_path
from pmac_comp.machine.controller import programs
from pmac_comp.machine.controller.context import Context
from pmac_comp.machine.controller.guard_install import (
    CLOCK,
    FOREIGN_GUARD,
    GUARD,
    GUARD_DEFINITION,
    guard_program,
    is_foreign,
)
from pmac_comp.machine.controller.law_arming import disarm
from pmac_comp.machine.controller.law_bank import (
    MASTER_SCALE_IXX07,
    MASTER_WORD_ADDRESS,
    SIGNATURE_SERVO,
    BankIndex,
    Index,
    LawBlock,
)
from pmac_comp.machine.controller.law_state import (
    GAIN_TOLERANCE,
    LawForm,
    LawHead,
    degree_refusals,
    is_running,
    read_law_head,
)
from pmac_comp.machine.controller.link import Link
from pmac_comp.machine.controller.numbers import parse_integer
from pmac_comp.machine.controller.open_servos import scratch_refusals
from pmac_comp.machine.controller.programs import Program, ProgramKind
from pmac_comp.machine.controller.safety import raise_all
from pmac_comp.machine.controller.settings import (
    MOTORS,
    Settings,
    differences,
    plc_runs,
    read_settings,
)
from pmac_comp.machine.controller.settings_upload import SettingsUpload, texts
from pmac_comp.machine.controller.transaction import UploadResult
from pmac_comp.machine.controller.upload_checks import motion_refusals
from pmac_comp.machine.controller.variables import read_many, read_one, same_value, verify_many
from pmac_comp.machine.controller.verdict import untouched

DEFAULT_RAMP_s: Final = 0.5
HARDER: Final = 1.5  # than the axis ever accelerates: such a step of the command is no motion
LAW: Final = (ProgramKind.PLC, 0)
_ARMED: Final = "PC-LAW-021"
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


def install_law(
    link: Link,
    context: Context,
    motor: int,
    *,
    ramp_s: float = DEFAULT_RAMP_s,
    every_cycles: int = 1,
) -> tuple[str, ...]:
    """Put law and guard on the controller, switched off, and prove that they run.

    Following of the master word is set up with the word at zero, so nothing moves. Does nothing
    to what is there already; a failure takes back what was done.

    Parameters
    ----------
    link, context
        Conversation and limits.
    motor : int
        Motor of the law.
    ramp_s : float
        Time in which the gain rises.
    every_cycles : int
        Servo cycles between two passes of PLC 0, written to I8 (p. 42).

    Returns
    -------
    tuple of str
        What was done, for the report.

    Raises
    ------
    SafetyRefusal
        The motor moves, an armed law would be replaced, the open servo has the law already, or
        the master word is not zero: all reasons together, nothing was changed.
    VerifyMismatch
        A program does not list back as sent, or PLC 0 gives no sign of life.
    """
    with untouched():
        head = read_law_head(link, context.block)
        found = _standing(link, motor)
        goal, done = _missing(link, context, motor, head, found, ramp_s, every_cycles)
        if (
            goal.is_empty
            and not _in_open_servo(link, motor)
            and is_running(link, context.block, context.servo_period_s) is LawForm.PLC
        ):
            return done
        refusals = _refusals(link, context.block, motor, head, goal) + _owners(
            context, motor, found
        )
        refusals += _of_another_axis(
            link, context.block, head, motor, stands=_holds_law(context, found)
        )
    with SettingsUpload(link, context, goal, route="law", refusals=refusals) as upload:
        upload.write()
        upload.check(lambda: _require_life(link, context))
        upload.finish()
    return done


def _standing(link: Link, motor: int) -> Settings:
    """What stands in the places of law and guard."""
    variables = {**_following(motor), "I8": "", f"I{motor}01": "", f"I{motor}29": ""}
    asked = Settings(variables, definitions(motor), {LAW: (), GUARD: ()})
    return read_settings(link, asked)


def _missing(
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
    following, pace = _following(motor), {"I8": str(every_cycles - 1)}
    whole = programs.canonical(found.programs[LAW]) == law.tokens and head.motor == motor
    paced = parse_integer(found.variables["I8"]) == every_cycles - 1
    follows = all(same_value(float(parse_integer(found.variables[k])), float(parse_integer(v)))
                  for k, v in following.items())  # fmt: skip
    guarded = programs.canonical(found.programs[GUARD]) == guard.tokens and 1 in found.running
    foreign_guard = is_foreign(found, GUARD, guard)
    wanted = {
        LAW: None if whole and 0 in found.running else law.lines,
        GUARD: None if guarded or foreign_guard else guard.lines,
    }
    programs_missing = {key: lines for key, lines in wanted.items() if lines is not None}
    scales = _stale_scales(link, context, motor, Index.STEP_PLC)
    variables = (
        scales if whole else _head_values(link, context, head, motor, ramp_s, Index.STEP_PLC)
    )
    goal = Settings(
        {**variables, **({} if paced else pace), **({} if follows else following)},
        {} if whole else definitions(motor),
        programs_missing,
        running=frozenset(number for _, number in programs_missing),
    )
    notes = (
        "PLC 0 is on the card already" if whole else "PLC 0 was written and listed back",
        "" if follows else f"motor #{motor} follows X:${MASTER_WORD_ADDRESS:X} in offset mode",
        "" if paced else f"PLC 0 runs every {every_cycles} servo cycles (I8 = {every_cycles - 1})",
        _RESCALED if whole and scales else "",
        FOREIGN_GUARD if foreign_guard else "",
        "" if guarded or foreign_guard else "the guard (PLC 1) was written and listed back",
    )
    return goal, tuple(note for note in notes if note)


def _following(motor: int) -> dict[str, str]:
    """Position following in offset mode; the switch last, so that going back it is first."""
    return {
        f"I{motor}05": str(MASTER_WORD_ADDRESS),
        f"I{motor}07": str(MASTER_SCALE_IXX07),
        f"I{motor}06": "3",
    }


def follows(link: Link, motor: int) -> bool:
    """Whether a motor follows the master word of the law."""
    found = read_many(link, [f"I{motor}05", f"I{motor}06"])
    return found[f"I{motor}05"] == MASTER_WORD_ADDRESS and bool(int(found[f"I{motor}06"]) & 1)


def _refusals(
    link: Link, block: LawBlock, motor: int, head: LawHead, goal: Settings
) -> list[SafetyRefusal]:
    found = degree_refusals(link) + _in_open_servo(link, motor)
    found += scratch_refusals(link, block, motor)
    if head.form is not LawForm.NONE and abs(head.gain) > GAIN_TOLERANCE:
        found.append(
            MotorNotSafe(
                "A law is armed, and its program or settings would be replaced under it.",
                code=_ARMED,
                hint="Take that law off first: `pmac-comp remove`, or `pmac-comp rollback` where "
                "the last upload put it on.",
            )
        )
    word = parse_integer(link.query(f"RX${MASTER_WORD_ADDRESS:X}")[0])
    if word != 0 and f"I{motor}06" in goal.variables:
        found.append(
            MotorNotSafe(
                f"The master word is {word}, not zero: following it would make the motor jump.",
                code="PC-LAW-023",
                hint=f"Clear it with the motor killed: WX${MASTER_WORD_ADDRESS:X},0.",
            )
        )
    elif word != 0 and LAW in goal.programs:
        found.append(
            MotorNotSafe(
                f"The master word is {word}, not zero, and motor #{motor} follows it: PLC 0 would "
                "make it jump when it begins.",
                code="PC-LAW-050",
                hint="`pmac-comp remove` takes it out slowly (a sign test or a law that was "
                "stopped left it); then upload again.",
            )
        )
    return found + motion_refusals(link, [motor])


def _in_open_servo(link: Link, motor: int) -> list[SafetyRefusal]:
    if not int(read_one(link, f"I{motor}59")) & 1:
        return []
    return [
        MotorNotSafe(
            f"The open servo has the law already (I{motor}59 = 1): PLC 0 would correct twice.",
            code="PC-LAW-032",
            hint=f"Use --route servo, or set I{motor}59 = 0 with the motor killed.",
        )
    ]


def law_refusals(
    link: Link, context: Context, motor: int, *, every_cycles: int = 1
) -> list[SafetyRefusal]:
    """All that forbids ``install_law`` now; nothing is changed."""
    with untouched():
        head, found = read_law_head(link, context.block), _standing(link, motor)
        goal, _ = _missing(link, context, motor, head, found, DEFAULT_RAMP_s, every_cycles)
        if goal.is_empty:  # law and guard stand already: they stay
            running = _in_open_servo(link, motor) + scratch_refusals(link, context.block, motor)
            return degree_refusals(link) + running
        return [
            *_refusals(link, context.block, motor, head, goal),
            *_owners(context, motor, found),
            *_of_another_axis(link, context.block, head, motor, stands=_holds_law(context, found)),
        ]


def owner_refusals(link: Link, context: Context, motor: int) -> list[SafetyRefusal]:
    """What belongs to somebody else where a law would go; nothing is changed."""
    with untouched():
        return _owners(context, motor, _standing(link, motor))


def _owners(context: Context, motor: int, found: Settings) -> list[SafetyRefusal]:
    """What belongs to somebody else where the law would go: a machine's logic must not vanish."""
    out: list[SafetyRefusal] = []
    law = law_program(context.block, motor)
    if is_foreign(found, LAW, law):
        out.append(
            SafetyRefusal(
                "PLC 0 holds a program that is not ours; the law would replace it.",
                code="PC-LAW-037",
                hint="Move it to another PLC, or use --route servo, table or program.",
            )
        )
    out += _output_refusals(motor, found, law)
    # Definitions that an earlier law of any motor left behind are ours.
    ours = [definitions(number) for number in range(1, MOTORS + 1)]
    defined = {n: text for n, text in found.definitions.items() if text.strip() not in {"", "*"}}
    taken = [
        f"M{n} is {text}"
        for n, text in defined.items()
        if all(differences(Settings(definitions={n: any_motor[n]}), found) for any_motor in ours)
    ]
    if taken:
        out.append(
            SafetyRefusal(
                f"M-variables of the law are defined otherwise: {', '.join(taken)}.",
                code="PC-LAW-038",
                hint="Renumber them where they are used, then free them (M7003->*).",
            )
        )
    master = parse_integer(found.variables[f"I{motor}05"])
    if parse_integer(found.variables[f"I{motor}06"]) & 1 and master != MASTER_WORD_ADDRESS:
        out.append(
            MotorNotSafe(
                f"Motor #{motor} follows the master at ${master:X} already (I{motor}06 odd).",
                code="PC-LAW-039",
                hint=f"Switch that following off (I{motor}06=0), or use --route servo or program.",
            )
        )
    return out


def _holds_law(context: Context, found: Settings) -> bool:
    """Whether PLC 0 holds the law of this block, of any version and motor, running or not."""
    return bool(found.programs[LAW]) and not is_foreign(found, LAW, law_program(context.block, 1))


def law_stands(link: Link, context: Context) -> bool:
    """Whether PLC 0 holds the law of this block, of any version and motor, running or not."""
    return _holds_law(context, _plc_0(link))


def _plc_0(link: Link) -> Settings:
    """PLC 0 as it stands; nothing where a password hides it, as a law of ours has none."""
    asked = Settings(programs={LAW: ()})
    try:
        return read_settings(link, asked)
    except CommandRefused as error:
        if programs.explain_protection(error):
            return asked
        raise


def _of_another_axis(
    link: Link, block: LawBlock, head: LawHead, motor: int, *, stands: bool
) -> list[SafetyRefusal]:
    """A block holds one law: that of another motor would be lost, and two follow one word."""
    other = head.motor
    if other in {0, motor} or not 1 <= other <= MOTORS:
        return []
    if not stands and not int(read_one(link, f"I{other}59")) & 1:
        return []
    return [
        SafetyRefusal(
            f"The block at P{block.first} holds the law of motor #{other}; one for motor "
            f"#{motor} would take its place, and both motors would follow it.",
            code="PC-LAW-049",
            hint=f"Take that law off first: `pmac-comp remove` with the bench file of motor "
            f"#{other} (a motor that keeps I{other}59 = 1: P{block.p(Index.MOTOR)}=0). For "
            "both at once use --route servo, table, cam or program here, and another p_block.",
        )
    ]


def _output_refusals(motor: int, found: Settings, law: Program) -> list[SafetyRefusal]:
    """Where Ixx29, in which PLC 0 sends its torque, is something else (p. 110)."""
    out: list[SafetyRefusal] = []
    if parse_integer(found.variables[f"I{motor}01"]) & 1:
        out.append(
            SafetyRefusal(
                f"Motor #{motor} is commutated by the card (I{motor}01 odd): I{motor}29 offsets "
                "its first phase then, and carries no torque.",
                code="PC-LAW-046",
                hint="Use --route servo, which sends the torque inside the servo; or cam, "
                "program, table.",
            )
        )
    offset = found.variables[f"I{motor}29"]
    if float(offset) != 0.0 and programs.canonical(found.programs[LAW]) != law.tokens:
        out.append(
            SafetyRefusal(
                f"I{motor}29 = {offset}: the output of motor #{motor} has an offset, and the law "
                "would write its torque over it.",
                code="PC-LAW-045",
                hint=f"Set I{motor}29 = 0 with the motor killed, capture and compute again (the "
                "law sends what is constant); or use --route servo, cam, program or table, which "
                "leave it.",
            )
        )
    return out


def _require_life(link: Link, context: Context) -> None:
    if is_running(link, context.block, context.servo_period_s) is not LawForm.PLC:
        raise VerifyMismatch(
            "PLC 0 gives no sign of life.",
            code="PC-LAW-020",
            hint="I5 must be 1 or 3 and I8 small; control-D disables all PLCs.",
        )


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


def servo_refusals(link: Link, context: Context, motor: int) -> list[SafetyRefusal]:
    """All that forbids the route ``servo`` and can be read; nothing is changed.

    A servo that never ran for this motor gives no signature before its head is set up: whether it
    runs then is proved by ``require_open_servo``.
    """
    with untouched():
        mode, head = int(read_one(link, f"I{motor}59")), read_law_head(link, context.block)
        goal = _servo_missing(link, context, motor, head)
        found = degree_refusals(link) + _beside_plc_0(link, context, motor, head)
        found += [] if goal.is_empty else _armed(head, found)
        silent = head.motor == motor and head.form is LawForm.NONE
        if not mode & 1 or silent:
            found.append(_no_servo(context, motor, mode))
        return found


def _beside_plc_0(link: Link, context: Context, motor: int, head: LawHead) -> list[SafetyRefusal]:
    """Both forms must not run on one block: each writes what the other works with."""
    standing = _plc_0(link)
    ours = _holds_law(context, standing)
    refusals = _of_another_axis(link, context.block, head, motor, stands=ours)
    if ours and 0 in standing.running:
        refusals += _armed(head, ()) or [
            MotorNotSafe(
                "PLC 0 evaluates the law; the open servo beside it would use the same variables.",
                code="PC-LAW-047",
                hint=f"Set I{motor}59 = 0 with the motor killed, take that law off (`pmac-comp "
                f"remove`), then set I{motor}59 = 1 and upload again.",
            )
        ]
    return refusals


def beside_open_servo(link: Link, context: Context, old: Settings) -> list[SafetyRefusal]:
    """Refusal to bring PLC 0 with the law back where an open servo was switched on since."""
    law_came = _holds_law(context, replace(old, programs={LAW: old.programs.get(LAW, ())}))
    motor = read_law_head(link, context.block).motor if law_came else 0
    if not 1 <= motor <= MOTORS or not int(read_one(link, f"I{motor}59")) & 1:
        return []
    if 0 not in old.running or plc_runs(link, 0):
        return []
    return [
        MotorNotSafe(
            f"I{motor}59 = 1: PLC 0 would come back beside the open servo, and both write the same "
            "variables.",
            code="PC-LAW-048",
            hint=f"Set I{motor}59 = 0 with the motor killed and run the command again.",
        )
    ]


def _servo_missing(link: Link, context: Context, motor: int, head: LawHead) -> Settings:
    """What is to be set up for an open servo: its head; a law that PLC 0 holds idle goes."""
    idle = {LAW: ()} if law_stands(link, context) else {}
    if head.motor == motor and head.slew != 0.0 and head.form is not LawForm.PLC:
        return Settings(_stale_scales(link, context, motor, Index.STEP_SERVO), programs=idle)
    values = _head_values(link, context, head, motor, DEFAULT_RAMP_s, Index.STEP_SERVO)
    return Settings(values, programs=idle)


def require_open_servo(link: Link, context: Context, motor: int) -> None:
    """Refuse the route ``servo`` unless the expected open servo proves to run for a motor.

    The head of the block is set up if it is not yet this motor's.

    Raises
    ------
    SafetyRefusal
        No open servo: says what to do. Or PLC 0 evaluates the law, or the block must be set up
        while a law is armed or the motor moves.
    """
    raise_all(servo_refusals(link, context, motor), "The route servo")
    with untouched():
        goal = _servo_missing(link, context, motor, read_law_head(link, context.block))
    if not goal.is_empty:
        with SettingsUpload(link, context, goal, route="servo", motors=[motor]) as upload:
            upload.write()
            upload.finish()
    with untouched():
        if is_running(link, context.block, context.servo_period_s) is not LawForm.SERVO:
            raise _no_servo(context, motor, int(read_one(link, f"I{motor}59")))


def _armed(head: LawHead, told: Sequence[SafetyRefusal]) -> list[SafetyRefusal]:
    """Refusal to set the block up under an armed law, unless it is told already."""
    idle = head.form is LawForm.NONE or abs(head.gain) <= GAIN_TOLERANCE
    if idle or any(refusal.code == _ARMED for refusal in told):
        return []
    where = "PLC 0" if head.form is LawForm.PLC else "the open servo"
    return [
        MotorNotSafe(
            f"A law is armed in {where}: its block cannot be set up under it, nor may a second "
            "algorithm correct beside it.",
            code=_ARMED,
            hint="Take that law off first: `pmac-comp remove`, or `pmac-comp rollback` where the "
            "last upload put it on.",
        )
    ]


def _no_servo(context: Context, motor: int, mode: int) -> SafetyRefusal:
    return SafetyRefusal(
        f"The open servo does not run for motor #{motor} "
        f"(I{motor}59 = {mode}, no signature {SIGNATURE_SERVO} in P{context.block.p(0)}).",
        code="PC-LAW-024",
        hint="Compile firmware_plc/feedforward_servo.txt with the vendor's tool and download it (a "
        "simulated card takes the file itself: `pmac-comp sim --servo`), then set "
        f"I{motor}59 = 1 with the motor killed; or use --route law.",
        left=ControllerState.OLD,
    )


def remove_law(link: Link, context: Context) -> UploadResult:
    """Take the law off: fade, stop following, delete PLC 0; interrupted, it comes back whole.

    A PLC 0 that somebody else has put in its place stays.
    """
    with untouched():
        head = read_law_head(link, context.block)
        programs_of_law = {LAW: ()} if law_stands(link, context) else {}
    variables = {f"P{context.block.p(Index.TARGET)}": "0"}
    # The torque (Ixx29) is an output: written back as it was read it would push the axis.
    torque = {f"I{head.motor}29": 0.0} if head.motor else {}
    if head.motor:
        variables |= {f"I{head.motor}06": "0"}
    goal = Settings(variables, programs=programs_of_law)
    motors = [head.motor] if head.motor else []
    with SettingsUpload(link, context, goal, route="law", motors=motors) as upload:
        upload.write(first=lambda: disarm(link, context))
        upload.check(lambda: verify_many(link, torque))
        return upload.finish()
