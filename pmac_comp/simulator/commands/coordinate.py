"""Commands of the addressed coordinate system. Source: Software Reference Manual p. 264-403."""

from __future__ import annotations

from pmac_comp.simulator.commands.line import LineContext, command
from pmac_comp.simulator.language.keywords import axis_modes
from pmac_comp.simulator.language.parser import StatementParser
from pmac_comp.simulator.language.statements import AXES, MOTION
from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.numbers import format_number
from pmac_comp.simulator.programs.axes import read_definition
from pmac_comp.simulator.programs.coordinate_system import CoordinateSystem


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
        context.system.set_override(percent)


@command("A")
def _abort(context: LineContext) -> None:
    if _rename(context, "A"):
        return
    context.system.abort()


@command("ABR")
def _abort_run(context: LineContext) -> None:
    named = context.scanner.peek().isdigit()
    context.system.abort_run(_label(context) if named else None)


@command("B")
def _point(context: LineContext) -> None:
    if not _rename(context, "B"):
        context.system.point(*_label(context))


def _label(context: LineContext) -> tuple[int, int]:
    value = context.scanner.number()
    if value is None:
        return context.card.variables.int_i(5091 + 100 * context.modal.cs), 0
    program = int(value)
    return program, round((value - program) * 100000)


@command("R")
def _run(context: LineContext) -> None:
    context.system.run()


@command("S")
def _step(context: LineContext) -> None:
    context.system.run(single=True)


@command("H")
def _hold(context: LineContext) -> None:
    context.system.hold()


@command("\\", "<")
def _quick_stop(context: LineContext) -> None:
    # Outside lookahead the quick stop and the reversal act as feed hold (p. 278).
    context.system.hold()


@command(">")
def _resume_forward(context: LineContext) -> None:
    context.system.run()


@command("/")
def _halt(context: LineContext) -> None:
    context.system.quit()


@command("E")
def _enable(context: LineContext) -> None:
    for motor in context.system.motors:
        context.check(context.card.servo.enable(motor))


@command("PMATCH")
def _match(context: LineContext) -> None:
    _stopped(context).match()


@command("PC")
def _program_counter(context: LineContext) -> None:
    context.answer(context.system.counter_text())


@command("PE")
def _executing(context: LineContext) -> None:
    context.answer(context.system.counter_text(executing=True))


@command("PR")
def _rotary_lines(context: LineContext) -> None:
    context.answer(str(context.card.rotary.lines_left(context.modal.cs)))


@command("MOVETIME", "MVTM")
def _move_time(context: LineContext) -> None:
    context.answer(format_number(context.system.move_time_ms()))


@command("MFLUSH")
def _flush_assignments(context: LineContext) -> None:
    context.system.flush_assignments()


def _axis_mode(name: str) -> None:
    @command(name)
    def handler(context: LineContext) -> None:
        statement = axis_modes(StatementParser(context.scanner, MOTION), name)
        context.system.set_axis_mode(statement)


for _name in ("ABS", "INC", "FRAX"):
    _axis_mode(_name)


def define_axis(context: LineContext, motor: int) -> None:
    """``#n->``: report, define or clear an axis definition (p. 276)."""
    scanner, system = context.scanner, context.system
    nearby = scanner.peek()
    if not (nearby.isalnum() or nearby in ("-", "+", ".")) or nearby == "":
        definition = system.axes.get(motor)
        context.answer(definition.text() if definition is not None else "0")
        return
    definition = read_definition(scanner)
    other = next((s for s in context.card.systems.values() if motor in s.axes), None)
    if other is not None and (other.running or (other is not system and definition)):
        raise CardError(1 if other.running else 3)
    if definition is None:
        system.axes.pop(motor, None)
    else:
        system.axes[motor] = definition
    context.card.write_assignment(motor)


@command("UNDEFINEALL", "UNDEFALL")
def _undefine_all(context: LineContext) -> None:
    _clear_axes(context, list(context.card.systems.values()))


@command("UNDEFINE", "UNDEF")
def _undefine(context: LineContext) -> None:
    _clear_axes(context, [context.system])


def _clear_axes(context: LineContext, systems: list[CoordinateSystem]) -> None:
    for system in systems:
        if system.running:
            raise CardError(1)
        motors = system.motors
        system.axes.clear()
        for motor in motors:
            context.card.write_assignment(motor)


def _stopped(context: LineContext) -> CoordinateSystem:
    """The addressed coordinate system, refused with ERR001 while it runs a program."""
    if context.system.running:
        raise CardError(1)
    return context.system


def _zero_positions(context: LineContext) -> None:
    """Z: every axis position becomes zero."""
    system = _stopped(context)
    letters = {letter for d in system.axes.values() for letter, _ in d.terms}
    for letter in sorted(letters):
        system.rename(letter, 0.0)


def _rename(context: LineContext, letter: str) -> bool:
    """Take ``{axis}={constant}``: rename the present axis position (p. 294)."""
    if not context.scanner.take("="):
        return False
    value = context.value()
    _stopped(context).rename(letter, value)
    return True


def _axis_command(letter: str) -> None:
    @command(letter)
    def handler(context: LineContext) -> None:
        if _rename(context, letter):
            return
        if letter == "Z":
            _zero_positions(context)
            return
        # A move without an open buffer.
        raise CardError(5 if context.scanner.peek()[:1] in "0123456789(-." else 3)


for _letter in AXES[2:]:
    _axis_command(_letter)
