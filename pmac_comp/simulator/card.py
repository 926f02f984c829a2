"""The simulated Turbo PMAC2: memory, language, programs and servo task put together.

``run_cycles`` is the only way time moves, so commands that arrive at the same servo cycles leave
the same memory, however the cycles were cut into calls.
"""

from __future__ import annotations

import importlib
import zlib
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from pmac_comp.files.bench import Bench
from pmac_comp.simulator import kernel_servo as ks
from pmac_comp.simulator import power_up
from pmac_comp.simulator import registers as r
from pmac_comp.simulator import trajectory as traj
from pmac_comp.simulator.answers import Answers
from pmac_comp.simulator.axes import read_definition
from pmac_comp.simulator.commanded_faults import LinkFaults
from pmac_comp.simulator.commands.line import LineContext, Modal, execute_command
from pmac_comp.simulator.coordinate_system import CoordinateSystem
from pmac_comp.simulator.dpram_ascii import DpramAscii
from pmac_comp.simulator.dpram_reports import DpramReports
from pmac_comp.simulator.errors import CardError
from pmac_comp.simulator.flash import Flash
from pmac_comp.simulator.language.scanner import Scanner
from pmac_comp.simulator.language.statements import MOTION, PLC, Statement, StatementParser
from pmac_comp.simulator.machine import Machine
from pmac_comp.simulator.memory import (
    Memory,
    read_float48,
    read_long,
    write_long,
)
from pmac_comp.simulator.plant.door import Plant
from pmac_comp.simulator.plcs import Plcs
from pmac_comp.simulator.ports import Port
from pmac_comp.simulator.programs import Program, ProgramStore
from pmac_comp.simulator.ring_hold import RingHold
from pmac_comp.simulator.rotary import RotaryBuffers
from pmac_comp.simulator.servo import Servo, ServoEvent
from pmac_comp.simulator.variables import Variables

# Commands register themselves when their modules are imported.
for _name in ("buffers", "coordinate", "faults", "identity", "memory", "motor", "variables"):
    importlib.import_module(f"pmac_comp.simulator.commands.{_name}")

BACKGROUND_CYCLES = 10
SAVE_TIME_s = 1.5  # SRM p. 394: 1 to 2 s
_STOPPING_EVENTS = {
    ks.EV_FATAL,
    ks.EV_LIMIT,
    ks.EV_HARD_LIMIT,
    ks.EV_DESIRED_LIMIT,
    ks.EV_OVERCURRENT,
    ks.EV_INTEGRATED,
    ks.EV_SERVO_FAULT,
}
Listener = Callable[[str, str], None]


class Card:
    """One simulated controller with a drive behind it.

    Parameters
    ----------
    bench : Bench
        Bench file: sensors, I-variables, travel.
    plant : Plant or None
        Drive behind the card, None for the bench's own.
    servo_source : str or None
        Source text of the open servo.
    dpram : str or None
        ``small``, ``large`` or ``none``; None takes the bench's.
    flash : Path or None
        File of the flash image.
    faults : bool
        Take commanded faults (``FAULT"..."``), for tests.
    """

    def __init__(
        self,
        bench: Bench,
        *,
        plant: Plant | None = None,
        servo_source: str | None = None,
        dpram: str | None = None,
        flash: Path | None = None,
        faults: bool = False,
    ) -> None:
        self.bench = bench
        self.faults = faults
        self.link_faults = LinkFaults()
        self.dpram = dpram if dpram is not None else bench.controller.dpram
        self.memory = Memory()
        self.variables = Variables(self.memory)
        self.machine = Machine(self.variables)
        self.servo = Servo(self.variables, bench, plant)
        self.servo.on_event = self._servo_event
        self.tables = self.servo.tables
        self.gathering = self.servo.gathering
        self.ring_hold = RingHold(self.memory)
        self.status = Answers(self.memory, self.servo)
        self.programs = ProgramStore(self.memory)
        self.plcs = Plcs(self)
        self.rotary = RotaryBuffers(self)
        self.reports = DpramReports(self)
        self.dpram_ascii = DpramAscii(self)
        self.systems = {n: CoordinateSystem(self, n) for n in range(1, r.COORDINATE_SYSTEMS + 1)}
        self.flash = Flash(flash)
        self.clock_shift_s = 0.0  # of TIME= and TODAY=, until the next reset
        self.listeners: list[Listener] = []
        self.ip_address = bytes((192, 6, 94, 5))
        self._queue: deque[tuple[str, Modal, str]] = deque()
        self._elapsed = 0
        self._next_background = BACKGROUND_CYCLES
        self._keep_background = False
        if servo_source is not None:
            self._load_servo(servo_source)
        self.reset()

    def _load_servo(self, source: str) -> None:
        from pmac_comp.simulator.open_servo import translate_open_servo

        self.servo.set_open_servo(translate_open_servo(source))

    def port(self) -> Port:
        """One conversation with its own addressing and modes of address."""
        return Port(self)

    # --- time -----------------------------------------------------------------------------------

    @property
    def cycles(self) -> int:
        """Servo cycles since the card was made, resets included."""
        return self._elapsed

    @property
    def time_s(self) -> float:
        """Simulated time since the card was made."""
        return self._elapsed * self.bench.servo_period_s

    def run_cycles(self, n: int) -> None:
        """Let `n` servo cycles pass."""
        left = n
        while left > 0:
            chunk = left
            if self._has_background():
                chunk = min(left, self._next_background - self._elapsed)
            done = self.servo.run(min(chunk, self.reports.cycles_to_next()))
            self._elapsed += done
            left -= done
            self.reports.passed(done)
            if self._elapsed >= self._next_background:
                self._background()
                late = self._elapsed - self._next_background
                self._next_background += BACKGROUND_CYCLES * (late // BACKGROUND_CYCLES + 1)
        self.refresh_status()

    def _has_background(self) -> bool:
        return (
            bool(self._queue)
            or self._keep_background
            or any(s.running for s in self.systems.values())
            or self.reports.in_background
            or self.plcs.any_background()
        )

    def background_needed(self) -> None:
        """Something must be looked at in the next background cycle."""
        self._keep_background = True

    def _background(self) -> None:
        self._keep_background = False
        self.reports.background(self._elapsed)
        self.dpram_ascii.background()
        self.plcs.background()
        for _ in range(len(self._queue)):
            text, modal, port = self._queue.popleft()
            self._execute_queued(text, modal, port)
        for system in self.systems.values():
            if system.running:
                system.tick()
            elif system.restarting:
                self._restart(system)
            if system.axes:
                system.update_status()

    def refresh_status(self) -> None:
        """Bring status words up to date that the background maintains."""
        for system in self.systems.values():
            if system.axes:
                system.update_status()

    def _servo_event(self, event: ServoEvent) -> None:
        if event.kind == ks.EV_SEGMENT:
            for system in self.systems.values():
                if system.running and event.motor in system.axes:
                    system.segment_started(event.motor, event.value)
        elif event.kind == ks.EV_PLC:
            self.plcs.servo_events()
        elif event.kind in _STOPPING_EVENTS:
            for system in self.systems.values():
                if system.running and event.motor in system.axes:
                    self._stop_program(system)

    def _stop_program(self, system: CoordinateSystem) -> None:
        system.stop_now()
        for motor in system.motors:
            if not self.servo.is_open_loop(motor):
                self.servo.abort_motion(motor)

    # --- lines ----------------------------------------------------------------------------------

    def execute_line(self, context: LineContext) -> None:
        """Execute a line: program text into an open buffer, the rest at once."""
        scanner = context.scanner
        first = True
        try:
            while not scanner.at_end:
                if not self._take_program_text(context, starts_line=first):
                    self._take_command(context)
                first = False
        except CardError:
            self.rotary.drop_line()
            self.programs.drop_line()
            raise
        if self.rotary.is_open_on(context.owner):
            self.rotary.end_line(context.modal.cs)
        if self.programs.is_open_on(context.owner):
            self.programs.end_line()

    def _take_program_text(self, context: LineContext, *, starts_line: bool) -> bool:
        rotary = self.rotary.is_open_on(context.owner)
        program = self.programs.open_program if self.programs.is_open_on(context.owner) else None
        if not rotary and program is None:
            return False
        kind = program.kind if program is not None else MOTION
        statement = StatementParser(context.scanner, kind).statement()
        if statement is None:
            return False
        statement.starts_line = starts_line
        if program is not None:
            self.programs.enter(statement)
        else:
            self.rotary.enter(context.modal.cs, statement)
        return True

    def _take_command(self, context: LineContext) -> None:
        scanner = context.scanner
        start = scanner.position
        try:
            execute_command(context)
        except CardError as error:
            if error.code == 3 and not self.programs.is_open_on(context.owner):
                if _is_program_text(scanner.text[start:]):
                    raise CardError(5) from error
            elif error.code == 5 and self.programs.is_open_on(context.owner):
                raise CardError(3) from error
            raise

    def _execute_queued(self, text: str, modal: Modal, port: str) -> None:
        context = LineContext(self, modal, Scanner(text), owner=self)
        try:
            self.execute_line(context)
        except CardError as error:
            if self.variables.int_i(6) != 2:
                self.announce(port, f"\x07ERR{error.code:03d}", commanded=True)
        for line in context.lines:
            self.announce(port, line, commanded=True)

    def announce(self, port: str, text: str, *, commanded: bool = False) -> None:
        """Unsolicited text of a program, or of its command, to a port.

        ``S`` is the main serial port, ``R`` the dual-ported RAM, empty means nowhere.
        """
        if port == "R":
            self.dpram_ascii.announce(text, commanded=commanded)
        elif port:
            for listener in self.listeners:
                listener(port, text)

    def do_statement(self, statement: Statement, motor: int, cs: int, *, origin: str) -> None:
        """What programs ask of the rest of the card."""
        kind, data = statement.kind, statement.data
        if kind == "plc":
            verb, numbers = data
            for number in numbers:
                self.plcs.switch(verb, number)
        elif kind == "command":
            port, body = data
            if len(body) == 1 and body < " ":
                self.control_character(ord(body))
            else:
                self._queue.append((body, Modal(motor, cs), port))
        elif kind == "send":
            port, body = data
            self.announce(port or "S", body)
        elif kind == "gather":
            self.gathering.start()
        elif kind == "endgather":
            self.gathering.stop()
        elif kind == "lock":
            self._lock(*data)
        else:
            raise CardError(16, f"{kind} in {origin}")

    def _lock(self, number: int, variable: int | None) -> None:
        bit = 1 << (4 + number)
        words, cell = self.memory.x, r.INTERNAL_GLOBAL + 0xF4
        if variable is None:
            words[cell] = int(words[cell]) & ~bit
            return
        self.variables.write("P", variable, 1.0 if int(words[cell]) & bit else 0.0)
        words[cell] = int(words[cell]) | bit

    def control_character(self, code: int) -> None:
        """Control characters that act on the whole card."""
        if code == 0x01:  # ^A
            for system in self.systems.values():
                system.stop_now()
            for motor in self.servo.active_motors():
                self.servo.abort(motor)
        elif code == 0x04:  # ^D
            self.plcs.disable_all()
        elif code == 0x05:  # ^E
            for motor in self.servo.active_motors():
                if self.servo.is_killed(motor):
                    self.servo.enable(motor)
        elif code == 0x0B:  # ^K
            for system in self.systems.values():
                system.stop_now()
            for motor in self.servo.active_motors():
                self.servo.kill(motor)
        elif code == 0x0F:  # ^O
            for system in self.systems.values():
                system.hold()
        elif code == 0x11:  # ^Q
            for system in self.systems.values():
                system.quit()
        elif code in (0x12, 0x13):  # ^R, ^S
            for system in self.systems.values():
                self._try_run(system, single=code == 0x13)

    def _try_run(self, system: CoordinateSystem, *, single: bool) -> None:
        if not system.axes:
            return
        try:
            system.run(single=single)
        except CardError:
            # A control character has no way to answer with an error.
            return

    # --- coordinate systems ---------------------------------------------------------------------

    def motors_of(self, cs: int) -> list[int]:
        """Motors assigned to a coordinate system."""
        return self.systems[cs].motors

    def program_moves(self, motor: int) -> bool:
        """Whether the motor's coordinate system runs a program that is not in feed hold."""
        return any(s.running and not s.holding and motor in s.axes for s in self.systems.values())

    def leave_hold_point(self, motor: int) -> bool:
        """Whether a motor about to be moved is in feed hold; its trajectory is then kept."""
        for system in self.systems.values():
            if system.running and system.holding and motor in system.axes:
                system.hold_point.leave(motor)
                return True
        return False

    def any_program_runs(self) -> bool:
        """Whether any motion program runs."""
        return any(s.running for s in self.systems.values())

    def axis_command(self, context: LineContext, motor: int) -> None:
        """``#n->``: report, define or clear an axis definition."""
        scanner, system = context.scanner, self.systems[context.modal.cs]
        nearby = scanner.peek()
        if not (nearby.isalnum() or nearby in ("-", "+", ".")) or nearby == "":
            definition = system.axes.get(motor)
            context.answer(definition.text() if definition is not None else "0")
            return
        definition = read_definition(scanner)
        other = next((s for s in self.systems.values() if motor in s.axes), None)
        if other is not None and (other.running or (other is not system and definition)):
            raise CardError(1 if other.running else 3)
        if definition is None:
            system.axes.pop(motor, None)
        else:
            system.axes[motor] = definition
        self.write_assignment(motor)

    def undefine_axes(self, cs: int | None) -> None:
        """UNDEFINE (ALL)."""
        for system in self.systems.values():
            if cs is None or system.number == cs:
                if system.running:
                    raise CardError(1)
                motors = system.motors
                system.axes.clear()
                for motor in motors:
                    self.write_assignment(motor)

    def write_assignment(self, motor: int) -> None:
        """Coordinate system, axis code and scale factors in the motor's registers."""
        base = r.motor_base(motor)
        word = int(self.memory.y[base + r.M_STATUS2]) & 0x007FFF
        self.memory.x[base + r.M_AXIS_SCALE : base + r.M_AXIS_SCALE + 4] = 0
        self.memory.y[base + r.M_AXIS_SCALE : base + r.M_AXIS_SCALE + 4] = 0
        for system in self.systems.values():
            definition = system.axes.get(motor)
            if definition is None:
                continue
            word |= (system.number - 1) << r.S2_CS_SHIFT
            word |= definition.code << r.S2_AXIS_SHIFT | r.S2_ASSIGNED
            for letter, scale in definition.terms:
                place = {"Y": 1, "V": 1, "Z": 2, "W": 2}.get(letter, 0)
                self.variables.write_float(base + r.M_AXIS_SCALE + place, scale)
            self.variables.write_float(base + r.M_AXIS_SCALE + 3, definition.offset)
        self.memory.y[base + r.M_STATUS2] = word
        self.memory.touch()

    def abort(self, cs: int) -> None:
        """A command."""
        self.systems[cs].stop_now()
        for motor in self.systems[cs].motors:
            self.servo.abort(motor)

    def point(self, cs: int, label: tuple[int, int]) -> None:
        """B command."""
        self.systems[cs].point(*label)

    def run(self, cs: int, *, single: bool = False) -> None:
        """R and S commands."""
        self.systems[cs].run(single=single)

    def quit(self, cs: int) -> None:
        """Q command."""
        self.systems[cs].quit()

    def abort_run(self, cs: int, label: tuple[int, int] | None) -> None:
        """ABR command; without a label the program starts at its top again."""
        self.abort(cs)
        system = self.systems[cs]
        if label is None and system.pointer is not None:
            label = (system.pointer[0], 0)
        if label is not None:
            if label[0] == 0:
                self.rotary.clear(cs)
            system.point(*label)
        system.run_when_stopped()

    def _restart(self, system: CoordinateSystem) -> None:
        # Nobody waits for an answer any more.
        with suppress(CardError):
            system.try_restart()

    def feed_hold(self, cs: int) -> None:
        """H command."""
        self.systems[cs].hold()

    def wake(self, cs: int) -> None:
        """A rotary line arrived."""
        if self.systems[cs].running:
            self.background_needed()

    def match_positions(self, cs: int) -> None:
        """PMATCH command."""
        if self.systems[cs].running:
            raise CardError(1)
        self.systems[cs].match()

    def rename_position(self, cs: int, letter: str, value: float) -> None:
        """``X=5``."""
        if self.systems[cs].running:
            raise CardError(1)
        self.systems[cs].rename(letter, value)

    def zero_positions(self, cs: int) -> None:
        """Z command: every axis position becomes zero."""
        system = self.systems[cs]
        if system.running:
            raise CardError(1)
        letters = {letter for d in system.axes.values() for letter, _ in d.terms}
        for letter in sorted(letters):
            system.rename(letter, 0.0)

    def set_override(self, cs: int, percent: float) -> None:
        """``%{c}``: commanded time base."""
        base = r.cs_base(cs)
        if int(self.memory.x[base + r.C_TIMEBASE_SOURCE]) != base:
            raise CardError(3)
        i10 = int(self.memory.x[r.I10_REGISTER])
        value = min(round(percent * i10 / 100.0), 0x7FFFFF)
        self.memory.x[base + r.C_TIMEBASE_COMMAND] = value

    def program_counter(self, cs: int, *, executing: bool = False) -> str:
        """PC and PE commands."""
        return self.systems[cs].counter_text(executing=executing)

    def list_from_counter(self, cs: int, count: int | None, *, executing: bool) -> list[str]:
        """LIST PC and LIST PE."""
        number, offset = self.systems[cs].counter()
        if executing and self.systems[cs].executing is not None:
            number, offset = self.systems[cs].executing or (number, offset)
        program = self.programs.find(MOTION, number)
        long = bool(self.variables.int_i(9) & 1)
        lines = [(o, text) for o, text in program.lines(long=long) if o >= offset]
        chosen = lines if count is None else lines[:count]
        return [
            f"P{number}:{o}:{text}" if k == 0 else f"{o}:{text}"
            for k, (o, text) in enumerate(chosen)
        ]

    def rotary_lines(self, cs: int) -> int:
        """PR command."""
        return self.rotary.lines_left(cs)

    def move_time_ms(self, cs: int) -> float:
        """MOVETIME command."""
        return self.systems[cs].move_time_ms()

    def flush_assignments(self, cs: int) -> None:
        """MFLUSH command."""
        self.systems[cs].flush_assignments()

    def find_program(self, cs: int, number: int) -> Program | None:
        """Program that ``B{number}`` points to."""
        return self.rotary.program(cs) if number == 0 else self.programs.programs.get(number)

    def synchronous_assignment(self, number: int, op: str, value: float) -> None:
        """``M1==5`` and its bitwise forms, when their move starts."""
        present = int(self.variables.read("M", number))
        whole = int(value)
        result = {"&=": present & whole, "|=": present | whole, "^=": present ^ whole}
        self.variables.write("M", number, value if op == "==" else float(result[op]))

    # --- motors ---------------------------------------------------------------------------------

    def bias(self, motor: int) -> float:
        """Position bias of a motor in counts."""
        cell = r.motor_base(motor) + r.M_BIAS
        units = int(read_long(self.memory.x, self.memory.y, cell))
        return units / self.servo.unit(motor) if units else 0.0

    def add_bias(self, motor: int, counts: float) -> None:
        """Change the position bias of a motor."""
        cell = r.motor_base(motor) + r.M_BIAS
        units = round((self.bias(motor) + counts) * self.servo.unit(motor))
        write_long(self.memory.x, self.memory.y, cell, units)

    def rapid_limits(self, motor: int) -> traj.JogLimits:
        """Limits of a RAPID move: speed Ixx22 or Ixx16 by Ixx90 (p. 465)."""
        limits = self.servo.jog_limits(motor)
        speed = limits.speed_ct_per_ms
        if self.variables.int_i(100 * motor + 90):
            cell = r.motor_base(motor) + r.M_IXX16
            speed = float(read_float48(self.memory.x, self.memory.y, cell))
        return replace(limits, speed_ct_per_ms=speed, calculation_ms=0.0)

    # --- programs -------------------------------------------------------------------------------

    def close(self, owner: object, *, force: bool = False) -> None:
        """CLOSE (ALL)."""
        if self.rotary.is_open_on(owner) or (force and self.rotary.owner is not None):
            self.rotary.close()
        program = self.programs.open_program
        try:
            self.programs.close(owner, force=force)
        finally:
            if program is not None and program.kind == PLC and not self.programs.open_program:
                self.plcs.reload(program.number)

    def programs_changed(self) -> None:
        """Program buffers were opened or dropped: pointers are void."""
        for system in self.systems.values():
            if system.frames and not system.running:
                system.frames, system.pointer = [], None
        for number in range(32):
            if number not in self.programs.plcs:
                self.plcs.reload(number)

    def variable_written(self, kind: str, number: int) -> None:
        """An on-line assignment was made."""
        if kind == "I" and number == 5:
            self.background_needed()

    def define_user_buffer(self, words: int) -> None:
        """DEFINE UBUFFER: memory at the end of the user area; no other buffer may exist."""
        from pmac_comp.simulator.compensation import lowest_defined

        end = r.USER_BUFFER_END_STANDARD
        if lowest_defined(self.memory) != int(self.memory.x[r.MEMORY_END]):
            raise CardError(3)
        if end - words < int(self.memory.y[r.PROGRAM_END]):
            raise CardError(6)
        self.memory.x[r.MEMORY_END] = end - words

    def free_words(self) -> int:
        """SIZE: unused long words, negative while a buffer is open."""
        free = self.programs.free_words()
        return -free if self.programs.open_program is not None else free

    def set_password(self, text: str) -> None:
        """PASSWORD: unlock with the right one, then a new one may be given (p. 384)."""
        if self.programs.unlocked:
            self.programs.password = text
        elif text == self.programs.password:
            self.programs.unlocked = True
        else:
            raise CardError(2)

    def checksum(self) -> int:
        """CHECKSUM: sum over the fixed buffers."""
        texts = [
            text
            for program in (*self.programs.programs.values(), *self.programs.plcs.values())
            for _, text in program.lines(long=True)
        ]
        return zlib.crc32("\n".join(texts).encode()) & 0xFFFFFF

    # --- power-up, flash ------------------------------------------------------------------------

    def reset(self, *, factory: bool = False) -> None:
        """Power-up (``$$$``), or ``$$$***`` which goes to factory values in memory only."""
        if factory:
            power_up.factory_reset(self)
            self.dpram_ascii.power_up()
            return
        for system in self.systems.values():
            system.axes.clear()
        self.memory.clear()
        self.clock_shift_s = 0.0
        self._queue.clear()
        self.programs.clear_all()
        self.rotary.delete_all()
        self.variables.set_factory_memory()
        power_up.fixed_registers(self)
        for system in self.systems.values():
            system.power_up()
        damaged = power_up.restore(self)
        self.dpram_ascii.power_up()
        if damaged:
            self.memory.x[r.GLOBAL_STATUS] |= r.G1_FLASH_ERROR | r.G1_CHECKSUM

    def save(self) -> None:
        """SAVE: write the flash image; no background task runs meanwhile (p. 394)."""
        self.flash.store(power_up.saved_image(self))
        pause = round(SAVE_TIME_s / self.bench.servo_period_s)
        done = 0
        while done < pause:
            done += self.servo.run(pause - done)
        self._elapsed += pause
        self._next_background = self._elapsed + BACKGROUND_CYCLES


def _is_program_text(text: str) -> bool:
    try:
        for kind in (MOTION, PLC):
            if StatementParser(Scanner(text), kind).statement() is not None:
                return True
    except CardError:
        return False
    return False
