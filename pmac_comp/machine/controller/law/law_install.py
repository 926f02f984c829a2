"""The law on the controller: put there, proved to run, taken off.

What lives here: the transactions, each of which leaves everything as it was if it does not end.
What may not: coefficients (``law_upload``), the gain (``law_arming``), what forbids a law
(``law_checks``).
"""

from pmac_comp.base.errors import VerifyMismatch
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.variables import read_one, verify_many
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.transaction import UploadResult
from pmac_comp.machine.controller.change.verdict import untouched
from pmac_comp.machine.controller.contents.law_bank import Index
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.contents.settings import Settings
from pmac_comp.machine.controller.law.law_arming import disarm
from pmac_comp.machine.controller.law.law_checks import (
    in_open_servo,
    install_refusals,
    no_servo,
    servo_refusals,
)
from pmac_comp.machine.controller.law.law_goal import (
    LAW,
    DEFAULT_RAMP_s,
    law_missing,
    law_standing,
    law_stands,
    servo_missing,
)
from pmac_comp.machine.controller.law.law_state import LawForm, is_running, read_law_head
from pmac_comp.machine.controller.settings.settings_upload import SettingsUpload


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
        found = law_standing(link, motor)
        goal, done = law_missing(link, context, motor, head, found, ramp_s, every_cycles)
        if (
            goal.is_empty
            and not in_open_servo(link, motor)
            and is_running(link, context.block, context.servo_period_s) is LawForm.PLC
        ):
            return done
        refusals = install_refusals(link, context, motor, head, found, goal)
    with SettingsUpload(link, context, goal, route="law", refusals=refusals) as upload:
        upload.write()
        upload.check(lambda: _require_life(link, context))
        upload.finish()
    return done


def _require_life(link: Link, context: Context) -> None:
    if is_running(link, context.block, context.servo_period_s) is not LawForm.PLC:
        raise VerifyMismatch(
            "PLC 0 gives no sign of life.",
            code="PC-LAW-020",
            hint="I5 must be 1 or 3 and I8 small; control-D disables all PLCs.",
        )


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
        goal = servo_missing(link, context, motor, read_law_head(link, context.block))
    if not goal.is_empty:
        with SettingsUpload(link, context, goal, route="servo", motors=[motor]) as upload:
            upload.write()
            upload.finish()
    with untouched():
        if is_running(link, context.block, context.servo_period_s) is not LawForm.SERVO:
            raise no_servo(context, motor, int(read_one(link, f"I{motor}59")))


def fade_law(link: Link, context: Context, motor: int) -> UploadResult:
    """Fade the law of the open servo, which stays; taken back, its gain rises again."""
    goal = Settings({f"P{context.block.p(Index.TARGET)}": "0"})
    with SettingsUpload(link, context, goal, route="servo", motors=[motor]) as upload:
        upload.write(first=lambda: disarm(link, context))
        return upload.finish()


def remove_law(link: Link, context: Context) -> UploadResult:
    """Take the law off: fade, stop following, delete PLC 0; interrupted, it comes back whole.

    A PLC 0 that somebody else has put in its place stays.
    """
    with untouched():
        head = read_law_head(link, context.block)
        programs_of_law = {LAW: ()} if law_stands(link, context.block) else {}
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
