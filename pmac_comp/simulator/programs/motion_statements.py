"""Statements of a motion program: what each does to its coordinate system.

One function per statement, under the name that the parser gives it. What a program asks of the rest
of the card (PLC switches, commands, messages, gathering) goes there.
Source: Turbo PMAC Software Reference Manual p. 405-485.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from pmac_comp.simulator.language.statements import AXES, Statement
from pmac_comp.simulator.memory import vm
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.programs import motion_moves as moves
from pmac_comp.simulator.programs.motion_planner import join

if TYPE_CHECKING:
    from pmac_comp.simulator.programs.coordinate_system import CoordinateSystem

_DWELL_END_CYCLES = 2.0
_LONGEST_TIME_ms = 8388607.0
Arguments = tuple[float, ...]
Doer = Callable[["CoordinateSystem", Statement, Arguments], None]
_DOERS: dict[str, Doer] = {}


def execute(system: CoordinateSystem, statement: Statement, arguments: Arguments) -> None:
    """Do what a statement says in its coordinate system, or have the card do it."""
    doer = _DOERS.get(statement.kind)
    if doer is not None:
        doer(system, statement, arguments)
    else:
        system.card.interpreter.do_statement(statement, 1, system.number, origin="PROG")


def _does(kind: str) -> Callable[[Doer], Doer]:
    def register(doer: Doer) -> Doer:
        _DOERS[kind] = doer
        return doer

    return register


# --- move modes ----------------------------------------------------------------------------------


def _mode(system: CoordinateSystem, mode: str) -> None:
    if mode != system.modal.mode:
        system.settle()
        system.velocities = {}
    system.modal.mode = mode
    system.set_status()


def _plain_mode(kind: str, mode: str) -> None:
    @_does(kind)
    def doer(system: CoordinateSystem, _statement: Statement, _arguments: Arguments) -> None:
        _mode(system, mode)


for _kind, _name in (("linear", "linear"), ("rapid", "rapid"), ("spline1", "spline")):
    _plain_mode(_kind, _name)


@_does("pvt")
def _pvt(system: CoordinateSystem, _statement: Statement, arguments: Arguments) -> None:
    system.modal.tm_ms = arguments[0]
    _mode(system, "pvt")


@_does("abs")
def _absolute(system: CoordinateSystem, statement: Statement, _arguments: Arguments) -> None:
    system.modal.incremental -= set(statement.data or AXES)
    system.set_status()


@_does("inc")
def _incremental(system: CoordinateSystem, statement: Statement, _arguments: Arguments) -> None:
    system.modal.incremental |= set(statement.data or AXES)
    system.set_status()


@_does("frax")
def _feed_axes(system: CoordinateSystem, statement: Statement, _arguments: Arguments) -> None:
    system.modal.feed_axes = tuple(statement.data) or tuple(AXES)
    system.set_status()


@_does("tm")
def _move_time(system: CoordinateSystem, _statement: Statement, arguments: Arguments) -> None:
    system.modal.tm_ms, system.modal.feed = arguments[0], None
    system.set_status()


@_does("feed")
def _feed(system: CoordinateSystem, _statement: Statement, arguments: Arguments) -> None:
    limit = system.isx(98)
    feed = min(arguments[0], limit) if limit > 0.0 else arguments[0]
    system.modal.feed, system.modal.tm_ms = feed, None
    system.set_status()


def _whole_ms(time_ms: float) -> float:
    return float(math.floor(min(time_ms, _LONGEST_TIME_ms) + 0.5))


@_does("ta")
def _ramp_time(system: CoordinateSystem, _statement: Statement, arguments: Arguments) -> None:
    system.modal.ta_ms = _whole_ms(arguments[0])


@_does("ts")
def _s_curve_time(system: CoordinateSystem, _statement: Statement, arguments: Arguments) -> None:
    system.modal.ts_ms = _whole_ms(arguments[0])


@_does("spindle")
def _spindle(system: CoordinateSystem, _statement: Statement, arguments: Arguments) -> None:
    system.card.variables.write("Q", 127, arguments[0], system.number)


# --- flow ----------------------------------------------------------------------------------------


@_does("sync")
def _synchronous(system: CoordinateSystem, statement: Statement, arguments: Arguments) -> None:
    number, op = statement.data
    system.assignments.append((number, op, arguments[0]))


@_does("stop")
def _stop(system: CoordinateSystem, _statement: Statement, _arguments: Arguments) -> None:
    system.stopping = True
    system.settle()


@_does("wait")
def _wait(system: CoordinateSystem, _statement: Statement, _arguments: Arguments) -> None:
    # The condition is tested again at the next chance; the move timer stops meanwhile.
    system.settle()
    system.wait_for_interrupt()


@_does("block_start")
@_does("block_stop")
def _block(_system: CoordinateSystem, _statement: Statement, _arguments: Arguments) -> None:
    """Marks what S executes in one go."""


@_does("call")
def _call(system: CoordinateSystem, _statement: Statement, arguments: Arguments) -> None:
    number = int(arguments[0])
    label = round((arguments[0] - number) * 100000)
    program = system.card.programs.programs.get(number)
    if program is None or program.assembled is None:
        raise CardError(16)
    if label not in program.assembled.labels:
        raise CardError(16)
    frame = system.frame_of(program)
    frame.context.state[vm.S_PC] = program.assembled.labels[label]
    system.enter(frame)


# --- positions -----------------------------------------------------------------------------------


@_does("home")
def _home(system: CoordinateSystem, statement: Statement, _arguments: Arguments) -> None:
    system.settle()
    motors = tuple(statement.data)
    started = False

    def homed() -> bool:
        nonlocal started
        servo = system.card.servo
        if not started:
            if any(servo.is_moving(m) for m in motors):
                return False
            for motor in motors:
                servo.home(motor)
            started = True
            return False
        if any(servo.is_moving(m) for m in motors):
            return False
        system.rematch()
        return True

    system.wait_until(homed)


@_does("homez")
def _home_zero(system: CoordinateSystem, statement: Statement, _arguments: Arguments) -> None:
    system.settle()
    motors = tuple(statement.data)

    def zeroed() -> bool:
        if any(system.card.servo.is_moving(m) for m in system.motors):
            return False
        for motor in motors:
            system.card.servo.home_zero(motor)
        system.rematch()
        return True

    system.wait_until(zeroed)


@_does("pset")
def _position_set(system: CoordinateSystem, statement: Statement, arguments: Arguments) -> None:
    system.settle()
    values = dict(zip(statement.data, arguments, strict=True))

    def renamed() -> bool:
        if any(system.card.servo.is_moving(m) for m in system.motors):
            return False
        for letter, value in values.items():
            system.rename(letter, value)
        system.fresh = True
        return True

    system.wait_until(renamed)


# --- moves ---------------------------------------------------------------------------------------


@_does("move")
def _move(system: CoordinateSystem, statement: Statement, arguments: Arguments) -> None:
    if system.planner is None:
        return
    targets = dict(system.targets)
    rates: dict[str, float] = {}
    values = iter(arguments)
    for letter, has_velocity in statement.data:
        value = next(values)
        start = system.targets.get(letter, 0.0)
        if letter in system.modal.incremental:
            targets[letter] = start + value
        else:
            targets[letter] = start + system.distance_to(letter, start, value)
        if has_velocity:
            rates[letter] = next(values) / system.isx(90)
    system.allow_calculation_time()
    tag = system.next_tag()
    segments = moves.move_segments(system, system.planner, targets, rates, tag)
    system.targets = targets
    system.accept(segments, tag)


@_does("dwell")
def _dwell(system: CoordinateSystem, _statement: Statement, arguments: Arguments) -> None:
    if system.planner is None:
        return
    tag = system.next_tag()
    cycles = system.cycles(min(max(arguments[0], 0.0), _LONGEST_TIME_ms))
    # Nothing is calculated before the dwell is over (p. 429): its last cycles tell. A shorter
    # piece than these could pass unseen; a DWELL0 is these alone.
    before = cycles - _DWELL_END_CYCLES
    ends = system.next_tag() if before >= 1.0 else tag
    segments = system.planner.dwell(before if ends != tag else _DWELL_END_CYCLES, tag)
    if ends != tag:
        join(segments, system.planner.dwell(_DWELL_END_CYCLES, ends))
    system.velocities, system.fresh = {}, True
    system.stop_until(ends)
    system.accept(segments, tag)
    if ends != tag:
        system.await_start(ends)


@_does("delay")
def _delay(system: CoordinateSystem, _statement: Statement, arguments: Arguments) -> None:
    if system.planner is None:
        return
    tag = system.next_tag()
    segments = moves.delay_segments(system, system.planner, arguments[0], tag)
    system.accept(segments, tag)
