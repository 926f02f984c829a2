"""Commands of the addressed coordinate system. Source: Software Reference Manual p. 264-403."""

from __future__ import annotations

from pmac_comp.simulator import registers as r
from pmac_comp.simulator.commands.line import LineContext, command
from pmac_comp.simulator.errors import CardError
from pmac_comp.simulator.language.statements import MOTION, StatementParser, axis_modes
from pmac_comp.simulator.numbers import format_number

_AXES = "ABCUVWXYZ"


@command("&")
def _address_cs(context: LineContext) -> None:
    cs = context.scanner.integer()
    if cs is None:
        context.answer(str(context.modal.cs))
    elif 1 <= cs <= r.COORDINATE_SYSTEMS:
        context.modal.cs = cs
    else:
        raise CardError(3)


@command("%")
def _override(context: LineContext) -> None:
    percent = context.scanner.number()
    if percent is None:
        context.answer(context.card.status.override(context.modal.cs))
    else:
        context.card.set_override(context.modal.cs, percent)


@command("A")
def _abort(context: LineContext) -> None:
    if _rename(context, "A"):
        return
    context.card.abort(context.modal.cs)


@command("ABR")
def _abort_run(context: LineContext) -> None:
    named = context.scanner.peek().isdigit()
    context.card.abort_run(context.modal.cs, _label(context) if named else None)


@command("B")
def _point(context: LineContext) -> None:
    if not _rename(context, "B"):
        context.card.point(context.modal.cs, _label(context))


def _label(context: LineContext) -> tuple[int, int]:
    value = context.scanner.number()
    if value is None:
        return context.card.variables.int_i(5091 + 100 * context.modal.cs), 0
    program = int(value)
    return program, round((value - program) * 100000)


@command("R")
def _run(context: LineContext) -> None:
    context.card.run(context.modal.cs)


@command("S")
def _step(context: LineContext) -> None:
    context.card.run(context.modal.cs, single=True)


@command("H")
def _hold(context: LineContext) -> None:
    context.card.feed_hold(context.modal.cs)


@command("\\", "<")
def _quick_stop(context: LineContext) -> None:
    # Outside lookahead the quick stop and the reversal act as feed hold (p. 278).
    context.card.feed_hold(context.modal.cs)


@command(">")
def _resume_forward(context: LineContext) -> None:
    context.card.run(context.modal.cs)


@command("/")
def _halt(context: LineContext) -> None:
    context.card.quit(context.modal.cs)


@command("E")
def _enable(context: LineContext) -> None:
    for motor in context.card.motors_of(context.modal.cs):
        context.check(context.card.servo.enable(motor))


@command("PMATCH")
def _match(context: LineContext) -> None:
    context.card.match_positions(context.modal.cs)


@command("PC")
def _program_counter(context: LineContext) -> None:
    context.answer(context.card.program_counter(context.modal.cs))


@command("PE")
def _executing(context: LineContext) -> None:
    context.answer(context.card.program_counter(context.modal.cs, executing=True))


@command("PR")
def _rotary_lines(context: LineContext) -> None:
    context.answer(str(context.card.rotary_lines(context.modal.cs)))


@command("MOVETIME", "MVTM")
def _move_time(context: LineContext) -> None:
    context.answer(format_number(context.card.move_time_ms(context.modal.cs)))


@command("MFLUSH")
def _flush_assignments(context: LineContext) -> None:
    context.card.flush_assignments(context.modal.cs)


def _axis_mode(name: str) -> None:
    @command(name)
    def handler(context: LineContext) -> None:
        statement = axis_modes(StatementParser(context.scanner, MOTION), name)
        context.card.systems[context.modal.cs].set_axis_mode(statement)


for _name in ("ABS", "INC", "FRAX"):
    _axis_mode(_name)


@command("UNDEFINEALL", "UNDEFALL")
def _undefine_all(context: LineContext) -> None:
    context.card.undefine_axes(None)


@command("UNDEFINE", "UNDEF")
def _undefine(context: LineContext) -> None:
    context.card.undefine_axes(context.modal.cs)


def _rename(context: LineContext, letter: str) -> bool:
    """Take ``{axis}={constant}``: rename the present axis position (p. 294)."""
    if not context.scanner.take("="):
        return False
    context.card.rename_position(context.modal.cs, letter, context.value())
    return True


def _axis_command(letter: str) -> None:
    @command(letter)
    def handler(context: LineContext) -> None:
        if _rename(context, letter):
            return
        if letter == "Z":
            context.card.zero_positions(context.modal.cs)
            return
        # A move without an open buffer.
        raise CardError(5 if context.scanner.peek()[:1] in "0123456789(-." else 3)


for _letter in _AXES[2:]:
    _axis_command(_letter)
