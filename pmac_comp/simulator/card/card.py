"""The simulated Turbo PMAC2: memory, language, programs and servo task put together.

``run_cycles`` is the only way time moves, so commands that arrive at the same servo cycles leave
the same memory, however the cycles were cut into calls.
"""

from __future__ import annotations

import importlib
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from pmac_comp.files.bench import Bench
from pmac_comp.simulator.card import power_up
from pmac_comp.simulator.dialog.answers import Answers
from pmac_comp.simulator.dialog.dpram_ascii import DpramAscii
from pmac_comp.simulator.dialog.dpram_reports import DpramReports
from pmac_comp.simulator.dialog.interpreter import Interpreter
from pmac_comp.simulator.dialog.ports import Port
from pmac_comp.simulator.language.machine import Machine
from pmac_comp.simulator.language.statements import PLC
from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.flash import Flash
from pmac_comp.simulator.memory.memory import (
    Memory,
    read_float48,
    read_long,
    saturated_long,
    write_long,
)
from pmac_comp.simulator.memory.variables import Variables
from pmac_comp.simulator.plant.door import Plant
from pmac_comp.simulator.programs.coordinate_system import CoordinateSystem
from pmac_comp.simulator.programs.plcs import Plcs
from pmac_comp.simulator.programs.programs import Program, ProgramStore
from pmac_comp.simulator.programs.rotary import RotaryBuffers
from pmac_comp.simulator.servo import kernel_servo as ks
from pmac_comp.simulator.servo import trajectory as traj
from pmac_comp.simulator.servo.commanded_faults import LinkFaults
from pmac_comp.simulator.servo.ring_hold import RingHold
from pmac_comp.simulator.servo.servo import Servo, ServoEvent

# Commands register themselves when their modules are imported.
for _name in ("buffers", "coordinate", "faults", "identity", "memory", "motor", "variables"):
    importlib.import_module(f"pmac_comp.simulator.commands.{_name}")

_FIRST_READING_CYCLES = 4  # after which the positions are those of encoder and scale
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
        self.resets = 0
        self.saves_aside = False  # the time of a SAVE passes with the rest, as whoever serves it
        self.saves = 0
        self._saved_at = 0
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
        self.interpreter = Interpreter(self)
        self.programs = ProgramStore(self.memory)
        self.plcs = Plcs(self)
        self.rotary = RotaryBuffers(self)
        self.reports = DpramReports(self)
        self.dpram_ascii = DpramAscii(self)
        self.systems = {n: CoordinateSystem(self, n) for n in range(1, r.COORDINATE_SYSTEMS + 1)}
        self.flash = Flash(flash)
        self.clock_shift_s = 0.0  # of TIME and TODAY against the time of the card
        self.ip_address = bytes((192, 6, 94, 5))
        self._elapsed = 0
        self._next_background = ks.BACKGROUND_CYCLES
        self._keep_background = False
        if servo_source is not None:
            self._load_servo(servo_source)
        self.reset()
        if self.servo.start_m != 0.0:
            self.servo.run(_FIRST_READING_CYCLES)
            self.servo.show_start()

    def _load_servo(self, source: str) -> None:
        from pmac_comp.simulator.servo.open_servo import translate_open_servo

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
            waiting = [s for s in self.systems.values() if s.running and s.at_interrupt]
            to_interrupt = self._cycles_to_interrupt() if waiting else left
            chunk = min(chunk, to_interrupt)
            done = self.servo.run(min(chunk, self.reports.cycles_to_next()))
            self._elapsed += done
            left -= done
            self.reports.passed(done)
            if done == to_interrupt:
                for system in waiting:
                    if system.at_interrupt:
                        system.tick()
            if self._elapsed >= self._next_background:
                self._background()
                late = self._elapsed - self._next_background
                if late >= 0:  # no command in it was SAVE
                    self._next_background += ks.BACKGROUND_CYCLES * (
                        late // ks.BACKGROUND_CYCLES + 1
                    )
        self.refresh_status()

    def _cycles_to_interrupt(self) -> int:
        """Servo cycles until the next real-time interrupt is over."""
        memory = self.memory
        left = int(memory.y[r.SERVO_COUNTER]) - int(memory.x[r.SERVO_COUNTER]) & 0xFFFFFF
        return max(1, min(left, int(memory.y[r.RTI_PERIOD]) + 1))

    def _has_background(self) -> bool:
        return (
            not self.interpreter.is_idle
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
        self.interpreter.background()
        for system in self.systems.values():
            if system.running:
                if not system.at_interrupt:
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
                # A fault may have killed motors of other systems, too (Ixx24).
                hit = event.motor in system.axes or any(map(self.servo.is_killed, system.motors))
                if system.running and hit:
                    self._stop_program(system)

    def _stop_program(self, system: CoordinateSystem) -> None:
        system.stop_now()
        for motor in system.motors:
            if not self.servo.is_open_loop(motor):
                self.servo.abort_motion(motor)

    # --- coordinate systems ---------------------------------------------------------------------

    def motors_of(self, cs: int) -> list[int]:
        """Motors assigned to a coordinate system."""
        return self.systems[cs].motors

    def program_moves(self, motor: int) -> bool:
        """Whether the motor's coordinate system runs a program that is not in feed hold."""
        return any(s.running and not s.holding and motor in s.axes for s in self.systems.values())

    def leave_hold_point(self, motor: int) -> None:
        """A motor is about to be moved: in feed hold its trajectory is kept for the program.

        Without a program what was left of a jog is dropped, it goes on from where it stands; one
        that was commanded in the hold moves, and goes on with its velocity.
        """
        system = self.systems[self.servo.coordinate_system(motor)]
        if not system.holding:
            return
        if system.running and motor in system.axes:
            system.hold_point.leave(motor)
        elif self.is_held(motor) and self.servo.is_moving(motor):
            queue = self.servo.queue
            if not queue.ignores_time_base(motor):
                queue.place(motor, queue.state(motor)[0])

    def is_held(self, motor: int) -> bool:
        """Whether the motor's coordinate system is in feed hold and its time base has run out."""
        system = self.systems[self.servo.coordinate_system(motor)]
        return system.holding and int(self.memory.x[system.base + r.C_TIMEBASE]) == 0

    def any_program_runs(self) -> bool:
        """Whether any motion program runs."""
        return any(s.running for s in self.systems.values())

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

    def _restart(self, system: CoordinateSystem) -> None:
        # Nobody waits for an answer any more.
        with suppress(CardError):
            system.try_restart()

    def wake(self, cs: int) -> None:
        """A rotary line arrived."""
        if self.systems[cs].running:
            self.background_needed()

    def find_program(self, cs: int, number: int) -> Program | None:
        """Program that ``B{number}`` points to."""
        return self.rotary.program(cs) if number == 0 else self.programs.programs.get(number)

    # --- motors ---------------------------------------------------------------------------------

    def bias(self, motor: int) -> float:
        """Position bias of a motor in counts."""
        cell = r.motor_base(motor) + r.M_BIAS
        units = int(read_long(self.memory.x, self.memory.y, cell))
        return units / self.servo.unit(motor) if units else 0.0

    def add_bias(self, motor: int, counts: float) -> None:
        """Change the position bias of a motor."""
        cell = r.motor_base(motor) + r.M_BIAS
        units = saturated_long((self.bias(motor) + counts) * self.servo.unit(motor))
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

    # --- power-up, flash ------------------------------------------------------------------------

    def reset(self, *, factory: bool = False) -> None:
        """Power-up (``$$$``), or ``$$$***`` which goes to factory values in memory only."""
        self.resets += 1
        if self.is_saving:
            self._saved_at = self._elapsed
            self._next_background = self._elapsed + ks.BACKGROUND_CYCLES
        if factory:
            power_up.factory_reset(self)
            self.dpram_ascii.power_up()
            return
        for system in self.systems.values():
            system.axes.clear()
        self.memory.clear()
        self.clock_shift_s = -self.time_s  # there is no clock option (p. 397)
        self.interpreter.reset()
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
        """SAVE: write the flash image; no background task runs meanwhile (p. 394).

        The time it takes passes here, unless a server lets it pass and acknowledges afterwards.
        """
        self.flash.store(power_up.saved_image(self))
        pause = round(SAVE_TIME_s / self.bench.servo_period_s)
        self.saves += 1
        self._saved_at = self._elapsed + pause
        self._next_background = self._saved_at + ks.BACKGROUND_CYCLES
        if self.saves_aside:
            return
        done = 0
        while done < pause:
            done += self.servo.run(pause - done)
        self._elapsed += pause

    @property
    def is_saving(self) -> bool:
        """Whether a SAVE goes on, which is to be acknowledged when it is over."""
        return self._elapsed < self._saved_at
