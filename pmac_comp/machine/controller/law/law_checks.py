"""What forbids a law on the card: an armed one, an owner of its places, another axis, a servo.

What lives here: refusals, all of them at once; nothing is changed.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from pmac_comp.base.errors import ControllerState, MotorNotSafe, SafetyRefusal
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.card.variables import read_one
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.verdict import untouched
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.law_bank import (
    BLOCK_SIZE,
    MASTER_WORD_ADDRESS,
    SIGNATURE_SERVO,
    Index,
    LawBlock,
)
from pmac_comp.machine.controller.contents.programs import Program
from pmac_comp.machine.controller.contents.settings import MOTORS, Settings, differences, plc_runs
from pmac_comp.machine.controller.law.law_goal import (
    LAW,
    DEFAULT_RAMP_s,
    definitions,
    followers,
    following_in,
    holds_law,
    law_missing,
    law_program,
    law_standing,
    plc_0,
    servo_missing,
)
from pmac_comp.machine.controller.law.law_state import (
    GAIN_TOLERANCE,
    LawForm,
    LawHead,
    degree_refusals,
    read_law_head,
)
from pmac_comp.machine.controller.motors.motors import read_motor
from pmac_comp.machine.controller.motors.open_servos import is_in_open_servo, scratch_refusals
from pmac_comp.machine.controller.settings.guard_install import block_elsewhere, is_foreign
from pmac_comp.machine.controller.tables.upload_checks import motion_refusals

_ARMED: Final = "PC-LAW-021"
_MASTER_WORD: Final = "PC-LAW-023"
_OTHER_LAW: Final = frozenset({"PC-LAW-049", "PC-LAW-054"})  # of another axis, in block or PLC 0


def law_refusals(
    link: Link, context: Context, motor: int, *, every_cycles: int = 1
) -> list[SafetyRefusal]:
    """All that forbids ``install_law`` now; nothing is changed."""
    with untouched():
        head, found = read_law_head(link, context.block), law_standing(link, motor)
        goal, _ = law_missing(link, context, motor, head, found, DEFAULT_RAMP_s, every_cycles)
        if goal.is_empty:  # law and guard stand already: they stay
            running = in_open_servo(link, motor) + scratch_refusals(link, context.block, motor)
            return degree_refusals(link) + running
        return install_refusals(link, context, motor, head, found, goal)


def owner_refusals(link: Link, context: Context, motor: int) -> list[SafetyRefusal]:
    """What belongs to somebody else where a law would go; nothing is changed."""
    with untouched():
        return _owners(context, motor, law_standing(link, motor))


def law_elsewhere(link: Link, context: Context, motor: int) -> int | None:
    """First variable of another block whose law stands in PLC 0, if one does."""
    with untouched():
        law = law_program(context.block, motor)
        return block_elsewhere(law_standing(link, motor), LAW, law, context.block)


def install_refusals(
    link: Link, context: Context, motor: int, head: LawHead, found: Settings, goal: Settings
) -> list[SafetyRefusal]:
    """All that forbids putting law and guard on a card that stands as ``found``."""
    refusals = [
        *_block_refusals(
            link, context.block, motor, head, goal, armed=_is_armed(link, context, head, found)
        ),
        *_owners(context, motor, found),
        *_of_another_axis(link, context.block, head, motor, stands=holds_law(context.block, found)),
    ]
    if any(refusal.code in _OTHER_LAW for refusal in refusals):
        # Whose motor follows, as it should; what stands in the master word is sent by that law.
        return [refusal for refusal in refusals if refusal.code != _MASTER_WORD]
    return refusals + _followed_by_others(link, motor)


def _followed_by_others(link: Link, motor: int) -> list[SafetyRefusal]:
    """Refusal of a law whose master word other motors follow: it would move them as well."""
    return [
        MotorNotSafe(
            f"Motor #{other} follows the master word of the law (I{other}05, I{other}06): the law "
            f"of motor #{motor} would move it as well.",
            code="PC-LAW-056",
            hint=f"Take off what a law has left there: `pmac-comp remove` with the bench file of "
            f"motor #{other}; or set I{other}06 = 0 with that motor killed.",
        )
        for other in sorted(followers(link) - {motor})
    ]


def servo_refusals(link: Link, context: Context, motor: int) -> list[SafetyRefusal]:
    """All that forbids the route ``servo`` and can be read; nothing is changed.

    A servo that never ran for this motor gives no signature before its head is set up: whether it
    runs then is proved by ``require_open_servo``, in closed loop only.
    """
    with untouched():
        mode, head = int(read_one(link, f"I{motor}59")), read_law_head(link, context.block)
        goal = servo_missing(link, context, motor, head)
        found = degree_refusals(link) + _beside_plc_0(link, context, motor, head)
        armed = not goal.is_empty and _is_armed(link, context, head, plc_0(link))
        found += _armed(head, found) if armed else []
        silent = head.motor == motor and head.form is LawForm.NONE
        if mode & 1 and not read_motor(link, motor).status.is_closed_loop:
            found.append(_asleep(motor))
        elif not mode & 1 or silent:
            found.append(no_servo(context, motor, mode))
        return found


def _asleep(motor: int) -> SafetyRefusal:
    """Refusal to load a law for an open servo that rests: nothing would show that it is there."""
    return MotorNotSafe(
        f"The loop of motor #{motor} is open: its open servo (I{motor}59 = 1) runs in closed loop "
        "only, and nothing shows before that it is the one expected.",
        code="PC-LAW-057",
        hint=f"Enable the motor (`pmac-comp terminal URL -c '#{motor}J/'`) and upload again; or "
        "use --route law, which can be loaded with the motor killed.",
    )


def beside_open_servo(link: Link, context: Context, old: Settings) -> list[SafetyRefusal]:
    """Refusal to bring PLC 0 with the law back where an open servo was switched on since."""
    law_came = holds_law(context.block, replace(old, programs={LAW: old.programs.get(LAW, ())}))
    motor = read_law_head(link, context.block).motor if law_came else 0
    if not is_in_open_servo(link, motor):
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


def beside_another_law(
    link: Link, context: Context, old: Sequence[Settings]
) -> list[SafetyRefusal]:
    """Refusal to let a motor follow the law again where that of another block stands by now.

    Parameters
    ----------
    link, context
        Conversation and block.
    old : sequence of Settings
        What would come back.
    """
    found = (following_in(settings) for settings in old)
    motor = next((number for number in found if number is not None), None)
    other = None if motor is None else law_elsewhere(link, context, motor)
    if other is None:
        return []
    return [
        MotorNotSafe(
            f"PLC 0 holds the law of another bench file, whose p_block begins at P{other}; motor "
            f"#{motor} would follow it as it once followed its own.",
            code="PC-LAW-055",
            hint="Take that law off first: `pmac-comp remove` with its bench file.",
        )
    ]


def _is_armed(link: Link, context: Context, head: LawHead, found: Settings) -> bool:
    """Whether the law of the block acts; one that a reset took away has left its gain behind."""
    if head.form is LawForm.NONE or abs(head.gain) <= GAIN_TOLERANCE:
        return False
    if head.form is LawForm.PLC:
        return holds_law(context.block, found)  # stopped as well: its outputs stand
    return is_in_open_servo(link, head.motor)


def _block_refusals(
    link: Link, block: LawBlock, motor: int, head: LawHead, goal: Settings, *, armed: bool
) -> list[SafetyRefusal]:
    found = degree_refusals(link) + in_open_servo(link, motor)
    found += scratch_refusals(link, block, motor)
    if armed:
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
                code=_MASTER_WORD,
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


def in_open_servo(link: Link, motor: int) -> list[SafetyRefusal]:
    """Refusal where the open servo of a motor has the law already."""
    if not is_in_open_servo(link, motor):
        return []
    return [
        MotorNotSafe(
            f"The open servo has the law already (I{motor}59 = 1): PLC 0 would correct twice.",
            code="PC-LAW-032",
            hint=f"Use --route servo, or set I{motor}59 = 0 with the motor killed.",
        )
    ]


def _owners(context: Context, motor: int, found: Settings) -> list[SafetyRefusal]:
    """What belongs to somebody else where the law would go: a machine's logic must not vanish."""
    out: list[SafetyRefusal] = []
    law = law_program(context.block, motor)
    out += _program_refusals(context, motor, found, law)
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


def _program_refusals(
    context: Context, motor: int, found: Settings, law: Program
) -> list[SafetyRefusal]:
    """Refusal where PLC 0 is taken: by the law of another bench file, or by the machine."""
    other = block_elsewhere(found, LAW, law, context.block)
    if other is not None:
        return [
            SafetyRefusal(
                f"PLC 0 holds the law of another bench file, whose p_block begins at P{other}; "
                f"that of motor #{motor} would replace it.",
                code="PC-LAW-054",
                hint="Take that law off first: `pmac-comp remove` with its bench file. For both at "
                "once use --route servo, table, cam or program here.",
            )
        ]
    if not is_foreign(found, LAW, law):
        return []
    return [
        SafetyRefusal(
            "PLC 0 holds a program that is not ours; the law would replace it.",
            code="PC-LAW-037",
            hint="Move it to another PLC, or use --route servo, table or program.",
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


def _of_another_axis(
    link: Link, block: LawBlock, head: LawHead, motor: int, *, stands: bool
) -> list[SafetyRefusal]:
    """A block holds one law: that of another motor would be lost, and two follow one word."""
    other = head.motor
    if other in {0, motor} or not 1 <= other <= MOTORS:
        return []
    if not stands and not is_in_open_servo(link, other):
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


def _beside_plc_0(link: Link, context: Context, motor: int, head: LawHead) -> list[SafetyRefusal]:
    """Both forms must not run on one block: each writes what the other works with."""
    standing = plc_0(link)
    ours = holds_law(context.block, standing)
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


def no_servo(context: Context, motor: int, mode: int) -> SafetyRefusal:
    """Refusal where no open servo of ours runs for a motor; ``mode`` is its Ixx59."""
    first, last = context.block.first, context.block.first + BLOCK_SIZE - 1
    return SafetyRefusal(
        f"The open servo does not run for motor #{motor} "
        f"(I{motor}59 = {mode}, no signature {SIGNATURE_SERVO} in P{context.block.p(0)}).",
        code="PC-LAW-024",
        hint=f"Compile its source for P{first}-P{last}, which `pmac-comp config servo BENCH` "
        "prints, with the vendor's tool and download it (a simulated card takes the file itself: "
        "`pmac-comp sim --servo firmware_plc/feedforward_servo.txt --bench BENCH`), then set "
        f"I{motor}59 = 1 with the motor killed; or use --route law.",
        left=ControllerState.OLD,
    )
