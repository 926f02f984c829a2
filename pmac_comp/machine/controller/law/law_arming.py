"""Arming and disarming the law: the gain ramps, nothing jumps."""

from typing import Final

from pmac_comp.base.errors import ControllerState, MotorNotSafe, TableStateError
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer, plain
from pmac_comp.machine.controller.card.variables import read_one, verify_many
from pmac_comp.machine.controller.change.card_time import CardDeadline
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.contents.law_bank import MASTER_WORD_ADDRESS, Index
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.law.law_goal import followers
from pmac_comp.machine.controller.law.law_state import (
    GAIN_TOLERANCE,
    LawForm,
    LawHead,
    degree_refusals,
    is_running,
    read_bank,
    read_law_head,
)
from pmac_comp.machine.controller.motors.motors import read_motor, require_stationary
from pmac_comp.machine.controller.motors.open_servos import is_in_open_servo

_FADE_STEPS: Final = 50
_FADE_PAUSE_s: Final = 0.01


def arm(link: Link, context: Context, *, gain: float = 1.0, timeout_s: float = 10.0) -> LawHead:
    """Ramp the gain up and wait until it is there, at most ``timeout_s`` by the card's clock.

    Raises
    ------
    TableStateError
        No algorithm runs, or the bank in use is not sealed, or the gain did not arrive (heartbeat
        lost, something else writes the target).
    MotorNotSafe
        The loop is open, or the motor moves: a correction grows in beside a motion.
    """
    block = context.block
    head = read_law_head(link, block)
    if is_running(link, block, context.servo_period_s) is LawForm.NONE:
        raise TableStateError(
            "No algorithm evaluates the law.",
            code="PC-LAW-028",
            hint="PLC 0 or the open servo does not run: `pmac-comp status` shows it; upload again.",
            left=ControllerState.DISABLED,
        )
    if read_bank(link, block, head.bank) is None:
        raise TableStateError(
            f"Bank {head.bank} holds no sealed law.",
            code="PC-LAW-029",
            hint="Upload a law first.",
            left=ControllerState.DISABLED,
        )
    raise_all(degree_refusals(link), "Arming")
    if not read_motor(link, head.motor).status.is_closed_loop:
        raise MotorNotSafe(
            f"Motor #{head.motor} is not in closed loop.",
            code="PC-LAW-030",
            hint=f"Enable it (`pmac-comp terminal URL -c '#{head.motor}J/'`) and upload again.",
            left=ControllerState.DISABLED,
        )
    if head.target != gain:
        require_stationary(link, [head.motor])
    return _ramp(link, context, gain, timeout_s)


def disarm(link: Link, context: Context, *, timeout_s: float = 10.0) -> LawHead:
    """Ramp the gain to zero and wait; the correction fades, nothing jumps.

    With no algorithm running the outputs are what it left: they are taken to zero in small steps.
    The open servo leaves none: it does not run while its motor is killed.
    """
    head = read_law_head(link, context.block)
    if is_running(link, context.block, context.servo_period_s) is LawForm.NONE:
        return fade_by_hand(link, context, head)
    return _ramp(link, context, 0.0, timeout_s)


def _ramp(link: Link, context: Context, gain: float, timeout_s: float) -> LawHead:
    link.command(f"P{context.block.p(Index.TARGET)}={plain(gain)}")
    deadline = CardDeadline(link, timeout_s)
    while True:
        head = read_law_head(link, context.block)
        if abs(head.gain - gain) <= GAIN_TOLERANCE:
            return head
        if deadline.expired():
            raise TableStateError(
                f"The gain of the law is {head.gain:g} instead of {gain:g} after {timeout_s:g} s.",
                code="PC-LAW-031",
                hint="The loop may be open, the heartbeat lost or PLC 0 disabled.",
                left=ControllerState.DISABLED,
            )
        link.clock.sleep_s(0.02)


def fade_by_hand(link: Link, context: Context, head: LawHead) -> LawHead:
    """Outputs that no algorithm writes any more go to zero in small steps.

    The master word is left alone where another motor follows it: it is another law's.
    """
    link.write_buffer([f"P{context.block.p(k)}=0" for k in (Index.TARGET, Index.GAIN)])
    if is_in_open_servo(link, head.motor):
        return read_law_head(link, context.block)
    is_ours = followers(link) <= {head.motor}
    word = parse_integer(link.query(f"RX${MASTER_WORD_ADDRESS:X}")[0]) if is_ours else 0
    torque = read_one(link, f"I{head.motor}29") if head.motor else 0.0
    for k in range(_FADE_STEPS - 1, -1, -1) if word or torque else ():
        if head.motor:
            link.command(f"I{head.motor}29={int(torque * k / _FADE_STEPS)}")
        if word:
            link.command(f"WX${MASTER_WORD_ADDRESS:X},{int(word * k / _FADE_STEPS)}")
        link.clock.sleep_s(_FADE_PAUSE_s)
    if head.motor:
        verify_many(link, {f"I{head.motor}29": 0.0})
    return read_law_head(link, context.block)
