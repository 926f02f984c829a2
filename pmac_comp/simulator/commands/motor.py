"""Commands of the addressed motor. Source: Software Reference Manual p. 264-277, 322-340, 377."""

from __future__ import annotations

from pmac_comp.simulator.commands.coordinate import define_axis
from pmac_comp.simulator.commands.line import LineContext, bare_constant, command, execute_command
from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.memory import read_float48


@command("##")
def _group(context: LineContext) -> None:
    group = context.scanner.integer()
    if group is None:
        context.answer(str(context.modal.group))
    elif group <= 3:
        context.modal.group = group
    else:
        raise CardError(3)


@command("#")
def _address_motor(context: LineContext) -> None:
    motor = context.scanner.integer()
    if motor is None:
        context.answer(str(context.modal.motor))
        return
    if not 1 <= motor <= r.MOTORS:
        raise CardError(3)
    if context.scanner.take("->"):
        define_axis(context, motor)
        return
    context.modal.motor = motor


@command("?")
def _status(context: LineContext) -> None:
    if context.scanner.take("??"):
        context.answer(context.card.status.global_words())
    elif context.scanner.take("?"):
        context.card.refresh_status()
        context.answer(context.card.status.cs_words(context.modal.cs))
    else:
        context.answer(context.card.status.motor_words(context.modal.motor))


@command("V")
def _velocity(context: LineContext) -> None:
    context.answer(context.card.status.velocity(context.modal.motor))


@command("F")
def _following_error(context: LineContext) -> None:
    context.answer(context.card.status.following_error(context.modal.motor))


def _movable(context: LineContext) -> int:
    """Addressed motor, refused with ERR001 while its coordinate system runs a program."""
    motor = context.modal.motor
    if context.card.program_moves(motor):
        raise CardError(1)
    context.card.leave_hold_point(motor)
    return motor


def _started(context: LineContext, motor: int) -> None:
    """A jog or search has been planned: in feed hold it does not wait for the time base."""
    if context.card.is_held(motor):
        context.card.servo.queue.ignore_time_base(motor)


@command("J")
def _jog(context: LineContext) -> None:
    scanner = context.scanner
    form = scanner.take("+", "-", "/", "!", "==", "=", "^", ":")
    if form is None:
        raise CardError(3)
    motor = _movable(context)
    servo = context.card.servo
    if form in ("+", "-"):
        context.check(servo.jog(motor, 1 if form == "+" else -1))
    elif form == "/":
        context.check(servo.jog_stop(motor))
    elif form == "!":
        context.check(servo.jog_round(motor))
    else:
        _jog_to(context, motor, form)
    _started(context, motor)


def _jog_to(context: LineContext, motor: int, form: str) -> None:
    scanner, memory = context.scanner, context.card.memory
    value: float | None
    if scanner.take("*"):
        value = float(read_float48(memory.x, memory.y, r.motor_base(motor) + r.M_JOG_VARIABLE))
    else:
        value = scanner.signed_number()
    if value is None and form != "=":
        raise CardError(3)
    trigger = None
    if scanner.take("^"):
        trigger = scanner.signed_number()
        if trigger is None:
            raise CardError(3)
    context.check(context.card.servo.jog_to(motor, form, value, trigger_ct=trigger))


@command("HMZ", "HOMEZ")
def _home_zero(context: LineContext) -> None:
    context.check(context.card.servo.home_zero(_movable(context)))


@command("HM", "HOME")
def _home(context: LineContext) -> None:
    motor = _movable(context)
    context.check(context.card.servo.home(motor))
    _started(context, motor)


@command("K")
def _kill(context: LineContext) -> None:
    context.card.servo.kill(_movable(context))


@command("O")
def _open_loop(context: LineContext) -> None:
    percent = context.scanner.signed_number()
    if percent is None:
        raise CardError(3)
    context.check(context.card.servo.open_loop(_movable(context), percent))


@command("$$$***")
def _factory(context: LineContext) -> None:
    context.card.reset(factory=True)
    context.modal.power_up()
    context.silent_end = True


@command("$$$")
def _reset(context: LineContext) -> None:
    context.card.reset()
    context.modal.power_up()
    context.silent_end = True


@command("$$*")
def _absolute_cs(context: LineContext) -> None:
    for motor in context.system.motors:
        context.check(context.card.servo.reset_position(motor))


@command("$$")
def _phase_cs(context: LineContext) -> None:
    for motor in context.system.motors:
        context.check(context.card.servo.enable(motor))


@command("$*")
def _absolute(context: LineContext) -> None:
    context.check(context.card.servo.reset_position(_movable(context)))


@command("$")
def _phase(context: LineContext) -> None:
    if context.scanner.peek().isalnum():
        # A bare $hex constant.
        context.scanner.position -= 1
        bare_constant(context)
        return
    context.check(context.card.servo.enable(_movable(context)))


@command("@")
def _card_address(context: LineContext) -> None:
    # Software addressing of several cards needs I1 = 2 or 3 (p. 265).
    number = context.scanner.integer()
    serial_mode = context.card.variables.int_i(1)
    if not serial_mode & 2:
        raise CardError(3)
    if number is None:
        context.answer(str(context.card.variables.int_i(0)))
    elif not context.scanner.at_end:
        execute_command(context)
