"""Coordinate systems: axes, the pointer to a motion program, and its execution.

A program is calculated ahead of the motion: whenever a move starts, the next one is calculated, so
one complete move waits behind the executing one (blended LINEAR moves need one more).
Source: Turbo PMAC Software Reference Manual p. 391-393 (run), 405-485 (statements).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pmac_comp.simulator import motion_moves as moves
from pmac_comp.simulator import registers as r
from pmac_comp.simulator import trajectory as traj
from pmac_comp.simulator import vm
from pmac_comp.simulator.axes import AxisDefinition
from pmac_comp.simulator.errors import CardError
from pmac_comp.simulator.hold_point import HoldPoint
from pmac_comp.simulator.language.statements import Statement
from pmac_comp.simulator.machine import Context
from pmac_comp.simulator.memory import read_long, write_float48
from pmac_comp.simulator.motion_planner import Planner, Segments, join
from pmac_comp.simulator.programs import Program

if TYPE_CHECKING:
    from pmac_comp.simulator.card import Card

_AXES = "ABCUVWXYZ"
_ROTARY_AXES = "ABC"
# In position, warning, fatal error and amplifier fault stand in the same order in both words.
_ERRORS2 = r.S2_WARNING_ERROR | r.S2_FATAL_ERROR | r.S2_AMPLIFIER_FAULT
_FOLLOWED_SHIFT = 17
_CALCULATION_BUDGET = 50_000
_AHEAD = 1  # moves that wait behind the executing one
_MOST_TAG = 1 << 30
_DWELL_END_CYCLES = 2.0
_MODE_BITS = {
    "linear": 0,
    "rapid": r.CS2_MODE1,
    "spline": r.CS2_MODE4 | r.CS2_MODE0,
    "pvt": r.CS2_MODE4 | r.CS2_MODE1,
}
# Run-time error codes of Y:+$14 (p. 505).
ERROR_LABEL, ERROR_STACK, ERROR_COUNTER, ERROR_AXES = 6, 5, 3, 10


# Program and bytecode position.
Place = tuple[Program, int]


@dataclass
class Frame:
    """One level of program execution."""

    program: Program
    context: Context = field(default_factory=Context)


@dataclass
class Modal:
    """Modal settings of a running program."""

    mode: str = "linear"
    incremental: set[str] = field(default_factory=set)
    feed_axes: tuple[str, ...] = ("X", "Y", "Z")
    ta_ms: float = 0.0
    ts_ms: float = 0.0
    tm_ms: float | None = None
    feed: float | None = None


class CoordinateSystem:
    """One of the sixteen coordinate systems."""

    def __init__(self, card: Card, number: int) -> None:
        self.card = card
        self.number = number
        self.axes: dict[int, AxisDefinition] = {}
        self.frames: list[Frame] = []
        self.pointer: tuple[int, int] | None = None
        self.modal = Modal()
        self.running = False
        self.single = False
        self.stopping = False
        self.holding = False
        self.restarting = False  # ABR waits for the motors to stop
        self.hold_point = HoldPoint(card, number)
        self._returned = False  # everything is calculated, the last moves may still be executing
        self._dwell_end = 0  # tag of the end of the dwell that stops the calculation, 0 if none
        self._quitted = False
        self._fresh = False  # the next move is the first after a stop: I11
        self.planner: Planner | None = None
        self.targets: dict[str, float] = {}
        self.velocities: dict[str, float] = {}
        self.waiting: Callable[[], bool] | None = None
        self._tags = 0
        self._queued: list[int] = []
        self._assignments: list[tuple[int, str, float]] = []
        self._at_start: dict[int, list[tuple[int, str, float]]] = {}
        self._calculating = False
        self._executing: Place | None = None
        self._places: dict[int, Place] = {}
        self._units: dict[int, float] = {}

    # --- axes and positions ---------------------------------------------------------------------

    @property
    def base(self) -> int:
        """Address of the register block."""
        return r.cs_base(self.number)

    @property
    def motors(self) -> list[int]:
        """Motors assigned to this coordinate system."""
        return sorted(self.axes)

    def isx(self, index: int) -> float:
        """I-variable Isx of this coordinate system by its last two digits."""
        return self.card.variables.read_i(5000 + 100 * self.number + index)

    def match(self) -> None:
        """PMATCH: axis positions from the commanded positions of the motors (p. 387)."""
        rows: list[tuple[AxisDefinition, float]] = []
        for motor, definition in self.axes.items():
            counts = self.card.servo.queue.last_position(motor)[0] / self.card.servo.unit(motor)
            rows.append((definition, counts + self._bias(motor)))
        letters = sorted({letter for definition, _ in rows for letter, _ in definition.terms})
        if letters:
            self.targets.update(_solve(letters, rows))
        self._write_targets()

    def _bias(self, motor: int) -> float:
        return self.card.bias(motor)

    def _write_targets(self) -> None:
        memory = self.card.memory
        for letter, value in self.targets.items():
            address = self.base + r.C_TARGETS + _AXES.index(letter)
            write_float48(memory.x, memory.y, address, value)

    def motor_targets(self, targets: dict[str, float]) -> dict[int, float]:
        """Motor positions in units of axis positions."""
        found: dict[int, float] = {}
        for motor, definition in self.axes.items():
            counts = definition.offset - self._bias(motor)
            for letter, scale in definition.terms:
                counts += scale * targets.get(letter, 0.0)
            found[motor] = counts * self._unit(motor)
        return found

    def _unit(self, motor: int) -> float:
        # Ixx08 may only be changed while the motor is killed, so it holds for a run.
        unit = self._units.get(motor)
        return unit if unit is not None else self.card.servo.unit(motor)

    def motor_rates(self, rates: dict[str, float]) -> dict[int, float]:
        """Motor velocities in units per cycle of axis velocities in axis units per ms."""
        cycle_ms = self.card.servo.cycle_ms
        return {
            motor: sum([s * rates.get(letter, 0.0) for letter, s in definition.terms])
            * self._unit(motor)
            * cycle_ms
            for motor, definition in self.axes.items()
        }

    # --- pointing, running, stopping ------------------------------------------------------------

    def point(self, number: int, label: int) -> None:
        """B command: point to a program and label."""
        if self.running and not self._returned:
            raise CardError(1)
        program = self.card.find_program(self.number, number)
        if program is None or program.assembled is None:
            raise CardError(15)
        if label not in program.assembled.labels:
            raise CardError(3 if program.statements else 15)
        frame = self._frame(program)
        frame.context.state[vm.S_PC] = program.assembled.labels[label]
        self.frames = [frame]
        self.hold_point.forget()
        self.pointer = (number, label)
        self._load_defaults()

    def _frame(self, program: Program) -> Frame:
        frame = Frame(program)
        self._prepare(frame)
        return frame

    def _prepare(self, frame: Frame) -> None:
        frame.context.state[vm.S_SUSPEND] = 1
        frame.context.state[vm.S_CS] = self.number - 1

    def power_up(self) -> None:
        """Forget programs and move modes; modes last until the next reset (p. 409, 444)."""
        self.stop_now()
        self.frames, self.pointer = [], None
        self.modal = Modal()
        self._set_status()

    def set_axis_mode(self, statement: Statement) -> None:
        """ABS, INC or FRAX given on-line (p. 293, 322, 331)."""
        self._event(statement, ())

    def _load_defaults(self) -> None:
        self.modal.ta_ms = self.isx(87)
        self.modal.ts_ms = self.isx(88)
        self.modal.feed = self.isx(89)
        self.modal.tm_ms = None

    def forget_program(self) -> None:
        """Programs were edited: every coordinate system must be pointed again (p. 381)."""
        self.stop_now()
        self.frames = []
        self.pointer = None

    def run(self, *, single: bool = False) -> None:
        """R or S."""
        if self.holding:
            self._resume()
            return
        if self.running and not self._returned:
            if single:
                self.quit()
                return
            raise CardError(1)
        self._check_ready()
        if self.running:
            self._ended()
        self.hold_point.return_to()
        self.match()
        self.planner = Planner(self._commanded())
        self._units = {motor: self.card.servo.unit(motor) for motor in self.motors}
        self.velocities = {}
        self.running, self.single, self.stopping = True, single, False
        self._quitted, self._fresh, self._returned = False, True, False
        self._queued = []
        self._set_status()
        self.card.background_needed()
        self.calculate()

    def run_when_stopped(self) -> None:
        """ABR: run as soon as the aborted motors stand (p. 292)."""
        self.restarting = True
        self.try_restart()

    def try_restart(self) -> None:
        """Background: start what ABR asked for, or go on waiting."""
        if any(self.card.servo.is_moving(m) for m in self.motors):
            self.card.background_needed()
            return
        self.restarting = False
        self.run()

    def _commanded(self) -> dict[int, float]:
        return {m: self.card.servo.queue.last_position(m)[0] for m in self.motors}

    def _check_ready(self) -> None:
        servo = self.card.servo
        if not self.axes:
            raise CardError(14)
        if self.card.programs.open_program is not None:
            from pmac_comp.simulator.language.statements import MOTION

            if self.card.programs.open_program.kind == MOTION:
                raise CardError(15)
        if not self.frames:
            raise CardError(15)
        if self.frames[-1].program.assembled is None:
            raise CardError(16)
        for motor in self.motors:
            status = int(self.card.memory.x[r.motor_base(motor) + r.M_STATUS1])
            both = r.S1_NEGATIVE_LIMIT | r.S1_POSITIVE_LIMIT
            if not servo.is_active(motor):
                raise CardError(13)
            if status & both == both:
                raise CardError(10)
            if servo.is_open_loop(motor):
                raise CardError(12)
            if servo.is_moving(motor):
                raise CardError(11)

    def _resume(self) -> None:
        for motor in self.motors:
            if self.card.servo.is_open_loop(motor):
                raise CardError(12)
        self.hold_point.return_to()
        self.holding = False
        self.card.memory.y[self.base + r.C_TIMEBASE_SOURCE] = 0

    def hold(self) -> None:
        """H: the time base slews to zero."""
        self.holding = self.running
        self.card.memory.y[self.base + r.C_TIMEBASE_SOURCE] = 1

    def quit(self) -> None:
        """Q: no further move is calculated."""
        if self.running and not self.stopping:
            self.stopping = self._quitted = True
            self.waiting = None
            self._settle()

    def stop_now(self) -> None:
        """Abort or fault: the program stops where it is, trajectories are replaced outside."""
        self.running = self.stopping = self.holding = self.single = self.restarting = False
        self._dwell_end = 0
        self.hold_point.forget()
        self.waiting = None
        self.planner = None
        self._units = {}
        self._queued, self._at_start, self._assignments = [], {}, []
        self.card.memory.y[self.base + r.C_TIMEBASE_SOURCE] = 0
        self._set_status()

    def fail(self, code: int) -> None:
        """Run-time error: code to Y:+$14, status bit, motors decelerate."""
        self.card.memory.y[self.base + r.C_ERROR] = code
        self.card.memory.y[self.base + r.C_STATUS2_ADDRESS] |= r.CS2_RUNTIME_ERROR
        self.stop_now()
        for motor in self.motors:
            self.card.servo.abort_motion(motor)

    def flush_assignments(self) -> None:
        """MFLUSH: forget synchronous assignments that wait."""
        self._assignments, self._at_start = [], {}

    # --- calculation ----------------------------------------------------------------------------

    def segment_started(self, motor: int, tag: int) -> None:
        """A tagged segment has started: its assignments act and the next move is calculated."""
        if not self.motors or motor != self.motors[0] or tag not in self._queued:
            return
        while self._queued:
            passed = self._queued.pop(0)
            self._executing = self._places.pop(passed, self._executing)
            for number, op, value in self._at_start.pop(passed, []):
                self.card.synchronous_assignment(number, op, value)
            if passed == tag:
                break
        if tag == self._dwell_end:
            self._dwell_end, self.waiting = 0, None
        self.calculate()

    def tick(self) -> None:
        """Background: what waits for a condition, and the end of the program."""
        if not self.running or self.hold_point.is_left:
            return
        if self.waiting is not None:
            if not self.waiting():
                return
            self.waiting = None
        self.calculate()
        if self.stopping and not any(self.card.servo.is_moving(m) for m in self.motors):
            self._ended()

    def _ended(self) -> None:
        self._units = {}
        if self._quitted:
            self.hold_point.stopped(self.motors)
        self.running = self.stopping = self.single = False
        self.planner = None
        self._queued = []
        self._set_status()

    def calculate(self) -> None:
        """Calculate moves until enough of them wait."""
        if self._calculating or not self.running or self.stopping or self.waiting is not None:
            return
        self._calculating = True
        try:
            budget = _CALCULATION_BUDGET
            while self._wants_more() and budget > 0:
                budget -= self._step(budget)
        except CardError as error:
            self.fail(ERROR_LABEL if error.code == 16 else ERROR_COUNTER)
        finally:
            self._calculating = False

    def _wants_more(self) -> bool:
        return (
            self.running
            and not self.stopping
            and self.waiting is None
            and len(self._queued) <= _AHEAD
        )

    def _step(self, budget: int) -> int:
        frame = self.frames[-1]
        if frame.program.assembled is None:
            raise CardError(16)
        status = self.card.machine.run(frame.program.assembled.compiled, frame.context, budget)
        used = max(int(frame.context.state[vm.S_STEPS]), 1)
        for index, arguments in frame.context.take_events():
            self._event(frame.program.statements[index], arguments)
        if status == vm.FINISHED:
            self._finished()
        elif status == vm.FAULT:
            self.fail(ERROR_STACK)
        elif status == vm.JUMPED_BACK:
            # Two jumps back without a move end blending (p. 433).
            self._settle()
            self.waiting = lambda: True
            self.card.background_needed()
        return used

    def _finished(self) -> None:
        if len(self.frames) > 1:
            self.frames.pop()
            return
        if self.card.rotary.more(self):
            return
        frame = self.frames[0]
        frame.context.restart()
        self._prepare(frame)
        self.stopping = self._returned = True
        self._settle()
        self._set_status()
        if not any(self.card.servo.is_moving(m) for m in self.motors):
            self._ended()

    def idle(self) -> None:
        """Nothing to calculate now: stop at the end of what is planned, go on when woken."""
        self._settle()
        empty = self.card.rotary.program(self.number)
        if empty is not None:
            self.replace_program(empty)
        self.waiting = lambda: bool(self.card.rotary.buffers[self.number].lines)
        self.card.background_needed()

    def replace_program(self, program: Program) -> None:
        """Go on with another program at the same level (next rotary line)."""
        self.frames = [self._frame(program)]

    def _settle(self) -> None:
        if self.planner is not None:
            self._push(self.planner.finish())

    def _push(self, segments: Segments) -> None:
        for motor, pieces in segments.items():
            self.card.servo.queue.push(motor, pieces)

    # --- statements -----------------------------------------------------------------------------

    def _event(self, statement: Statement, arguments: tuple[float, ...]) -> None:
        method = getattr(self, f"_do_{statement.kind}", None)
        if method is not None:
            method(statement, arguments)
        else:
            self.card.do_statement(statement, 1, self.number, origin="PROG")

    def _do_linear(self, _statement: Statement, _arguments: tuple[float, ...]) -> None:
        self._mode("linear")

    def _do_rapid(self, _statement: Statement, _arguments: tuple[float, ...]) -> None:
        self._mode("rapid")

    def _do_spline1(self, _statement: Statement, _arguments: tuple[float, ...]) -> None:
        self._mode("spline")

    def _do_pvt(self, _statement: Statement, arguments: tuple[float, ...]) -> None:
        self._mode("pvt")
        self.modal.tm_ms = arguments[0]

    def _mode(self, mode: str) -> None:
        if mode != self.modal.mode:
            self._settle()
            self.velocities = {}
        self.modal.mode = mode
        self._set_status()

    def _do_abs(self, statement: Statement, _arguments: tuple[float, ...]) -> None:
        self.modal.incremental -= set(statement.data or _AXES)
        self._set_status()

    def _do_inc(self, statement: Statement, _arguments: tuple[float, ...]) -> None:
        self.modal.incremental |= set(statement.data or _AXES)
        self._set_status()

    def _do_frax(self, statement: Statement, _arguments: tuple[float, ...]) -> None:
        self.modal.feed_axes = tuple(statement.data) or tuple(_AXES)
        self._set_status()

    def _do_tm(self, _statement: Statement, arguments: tuple[float, ...]) -> None:
        self.modal.tm_ms, self.modal.feed = arguments[0], None

    def _do_feed(self, _statement: Statement, arguments: tuple[float, ...]) -> None:
        limit = self.isx(98)
        feed = min(arguments[0], limit) if limit > 0.0 else arguments[0]
        self.modal.feed, self.modal.tm_ms = feed, None

    def _do_ta(self, _statement: Statement, arguments: tuple[float, ...]) -> None:
        self.modal.ta_ms = float(math.floor(arguments[0] + 0.5))

    def _do_ts(self, _statement: Statement, arguments: tuple[float, ...]) -> None:
        self.modal.ts_ms = float(math.floor(arguments[0] + 0.5))

    def _do_spindle(self, _statement: Statement, arguments: tuple[float, ...]) -> None:
        self.card.variables.write("Q", 127, arguments[0], self.number)

    def _do_sync(self, statement: Statement, arguments: tuple[float, ...]) -> None:
        number, op = statement.data
        self._assignments.append((number, op, arguments[0]))

    def _do_stop(self, _statement: Statement, _arguments: tuple[float, ...]) -> None:
        self.stopping = True
        self._settle()

    def _do_wait(self, _statement: Statement, _arguments: tuple[float, ...]) -> None:
        # The condition is tested again at the next chance; the move timer stops meanwhile.
        self._settle()
        self.waiting = lambda: True
        self.card.background_needed()

    def _do_block_start(self, _statement: Statement, _arguments: tuple[float, ...]) -> None:
        """Marks the start of what S executes in one go."""

    def _do_block_stop(self, _statement: Statement, _arguments: tuple[float, ...]) -> None:
        """Ends a block."""

    def _do_call(self, _statement: Statement, arguments: tuple[float, ...]) -> None:
        number = int(arguments[0])
        label = round((arguments[0] - number) * 100000)
        program = self.card.programs.programs.get(number)
        if program is None or program.assembled is None or len(self.frames) >= 15:
            raise CardError(16)
        if label not in program.assembled.labels:
            raise CardError(16)
        frame = self._frame(program)
        frame.context.state[vm.S_PC] = program.assembled.labels[label]
        self.frames.append(frame)

    def _do_home(self, statement: Statement, _arguments: tuple[float, ...]) -> None:
        self._settle()
        motors = tuple(statement.data)
        started = False

        def homed() -> bool:
            nonlocal started
            servo = self.card.servo
            if not started:
                if any(servo.is_moving(m) for m in motors):
                    return False
                for motor in motors:
                    servo.home(motor)
                started = True
                return False
            if any(servo.is_moving(m) for m in motors):
                return False
            self._rematch()
            return True

        self.waiting = homed
        self.card.background_needed()

    def _do_homez(self, statement: Statement, _arguments: tuple[float, ...]) -> None:
        self._settle()
        motors = tuple(statement.data)

        def zeroed() -> bool:
            if any(self.card.servo.is_moving(m) for m in self.motors):
                return False
            for motor in motors:
                self.card.servo.home_zero(motor)
            self._rematch()
            return True

        self.waiting = zeroed
        self.card.background_needed()

    def _do_pset(self, statement: Statement, arguments: tuple[float, ...]) -> None:
        self._settle()
        values = dict(zip(statement.data, arguments, strict=True))

        def renamed() -> bool:
            if any(self.card.servo.is_moving(m) for m in self.motors):
                return False
            for letter, value in values.items():
                self.rename(letter, value)
            self._fresh = True
            return True

        self.waiting = renamed
        self.card.background_needed()

    def _rematch(self) -> None:
        self.match()
        self.planner = Planner(self._commanded())

    def rename(self, letter: str, value: float) -> None:
        """Give the present axis position a new value: position bias, no motion (p. 294)."""
        self.match()
        if letter not in self.targets:
            raise CardError(3)
        change = value - self.targets[letter]
        for motor, definition in self.axes.items():
            scale = dict(definition.terms).get(letter, 0.0)
            self.card.add_bias(motor, scale * change)
        self.targets[letter] = value
        self._write_targets()

    # --- moves ----------------------------------------------------------------------------------

    def _do_move(self, statement: Statement, arguments: tuple[float, ...]) -> None:
        if self.planner is None:
            return
        targets = dict(self.targets)
        rates: dict[str, float] = {}
        values = iter(arguments)
        for letter, has_velocity in statement.data:
            value = next(values)
            start = self.targets.get(letter, 0.0)
            if letter in self.modal.incremental:
                targets[letter] = start + value
            else:
                targets[letter] = start + self._rolled_over(letter, start, value)
            if has_velocity:
                rates[letter] = next(values) / self.isx(90)
        self._calculation_time()
        tag = self._next_tag()
        segments = moves.move_segments(self, self.planner, targets, rates, tag)
        self.targets = targets
        self._accept(segments, tag)

    def _rolled_over(self, letter: str, start: float, value: float) -> float:
        """Distance of an absolute move; rotary axes A, B, C take Ixx27 into account (p. 108)."""
        distance = value - start
        motor = next((m for m, d in self.axes.items() if dict(d.terms).get(letter)), None)
        if letter not in _ROTARY_AXES or motor is None:
            return distance
        memory, base = self.card.memory, r.motor_base(motor)
        range_ct = int(read_long(memory.x, memory.y, base + r.M_IXX27))
        if not range_ct:
            return distance
        scale = abs(dict(self.axes[motor].terms)[letter])
        turn = abs(range_ct) / scale
        if range_ct > 0:
            return (distance + 0.5 * turn) % turn - 0.5 * turn
        # The sign of the destination is the direction; what lies in the band is no move.
        band = int(memory.x[base + r.M_IXX28_IXX12]) / 16.0 / scale
        way = distance % turn
        if min(way, turn - way) < band:
            return 0.0
        return way if value >= 0.0 else way - turn

    def _calculation_time(self) -> None:
        """I11: the first move after R, DWELL, PSET or WAIT starts that many ms later (p. 43)."""
        wait_ms = self.card.variables.int_i(11)
        if self._fresh and wait_ms and self.planner is not None:
            cycles, flags = self.cycles(wait_ms), traj.TIMED | traj.REAL_TIME
            position = self.planner.position
            self._push({m: [traj.Segment(cycles, (position[m],), flags)] for m in self.motors})
        self._fresh = False

    def _accept(self, segments: Segments, tag: int) -> None:
        self._write_targets()
        self._set_prejog()
        self._remember(tag)
        self._push(segments)
        if self.single:
            self.quit()

    def _set_prejog(self) -> None:
        if self.planner is None:
            return
        for motor, units in self.planner.end.items():
            self.card.servo.set_prejog(motor, units / self._unit(motor))

    def _remember(self, tag: int) -> None:
        self._queued.append(tag)
        frame = self.frames[-1]
        self._places[tag] = (frame.program, int(frame.context.state[vm.S_PC]))
        if self._assignments:
            self._at_start[tag] = self._assignments
            self._assignments = []

    def _next_tag(self) -> int:
        self._tags = self._tags % _MOST_TAG + 1
        return self._tags

    def cycles(self, time_ms: float) -> float:
        """Servo cycles of a time at 100 % override."""
        return time_ms / self.card.servo.cycle_ms

    def _do_dwell(self, _statement: Statement, arguments: tuple[float, ...]) -> None:
        if self.planner is None:
            return
        tag = self._next_tag()
        cycles = self.cycles(min(max(arguments[0], 0.0), 8388607.0))
        # Nothing is calculated before the dwell is over (p. 429): its last cycles tell. A shorter
        # piece than these could pass unseen; a DWELL0 is these alone.
        before = cycles - _DWELL_END_CYCLES
        ends = self._next_tag() if before >= 1.0 else tag
        segments = self.planner.dwell(before if ends != tag else _DWELL_END_CYCLES, tag)
        if ends != tag:
            join(segments, self.planner.dwell(_DWELL_END_CYCLES, ends))
        self.velocities, self._fresh = {}, True
        self._dwell_end, self.waiting = ends, self._dwell_is_over
        self._accept(segments, tag)
        if ends != tag:
            self._queued.append(ends)

    def _dwell_is_over(self) -> bool:
        return not self._dwell_end or not any(self.card.servo.is_moving(m) for m in self.motors)

    def _do_delay(self, _statement: Statement, arguments: tuple[float, ...]) -> None:
        if self.planner is None:
            return
        tag = self._next_tag()
        segments = moves.delay_segments(self, self.planner, arguments[0], tag)
        self._accept(segments, tag)

    # --- reports --------------------------------------------------------------------------------

    def counter(self) -> tuple[int, int]:
        """Program number and word offset of the next statement to calculate."""
        if not self.frames:
            raise CardError(3)
        frame = self.frames[-1]
        return _offset_of((frame.program, int(frame.context.state[vm.S_PC])))

    @property
    def executing(self) -> tuple[int, int] | None:
        """Program number and word offset behind the executing move, None if nothing runs."""
        return _offset_of(self._executing) if self._executing is not None else None

    def counter_text(self, *, executing: bool = False) -> str:
        """Answer to PC or PE."""
        place = self.executing if executing and self.executing and self.running else None
        number, offset = place or self.counter()
        return f"P{number}:{offset}"

    def move_time_ms(self) -> float:
        """Time left in the commanded move."""
        if not self.motors:
            return 0.0
        cycles = self.card.servo.queue.time_left_cycles(self.motors[0])
        return cycles * self.card.servo.cycle_ms

    def update_status(self) -> None:
        """Status bits that follow the motors: in position if all are, errors if any has one."""
        words = self.card.memory.y
        any_of, all_of = 0, -1 if self.axes else 0
        for motor in self.axes:
            status2 = int(words[r.motor_base(motor) + r.M_STATUS2])
            any_of |= status2
            all_of &= status2
        bits = any_of & _ERRORS2 | all_of & r.S2_IN_POSITION
        cell = self.base + r.C_STATUS2_ADDRESS
        followed = (_ERRORS2 | r.S2_IN_POSITION) << _FOLLOWED_SHIFT
        words[cell] = int(words[cell]) & ~followed | bits << _FOLLOWED_SHIFT

    def _mode_word(self) -> int:
        """Word 1 of the status without what runs: feedrate axes, incremental axes (p. 284)."""
        word = r.CS1_RADIUS_INCREMENTAL
        for place, letter in enumerate(_AXES):
            if letter in self.modal.feed_axes:
                word |= r.CS1_FIRST_FEED_AXIS << (2 * place)
            if letter in self.modal.incremental:
                word |= r.CS1_FIRST_INCREMENTAL_AXIS << (2 * place)
        return word

    def _set_status(self) -> None:
        memory = self.card.memory
        word1 = self._mode_word()
        if self.running and not self._returned:  # p. 285: 0 once RETURN is reached
            word1 |= r.CS1_RUNNING | (r.CS1_SINGLE_STEP if self.single else r.CS1_CONTINUOUS)
        memory.x[self.base + r.C_STATUS13] = word1
        word2 = int(memory.y[self.base + r.C_STATUS2_ADDRESS])
        word2 &= ~(r.CS2_MODE0 | r.CS2_MODE1 | r.CS2_MODE4)
        if self.running:
            word2 &= ~r.CS2_RUNTIME_ERROR
        memory.y[self.base + r.C_STATUS2_ADDRESS] = word2 | _MODE_BITS[self.modal.mode]


def _offset_of(place: Place) -> tuple[int, int]:
    program, position = place
    if program.assembled is None:
        raise CardError(3)
    index = program.assembled.statement_at(position)
    return program.number, program.offset_of(max(index, 0))


def _solve(letters: list[str], rows: list[tuple[AxisDefinition, float]]) -> dict[str, float]:
    """Axis positions of motor positions in counts (least squares where axes share motors)."""
    import numpy as np

    matrix = np.array(
        [[dict(d.terms).get(letter, 0.0) for letter in letters] for d, _ in rows], dtype=float
    )
    right = np.array([counts - d.offset for d, counts in rows])
    solution, *_ = np.linalg.lstsq(matrix, right, rcond=None)
    return {letter: float(v) for letter, v in zip(letters, solution, strict=True)}
