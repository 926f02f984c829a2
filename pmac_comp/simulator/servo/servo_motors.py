"""The motors of the simulated card: what they report and the motor commands.

What lives here: enabling, killing, jogging, homing, aborting of single motors, and their positions.
What may not: the servo loop itself, the command language, programs. Commands answer with the error
number of the command line (0 = done).

Source: Turbo PMAC Software Reference Manual p. 95-108, 284-286, 326-340, 377, 382.
"""

from typing import Final

import numpy as np

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.simulator.memory import registers as reg
from pmac_comp.simulator.memory.memory import (
    Memory,
    read_float48,
    read_long,
    read_word_signed,
    saturated_long,
    write_long,
)
from pmac_comp.simulator.servo import encoder, sensors
from pmac_comp.simulator.servo import kernel_servo as ks
from pmac_comp.simulator.servo import trajectory as traj

ERR_REFUSED: Final = 3
_FAULTS2: Final = reg.S2_FATAL_ERROR | reg.S2_INTEGRATED_ERROR | reg.S2_I2T | reg.S2_AMPLIFIER_FAULT


class Motors:
    """Motors 1-32 over the memory of a card.

    Parameters
    ----------
    memory : Memory
        Memory of the card.
    """

    def __init__(self, memory: Memory) -> None:
        self.memory = memory
        self.queue = traj.MotionQueue()
        self.motor_memory: FloatArray = np.zeros((33, ks.N_MOTOR_MEMORY))
        self.history: IntArray = np.zeros((33, 16), dtype=np.int64)
        self.world: FloatArray = sensors.new_world()
        self._after_trigger: dict[int, float] = {}

    @property
    def cycle_ms(self) -> float:
        """Servo period by I10, in ms; never 0, for what is divided by it."""
        return max(int(self.memory.x[reg.I10_REGISTER]), 1) / 8388608.0

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
        """What P reports, in counts (p. 382): actual + bias + register - master (offset mode).

        Backlash that is taken up does not show (p. 148).
        """
        total = self._long(motor, reg.M_ACTUAL) + self._long(motor, reg.M_BIAS)
        total += self.backlash(motor)
        total += self._long(motor, reg.M_COMPENSATION)
        if self._status1(motor) & reg.S1_FOLLOWING_OFFSET:
            total -= self._long(motor, reg.M_MASTER)
        return total / self.unit(motor)

    def backlash(self, motor: int) -> int:
        """Backlash that is taken up now, in units."""
        return int(self.motor_memory[motor, ks.K_BACKLASH])

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
        write_long(self.memory.x, self.memory.y, address, saturated_long(value))

    def _offset(self, motor: int) -> int:
        """What is added to the commanded position: master, compensation, backlash; in units."""
        register = self._long(motor, reg.M_COMPENSATION)
        sign = int(ks.COMPENSATION_REGISTER_SIGN)
        return self._long(motor, reg.M_MASTER) + sign * register - self.backlash(motor)

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

    def enable(self, motor: int) -> int:
        """Enable and close the loop at the actual position; fault bits are cleared."""
        if not self.is_active(motor):
            return 0
        memory = self.memory
        base = reg.motor_base(motor)
        if self._status1(motor) & reg.S1_OPEN_LOOP:
            command = self._long(motor, reg.M_ACTUAL) - self._offset(motor)
            self._write(motor, reg.M_COMMANDED, command)
            self._write(motor, reg.M_PREVIOUS_NET, self._long(motor, reg.M_ACTUAL))
            self.queue.place(motor, float(command))
            backlash = self.motor_memory[motor, ks.K_BACKLASH]
            self.motor_memory[motor, :] = 0.0
            self.motor_memory[motor, ks.K_BACKLASH] = backlash
            self.motor_memory[motor, ks.K_FILTERED] = self._long(motor, reg.M_ACTUAL)
            self.motor_memory[motor, ks.K_BACKLASH_EXTREME] = command
            memory.x[base + reg.M_FILTER_RESULT] = 0
        status = self._status1(motor) | reg.S1_AMPLIFIER_ENABLED
        memory.x[base + reg.M_STATUS1] = status & ~reg.S1_OPEN_LOOP & 0xFFFFFF
        memory.y[base + reg.M_STATUS2] &= ~_FAULTS2 & 0xFFFFFF
        return 0

    def kill(self, motor: int) -> None:
        """K: loop open, output zero, amplifier disabled."""
        memory = self.memory
        base = reg.motor_base(motor)
        gone = reg.S1_AMPLIFIER_ENABLED | reg.S1_HOME_SEARCH
        memory.x[base + reg.M_STATUS1] = (
            (self._status1(motor) | reg.S1_OPEN_LOOP) & ~gone & 0xFFFFFF
        )
        memory.x[base + reg.M_FILTER_RESULT] = 0
        self.motor_memory[motor, ks.K_ARMED] = 0.0
        self.queue.clear(motor)

    def open_loop(self, motor: int, percent: float) -> int:
        """O{c}: enabled open loop with a share of Ixx69; refused beyond a software limit."""
        if self._beyond_limit(motor):
            return ERR_REFUSED
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
        return 0

    def jog(self, motor: int, direction: int) -> int:
        """J+ or J-."""
        if not self._ready_to_move(motor, direction):
            return 0
        position, velocity = self.queue.state(motor)
        limits = self.jog_limits(motor)
        self.queue.replace(
            motor, traj.jog_continuous(position, velocity, limits, 1 if direction > 0 else -1)
        )
        self._show_started(motor, 0)
        return 0

    def jog_stop(self, motor: int) -> int:
        """J/: stop, or close the loop."""
        if self.is_open_loop(motor) or self.is_killed(motor):
            return self.enable(motor)
        self._disarm(motor)
        position, velocity = self.queue.state(motor)
        self.queue.replace(motor, traj.stop(position, velocity, self.jog_limits(motor)))
        return 0

    def jog_to(
        self, motor: int, form: str, counts: float | None, *, trigger_ct: float | None = None
    ) -> int:
        """Jog to a place.

        Parameters
        ----------
        motor : int
            Motor.
        form : str
            ``=`` position, ``==`` position that becomes the pre-jog one, ``^`` from the actual and
            ``:`` from the commanded position.
        counts : float or None
            Position or distance; None with ``=`` goes back to the pre-jog position.
        trigger_ct : float or None
            Jog until trigger: where to end, counts from the trigger.
        """
        if not self.is_active(motor):
            return 0
        if self.is_open_loop(motor):
            self.enable(motor)
        unit = self.unit(motor)
        distance = 0.0 if counts is None else counts * unit
        if form == "^":
            target = self._long(motor, reg.M_ACTUAL) - self._offset(motor) + distance
        elif form == ":":
            target = self.queue.state(motor)[0] + distance
        elif counts is None:
            target = float(self._long(motor, reg.M_TARGET))
        else:
            target = distance
        if form == "==":
            self._write(motor, reg.M_TARGET, target)
        self._jog_units(motor, target, trigger_ct)
        return 0

    def set_prejog(self, motor: int, counts: float) -> None:
        """Target register D:+$47, as J== and programmed moves set it."""
        self._write(motor, reg.M_TARGET, counts * self.unit(motor))

    def _jog_units(self, motor: int, target: float, until_trigger: float | None) -> None:
        direction = 1 if target >= self.queue.state(motor)[0] else -1
        if not self._ready_to_move(motor, direction):
            return
        self._plan_jog(motor, float(saturated_long(target)))
        if until_trigger is not None:
            self._after_trigger[motor] = until_trigger
            base = reg.motor_base(motor)
            self.memory.y[base + reg.M_STATUS2] |= reg.S2_TRIGGER_MOVE
            self._arm(motor)

    def _plan_jog(self, motor: int, target: float) -> None:
        position, velocity = self.queue.state(motor)
        limits = self.jog_limits(motor)
        self.queue.replace(motor, traj.jog_to(position, velocity, limits, target))
        self._show_started(motor, reg.S1_MOVE_TIMER)
        self._write(motor, reg.M_TARGET_VELOCITY, 0)

    def _show_started(self, motor: int, timer: int) -> None:
        """Let a client that asks in the same servo cycle not take the axis for arrived."""
        base = reg.motor_base(motor)
        self.memory.x[base + reg.M_STATUS1] |= timer
        self.memory.y[base + reg.M_STATUS2] &= ~reg.S2_IN_POSITION & 0xFFFFFF

    def home(self, motor: int) -> int:
        """HM: homing search at Ixx23 until the trigger."""
        speed = self._float(motor, reg.M_IXX23)
        if not self._ready_to_move(motor, 1 if speed >= 0 else -1):
            return 0
        base = reg.motor_base(motor)
        self.memory.x[base + reg.M_STATUS1] |= reg.S1_HOME_SEARCH
        self.memory.y[base + reg.M_STATUS2] &= ~reg.S2_HOME_COMPLETE & 0xFFFFFF
        position, velocity = self.queue.state(motor)
        limits = self.jog_limits(motor, homing=True)
        segments = traj.jog_continuous(
            position, velocity, limits, 1 if speed >= 0 else -1, flags=traj.HOMING
        )
        self.queue.replace(motor, segments)
        self._show_started(motor, 0)
        self._arm(motor)
        return 0

    def home_zero(self, motor: int) -> int:
        """HMZ: the present commanded position becomes zero."""
        base = reg.motor_base(motor)
        self._write(motor, reg.M_BIAS, 0)
        self.shift_zero(motor, round(self.queue.state(motor)[0]))
        self.memory.y[base + reg.M_STATUS2] |= reg.S2_HOMEZ
        return 0

    def jog_round(self, motor: int) -> int:
        """J!: whole counts, if the desired velocity is zero."""
        position, velocity = self.queue.state(motor)
        if velocity == 0.0 and not self.is_open_loop(motor):
            unit = self.unit(motor)
            self.queue.place(motor, round(position / unit) * unit)
        return 0

    def reset_position(self, motor: int) -> int:
        """$*: kill, forget home and bias, actual position becomes zero."""
        self.kill(motor)
        base = reg.motor_base(motor)
        gone = reg.S2_HOME_COMPLETE | reg.S2_BACKLASH_DIRECTION
        self.memory.y[base + reg.M_STATUS2] &= ~gone & 0xFFFFFF
        self.memory.y[base + reg.M_IXX86] = 0
        self.motor_memory[motor, ks.K_BACKLASH] = 0.0
        self._write(motor, reg.M_BIAS, 0)
        self.shift_zero(motor, self._long(motor, reg.M_ACTUAL))
        return 0

    def abort(self, motor: int) -> None:
        """A: decelerate by Ixx15; open loops close, killed ones only if I36 = 0 (p. 54, 292)."""
        if self.is_killed(motor):
            if not int(self.memory.x[reg.INTERNAL_GLOBAL + 36]) & 1:
                self.enable(motor)
        elif self.is_open_loop(motor):
            self.enable(motor)
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
        self.history[motor, :] -= units
        self.motor_memory[motor, ks.K_FILTERED] -= units
        self.motor_memory[motor, ks.K_BACKLASH_EXTREME] -= units

    def _arm(self, motor: int) -> None:
        self.motor_memory[motor, ks.K_COUNT] = self.world[sensors.W_COUNT]
        channel = int(self.memory.x[reg.motor_base(motor) + reg.M_IXX25_IXX24]) & 0x7FFFF
        # The captured position is read, which makes ready for the next trigger (p. 223).
        self.memory.x[channel] &= ~encoder.CAPTURED & 0xFFFFFF
        self.motor_memory[motor, ks.K_ARMED] = 1.0

    def _disarm(self, motor: int) -> None:
        self.motor_memory[motor, ks.K_ARMED] = 0.0
        base = reg.motor_base(motor)
        self.memory.x[base + reg.M_STATUS1] &= ~reg.S1_HOME_SEARCH & 0xFFFFFF

    def _ready_to_move(self, motor: int, direction: int) -> bool:
        """Close the loop if it is open; False if the move would go further beyond a limit."""
        if not self.is_active(motor):
            return False
        if self.is_open_loop(motor) or self.is_killed(motor):
            self.enable(motor)
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

    def triggered(self, motor: int, captured: int) -> None:
        """The trigger of a homing or jog-until-trigger move came at ``captured`` units."""
        base = reg.motor_base(motor)
        memory = self.memory
        unit = self.unit(motor)
        memory.y[base + reg.M_TRIGGER_CAPTURE] = round(captured / unit) & 0xFFFFFF
        if int(memory.x[base + reg.M_STATUS1]) & reg.S1_HOME_SEARCH:
            offset = read_word_signed(memory.x, base + reg.M_IXX26_IXX80) / 16.0
            target = captured + self.backlash(motor) + offset * unit
            memory.x[base + reg.M_STATUS1] &= ~reg.S1_HOME_SEARCH & 0xFFFFFF
            memory.y[base + reg.M_STATUS2] |= reg.S2_HOME_COMPLETE
            memory.y[base + reg.M_HOME_CAPTURE] = round(captured / unit) & 0xFFFFFF
            # Reported positions refer to the new zero: what PSET or X=3 renamed is forgotten.
            self._write(motor, reg.M_BIAS, 0)
            self.shift_zero(motor, round(target))
            self._plan_jog(motor, 0.0)
            return
        distance = float(self._after_trigger.get(motor, 0.0))
        memory.y[base + reg.M_STATUS2] &= ~reg.S2_TRIGGER_MOVE & 0xFFFFFF
        self._plan_jog(motor, captured - self._offset(motor) + distance * unit)
