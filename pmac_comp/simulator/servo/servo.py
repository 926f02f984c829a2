"""The servo side of the simulated card: motors, trajectories, tables, gathering, plant.

What lives here: ``Servo``, which owns the arrays of the compiled servo task, runs it, answers its
events and carries out the motor commands. What may not: the command language, programs, sessions.

For the language side::

    servo = Servo(variables, bench)          # plant=None makes the bench's own drive
    servo.boot()                             # after memory was restored
    servo.on_event = handler                 # ServoEvent: faults, started segments, PLC 0 events
    servo.run(10)                            # ten servo cycles
    servo.jog_to(1, "=", 5000.0)             # J=5000 of motor 1
    servo.queue.push(1, segments)            # programmed moves
    servo.tables / servo.gathering           # DEFINE COMP ..., GATHER ...
    servo.set_plc0(compiled, context)        # PLC 0 at the real-time interrupt

Source: Turbo PMAC Software Reference Manual p. 95-108, 284-286, 326-340, 377; User Manual p. 319.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.base.units import MM_PER_M, MS_PER_S, UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.simulator.language.expressions import Compiled
from pmac_comp.simulator.language.machine import Context
from pmac_comp.simulator.memory import registers as reg
from pmac_comp.simulator.memory import vm
from pmac_comp.simulator.memory.variables import Variables
from pmac_comp.simulator.plant import kernel_ballscrew as pk
from pmac_comp.simulator.plant.ballscrew import BallscrewPlant, make_plant
from pmac_comp.simulator.plant.door import Plant
from pmac_comp.simulator.servo import compensation, conversion, gather, sensors
from pmac_comp.simulator.servo import kernel_servo as ks
from pmac_comp.simulator.servo.servo_motors import Motors

# Switches of the simulated bench relative to its travel.
_END_SWITCH_m = 5e-3
_HOME_SWITCH_m = 10e-3
_FORCE_CYCLES = 4  # a force schedule is renewed this often
_KILL_BITS = (1 << 21) | (1 << 22)
_FAULT_EVENTS = {ks.EV_FATAL, ks.EV_INTEGRATED, ks.EV_OVERCURRENT}


@dataclass(frozen=True)
class ServoEvent:
    """Something the servo task wants the rest of the card to know.

    Parameters
    ----------
    kind : int
        ``EV_...`` of ``kernel_servo``: ``EV_FATAL`` and its like (the motor is already killed),
        ``EV_LIMIT`` and its like (the motor is already decelerating), ``EV_SEGMENT`` (a
        segment with a tag has started: ``value`` is the tag), ``EV_LOW_QUEUE``, ``EV_PLC``.
    motor : int
        Motor, 0 if none.
    value : int
        As the kind says.
    """

    kind: int
    motor: int
    value: int


class Servo(Motors):
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
        super().__init__(variables.memory)
        self.variables = variables
        self.bench = bench
        self.plant: Plant = make_plant(bench) if plant is None else plant
        self.tables = compensation.CompensationTables(self.memory)
        self.gathering = gather.GatherBuffer(self.memory)
        self.on_event: Callable[[ServoEvent], None] | None = None
        self._force: tuple[FloatArray, FloatArray] | None = None
        self._ran = 0  # servo cycles since the card was made, resets included
        self._allocate()
        self._start_plant()

    def _allocate(self) -> None:
        self._head: IntArray = np.zeros(ks.N_HEAD, dtype=np.int64)
        self._head[ks.H_DIRTY] = -1
        self._decoded: FloatArray = np.zeros((33, ks.N_DECODED))
        self._addresses: IntArray = np.zeros((33, ks.N_ADDRESSES), dtype=np.int64)
        self._active: IntArray = np.zeros((2, 33), dtype=np.int64)
        self._entries, self._ectmem = conversion.new_table()
        self._tables = compensation.empty_tables()
        self._plan = gather.new_plan()
        self._events: IntArray = np.zeros((ks.MAX_EVENTS, 3), dtype=np.int64)
        self.world = self._new_world()
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
        self._no_drive = (np.zeros(pk.N_STATES), np.zeros(pk.N_PARAMETERS), pk.empty_log())
        self._card = self._card_arrays()

    def _new_world(self) -> FloatArray:
        bench = self.bench
        world = sensors.new_world()
        travel = bench.travel
        motor = bench.encoder.motor_number
        values = {
            sensors.W_COUNTS_PER_RAD: bench.encoder.counts_per_rev / (2.0 * math.pi),
            sensors.W_ENCODER_MOTOR: motor,
            sensors.W_ENCODER_CHANNEL: _channel(motor),
            sensors.W_TORQUE_PER_DAC: bench.drive.torque_per_dac_Nm,
            sensors.W_PLIM: travel.max_mm / MM_PER_M + _END_SWITCH_m,
            sensors.W_MLIM: travel.min_mm / MM_PER_M - _END_SWITCH_m,
            sensors.W_HOME: travel.min_mm / MM_PER_M + _HOME_SWITCH_m,
            sensors.W_ENCODER_SIGN: 1.0,
            sensors.W_COUNTS_PER_REV: bench.encoder.counts_per_rev,
            sensors.W_CYCLE_MS: bench.servo_period_s * MS_PER_S,
        }
        if bench.scale is not None:
            values[sensors.W_SCALE_MOTOR] = bench.scale.motor_number
            values[sensors.W_SCALE_CHANNEL] = _channel(bench.scale.motor_number)
            values[sensors.W_COUNTS_PER_M] = UM_PER_M / bench.scale.resolution_um
        for index, value in values.items():
            world[index] = value
        return world

    def _start_plant(self) -> None:
        self.plant.reset(self.start_m)
        reading = getattr(self.plant, "reading", None)
        angle, table = reading() if reading is not None else (0.0, 0.0)
        self.world[sensors.W_ANGLE] = angle
        self.world[sensors.W_TABLE] = table
        self.world[sensors.W_KIND] = 1.0 if isinstance(self.plant, BallscrewPlant) else 0.0

    @property
    def start_m(self) -> float:
        """Where the table stands at first, in m: zero, or mid travel if zero lies outside of it."""
        travel = self.bench.travel
        return 0.0 if travel.min_mm <= 0.0 <= travel.max_mm else self.bench.mid_travel_m

    def show_start(self) -> None:
        """Encoder and scale read the table's place as after a home search, once they were read."""
        bench = self.bench
        per_m = {bench.encoder.motor_number: 1.0 / bench.motor_resolution_m}
        if bench.scale is not None:
            per_m[bench.scale.motor_number] = UM_PER_M / bench.scale.resolution_um
        for motor, counts_per_m in per_m.items():
            self.shift_zero(motor, -round(self.start_m * counts_per_m * self.unit(motor)))

    # --- time -----------------------------------------------------------------------------------

    def boot(self) -> None:
        """Power-up: every motor killed at its present place, nothing moves, positions zero."""
        memory = self.memory
        servo_present = self._head[ks.H_SERVO]  # in program memory, which a reset does not touch
        self._head[:] = 0
        self._head[ks.H_SERVO] = servo_present
        self._head[ks.H_DIRTY] = memory.dirty[0] - 1
        self.motor_memory[:] = 0.0
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

    def run(self, n_cycles: int) -> int:
        """Run servo cycles; answers the events of the servo task on the way."""
        done = 0
        while done < n_cycles:
            chunk = n_cycles - done
            if self._force is not None:
                chunk = min(chunk, _FORCE_CYCLES)
                self._apply_force()
            cycles = self._run_kernel(chunk)
            done += cycles
            self._ran += cycles
            if self.world[sensors.W_KIND] == 0.0:
                angle, table = self.plant.step(float(self.world[sensors.W_TORQUE]))
                self.world[sensors.W_ANGLE] = angle
                self.world[sensors.W_TABLE] = table
            if self._head[ks.H_EVENTS]:
                self._answer_events()
        return done

    def _run_kernel(self, n_cycles: int) -> int:
        drive = self._no_drive
        if isinstance(self.plant, BallscrewPlant):
            drive = (self.plant.state, self.plant.par, self.plant.log)
        return int(ks.servo_cycles(self._card, drive, self.world, n_cycles))

    def _card_arrays(self) -> tuple[tuple[Any, ...], ...]:
        memory, queue = self.memory, self.queue
        arrays = ks.CardArrays(
            ks.Words(memory.x, memory.y, memory.dirty),
            ks.Task(self._head, self._events),
            ks.MotorData(
                self._active, self._decoded, self._addresses, self.motor_memory, self.history
            ),
            ks.Paths(queue.segments, queue.cursor, queue.index),
            ks.Tables(self._entries, self._ectmem, self._tables, self._plan),
            ks.IVariables(self.variables.imap, self.variables.iscale),
            self._program(*self._plc, ks.PLC_BUDGET),
            self._program(*self._servo, ks.SERVO_BUDGET),
            ks.Cycle(np.zeros(33), np.zeros(33), np.zeros(33), np.zeros(16)),
        )
        return tuple(tuple(group) for group in arrays)

    def _program(self, code: IntArray, consts: FloatArray, run: Context, budget: int) -> ks.Program:
        return ks.Program(code, consts, run.stack, run.state, run.events, self._regs, budget)

    def set_plc0(self, program: Compiled | None, context: Context | None = None) -> None:
        """Code of PLC 0 (its enable bits stay in Y:$3100); its events arrive as ``EV_PLC``."""
        self._head[ks.H_PLC] = 0 if program is None else 1
        if program is not None:
            chosen = Context() if context is None else context
            self._plc = (program.code, program.consts, chosen)
            self._card = self._card_arrays()

    @property
    def plc0(self) -> Context:
        """Context of PLC 0: state and event words."""
        return self._plc[2]

    def set_open_servo(self, program: Compiled | None) -> None:
        """Code of the open servo, None removes it."""
        self._head[ks.H_SERVO] = 0 if program is None else 1
        if program is not None:
            self._servo = (program.code, program.consts, Context())
            self._card = self._card_arrays()

    def set_external_force(self, force_N: float) -> None:
        """Force of the loading screws on the table; positive pushes against positive motion."""
        push = getattr(self.plant, "set_external_force", None)
        if push is not None:
            push(force_N)

    def set_force_schedule(self, time_s: FloatArray, force_N: FloatArray) -> None:
        """Force over simulated time from now, linear between the points, held after the last."""
        start = self._ran * self.bench.servo_period_s
        self._force = (np.asarray(time_s, dtype=np.float64) + start, np.asarray(force_N))

    def _apply_force(self) -> None:
        if self._force is None:
            return
        now = self._ran * self.bench.servo_period_s
        self.set_external_force(float(np.interp(now, *self._force)))

    def set_machine_input(self, *, high: bool) -> None:
        """Level of machine input MI2, which starts GATHER TRIGGER."""
        self.world[sensors.W_INPUT] = 1.0 if high else 0.0

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
        elif event.kind in (ks.EV_LIMIT, ks.EV_DESIRED_LIMIT):
            # An open loop beyond a limit is closed and stopped (p. 95).
            self.abort(event.motor)
        elif event.kind == ks.EV_HARD_LIMIT:
            self._hard_limit(event.motor)
        elif event.kind == ks.EV_TRIGGER:
            self.triggered(event.motor, event.value)

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

    def amplifier_fault(self, motor: int) -> None:
        """Let the drive of a motor report a fault, for tests of what the host makes of it."""
        base = reg.motor_base(motor)
        if int(self.memory.y[base + reg.M_IXX25_IXX24]) & (1 << 20):
            return  # Ixx24 bit 20: the fault input is ignored
        self.kill(motor)
        self.memory.y[base + reg.M_STATUS2] |= reg.S2_AMPLIFIER_FAULT
        self._spread_fault(motor)
        if self.on_event is not None:
            self.on_event(ServoEvent(ks.EV_OVERCURRENT, motor, 0))

    def _hard_limit(self, motor: int) -> None:
        word = int(self.memory.y[reg.motor_base(motor) + reg.M_IXX25_IXX24])
        if word & 0x100:
            self.kill(motor)
        else:
            for other in self.motors_of(self.coordinate_system(motor)) or [motor]:
                if not self.is_killed(other):
                    self.abort(other)


def _channel(motor: int) -> int:
    """Address of the encoder channel of motors 1-8 (servo ICs 0 and 1), 0 beyond."""
    return reg.channel_base(motor) if motor <= 8 else 0
