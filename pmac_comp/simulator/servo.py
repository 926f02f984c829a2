"""The servo side of the simulated card: motors, trajectories, tables, gathering, plant.

What lives here: ``Servo``, which owns the arrays of the compiled servo task, runs it, answers its
events and carries out the motor commands. What may not: the command language, programs, sessions.

For the language side::

    servo = Servo(variables, bench)          # plant=None makes the bench's own drive
    servo.boot()                             # after memory was restored
    servo.on_event = handler                 # ServoEvent: faults, started segments, PLC 0 events
    servo.run(10)                            # ten servo cycles
    servo.jog_to(1, 5000.0)                  # J=5000 of motor 1
    servo.queue.push(1, segments)            # programmed moves
    servo.tables / servo.gathering           # DEFINE COMP ..., GATHER ...
    servo.set_plc0(compiled, context)        # PLC 0 at the real-time interrupt

Source: Turbo PMAC Software Reference Manual p. 95-108, 284-286, 326-340, 377; User Manual p. 319.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.base.units import MM_PER_M, MS_PER_S, UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.simulator import compensation, encoder, gather, vm
from pmac_comp.simulator import kernel_servo as ks
from pmac_comp.simulator import registers as reg
from pmac_comp.simulator import trajectory as traj
from pmac_comp.simulator.language.expressions import Compiled
from pmac_comp.simulator.machine import Context
from pmac_comp.simulator.memory import read_float48, read_long, read_word_signed, write_long
from pmac_comp.simulator.plant import kernel_ballscrew as pk
from pmac_comp.simulator.plant.ballscrew import BallscrewPlant, make_plant
from pmac_comp.simulator.plant.door import Plant
from pmac_comp.simulator.variables import Variables

# Switches of the simulated bench relative to its travel.
_END_SWITCH_m = 5e-3
_HOME_SWITCH_m = 10e-3
_FORCE_CYCLES = 4  # a force schedule is renewed this often
_KILL_BITS = (1 << 21) | (1 << 22)
_FAULTS2: Final = reg.S2_FATAL_ERROR | reg.S2_INTEGRATED_ERROR | reg.S2_I2T | reg.S2_AMPLIFIER_FAULT
_FAULT_EVENTS = {ks.EV_FATAL, ks.EV_INTEGRATED, ks.EV_OVERCURRENT}


@dataclass(frozen=True)
class ServoEvent:
    """Something the servo task wants the rest of the card to know.

    Parameters
    ----------
    kind : int
        ``EV_...`` of ``kernel_servo``: ``EV_FATAL`` and its like (the motor is already killed),
        ``EV_LIMIT`` and ``EV_HARD_LIMIT`` (the motor is already decelerating), ``EV_SEGMENT`` (a
        segment with a tag has started: ``value`` is the tag), ``EV_LOW_QUEUE``, ``EV_PLC``.
    motor : int
        Motor, 0 if none.
    value : int
        As the kind says.
    """

    kind: int
    motor: int
    value: int


class Servo:
    """Compiled servo task with its plant, and the motor commands.

    Parameters
    ----------
    variables : Variables
        Variables over the memory of the card.
    bench : Bench
        Sensors, motor numbers, torque scale, travel.
    plant : Plant or None
        The drive behind the card; None makes the bench's own.
    """

    def __init__(self, variables: Variables, bench: Bench, plant: Plant | None = None) -> None:
        self.variables = variables
        self.memory = variables.memory
        self.bench = bench
        self.plant: Plant = make_plant(bench) if plant is None else plant
        self.queue = traj.MotionQueue()
        self.tables = compensation.CompensationTables(self.memory)
        self.gathering = gather.GatherBuffer(self.memory)
        self.on_event: Callable[[ServoEvent], None] | None = None
        self._after_trigger: dict[int, float] = {}
        self._force: tuple[FloatArray, FloatArray] | None = None
        self._allocate()
        self._start_plant()

    def _allocate(self) -> None:
        self._head: IntArray = np.zeros(ks.N_HEAD, dtype=np.int64)
        self._head[ks.H_DIRTY] = -1
        self._decoded: FloatArray = np.zeros((33, ks.N_DECODED))
        self._addresses: IntArray = np.zeros((33, ks.N_ADDRESSES), dtype=np.int64)
        self._active: IntArray = np.zeros((2, 33), dtype=np.int64)
        self._mmem: FloatArray = np.zeros((33, ks.N_MOTOR_MEMORY))
        self._entries, self._ectmem = encoder.new_table()
        self._tables = compensation.empty_tables()
        self._plan = gather.new_plan()
        self._history: IntArray = np.zeros((33, 16), dtype=np.int64)
        self._events: IntArray = np.zeros((ks.MAX_EVENTS, 3), dtype=np.int64)
        self._world = self._new_world()
        self._no_code: IntArray = np.zeros(1, dtype=np.int64)
        self._no_consts: FloatArray = np.zeros(1)
        self._plc: tuple[IntArray, FloatArray, Context] = (
            self._no_code,
            self._no_consts,
            Context(),
        )
        self._servo: tuple[IntArray, FloatArray, Context] = (
            self._no_code,
            self._no_consts,
            Context(),
        )
        # A result register of the open servo must not be that of PLC 0.
        self._regs: FloatArray = np.zeros(vm.N_REGS)
        # Arrays of a compiled plant that is not there.
        self._no_state: FloatArray = np.zeros(pk.N_STATES)
        self._no_par: FloatArray = np.zeros(pk.N_PARAMETERS)
        self._no_log: FloatArray = pk.empty_log()

    def _new_world(self) -> FloatArray:
        bench = self.bench
        world = np.zeros(ks.N_WORLD)
        travel = bench.travel
        motor = bench.encoder.motor_number
        values = {
            ks.W_COUNTS_PER_RAD: bench.encoder.counts_per_rev / (2.0 * math.pi),
            ks.W_ENCODER_MOTOR: motor,
            ks.W_ENCODER_CHANNEL: _channel(motor),
            ks.W_TORQUE_PER_DAC: bench.drive.torque_per_dac_Nm,
            ks.W_PLIM: travel.max_mm / MM_PER_M + _END_SWITCH_m,
            ks.W_MLIM: travel.min_mm / MM_PER_M - _END_SWITCH_m,
            ks.W_HOME: travel.min_mm / MM_PER_M + _HOME_SWITCH_m,
            ks.W_ENCODER_SIGN: 1.0,
            ks.W_COUNTS_PER_REV: bench.encoder.counts_per_rev,
            ks.W_CYCLE_MS: bench.servo_period_s * MS_PER_S,
        }
        if bench.scale is not None:
            values[ks.W_SCALE_MOTOR] = bench.scale.motor_number
            values[ks.W_SCALE_CHANNEL] = _channel(bench.scale.motor_number)
            values[ks.W_COUNTS_PER_M] = UM_PER_M / bench.scale.resolution_um
        for index, value in values.items():
            world[index] = value
        return world

    def _start_plant(self) -> None:
        self.plant.reset(0.0)
        reading = getattr(self.plant, "reading", None)
        angle, table = reading() if reading is not None else (0.0, 0.0)
        self._world[ks.W_ANGLE] = angle
        self._world[ks.W_TABLE] = table
        self._world[ks.W_KIND] = 1.0 if isinstance(self.plant, BallscrewPlant) else 0.0

    # --- time -----------------------------------------------------------------------------------

    def boot(self) -> None:
        """Power-up: every motor killed at its present place, nothing moves, positions zero."""
        memory = self.memory
        self._head[:] = 0
        self._head[ks.H_DIRTY] = memory.dirty[0] - 1
        self._mmem[:] = 0.0
        self._ectmem[:] = 0.0
        self._active[:] = 0
        for motor in range(1, reg.MOTORS + 1):
            base = reg.motor_base(motor)
            memory.x[base + reg.M_STATUS1] |= reg.S1_OPEN_LOOP
            memory.x[base + reg.M_STATUS1] &= ~reg.S1_AMPLIFIER_ENABLED & 0xFFFFFF
            self.queue.place(motor, 0.0)
        # Positions start at zero on the first result of the conversion table.
        memory.x[reg.SERVO_COUNTER] = 0
        memory.y[reg.SERVO_COUNTER] = 1
        for cs in range(1, reg.COORDINATE_SYSTEMS + 1):
            base = reg.cs_base(cs)
            i10 = int(memory.x[reg.I10_REGISTER])
            memory.x[base + reg.C_TIMEBASE_COMMAND] = i10
            memory.x[base + reg.C_TIMEBASE] = i10
            memory.y[base + reg.C_TIMEBASE_SOURCE] = 0
        self.tables.reloaded()
        memory.touch()

    @property
    def cycles(self) -> int:
        """Servo cycles since boot."""
        return int(self._head[ks.H_CYCLES])

    @property
    def cycle_ms(self) -> float:
        """Servo period by I10, in ms."""
        return int(self.memory.x[reg.I10_REGISTER]) / 8388608.0

    def run(self, n_cycles: int) -> int:
        """Run servo cycles; answers the events of the servo task on the way."""
        done = 0
        while done < n_cycles:
            chunk = n_cycles - done
            if self._force is not None:
                chunk = min(chunk, _FORCE_CYCLES)
                self._apply_force()
            done += self._run_kernel(chunk)
            if self._world[ks.W_KIND] == 0.0:
                angle, table = self.plant.step(float(self._world[ks.W_TORQUE]))
                self._world[ks.W_ANGLE] = angle
                self._world[ks.W_TABLE] = table
            if self._head[ks.H_EVENTS]:
                self._answer_events()
        return done

    def _run_kernel(self, n_cycles: int) -> int:
        memory, queue = self.memory, self.queue
        state, par, log = self._no_state, self._no_par, self._no_log
        if isinstance(self.plant, BallscrewPlant):
            state, par, log = self.plant.state, self.plant.par, self.plant.log
        plc_code, plc_consts, plc = self._plc
        srv_code, srv_consts, srv = self._servo
        return int(
            ks.servo_cycles(
                memory.x,
                memory.y,
                memory.dirty,
                self._head,
                self._decoded,
                self._addresses,
                self._active,
                self._mmem,
                queue.segments,
                queue.cursor,
                queue.index,
                self._entries,
                self._ectmem,
                self._tables,
                self._plan,
                self._history,
                self._world,
                state,
                par,
                log,
                self._events,
                self.variables.imap,
                self.variables.iscale,
                plc_code,
                plc_consts,
                plc.stack,
                plc.state,
                plc.events,
                srv_code,
                srv_consts,
                srv.stack,
                srv.state,
                srv.events,
                self._regs,
                n_cycles,
            )
        )

    def set_plc0(self, program: Compiled | None, context: Context | None = None) -> None:
        """Code of PLC 0 (its enable bits stay in Y:$3100); its events arrive as ``EV_PLC``."""
        self._head[ks.H_PLC] = 0 if program is None else 1
        if program is not None:
            chosen = Context() if context is None else context
            self._plc = (program.code, program.consts, chosen)

    @property
    def plc0(self) -> Context:
        """Context of PLC 0: state and event words."""
        return self._plc[2]

    def set_open_servo(self, program: Compiled | None) -> None:
        """Code of the open servo, None removes it."""
        self._head[ks.H_SERVO] = 0 if program is None else 1
        if program is not None:
            self._servo = (program.code, program.consts, Context())

    def set_external_force(self, force_N: float) -> None:
        """Force of the loading screws on the table; positive pushes against positive motion."""
        push = getattr(self.plant, "set_external_force", None)
        if push is not None:
            push(force_N)

    def set_force_schedule(self, time_s: FloatArray, force_N: FloatArray) -> None:
        """Force over simulated time from now, linear between the points, held after the last."""
        start = self.cycles * self.bench.servo_period_s
        self._force = (np.asarray(time_s, dtype=np.float64) + start, np.asarray(force_N))

    def _apply_force(self) -> None:
        if self._force is None:
            return
        now = self.cycles * self.bench.servo_period_s
        self.set_external_force(float(np.interp(now, *self._force)))

    def set_machine_input(self, *, high: bool) -> None:
        """Level of machine input MI2, which starts GATHER TRIGGER."""
        self._world[ks.W_INPUT] = 1.0 if high else 0.0

    # --- events ---------------------------------------------------------------------------------

    def _answer_events(self) -> None:
        count = int(self._head[ks.H_EVENTS])
        found = [ServoEvent(*(int(v) for v in row)) for row in self._events[:count]]
        self._head[ks.H_EVENTS] = 0
        for event in found:
            self._answer(event)
            if self.on_event is not None:
                self.on_event(event)

    def _answer(self, event: ServoEvent) -> None:
        if event.kind in _FAULT_EVENTS:
            self._spread_fault(event.motor)
        elif event.kind == ks.EV_SERVO_FAULT:
            self.kill(event.motor)
        elif event.kind == ks.EV_LIMIT:
            self.abort_motion(event.motor)
        elif event.kind == ks.EV_HARD_LIMIT:
            self._hard_limit(event.motor)
        elif event.kind == ks.EV_TRIGGER:
            self._triggered(event.motor, event.value)

    def _spread_fault(self, motor: int) -> None:
        """Ixx24 bits 21-22: which motors a fault kills besides its own (p. 104)."""
        base = reg.motor_base(motor)
        choice = int(self.memory.y[base + reg.M_IXX25_IXX24]) & _KILL_BITS
        if choice == 0:
            for other in self.active_motors():
                self.kill(other)
        elif choice == 1 << 21:
            for other in self.motors_of(self.coordinate_system(motor)):
                self.kill(other)

    def _hard_limit(self, motor: int) -> None:
        word = int(self.memory.y[reg.motor_base(motor) + reg.M_IXX25_IXX24])
        if word & 0x100:
            self.kill(motor)
        else:
            for other in self.motors_of(self.coordinate_system(motor)) or [motor]:
                self.abort_motion(other)

    def _triggered(self, motor: int, captured: int) -> None:
        base = reg.motor_base(motor)
        memory = self.memory
        unit = self.unit(motor)
        memory.y[base + reg.M_TRIGGER_CAPTURE] = round(captured / unit) & 0xFFFFFF
        if int(memory.x[base + reg.M_STATUS1]) & reg.S1_HOME_SEARCH:
            offset = read_word_signed(memory.x, base + reg.M_IXX26_IXX80) / 16.0
            target = captured + offset * unit
            memory.x[base + reg.M_STATUS1] &= ~reg.S1_HOME_SEARCH & 0xFFFFFF
            memory.y[base + reg.M_STATUS2] |= reg.S2_HOME_COMPLETE
            memory.y[base + reg.M_HOME_CAPTURE] = round(captured / unit) & 0xFFFFFF
            self.shift_zero(motor, round(target))
            self._plan_jog(motor, 0.0)
            return
        distance = float(self._after_trigger.get(motor, 0.0))
        memory.y[base + reg.M_STATUS2] &= ~reg.S2_TRIGGER_MOVE & 0xFFFFFF
        self._plan_jog(motor, captured - self._offset(motor) + distance * unit)

    # --- what is where --------------------------------------------------------------------------

    def active_motors(self) -> list[int]:
        """Motors that Ixx00 activates."""
        return [m for m in range(1, reg.MOTORS + 1) if self.is_active(m)]

    def is_active(self, motor: int) -> bool:
        """True if Ixx00 is 1."""
        return bool(self._status1(motor) & reg.S1_ACTIVATED)

    def is_open_loop(self, motor: int) -> bool:
        """True if the loop is open (killed or O command)."""
        return bool(self._status1(motor) & reg.S1_OPEN_LOOP)

    def is_killed(self, motor: int) -> bool:
        """True if the amplifier is disabled."""
        return not self._status1(motor) & reg.S1_AMPLIFIER_ENABLED

    def is_moving(self, motor: int) -> bool:
        """True while trajectory segments are executing or waiting."""
        return self.queue.pending(motor) > 0

    def coordinate_system(self, motor: int) -> int:
        """Coordinate system 1-16 of a motor by its status word."""
        word = int(self.memory.y[reg.motor_base(motor) + reg.M_STATUS2])
        return ((word >> reg.S2_CS_SHIFT) & 15) + 1

    def motors_of(self, cs: int) -> list[int]:
        """Activated motors that are assigned to a coordinate system."""
        return [
            m
            for m in self.active_motors()
            if self.coordinate_system(m) == cs
            and int(self.memory.y[reg.motor_base(m) + reg.M_STATUS2]) & reg.S2_ASSIGNED
        ]

    def unit(self, motor: int) -> float:
        """Position units per count, 32 Ixx08."""
        return 32.0 * max(int(self.memory.y[reg.motor_base(motor) + reg.M_IXX03_IXX08]), 1)

    def commanded(self, motor: int) -> float:
        """Commanded position D:+$08 in counts."""
        return self._long(motor, reg.M_COMMANDED) / self.unit(motor)

    def position(self, motor: int) -> float:
        """What P reports, in counts (p. 382): actual + bias + register - master (offset mode)."""
        total = self._long(motor, reg.M_ACTUAL) + self._long(motor, reg.M_BIAS)
        total += self._long(motor, reg.M_COMPENSATION)
        if self._status1(motor) & reg.S1_FOLLOWING_OFFSET:
            total -= self._long(motor, reg.M_MASTER)
        return total / self.unit(motor)

    def velocity(self, motor: int) -> float:
        """What V reports, in counts per servo interrupt."""
        scale = 32.0 * max(int(self.memory.y[reg.motor_base(motor) + reg.M_IXX65_IXX09]), 1)
        return self._long(motor, reg.M_VELOCITY_FILTERED) / scale

    def following_error(self, motor: int) -> float:
        """What F reports, in counts; 0 when the loop is open."""
        return self._long(motor, reg.M_FOLLOWING_ERROR) / self.unit(motor)

    def in_position(self, motor: int) -> bool:
        """In-position bit of status word 2."""
        word = int(self.memory.y[reg.motor_base(motor) + reg.M_STATUS2])
        return bool(word & reg.S2_IN_POSITION)

    def _status1(self, motor: int) -> int:
        return int(self.memory.x[reg.motor_base(motor) + reg.M_STATUS1])

    def _long(self, motor: int, offset: int) -> int:
        return int(read_long(self.memory.x, self.memory.y, reg.motor_base(motor) + offset))

    def _write(self, motor: int, offset: int, value: float) -> None:
        address = reg.motor_base(motor) + offset
        write_long(self.memory.x, self.memory.y, address, round(value))

    def _offset(self, motor: int) -> int:
        """What is added to the commanded position: master and compensation, in units."""
        register = self._long(motor, reg.M_COMPENSATION)
        sign = int(ks.COMPENSATION_REGISTER_SIGN)
        return self._long(motor, reg.M_MASTER) + sign * register

    def _float(self, motor: int, offset: int) -> float:
        memory = self.memory
        return float(read_float48(memory.x, memory.y, reg.motor_base(motor) + offset))

    def jog_limits(self, motor: int, *, homing: bool = False) -> traj.JogLimits:
        """Ixx19-22 (Ixx23 for homing) and Ixx92 as they are now."""
        base = reg.motor_base(motor)
        memory = self.memory
        return traj.JogLimits(
            acceleration_ct_per_ms2=self._float(motor, reg.M_IXX19),
            time_ms=float(memory.y[base + reg.M_IXX21_IXX20]),
            s_curve_ms=float(memory.x[base + reg.M_IXX21_IXX20]),
            speed_ct_per_ms=self._float(motor, reg.M_IXX23 if homing else reg.M_IXX22),
            calculation_ms=float(memory.y[base + reg.M_IXX92]),
            unit_per_count=self.unit(motor),
            cycle_ms=self.cycle_ms,
        )

    # --- motor commands -------------------------------------------------------------------------

    def close_loop(self, motor: int) -> None:
        """Enable and close the loop at the actual position; fault bits are cleared."""
        if not self.is_active(motor):
            return
        memory = self.memory
        base = reg.motor_base(motor)
        if self._status1(motor) & reg.S1_OPEN_LOOP:
            command = self._long(motor, reg.M_ACTUAL) - self._offset(motor)
            self._write(motor, reg.M_COMMANDED, command)
            self._write(motor, reg.M_PREVIOUS_NET, self._long(motor, reg.M_ACTUAL))
            self.queue.place(motor, float(command))
            self._mmem[motor, :] = 0.0
            self._mmem[motor, ks.K_FILTERED] = self._long(motor, reg.M_ACTUAL)
            self._mmem[motor, ks.K_BACKLASH_EXTREME] = command
            memory.x[base + reg.M_FILTER_RESULT] = 0
        status = self._status1(motor) | reg.S1_AMPLIFIER_ENABLED
        memory.x[base + reg.M_STATUS1] = status & ~reg.S1_OPEN_LOOP & 0xFFFFFF
        memory.y[base + reg.M_STATUS2] &= ~_FAULTS2 & 0xFFFFFF

    def kill(self, motor: int) -> None:
        """K: loop open, output zero, amplifier disabled."""
        memory = self.memory
        base = reg.motor_base(motor)
        gone = reg.S1_AMPLIFIER_ENABLED | reg.S1_HOME_SEARCH
        memory.x[base + reg.M_STATUS1] = (
            (self._status1(motor) | reg.S1_OPEN_LOOP) & ~gone & 0xFFFFFF
        )
        memory.x[base + reg.M_FILTER_RESULT] = 0
        self._mmem[motor, ks.K_ARMED] = 0.0
        self.queue.clear(motor)

    def open_loop(self, motor: int, percent: float) -> bool:
        """O{c}: enabled open loop with a share of Ixx69; False if refused beyond a limit."""
        if self._beyond_limit(motor):
            return False
        memory = self.memory
        base = reg.motor_base(motor)
        self.queue.clear(motor)
        limit = int(memory.y[base + reg.M_IXX69]) / 256.0
        share = min(max(percent, -100.0), 100.0) / 100.0
        memory.x[base + reg.M_FILTER_RESULT] = int(share * limit * 256.0) & 0xFFFFFF
        memory.x[base + reg.M_STATUS1] = (
            self._status1(motor) | reg.S1_OPEN_LOOP | reg.S1_AMPLIFIER_ENABLED
        )
        memory.y[base + reg.M_STATUS2] &= ~_FAULTS2 & 0xFFFFFF
        return True

    def jog_continuous(self, motor: int, direction: int) -> None:
        """J+ or J-."""
        if not self._ready_to_move(motor, direction):
            return
        position, velocity = self.queue.state(motor)
        limits = self.jog_limits(motor)
        self.queue.replace(
            motor, traj.jog_continuous(position, velocity, limits, 1 if direction > 0 else -1)
        )

    def jog_stop(self, motor: int) -> None:
        """J/: stop, or close the loop."""
        if self.is_open_loop(motor) or self.is_killed(motor):
            self.close_loop(motor)
            return
        self._disarm(motor)
        position, velocity = self.queue.state(motor)
        self.queue.replace(motor, traj.stop(position, velocity, self.jog_limits(motor)))

    def jog_to(self, motor: int, counts: float, *, until_trigger: float | None = None) -> None:
        """J={c}, or J={c}^{d} with ``until_trigger`` = d counts from the trigger."""
        self._jog_units(motor, counts * self.unit(motor), until_trigger)

    def jog_relative_actual(
        self, motor: int, counts: float, *, until_trigger: float | None = None
    ) -> None:
        """J^{c}: from the present actual position."""
        if self.is_open_loop(motor):
            self.close_loop(motor)
        start = self._long(motor, reg.M_ACTUAL) - self._offset(motor)
        self._jog_units(motor, start + counts * self.unit(motor), until_trigger)

    def jog_relative_commanded(
        self, motor: int, counts: float, *, until_trigger: float | None = None
    ) -> None:
        """J:{c}: from the present commanded position."""
        if self.is_open_loop(motor):
            self.close_loop(motor)
        start = self.queue.state(motor)[0]
        self._jog_units(motor, start + counts * self.unit(motor), until_trigger)

    def jog_prejog(self, motor: int, *, until_trigger: float | None = None) -> None:
        """J=: back to the target register D:+$47."""
        self._jog_units(motor, float(self._long(motor, reg.M_TARGET)), until_trigger)

    def set_prejog(self, motor: int, counts: float) -> None:
        """Target register D:+$47, as J== and programmed moves set it."""
        self._write(motor, reg.M_TARGET, counts * self.unit(motor))

    def _jog_units(self, motor: int, target: float, until_trigger: float | None) -> None:
        direction = 1 if target >= self.queue.state(motor)[0] else -1
        if not self._ready_to_move(motor, direction):
            return
        self._plan_jog(motor, float(round(target)))
        if until_trigger is not None:
            self._after_trigger[motor] = until_trigger
            base = reg.motor_base(motor)
            self.memory.y[base + reg.M_STATUS2] |= reg.S2_TRIGGER_MOVE
            self._arm(motor)

    def _plan_jog(self, motor: int, target: float) -> None:
        position, velocity = self.queue.state(motor)
        limits = self.jog_limits(motor)
        self.queue.replace(motor, traj.jog_to(position, velocity, limits, target))
        self._write(motor, reg.M_TARGET_VELOCITY, 0)

    def home(self, motor: int) -> None:
        """HM: homing search at Ixx23 until the trigger."""
        speed = self._float(motor, reg.M_IXX23)
        if not self._ready_to_move(motor, 1 if speed >= 0 else -1):
            return
        base = reg.motor_base(motor)
        self.memory.x[base + reg.M_STATUS1] |= reg.S1_HOME_SEARCH
        self.memory.y[base + reg.M_STATUS2] &= ~reg.S2_HOME_COMPLETE & 0xFFFFFF
        position, velocity = self.queue.state(motor)
        limits = self.jog_limits(motor, homing=True)
        segments = traj.jog_continuous(
            position, velocity, limits, 1 if speed >= 0 else -1, flags=traj.HOMING
        )
        self.queue.replace(motor, segments)
        self._arm(motor)

    def home_zero(self, motor: int) -> None:
        """HMZ: the present commanded position becomes zero."""
        base = reg.motor_base(motor)
        self.shift_zero(motor, round(self.queue.state(motor)[0]))
        self.memory.y[base + reg.M_STATUS2] |= reg.S2_HOMEZ

    def round_commanded(self, motor: int) -> None:
        """J!: whole counts, if the desired velocity is zero."""
        position, velocity = self.queue.state(motor)
        if velocity == 0.0 and not self.is_open_loop(motor):
            unit = self.unit(motor)
            self.queue.place(motor, round(position / unit) * unit)

    def read_absolute(self, motor: int) -> None:
        """$*: kill, forget home and bias, actual position becomes zero."""
        self.kill(motor)
        base = reg.motor_base(motor)
        self.memory.y[base + reg.M_STATUS2] &= ~reg.S2_HOME_COMPLETE & 0xFFFFFF
        self._write(motor, reg.M_BIAS, 0)
        self.shift_zero(motor, self._long(motor, reg.M_ACTUAL))

    def abort(self, motor: int) -> None:
        """A: decelerate by Ixx15; open loops close, killed ones only if I36 = 0 (p. 54, 292)."""
        if self.is_killed(motor):
            if not int(self.memory.x[reg.INTERNAL_GLOBAL + 36]) & 1:
                self.close_loop(motor)
        elif self.is_open_loop(motor):
            self.close_loop(motor)
        else:
            self.abort_motion(motor)

    def abort_motion(self, motor: int) -> None:
        """Deceleration by Ixx15 of a closed loop; at 0 % time base it stops at once."""
        self._disarm(motor)
        position, velocity = self.queue.state(motor)
        base = reg.cs_base(self.coordinate_system(motor))
        if int(self.memory.x[base + reg.C_TIMEBASE]) == 0:
            self.queue.place(motor, position)
            return
        rate = self._float(motor, reg.M_IXX15)
        segments = traj.abort(position, velocity, rate, self.unit(motor), self.cycle_ms)
        self.queue.replace(motor, segments)

    def shift_zero(self, motor: int, units: int) -> None:
        """Move the zero of a motor to what is now ``units`` (1/(32 Ixx08) count)."""
        for offset in (reg.M_COMMANDED, reg.M_ACTUAL, reg.M_PREVIOUS_NET, reg.M_TARGET):
            self._write(motor, offset, self._long(motor, offset) - units)
        self.queue.shift(motor, -float(units))
        self._history[motor, :] -= units
        self._mmem[motor, ks.K_FILTERED] -= units
        self._mmem[motor, ks.K_BACKLASH_EXTREME] -= units

    def _arm(self, motor: int) -> None:
        world = self._world
        count = world[ks.W_ANGLE] * world[ks.W_COUNTS_PER_RAD] * world[ks.W_ENCODER_SIGN]
        self._mmem[motor, ks.K_COUNT] = count
        self._mmem[motor, ks.K_ARMED] = 1.0

    def _disarm(self, motor: int) -> None:
        self._mmem[motor, ks.K_ARMED] = 0.0
        base = reg.motor_base(motor)
        self.memory.x[base + reg.M_STATUS1] &= ~reg.S1_HOME_SEARCH & 0xFFFFFF

    def _ready_to_move(self, motor: int, direction: int) -> bool:
        """Close the loop if it is open; False if the move would go further beyond a limit."""
        if not self.is_active(motor):
            return False
        if self.is_open_loop(motor) or self.is_killed(motor):
            self.close_loop(motor)
        if self._beyond_limit(motor) * direction > 0:
            return False
        self._disarm(motor)
        base = reg.motor_base(motor)
        self.memory.y[base + reg.M_STATUS2] &= ~reg.S2_LIMIT_STOP & 0xFFFFFF
        return True

    def _beyond_limit(self, motor: int) -> int:
        """+1 or -1 if the actual position is beyond a software limit."""
        actual = self._long(motor, reg.M_ACTUAL) / self.unit(motor)
        high = self._long(motor, reg.M_IXX13)
        low = self._long(motor, reg.M_IXX14)
        if high and actual > high:
            return 1
        return -1 if low and actual < low else 0


def _channel(motor: int) -> int:
    """Address of the encoder channel of motors 1-8 (servo ICs 0 and 1), 0 beyond."""
    return reg.channel_base(motor) if motor <= 8 else 0
