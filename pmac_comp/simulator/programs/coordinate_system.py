"""Coordinate systems: the pointer to a motion program, running and stopping it, what is ahead.

A program is calculated ahead of the motion: two moves wait behind the executing one, which blended
LINEAR moves need; the second is taken back when the program is told to stop (``last_move``).
Source: Turbo PMAC Software Reference Manual p. 391-393 (run), 405-485 (statements).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pmac_comp.simulator.language.machine import Context
from pmac_comp.simulator.language.statements import MOTION, Statement
from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory import vm
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.programs import cs_status
from pmac_comp.simulator.programs.axis_positions import AxisPositions
from pmac_comp.simulator.programs.hold_point import HoldPoint
from pmac_comp.simulator.programs.last_move import KINDS, Calculation, LastMove
from pmac_comp.simulator.programs.motion_planner import Planner, Segments
from pmac_comp.simulator.programs.motion_statements import execute
from pmac_comp.simulator.programs.programs import Program
from pmac_comp.simulator.servo import trajectory as traj

if TYPE_CHECKING:
    from pmac_comp.simulator.card.card import Card

_MOVES = ("move", "dwell", "delay", "home")  # what may stand between two jumps back (p. 433)
_CALCULATION_BUDGET = 50_000
_AHEAD = 1  # pieces of motion that may wait when the next move is calculated
_MOST_TAG = 1 << 30
# Run-time error codes of Y:+$14 (p. 505).
_ERROR_LABEL, _ERROR_STACK, _ERROR_COUNTER = 6, 5, 3
_DEEPEST_CALL = 15


def _at_once() -> bool:
    return True


# Program and bytecode position.
Place = tuple[Program, int]  # and the index of a statement


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


class CoordinateSystem(AxisPositions):
    """One of the sixteen coordinate systems: its axes, and the program that moves them."""

    def __init__(self, card: Card, number: int) -> None:
        super().__init__(card, number)
        self.frames: list[Frame] = []
        self.pointer: tuple[int, int] | None = None
        self.modal = Modal()
        self.running = False
        self.single = False
        self.stopping = False
        self.holding = False
        self.restarting = False  # ABR waits for the motors to stop
        self.hold_point = HoldPoint(card, number)
        self.returned = False  # everything is calculated, the last moves may still be executing
        self._dwell_end = 0  # tag of the end of the dwell that stops the calculation, 0 if none
        self.quitted = False
        self.fresh = False  # the next move is the first after a stop: I11
        self.planner: Planner | None = None
        self.velocities: dict[str, float] = {}
        self.waiting: Callable[[], bool] | None = None
        self.at_interrupt = False  # what waits is looked at in the next real-time interrupt
        self._tags = 0
        self.queued: list[int] = []  # tags of what is calculated and has not started
        self._last: LastMove | None = None
        self._again: LastMove | None = None  # was taken back: where the program goes on
        self.assignments: list[tuple[int, str, float]] = []
        self._at_start: dict[int, list[tuple[int, str, float]]] = {}
        self._calculating = False
        self._statement = 0  # index of the one that is carried out
        self._executing: Place | None = None
        self._places: dict[int, Place] = {}

    # --- pointing, running, stopping ------------------------------------------------------------

    def point(self, number: int, label: int) -> None:
        """B command: point to a program and label."""
        if self.running and not self.returned:
            raise CardError(1)
        program = self.card.find_program(self.number, number)
        if program is None or program.assembled is None:
            raise CardError(15)
        if label not in program.assembled.labels:
            raise CardError(3 if program.statements else 15)
        frame = self.frame_of(program)
        frame.context.state[vm.S_PC] = program.assembled.labels[label]
        self.frames = [frame]
        self._again = None
        self.hold_point.forget()
        self.pointer = (number, label)
        self._load_defaults()
        self.set_status()

    def frame_of(self, program: Program) -> Frame:
        """A level of execution at the beginning of a program."""
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
        self.set_status()

    def set_axis_mode(self, statement: Statement) -> None:
        """ABS, INC or FRAX given on-line (p. 293, 322, 331)."""
        execute(self, statement, ())

    def _load_defaults(self) -> None:
        self.modal.ta_ms = self.isx(87)
        self.modal.ts_ms = self.isx(88)
        self.modal.feed = self.isx(89)
        self.modal.tm_ms = None

    def run(self, *, single: bool = False) -> None:
        """R or S."""
        if self.holding:
            self._resume()
            return
        if self.running and not self.returned:
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
        self.hold_units(self.motors)
        self.velocities = {}
        self.running, self.single, self.stopping = True, single, False
        self.quitted, self.fresh, self.returned = False, True, False
        self.at_interrupt = False
        self.queued, self._executing, self._last = [], None, None
        self.set_status()
        self.card.background_needed()
        self.calculate()

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
        being_written = self.card.programs.open_program
        if being_written is not None and being_written.kind == MOTION:
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
        """R or S after H: the time base comes back, whether or not a program runs (p. 391)."""
        if self.running:
            for motor in self.motors:
                if self.card.servo.is_open_loop(motor):
                    raise CardError(12)
            self.hold_point.return_to()
            if self.quitted:
                self._wind_up()
        self.holding = False
        self.card.memory.y[self.base + r.C_TIMEBASE_SOURCE] = 0

    def hold(self) -> None:
        """H: the time base slews to zero, until R, S or A."""
        self.holding = True
        self.card.memory.y[self.base + r.C_TIMEBASE_SOURCE] = 1

    def quit(self) -> None:
        """Q: no further move is calculated, and at most one follows the executing one (p. 388)."""
        if self.running and not self.stopping:
            self.stopping = self.quitted = True
            self.set_status()
            self.waiting = None
            if not self.hold_point.is_left:
                self._wind_up()

    def _wind_up(self) -> None:
        """After Q: what is planned comes to a stop, where the motors are on their way."""
        self._take_back()
        self.settle()

    def _take_back(self) -> None:
        """Take back the last calculated move if it is the second behind the executing one."""
        last, self._last = self._last, None
        if last is None or self.single or self._executing is None:
            return
        behind = [tag for tag in self.queued if tag not in last.tags]
        if not behind or len(behind) == len(self.queued):
            return
        for motor, count in last.segments.items():
            self.card.servo.queue.drop_last(motor, count)
        for tag in last.tags:
            self._places.pop(tag, None)
            self.assignments = self._at_start.pop(tag, []) + self.assignments
        self.queued, self._dwell_end = behind, 0
        self.planner, self.targets = last.planner, dict(last.targets)
        self.write_targets()
        self._set_prejog()
        self._again = last

    def stop_now(self) -> None:
        """Abort or fault: the program stops where it is, trajectories are replaced outside."""
        self.running = self.stopping = self.holding = self.single = self.restarting = False
        self._dwell_end = 0
        self.hold_point.forget()
        self.waiting = None
        self.planner = None
        self.hold_units([])
        self.queued, self._at_start, self.assignments = [], {}, []
        self.card.memory.y[self.base + r.C_TIMEBASE_SOURCE] = 0
        self.set_status()

    def abort(self) -> None:
        """A: the program stops, the motors decelerate with their own limits."""
        self.stop_now()
        for motor in self.motors:
            self.card.servo.abort(motor)

    def abort_run(self, label: tuple[int, int] | None) -> None:
        """ABR: abort, then run; without a label the program starts at its top again (p. 292)."""
        self.abort()
        if label is None and self.pointer is not None:
            label = (self.pointer[0], 0)
        if label is not None:
            if label[0] == 0:
                self.card.rotary.clear(self.number)
            self.point(*label)
        self.restarting = True
        self.try_restart()

    def set_override(self, percent: float) -> None:
        """``%{c}``: commanded time base; ERR003 while something else is its source."""
        memory = self.card.memory
        if int(memory.x[self.base + r.C_TIMEBASE_SOURCE]) != self.base:
            raise CardError(3)
        i10 = int(memory.x[r.I10_REGISTER])
        memory.x[self.base + r.C_TIMEBASE_COMMAND] = min(round(percent * i10 / 100.0), 0x7FFFFF)

    def fail(self, code: int) -> None:
        """Run-time error: code to Y:+$14, status bit, motors decelerate."""
        self.card.memory.y[self.base + r.C_ERROR] = code
        self.card.memory.y[self.base + r.C_STATUS2_ADDRESS] |= r.CS2_RUNTIME_ERROR
        self.stop_now()
        for motor in self.motors:
            self.card.servo.abort_motion(motor)

    def enter(self, frame: Frame) -> None:
        """Go on in a called program; a run-time error where the calls are nested too deeply."""
        if len(self.frames) >= _DEEPEST_CALL:
            self.fail(_ERROR_STACK)
        else:
            self.frames.append(frame)

    def flush_assignments(self) -> None:
        """MFLUSH: forget synchronous assignments that wait."""
        self.assignments, self._at_start = [], {}

    # --- calculation ----------------------------------------------------------------------------

    def segment_started(self, motor: int, tag: int) -> None:
        """A tagged segment has started: its assignments act and the next move is calculated."""
        if not self.motors or motor != self.motors[0] or tag not in self.queued:
            return
        while self.queued:
            passed = self.queued.pop(0)
            self._executing = self._places.pop(passed, self._executing)
            for number, op, value in self._at_start.pop(passed, []):
                self._assign(number, op, value)
            if passed == tag:
                break
        if tag == self._dwell_end:
            self._dwell_end, self.waiting = 0, None
        self.calculate()

    def _assign(self, number: int, op: str, value: float) -> None:
        """``M1==5`` and its bitwise forms, when their move starts."""
        variables = self.card.variables
        present, whole = int(variables.read("M", number)), int(value)
        result = {"&=": present & whole, "|=": present | whole, "^=": present ^ whole}
        variables.write("M", number, value if op == "==" else float(result[op]))

    def tick(self) -> None:
        """Background or interrupt: what waits for a condition, and the end of the program."""
        if not self.running or self.hold_point.is_left:
            return
        self.at_interrupt = False
        if self.waiting is not None:
            if not self.waiting():
                return
            self.waiting = None
        self.calculate()
        if self.stopping and not any(self.card.servo.is_moving(m) for m in self.motors):
            self._ended()

    def _ended(self) -> None:
        self.hold_units([])
        if self.quitted:
            self.hold_point.stopped(self.motors)
        self.running = self.stopping = self.single = False
        self.planner = None
        self.queued = []
        self.set_status()

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
            self.fail(_ERROR_LABEL if error.code == 16 else _ERROR_COUNTER)
        finally:
            self._calculating = False

    def _wants_more(self) -> bool:
        return (
            self.running
            and not self.stopping
            and self.waiting is None
            and len(self.queued) <= _AHEAD
        )

    def _step(self, budget: int) -> int:
        frame = self.frames[-1]
        if frame.program.assembled is None:
            raise CardError(16)
        again, self._again = self._again, None
        if again is not None and again.frame is frame:
            self._carry_out(frame, again.statement, again.arguments)
            return 1
        status = self.card.machine.run(frame.program.assembled.compiled, frame.context, budget)
        used = max(int(frame.context.state[vm.S_STEPS]), 1)
        for index, arguments in frame.context.take_events():
            self._carry_out(frame, index, arguments)
        if status == vm.FINISHED:
            self._finished()
        elif status == vm.FAULT:
            self.fail(_ERROR_STACK)
        elif status == vm.JUMPED_BACK:
            # Two jumps back without a move end blending (p. 433).
            self.settle()
            self.wait_for_interrupt()
        return used

    def _carry_out(self, frame: Frame, index: int, arguments: tuple[float, ...]) -> None:
        statement = frame.program.statements[index]
        self._statement = index
        if statement.kind in KINDS and self.planner is not None:
            calculation = Calculation(self, self.planner)
            execute(self, statement, arguments)
            self._last = calculation.done(self, frame, index, arguments)
        else:
            execute(self, statement, arguments)
        if statement.kind in _MOVES:
            self._forget_jumps()

    def _forget_jumps(self) -> None:
        for frame in self.frames:
            frame.context.state[vm.S_JUMPS] = 0

    def _finished(self) -> None:
        if len(self.frames) > 1:
            self.frames.pop()
            return
        if self.card.rotary.more(self):
            return
        frame = self.frames[0]
        frame.context.restart()
        self._prepare(frame)
        self.stopping = self.returned = True
        self.settle()
        self.set_status()
        if not any(self.card.servo.is_moving(m) for m in self.motors):
            self._ended()

    def idle(self) -> None:
        """Nothing to calculate now: stop at the end of what is planned, go on when woken."""
        self.settle()
        empty = self.card.rotary.program(self.number)
        if empty is not None:
            self.replace_program(empty)
        self.wait_until(lambda: self.card.rotary.goes_on(self.number))

    def replace_program(self, program: Program) -> None:
        """Go on with another program at the same level (next rotary line)."""
        self.frames = [self.frame_of(program)]

    def settle(self) -> None:
        """End blending: what is planned comes to a stop."""
        if self.planner is not None:
            self._push(self.planner.finish())

    def _push(self, segments: Segments) -> None:
        for motor, pieces in segments.items():
            self.card.servo.queue.push(motor, pieces)

    # --- what statements do ---------------------------------------------------------------------

    def wait_until(self, true: Callable[[], bool]) -> None:
        """Calculate nothing before a condition holds; the background looks."""
        self.waiting, self.at_interrupt = true, False
        self.card.background_needed()

    def wait_for_interrupt(self) -> None:
        """Calculate nothing before the next real-time interrupt, every I8+1 cycles (p. 433)."""
        self.waiting, self.at_interrupt = _at_once, True

    def rematch(self) -> None:
        """Go on from where the motors are: something else than a move has moved them."""
        self.match()
        self.planner = Planner(self._commanded())

    # --- moves ----------------------------------------------------------------------------------

    def allow_calculation_time(self) -> None:
        """I11: the first move after R, DWELL, PSET or WAIT starts that many ms later (p. 43)."""
        wait_ms = self.card.variables.int_i(11)
        if self.fresh and wait_ms and self.planner is not None:
            cycles, flags = self.cycles(wait_ms), traj.TIMED | traj.REAL_TIME
            position = self.planner.position
            self._push({m: [traj.Segment(cycles, (position[m],), flags)] for m in self.motors})
        self.fresh = False

    def accept(self, segments: Segments, tag: int) -> None:
        """Queue a move whose targets are set; its tag says when it starts."""
        self.write_targets()
        self._set_prejog()
        self._remember(tag)
        self._push(segments)
        if self.single:
            self.quit()

    def _set_prejog(self) -> None:
        if self.planner is None:
            return
        for motor, units in self.planner.end.items():
            self.card.servo.set_prejog(motor, units / self.unit(motor))

    def _remember(self, tag: int) -> None:
        self.queued.append(tag)
        frame = self.frames[-1]
        self._places[tag] = (frame.program, self._statement)
        if self.assignments:
            self._at_start[tag] = self.assignments
            self.assignments = []

    def next_tag(self) -> int:
        """Number of the next piece of motion."""
        self._tags = self._tags % _MOST_TAG + 1
        return self._tags

    def stop_until(self, tag: int) -> None:
        """Calculate nothing before the piece of a dwell with this tag starts."""
        self._dwell_end, self.waiting = tag, self._dwell_is_over

    def await_start(self, tag: int) -> None:
        """Expect a piece of motion that is queued and is no move."""
        self.queued.append(tag)

    def _dwell_is_over(self) -> bool:
        return not self._dwell_end or not any(self.card.servo.is_moving(m) for m in self.motors)

    # --- reports --------------------------------------------------------------------------------

    def counter(self) -> tuple[int, int]:
        """Program number and word offset of the next statement to calculate."""
        if not self.frames:
            raise CardError(3)
        frame = self.frames[-1]
        assembled = frame.program.assembled
        if assembled is None:
            raise CardError(3)
        if self._again is not None and self._again.frame is frame:
            return frame.program.number, frame.program.offset_of(self._again.statement)
        index = assembled.statement_at(int(frame.context.state[vm.S_PC]))
        return frame.program.number, frame.program.offset_of(max(index, 0))

    @property
    def executing(self) -> tuple[int, int] | None:
        """Program number and word offset of the executing move, None before the first and after."""
        if self._executing is None or not self.running:
            return None
        program, index = self._executing
        return program.number, program.offset_of(index)

    def counter_text(self, *, executing: bool = False) -> str:
        """Answer to PC or PE."""
        number, offset = (executing and self.executing) or self.counter()
        return f"P{number}:{offset}"

    def move_time_ms(self) -> float:
        """Time left in the commanded move."""
        if not self.motors:
            return 0.0
        cycles = self.card.servo.queue.time_left_cycles(self.motors[0])
        return cycles * self.card.servo.cycle_ms

    def update_status(self) -> None:
        """Status bits that follow the motors: in position if all are, errors if any has one."""
        cs_status.follow_motors(self)

    def set_status(self) -> None:
        """Status words of the program: whether it runs, and in which modes."""
        cs_status.write_program(self)
