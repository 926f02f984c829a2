"""The servo task of the simulated card as one compiled loop.

What lives here: what happens in every servo interrupt, in its order: latch, encoder conversion,
time base, motor positions, trajectories, compensation, servo laws, outputs, gathering, counters,
PLC 0 at the real-time interrupt, plant. What may not: decisions that need the language (aborted
programs, planned moves); they leave as events. Imports the other kernels, ``memory``, ``registers``
and ``vm``.

Registers are read from and written to the card's memory; gains are decoded once and again whenever
the change counter of the memory has moved. Registers that a law writes every cycle (D:+$10, X:+$2E,
Ixx29, Ixx68) are read afresh.

Source: Turbo PMAC Software Reference Manual p. 84-127, 148, 284-286, 495-507; User Manual p. 319.
"""

import math
from typing import Any, NamedTuple

from numba import njit

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.simulator.memory import memory, vm
from pmac_comp.simulator.memory import registers as reg
from pmac_comp.simulator.memory.memory import (
    Space,
    read_long,
    read_word_signed,
    signed24,
    write_long,
)
from pmac_comp.simulator.plant import kernel_ballscrew as plant
from pmac_comp.simulator.servo import compensation as comp
from pmac_comp.simulator.servo import conversion, encoder, gather, sensors
from pmac_comp.simulator.servo import servo_law as law
from pmac_comp.simulator.servo import trajectory as traj
from pmac_comp.simulator.servo.compiled import keep_fresh
from pmac_comp.simulator.servo.sensors import (
    W_ANGLE,
    W_CAPTURE,
    W_COUNT,
    W_COUNTS_PER_REV,
    W_CYCLE_MS,
    W_ENCODER_CHANNEL,
    W_ENCODER_MOTOR,
    W_ENCODER_SIGN,
    W_FLAG_SELECT,
    W_INPUT,
    W_KIND,
    W_TABLE,
    W_TORQUE,
    W_TORQUE_PER_DAC,
)

# Sign of the compensation register D:+$10: it holds minus the correction and is subtracted in the
# following error. Two readings of the manual are open; the motor moves by +entry in both.
COMPENSATION_REGISTER_SIGN = -1.0

# Decoded settings of a motor after the gains of the law.
(
    D_FATAL,  # units of 1/(32 Ixx08) count, as all positions here
    D_WARNING,
    D_IN_POSITION,
    D_POSITIVE,
    D_NEGATIVE,
    D_FILTER,
    D_BACKLASH_RATE,
    D_BACKLASH_HYSTERESIS,
    D_BACKLASH_SIZE,
    D_UNIT,  # 32 Ixx08
    D_I2T_CONTINUOUS,
    D_I2T_LIMIT,
    N_DECODED,
) = range(law.N_GAINS, law.N_GAINS + 13)

(
    A_POSITION,
    A_VELOCITY,
    A_MASTER,
    A_OUTPUT,
    A_FLAGS,
    A_CS,
    A_EXTENSION,
    A_IXX07,
    A_IXX08,
    A_IXX09,
    A_IN_POSITION_SCANS,
    A_IXX24,
    A_CAPTURE,
    A_FLAG_SELECT,
    N_ADDRESSES,
) = range(15)

# Per-motor memory after that of the law.
(
    K_VELOCITY,  # net desired velocity of the last closure
    K_FILTERED,
    K_EXTENSION,
    K_BACKLASH,
    K_BACKLASH_EXTREME,
    K_LATCHED_LIMIT,  # 1 a limit event was given
    K_ARMED,  # 1 a trigger is awaited
    K_COUNT,  # encoder count of the last cycle, for index crossings
    K_CURRENT,
    K_DESIRED_LIMIT,  # 1 an event was given
    N_MOTOR_MEMORY,
) = range(law.N_LAW, law.N_LAW + 11)

# Integers shared with Python.
(
    H_DIRTY,  # last decoded change counter
    H_EVENTS,
    H_ENTRIES,
    H_TABLES,
    H_ACTIVE,
    H_PLC,  # 1: code of PLC 0 is present
    H_SERVO,  # 1: open servo is present
    H_CYCLES,
    H_CLOCK,
    H_SLOT,
    H_BAD_TABLE,
    H_TIMERS,
    N_HEAD,
) = range(13)

# Events: kind, motor, value.
(
    EV_FATAL,
    EV_LIMIT,
    EV_TRIGGER,
    EV_SEGMENT,
    EV_LOW_QUEUE,
    EV_PLC,
    EV_SERVO_FAULT,
    EV_HARD_LIMIT,
    EV_TRIGGER_MISSED,
    EV_OVERCURRENT,
    EV_INTEGRATED,
    EV_DESIRED_LIMIT,
) = range(1, 13)
MAX_EVENTS = 256
BACKGROUND_CYCLES = 10
# Modelled task times in half CPU cycles (the unit of the task-time registers): an interpreted
# operation of about two and a half instructions (fetches and jumps counted) takes 3 us at 80 MHz, a
# compiled one 1 us (User Manual).
PLC_INSTRUCTION_TIME = 48
SERVO_INSTRUCTION_TIME = 16
_INTERRUPT_TIME = 300
_MOTOR_TIME = 500
PLC_BUDGET = 20000
SERVO_BUDGET = 5000
_BACKGROUND_TIME = 36000  # of a background cycle that nothing interrupts: 0.9 ms at 80 MHz
_LONGEST_WATCHDOG = 4095  # servo cycles, where I40 is 0 (p. 57)
_LEAST_LEFT = 0.01  # share of the time that background tasks get of an overloaded card
_WORD = 0xFFFFFF
# A part of the servo task that allocates nothing: inlined, and without counts of references to its
# arrays, which are atomic. What happens now and then is not inlined, which compiles sooner; it has
# to say so, because a function takes over the options of the one that it is compiled for. On disk
# is only the whole, ``servo_cycles``: parts kept there would outlive changes of other modules.
_part = njit(_nrt=False, forceinline=True)
_aside = njit(_nrt=False, forceinline=False)
_DYNAMIC1 = (
    reg.S1_MOVE_TIMER | reg.S1_DWELL | reg.S1_DESIRED_VELOCITY_ZERO | reg.S1_ABORT_DECELERATION
)
# Bits of Ixx24 (p. 102-104).
_ERROR_TO_MASTER, _HOLD_AT_LIMIT, _DESIRED_LIMIT = 1 << 13, 1 << 14, 1 << 15


class Words(NamedTuple):
    """Memory of the card and the counter of its changes."""

    x: Space
    y: Space
    dirty: IntArray


class Task(NamedTuple):
    """Integers that the servo task shares with Python (``H_...``) and its events."""

    head: IntArray
    events: IntArray


class MotorData(NamedTuple):
    """What the servo task keeps of the motors, a row for each number."""

    active: IntArray  # numbers of the active motors, now and at the last decoding
    decoded: FloatArray
    addresses: IntArray
    memory: FloatArray
    history: IntArray


class Paths(NamedTuple):
    """Trajectories: waiting segments, and where each motor is in its own."""

    segments: FloatArray
    cursor: FloatArray
    places: IntArray  # ``traj.I_...``


class Tables(NamedTuple):
    """Decoded encoder table with its memory, compensation tables and plan of gathering."""

    entries: IntArray
    conversion: FloatArray
    compensation: IntArray
    plan: IntArray


class Program(NamedTuple):
    """PLC 0 or the open servo: code, constants, what its runs leave, and how long one may be."""

    code: IntArray
    consts: FloatArray
    stack: FloatArray
    state: IntArray
    events: FloatArray
    regs: FloatArray
    budget: int  # instructions; not a constant below, for which the interpreter is compiled anew


class IVariables(NamedTuple):
    """Where the registers of the I-variables are, and their scales."""

    imap: IntArray
    iscale: FloatArray


class Cycle(NamedTuple):
    """What one servo cycle hands on: corrections of the tables by motor, time steps by C.S."""

    correction: FloatArray
    torque: FloatArray
    backlash: FloatArray
    time_step: FloatArray


class CardArrays(NamedTuple):
    """All arrays of a card that its servo task works on."""

    words: Words
    task: Task
    motors: MotorData
    paths: Paths
    tables: Tables
    variables: IVariables
    plc: Program
    open_servo: Program
    cycle: Cycle


class Motor(NamedTuple):
    """One motor: number, its block of memory, addresses, decoded settings, memory of the task."""

    m: int
    base: int
    a: IntArray
    d: FloatArray
    k: FloatArray


class Present(NamedTuple):
    """What the servo law of a motor begins with: positions in units, feedback since it closed."""

    position: int
    master: int
    offset: int  # of the net desired position from the commanded one: master and correction
    feedback: int


@_aside
def _event(task: Task, kind: int, motor: int, value: int) -> None:
    n = task.head[H_EVENTS]
    if n < MAX_EVENTS:
        task.events[n, 0] = kind
        task.events[n, 1] = motor
        task.events[n, 2] = value
        task.head[H_EVENTS] = n + 1


@njit
def _signed16(value: int) -> int:
    """Sixteen-bit variables occupy the low bits of their word."""
    value &= 0xFFFF
    return value - 0x10000 if value >= 0x8000 else value


@njit
def decode_motor(x: Space, y: Space, m: int, d: FloatArray, a: IntArray) -> None:
    """Decode the block of one motor into gains, limits (units) and addresses."""
    base = 0x80 * m
    d[law.G_KP] = read_word_signed(y, base + reg.M_IXX30)
    d[law.G_KD] = read_word_signed(x, base + reg.M_IXX31)
    d[law.G_KVFF] = read_word_signed(x, base + reg.M_IXX32_IXX60)
    d[law.G_KI] = x[base + reg.M_IXX33_IXX63]
    status = int(x[base + reg.M_STATUS1])
    d[law.G_MODE] = 1.0 if status & reg.S1_INTEGRATION_MODE else 0.0
    d[law.G_KAFF] = read_word_signed(y, base + reg.M_IXX35)
    ixx08 = max(int(y[base + reg.M_IXX03_IXX08]), 1)
    ixx09 = max(int(y[base + reg.M_IXX65_IXX09]), 1)
    d[law.G_SCALE] = ixx08
    d[law.G_VSCALE] = ixx09
    d[law.G_ILIMIT] = read_word_signed(y, base + reg.M_IXX33_IXX63)
    d[law.G_BANDGAIN] = read_word_signed(y, base + reg.M_IXX64)
    d[law.G_BAND] = read_word_signed(x, base + reg.M_IXX65_IXX09)
    d[law.G_FELIMIT] = int(y[base + reg.M_IXX04_IXX67])
    d[law.G_OUTLIMIT] = int(y[base + reg.M_IXX69]) / 256.0
    for i in range(4):
        d[law.G_N1 + i] = read_word_signed(y, base + reg.M_IXX36 + i) / 4194304.0
    sixteenth = 2.0 * ixx08
    d[D_FATAL] = int(x[base + reg.M_IXX11]) * sixteenth
    d[D_WARNING] = int(y[base + reg.M_IXX28_IXX12]) * sixteenth
    d[D_IN_POSITION] = int(x[base + reg.M_IXX28_IXX12]) * sixteenth
    d[D_UNIT] = 32.0 * ixx08
    d[D_POSITIVE] = read_long(x, y, base + reg.M_IXX13) * d[D_UNIT]
    d[D_NEGATIVE] = read_long(x, y, base + reg.M_IXX14) * d[D_UNIT]
    d[D_FILTER] = int(x[0x1100 + 0x40 * (m - 1) + reg.R_IXX40]) / 8388608.0
    d[D_BACKLASH_RATE] = int(x[base + reg.M_IXX85_IXX87]) * sixteenth
    d[D_BACKLASH_HYSTERESIS] = int(y[base + reg.M_IXX85_IXX87]) * sixteenth
    d[D_BACKLASH_SIZE] = read_word_signed(x, base + reg.M_IXX86) * sixteenth
    d[D_I2T_CONTINUOUS] = _signed16(int(x[base + reg.M_IXX57_IXX58]))
    d[D_I2T_LIMIT] = int(y[base + reg.M_IXX57_IXX58])
    a[A_POSITION] = x[base + reg.M_IXX03_IXX08] & 0x7FFFF
    a[A_VELOCITY] = x[base + reg.M_IXX04_IXX67] & 0x7FFFF
    a[A_MASTER] = x[base + reg.M_IXX05] & 0x7FFFF
    a[A_OUTPUT] = x[base + reg.M_IXX02] & 0x7FFFF
    a[A_FLAGS] = x[base + reg.M_IXX25_IXX24] & 0x7FFFF
    a[A_IXX24] = y[base + reg.M_IXX25_IXX24]
    a[A_CS] = (int(y[base + reg.M_STATUS2]) >> reg.S2_CS_SHIFT) & 15
    a[A_EXTENSION] = int(y[base + reg.M_IXX32_IXX60]) & 0xFF
    a[A_IXX07] = signed24(int(x[base + reg.M_IXX07]))
    a[A_IXX08] = ixx08
    a[A_IXX09] = ixx09
    a[A_IN_POSITION_SCANS] = y[base + reg.M_IXX88]
    a[A_CAPTURE], a[A_FLAG_SELECT] = _capture_settings(x, y, a[A_FLAGS])


@njit
def _capture_settings(x: Space, y: Space, channel: int) -> tuple[int, int]:
    """Trigger (I7mn2) and flag (I7mn3) of a channel of servo IC 0 or 1."""
    for ic in range(2):
        offset = channel - (0x078000 + 0x100 * ic)
        if 0 <= offset < 0x20:
            cell = reg.INTERNAL_SERVO_IC + 10 * (offset // 8 + 1)
            words = x if ic == 0 else y
            return int(words[cell + 2]), int(words[cell + 3])
    return 1, 0


@njit
def decode_all(
    words: Words, task: Task, motors: MotorData, tables: Tables, world: FloatArray
) -> None:
    """Decode everything that changed words may have changed."""
    x, y, head = words.x, words.y, task.head
    _decode_motors(words, task, motors)
    head[H_ENTRIES], bad = conversion.decode_table(x, y, tables.entries)
    if bad:
        x[reg.GLOBAL_STATUS] |= reg.G1_CONFIGURATION
    elif head[H_BAD_TABLE]:
        x[reg.GLOBAL_STATUS] &= ~reg.G1_CONFIGURATION
    head[H_BAD_TABLE] = 1 if bad else 0
    head[H_TABLES] = comp.decode_tables(x, y, tables.compensation)
    gather.decode_plan(x, y, tables.plan)
    channel = int(world[W_ENCODER_CHANNEL])
    world[W_ENCODER_SIGN] = _channel_sign(x, y, channel)
    world[W_CAPTURE], world[W_FLAG_SELECT] = _capture_settings(x, y, channel)


@njit
def _decode_motors(words: Words, task: Task, motors: MotorData) -> None:
    """List the active motors and decode their blocks."""
    x, y, active, addresses = words.x, words.y, motors.active, motors.addresses
    before = task.head[H_ACTIVE]
    n = 0
    for m in range(1, 33):
        base = 0x80 * m
        if not x[base + reg.M_STATUS1] & reg.S1_ACTIVATED:
            continue
        decode_motor(x, y, m, motors.decoded[m], addresses[m])
        known = False
        for i in range(before):
            known = known or active[1, i] == m
        if not known:
            # The first cycle of a motor must not see a jump of its feedback.
            y[base + reg.M_IXX05] = x[addresses[m, A_POSITION]]
            y[base + reg.M_VELOCITY] = x[addresses[m, A_VELOCITY]]
            y[base + reg.M_IXX07] = x[addresses[m, A_MASTER]]
            motors.memory[m, :] = 0.0
        active[0, n] = m
        n += 1
    active[1, :n] = active[0, :n]
    task.head[H_ACTIVE] = n


@njit
def _channel_sign(x: Space, y: Space, channel: int) -> float:
    """Counting direction of I7mn0: 4-7 count up with the plant, 0-3 down."""
    ic = (channel - 0x078000) // 0x100
    n = ((channel & 0xFF) // 8) + 1
    if ic < 0 or ic > 1 or n > 4:
        return 1.0
    cell = reg.INTERNAL_SERVO_IC + 10 * n
    word = int(x[cell]) if ic == 0 else int(y[cell])
    return -1.0 if 0 < word < 4 else 1.0


@njit
def _time_bases(x: Space, y: Space, used: int, steps: FloatArray) -> None:
    """Slew the time base of every coordinate system in use; scaled time of this cycle."""
    i10 = float(x[reg.I10_REGISTER])
    for cs in range(16):
        if not (used >> cs) & 1:
            continue
        base = 0x2000 + 0x100 * cs
        source = int(x[base + reg.C_TIMEBASE_SOURCE]) & 0x7FFFF
        target = int(x[source]) if source != 0 else int(x[base])
        slew = int(y[base + reg.C_SLEWS])
        if y[base + reg.C_TIMEBASE_SOURCE] & 1:  # feed hold
            target = 0
            slew = int(x[base + reg.C_SLEWS])
        present = int(x[base + reg.C_TIMEBASE])
        if present < target:
            present = min(present + slew, target)
        elif present > target:
            present = max(present - slew, target)
        x[base + reg.C_TIMEBASE] = present
        steps[cs] = present / i10 if i10 > 0.0 else 0.0


@_aside
def _kill(words: Words, motor: Motor, paths: Paths) -> None:
    """Open the loop and disable the amplifier."""
    m, x = motor.m, words.x
    status = int(x[motor.base + reg.M_STATUS1])
    status = (status | reg.S1_OPEN_LOOP) & ~reg.S1_AMPLIFIER_ENABLED & ~reg.S1_HOME_SEARCH
    x[motor.base + reg.M_STATUS1] = status
    x[motor.base + reg.M_FILTER_RESULT] = 0
    paths.places[m, :] = 0
    paths.cursor[m, traj.C_TIME] = 0.0
    paths.cursor[m, traj.C_VELOCITY] = 0.0
    motor.k[K_ARMED] = 0.0


@njit
def _flag_level(x: Space, channel: int, select: int) -> bool:
    return bool((int(x[channel]) >> (16 + (select & 3))) & 1)


@_aside
def _trigger(words: Words, motor: Motor, world: FloatArray, position: int) -> tuple[bool, int]:
    """Whether the awaited trigger came in this cycle, and the captured position in units."""
    x, a, k = words.x, motor.a, motor.k
    status = int(x[motor.base + reg.M_STATUS1])
    if status & reg.S1_TRIGGER_ON_ERROR:
        status2 = int(words.y[motor.base + reg.M_STATUS2])
        return (status2 & reg.S2_WARNING_ERROR) != 0, position
    channel = a[A_FLAGS]
    if channel != int(world[W_ENCODER_CHANNEL]):
        return False, position
    control = a[A_CAPTURE]
    mode = control & 3
    flag = _flag_level(x, channel, a[A_FLAG_SELECT]) != bool(control & 8)
    here = world[W_COUNT]
    before = k[K_COUNT]
    k[K_COUNT] = here
    if mode in (0, encoder.CAPTURE_FLAG):
        return mode == 0 or flag, position
    per_rev = world[W_COUNTS_PER_REV]
    hit, index = encoder.index_trigger(x, channel, control, before, here, per_rev)
    if not hit or (mode == encoder.CAPTURE_BOTH and not flag):
        return False, position
    if status & reg.S1_SOFTWARE_CAPTURE:
        return True, position
    return True, position - round((here - index) * motor.d[D_UNIT])


@_aside
def _desired_limit(words: Words, motor: Motor, task: Task, command: int) -> int:
    """Commanded position under the software limits: stopped (one event), or held at the limit."""
    d, k = motor.d, motor.k
    side, limit = 0, 0.0
    if d[D_POSITIVE] != 0.0 and command > d[D_POSITIVE]:
        side, limit = 1, d[D_POSITIVE]
    elif d[D_NEGATIVE] != 0.0 and command < d[D_NEGATIVE]:
        side, limit = -1, d[D_NEGATIVE]
    if side == 0:
        k[K_DESIRED_LIMIT] = 0.0
        return command
    words.y[motor.base + reg.M_STATUS2] |= reg.S2_DESIRED_LIMIT_STOP
    if motor.a[A_IXX24] & _HOLD_AT_LIMIT:
        return int(limit)
    if k[K_DESIRED_LIMIT] == 0.0:
        k[K_DESIRED_LIMIT] = 1.0
        _event(task, EV_DESIRED_LIMIT, motor.m, side)
    return command


@_aside
def _backlash(words: Words, motor: Motor, command: float, table16: float) -> float:
    """Present backlash in units; taken up at Ixx85 per background cycle."""
    y, base, d, k = words.y, motor.base, motor.d, motor.k
    status = int(y[base + reg.M_STATUS2])
    negative = (status & reg.S2_BACKLASH_DIRECTION) != 0
    extreme = k[K_BACKLASH_EXTREME]
    if negative:
        extreme = min(extreme, command)
        if command > extreme + d[D_BACKLASH_HYSTERESIS]:
            negative = False
            extreme = command
    else:
        extreme = max(extreme, command)
        if command < extreme - d[D_BACKLASH_HYSTERESIS]:
            negative = True
            extreme = command
    k[K_BACKLASH_EXTREME] = extreme
    if negative:
        y[base + reg.M_STATUS2] = status | reg.S2_BACKLASH_DIRECTION
    else:
        y[base + reg.M_STATUS2] = status & ~reg.S2_BACKLASH_DIRECTION
    sixteenth = d[D_UNIT] / 16.0
    target = d[D_BACKLASH_SIZE] + table16 * sixteenth if negative else 0.0
    step = d[D_BACKLASH_RATE] / BACKGROUND_CYCLES
    present = k[K_BACKLASH]
    present = min(present + step, target) if present < target else max(present - step, target)
    k[K_BACKLASH] = present
    write_long(words.x, y, base + reg.M_BACKLASH_SAVED, int(extreme))
    y[base + reg.M_IXX86] = math.floor(present / sixteenth + 0.5) & _WORD
    return float(present)


@_aside
def _background(words: Words, motors: MotorData, n_active: int) -> None:
    """In-position check of all motors, as the background task makes it."""
    x, y = words.x, words.y
    for i in range(n_active):
        m = motors.active[0, i]
        base = 0x80 * m
        status = int(x[base + reg.M_STATUS1])
        still = not status & (reg.S1_OPEN_LOOP | reg.S1_MOVE_TIMER | reg.S1_DWELL)
        still = still and (status & reg.S1_DESIRED_VELOCITY_ZERO) != 0
        error = abs(read_long(x, y, base + reg.M_FOLLOWING_ERROR))
        scans = int(x[base + reg.M_IXX88])
        status2 = int(y[base + reg.M_STATUS2])
        if still and error < motors.decoded[m, D_IN_POSITION]:
            scans = min(scans + 1, 0xFFFF)
            if scans > motors.addresses[m, A_IN_POSITION_SCANS]:
                status2 |= reg.S2_IN_POSITION
        else:
            scans = 0
            status2 &= ~reg.S2_IN_POSITION
        x[base + reg.M_IXX88] = scans
        y[base + reg.M_STATUS2] = status2


@_aside
def _velocity_filters(words: Words, motors: MotorData, n_active: int, slot: int) -> None:
    """Averaged velocity over sixteen slots (I60, I61)."""
    x, y, addresses = words.x, words.y, motors.addresses
    shift = int(x[reg.INTERNAL_GLOBAL + 61])
    for i in range(n_active):
        m = motors.active[0, i]
        base = 0x80 * m
        position = read_long(x, y, base + reg.M_ACTUAL)
        change = position - motors.history[m, slot]
        motors.history[m, slot] = position
        write_long(x, y, base + reg.M_VELOCITY_HISTORY + slot, position)
        scaled = change * addresses[m, A_IXX09] / addresses[m, A_IXX08]
        averaged = scaled / (1 << min(shift, 30))
        write_long(x, y, base + reg.M_VELOCITY_FILTERED, math.floor(averaged + 0.5))


@njit
def _timers(x: Space, y: Space) -> None:
    """User countdown timers of all coordinate systems that I68 activates."""
    for cs in range(min(int(x[reg.INTERNAL_GLOBAL + 68]), 15) + 1):
        cell = 0x2000 + 0x100 * cs + reg.C_TIMERS
        if x[cell] != 0x800000:
            x[cell] = (int(x[cell]) - 1) & _WORD
        if y[cell] != 0x800000:
            y[cell] = (int(y[cell]) - 1) & _WORD


@_aside
def _open_loop(words: Words, motor: Motor, cursor: FloatArray, position: int, offset: int) -> float:
    """A motor whose loop is open: desired follows actual, the law forgets, X:+$2E goes out."""
    x, y, base, k = words.x, words.y, motor.base, motor.k
    command = position - offset + int(k[K_BACKLASH])  # what is taken up stays so
    write_long(x, y, base + reg.M_COMMANDED, command)
    write_long(x, y, base + reg.M_PREVIOUS_NET, position)
    write_long(x, y, base + reg.M_FOLLOWING_ERROR, 0)
    write_long(x, y, base + reg.M_INTEGRATOR, 0)
    # History register L:(R1-$29) of the open servo: zero while the loop is open (p. 179).
    write_long(x, y, base + 0x07, 0)
    k[: law.N_LAW] = 0.0
    k[K_VELOCITY] = 0.0
    k[K_FILTERED] = position
    k[K_BACKLASH_EXTREME] = command
    cursor[traj.C_POSITION] = command
    cursor[traj.C_VELOCITY] = 0.0
    if not x[base + reg.M_STATUS1] & reg.S1_AMPLIFIER_ENABLED:
        x[base + reg.M_FILTER_RESULT] = 0
    return float(read_word_signed(x, base + reg.M_FILTER_RESULT))


@njit
def _source_position(x: Space, y: Space, m: int, desired: int) -> float:
    """Uncorrected position of a table's source motor in counts."""
    base = 0x80 * m
    unit = 32.0 * max(int(y[base + reg.M_IXX03_IXX08]), 1)
    if desired:
        return float(read_long(x, y, base + reg.M_COMMANDED) / unit)
    register = read_long(x, y, base + reg.M_COMPENSATION)
    actual = read_long(x, y, base + reg.M_ACTUAL)
    return float((actual - COMPENSATION_REGISTER_SIGN * register) / unit)


@_aside
def _run_program(words: Words, variables: IVariables, program: Program) -> int:
    """Status of a run of PLC 0 or the open servo."""
    return int(
        vm.run(
            words.x,
            words.y,
            words.dirty,
            variables.imap,
            variables.iscale,
            program.code,
            program.consts,
            program.stack,
            program.state,
            program.regs,
            program.events,
            program.budget,
        )
    )


@_aside
def _user_servo(
    words: Words,
    variables: IVariables,
    program: Program,
    motor: Motor,
    task: Task,
    now: Present,
    velocity: float,
    error: float,
    net: float,
) -> float:
    """Open servo of one motor: 24-bit output, 0 and an event after a fault."""
    # The algorithm may put the error it really acts on in place of this one.
    write_long(words.x, words.y, motor.base + reg.M_FOLLOWING_ERROR, int(error))
    state, regs = program.state, program.regs
    state[vm.S_PC] = 0
    state[vm.S_SP] = 0
    state[vm.S_EVENTS] = 0
    state[vm.S_CS] = 0
    state[vm.S_MOTOR] = motor.m
    state[vm.S_R1] = motor.base + reg.M_STATUS1
    regs[0] = now.feedback
    regs[1] = velocity
    regs[2] = error
    regs[3] = now.position
    regs[4] = net
    regs[vm.REG_RETURN] = 0.0
    result = _run_program(words, variables, program)
    motor.k[: law.N_LAW] = 0.0
    out = float(min(max(regs[vm.REG_RETURN], -8388608.0), 8388607.0))
    if result in (vm.FAULT, vm.OUT_OF_BUDGET, vm.EVENTS) or math.isnan(out):
        _event(task, EV_SERVO_FAULT, motor.m, 0)
        return 0.0
    return out


@_aside
def _limits(
    words: Words, motor: Motor, task: Task, world: FloatArray, position: int, speed: float
) -> None:
    """Overtravel limits; one event per stop. ``speed`` tells the direction of the motion."""
    x, base, a, d, k = words.x, motor.base, motor.a, motor.d, motor.k
    status = int(x[base + reg.M_STATUS1]) & ~(reg.S1_POSITIVE_LIMIT | reg.S1_NEGATIVE_LIMIT)
    hard = 0
    if not a[A_IXX24] & 0x20000 and a[A_FLAGS] == int(world[W_ENCODER_CHANNEL]):
        flags = int(x[a[A_FLAGS]])
        hard = ((flags >> 17) & 1) - ((flags >> 18) & 1)
    soft = 0
    if not status & reg.S1_HOME_SEARCH:
        if d[D_POSITIVE] != 0.0 and position > d[D_POSITIVE]:
            soft = 1
        elif d[D_NEGATIVE] != 0.0 and position < d[D_NEGATIVE]:
            soft = -1
    side = hard if hard != 0 else soft
    if side > 0:
        status |= reg.S1_POSITIVE_LIMIT
    elif side < 0:
        status |= reg.S1_NEGATIVE_LIMIT
    x[base + reg.M_STATUS1] = status
    if side == 0:
        k[K_LATCHED_LIMIT] = 0.0
    elif speed * side > 0.0 and k[K_LATCHED_LIMIT] == 0.0:
        k[K_LATCHED_LIMIT] = 1.0
        words.y[base + reg.M_STATUS2] |= reg.S2_LIMIT_STOP
        _event(task, EV_HARD_LIMIT if hard != 0 else EV_LIMIT, motor.m, side)
    elif speed == 0.0:
        k[K_LATCHED_LIMIT] = 0.0


@_part
def _overcurrent(words: Words, motor: Motor, word: int) -> bool:
    """I2T (Ixx57 > 0) or IT (Ixx57 < 0) protection; True when it trips (p. 121-123)."""
    d, k = motor.d, motor.k
    command = word / 256.0
    continuous = d[D_I2T_CONTINUOUS]
    if continuous >= 0.0:
        k[K_CURRENT] += (command * command - continuous * continuous) / 1073741824.0
    else:
        k[K_CURRENT] += (abs(command) + continuous) / 32768.0
    k[K_CURRENT] = max(k[K_CURRENT], 0.0)
    write_long(words.x, words.y, motor.base + reg.M_INTEGRATED_CURRENT, int(k[K_CURRENT]))
    return bool(k[K_CURRENT] > d[D_I2T_LIMIT])


@_part
def _measure(x: Space, y: Space, base: int, a: IntArray) -> None:
    """Actual and master position of a motor, from what their registers moved by."""
    now = int(x[a[A_POSITION]])
    change = signed24(now - int(y[base + reg.M_IXX05]))
    y[base + reg.M_IXX05] = now
    position = read_long(x, y, base + reg.M_ACTUAL) + change * a[A_IXX08]
    write_long(x, y, base + reg.M_ACTUAL, position)
    now = int(x[a[A_MASTER]])
    change = signed24(now - int(y[base + reg.M_IXX07]))
    y[base + reg.M_IXX07] = now
    if x[base + reg.M_STATUS1] & reg.S1_FOLLOWING and change != 0:
        master = read_long(x, y, base + reg.M_MASTER) + change * a[A_IXX07]
        write_long(x, y, base + reg.M_MASTER, master)


@_part
def _command(words: Words, motor: Motor, paths: Paths, task: Task, step: float, ms: float) -> int:
    """Commanded position of a motor in closed loop, one step on; flags of its trajectory.

    ``step`` is this cycle's share of real time, ``ms`` the servo period.
    """
    x, y, base, m = words.x, words.y, motor.base, motor.m
    flags = traj.advance(paths.segments, paths.cursor, paths.places, m, step)
    if flags >= 65536:
        if flags & 65536:
            _event(task, EV_SEGMENT, m, paths.places[m, traj.I_TAG])
        if flags & 131072:
            _event(task, EV_LOW_QUEUE, m, paths.places[m, traj.I_COUNT])
        flags &= 65535
    c = paths.cursor[m]
    command = math.floor(c[traj.C_POSITION] + 0.5)
    if motor.a[A_IXX24] & _DESIRED_LIMIT:
        command = _desired_limit(words, motor, task, command)
    write_long(x, y, base + reg.M_COMMANDED, command)
    speed = c[traj.C_VELOCITY] / ms
    write_long(x, y, base + reg.M_DESIRED_VELOCITY, int(speed * (16777216.0 / 3.0)))
    rate = c[traj.C_ACCELERATION] / (ms * ms)
    write_long(x, y, base + reg.M_DESIRED_ACCELERATION, int(rate * (16777216.0 / 6.0)))
    return int(flags)


@_part
def _motion_status(x: Space, base: int, flags: int, velocity: float) -> None:
    """Bits of the first status word that follow the trajectory."""
    status = int(x[base + reg.M_STATUS1])
    status &= ~_DYNAMIC1
    if flags & traj.TIMED:
        status |= reg.S1_MOVE_TIMER
    if flags & traj.DWELL:
        status |= reg.S1_DWELL
    if flags & traj.ABORTING:
        status |= reg.S1_ABORT_DECELERATION
    # A real killed motor shows this bit as 0 (850000000000), a holding one as 1.
    if velocity == 0.0 and not status & reg.S1_OPEN_LOOP:
        status |= reg.S1_DESIRED_VELOCITY_ZERO
    x[base + reg.M_STATUS1] = status


@_part
def _follow_paths(
    words: Words,
    motors: MotorData,
    paths: Paths,
    task: Task,
    time_step: FloatArray,
    cycle_ms: float,
) -> None:
    """Positions and trajectories of all motors, one servo cycle on."""
    x, y = words.x, words.y
    for i in range(task.head[H_ACTIVE]):
        m = motors.active[0, i]
        motor = Motor(m, 0x80 * m, motors.addresses[m], motors.decoded[m], motors.memory[m])
        _measure(x, y, motor.base, motor.a)
        flags = 0
        if not x[motor.base + reg.M_STATUS1] & reg.S1_OPEN_LOOP:
            flags = _command(words, motor, paths, task, time_step[motor.a[A_CS]], cycle_ms)
        else:
            write_long(x, y, motor.base + reg.M_DESIRED_VELOCITY, 0)
            write_long(x, y, motor.base + reg.M_DESIRED_ACCELERATION, 0)
        _motion_status(x, motor.base, flags, paths.cursor[m, traj.C_VELOCITY])


@_part
def _apply_tables(
    words: Words, task: Task, motors: MotorData, tables: IntArray, cycle: Cycle
) -> bool:
    """What the tables say to their target motors, summed up; whether tables are on (I51)."""
    x, y = words.x, words.y
    for i in range(task.head[H_ACTIVE]):
        m = motors.active[0, i]
        cycle.correction[m] = 0.0
        cycle.torque[m] = 0.0
        cycle.backlash[m] = 0.0
    if not (x[reg.GLOBAL_STATUS] >> 14) & 1:
        return False
    for i in range(task.head[H_TABLES]):
        t = tables[i]
        source = t[comp.T_SOURCE]
        first = _source_position(x, y, source, t[comp.T_DESIRED])
        second = 0.0
        if t[comp.T_ROWS] > 0:
            second = _source_position(x, y, t[comp.T_SOURCE2], t[comp.T_DESIRED2])
        value = comp.look_up(y, t, first, second)
        if t[comp.T_KIND] == 0:
            cycle.correction[t[comp.T_TARGET]] += value
        elif t[comp.T_KIND] == 1:
            cycle.torque[t[comp.T_TARGET]] += value
        else:
            cycle.backlash[t[comp.T_TARGET]] += value
    return True


@_part
def _closes(y: Space, motor: Motor) -> bool:
    """Whether the loop is closed in this interrupt; with Ixx60 it is in one of several only."""
    left = int(y[motor.base + reg.M_TIMEBASE_POINTER])
    close = left == 0
    y[motor.base + reg.M_TIMEBASE_POINTER] = motor.a[A_EXTENSION] if close else left - 1
    return close


@_part
def _feedback_velocity(x: Space, y: Space, motor: Motor, close: bool) -> int:  # noqa: FBT001
    """What the velocity feedback moved by since the loop was last closed, times Ixx09."""
    cell = motor.base + reg.M_VELOCITY
    if not close:
        return int(signed24(int(x[cell])))
    now = int(x[motor.a[A_VELOCITY]])
    feedback = signed24(now - int(y[cell])) * motor.a[A_IXX09]
    y[cell] = now
    x[cell] = feedback & _WORD
    return int(feedback)


@_part
def _net_command(words: Words, motor: Motor, wanted: float, backlash: float) -> float:
    """Command with backlash taken out and filtered (Ixx40)."""
    d, k = motor.d, motor.k
    net = wanted
    if d[D_BACKLASH_RATE] > 0.0:
        net -= _backlash(words, motor, net, backlash)
    elif k[K_BACKLASH] != 0.0:
        k[K_BACKLASH] = 0.0
        words.y[motor.base + reg.M_IXX86] = 0
    if d[D_FILTER] > 0.0:
        k[K_FILTERED] += (1.0 - d[D_FILTER]) * (net - k[K_FILTERED])
        net = math.floor(k[K_FILTERED] + 0.5)
    else:
        k[K_FILTERED] = net
    return float(net)


@_part
def _command_motion(x: Space, y: Space, motor: Motor, net: float) -> tuple[float, float]:
    """Velocity and acceleration of the net desired position, per closure of the loop."""
    velocity = net - read_long(x, y, motor.base + reg.M_PREVIOUS_NET)
    acceleration = velocity - motor.k[K_VELOCITY]
    motor.k[K_VELOCITY] = velocity
    write_long(x, y, motor.base + reg.M_PREVIOUS_NET, int(net))
    return velocity, acceleration


@_part
def _shed_error(words: Words, motor: Motor, error: float, master: int, net: float) -> float:
    """Move what exceeds Ixx67 from the following error to the master position, for good."""
    x, y, base = words.x, words.y, motor.base
    most = motor.d[law.G_FELIMIT] * motor.d[D_UNIT] / 16.0
    excess = math.floor(error - min(max(error, -most), most))
    if excess != 0:
        write_long(x, y, base + reg.M_MASTER, master - excess)
        write_long(x, y, base + reg.M_PREVIOUS_NET, int(net) - excess)
        error -= excess
    return error


@_part
def _pid(
    words: Words,
    motor: Motor,
    feedback: int,
    velocity: float,
    acceleration: float,
    error: float,
    moving: bool,  # noqa: FBT001
) -> float:
    """Output of the card's own law, whose error and integrator go to their registers."""
    x, y, base, d, k = words.x, words.y, motor.base, motor.d, motor.k
    # Ixx68 may be rewritten every cycle by a law.
    d[law.G_FRICTION] = int(y[base + reg.M_IXX68])
    out = law.pid_output(d, k, error, velocity, acceleration, float(feedback), moving)
    write_long(x, y, base + reg.M_FOLLOWING_ERROR, int(k[law.L_FE]))
    write_long(x, y, base + reg.M_INTEGRATOR, int(k[law.L_INTEGRAL]))
    return float(out)


@_part
def _watch_error(
    words: Words, motor: Motor, paths: Paths, task: Task, error: float, out: float
) -> float:
    """Following-error and integrator limits; what goes out after them."""
    y, base, d, k = words.y, motor.base, motor.d, motor.k
    status2 = int(y[base + reg.M_STATUS2]) & ~reg.S2_WARNING_ERROR
    size = abs(error)
    if d[D_WARNING] > 0.0 and size > d[D_WARNING]:
        status2 |= reg.S2_WARNING_ERROR
    if d[D_FATAL] > 0.0 and size > d[D_FATAL]:
        status2 |= reg.S2_FATAL_ERROR
        _kill(words, motor, paths)
        _event(task, EV_FATAL, motor.m, int(error))
        out = 0.0
    elif d[law.G_ILIMIT] < 0.0 and abs(k[law.L_INTEGRAL]) >= -d[law.G_ILIMIT] * d[D_UNIT] / 16.0:
        status2 |= reg.S2_INTEGRATED_ERROR | reg.S2_FATAL_ERROR
        _kill(words, motor, paths)
        _event(task, EV_INTEGRATED, motor.m, 0)
        out = 0.0
    y[base + reg.M_STATUS2] = status2
    return out


@_part
def _foreground_in_position(y: Space, base: int, near: bool, status: int) -> None:  # noqa: FBT001
    """In-position bit that the servo task sets itself (I13)."""
    near = near and not status & (reg.S1_MOVE_TIMER | reg.S1_DWELL)
    bit = reg.S2_FOREGROUND_IN_POSITION
    status2 = int(y[base + reg.M_STATUS2])
    y[base + reg.M_STATUS2] = status2 | bit if near else status2 & ~bit


@_aside
def _await_trigger(
    words: Words, motor: Motor, paths: Paths, task: Task, world: FloatArray, position: int
) -> None:
    """Tell of a trigger that came, or of a move that ended without one."""
    hit, captured = _trigger(words, motor, world, position)
    if hit:
        motor.k[K_ARMED] = 0.0
        _event(task, EV_TRIGGER, motor.m, captured)
    elif paths.places[motor.m, traj.I_COUNT] == 0:
        motor.k[K_ARMED] = 0.0
        _event(task, EV_TRIGGER_MISSED, motor.m, position)


@_part
def _close_loop(
    words: Words,
    motor: Motor,
    paths: Paths,
    task: Task,
    world: FloatArray,
    variables: IVariables,
    open_servo: Program,
    now: Present,
    backlash: float,
) -> float:
    """Output of a closed servo loop; ``backlash`` is what a table adds to Ixx86."""
    x, y, base = words.x, words.y, motor.base
    status = int(x[base + reg.M_STATUS1])
    command = read_long(x, y, base + reg.M_COMMANDED)
    net = _net_command(words, motor, float(command + now.offset), backlash)
    velocity, acceleration = _command_motion(x, y, motor, net)
    error = net - now.position
    if motor.a[A_IXX24] & _ERROR_TO_MASTER:
        error = _shed_error(words, motor, error, now.master, net)
    moving = paths.cursor[motor.m, traj.C_VELOCITY] != 0.0
    if status & reg.S1_USER_SERVO and task.head[H_SERVO] != 0:
        out = _user_servo(words, variables, open_servo, motor, task, now, velocity, error, net)
    else:
        out = _pid(words, motor, now.feedback, velocity, acceleration, error, moving)
    x[base + reg.M_FILTER_RESULT] = int(out) & _WORD
    out = _watch_error(words, motor, paths, task, error, out)
    if x[reg.INTERNAL_GLOBAL + 13] & 1:
        near = not moving and abs(error) < motor.d[D_IN_POSITION]
        _foreground_in_position(y, base, near, status)
    _limits(words, motor, task, world, now.position, paths.cursor[motor.m, traj.C_VELOCITY])
    if motor.k[K_ARMED] != 0.0:
        _await_trigger(words, motor, paths, task, world, now.position)
    return float(out)


@_part
def _present(words: Words, motor: Motor, close: bool) -> Present:  # noqa: FBT001
    """What the law of a motor begins with in this cycle."""
    x, y, base = words.x, words.y, motor.base
    master = read_long(x, y, base + reg.M_MASTER)
    register = read_long(x, y, base + reg.M_COMPENSATION)
    return Present(
        read_long(x, y, base + reg.M_ACTUAL),
        master,
        master + int(COMPENSATION_REGISTER_SIGN) * register,
        _feedback_velocity(x, y, motor, close),
    )


@_part
def _store_correction(words: Words, motor: Motor, correction_16th: float) -> None:
    """Position correction of the tables, in sixteenths of a count, to its register."""
    units = COMPENSATION_REGISTER_SIGN * (correction_16th * motor.d[D_UNIT] / 16.0)
    write_long(words.x, words.y, motor.base + reg.M_COMPENSATION, math.floor(units + 0.5))


@_part
def _put_out(
    words: Words,
    motor: Motor,
    out: float,
    tables_on: bool,  # noqa: FBT001
    torque: float,
) -> int:
    """Send the output of a law with bias (Ixx29) and torque table; the word that went out."""
    x, y, base = words.x, words.y, motor.base
    bias = 256.0 * _signed16(int(y[base + reg.M_IXX79_IXX29]))
    if tables_on:
        y[base + reg.M_COMMAND] = math.floor(torque + 0.5) & _WORD
        bias += torque
    word = int(min(max(out + bias, -8388608.0), 8388607.0))
    x[base + reg.M_COMMAND] = word & _WORD
    if motor.a[A_OUTPUT] != 0:
        y[motor.a[A_OUTPUT]] = word & _WORD
    return word


@_part
def _servo_laws(
    words: Words,
    motors: MotorData,
    paths: Paths,
    task: Task,
    world: FloatArray,
    variables: IVariables,
    open_servo: Program,
    cycle: Cycle,
    tables_on: bool,  # noqa: FBT001
) -> int:
    """Servo laws and outputs of all motors; the time that the interrupt takes."""
    x, y = words.x, words.y
    n_active = task.head[H_ACTIVE]
    spent = _INTERRUPT_TIME + _MOTOR_TIME * n_active
    for i in range(n_active):
        m = motors.active[0, i]
        motor = Motor(m, 0x80 * m, motors.addresses[m], motors.decoded[m], motors.memory[m])
        if tables_on:
            _store_correction(words, motor, cycle.correction[m])
        status = int(x[motor.base + reg.M_STATUS1])
        close = _closes(y, motor)
        now = _present(words, motor, close)
        if status & reg.S1_OPEN_LOOP:
            out = _open_loop(words, motor, paths.cursor[m], now.position, now.offset)
            if status & reg.S1_AMPLIFIER_ENABLED:
                _limits(words, motor, task, world, now.position, float(now.feedback))
        elif not close:
            out = float(read_word_signed(x, motor.base + reg.M_FILTER_RESULT))
        else:
            backlash = cycle.backlash[m]
            out = _close_loop(
                words, motor, paths, task, world, variables, open_servo, now, backlash
            )
            if status & reg.S1_USER_SERVO and task.head[H_SERVO] != 0:
                spent += SERVO_INSTRUCTION_TIME * open_servo.state[vm.S_STEPS]
        word = _put_out(words, motor, out, tables_on, cycle.torque[m])
        watched = motor.d[D_I2T_LIMIT] > 0.0 and not status & reg.S1_OPEN_LOOP
        if watched and _overcurrent(words, motor, word):
            y[motor.base + reg.M_STATUS2] |= reg.S2_I2T | reg.S2_AMPLIFIER_FAULT
            _kill(words, motor, paths)
            _event(task, EV_OVERCURRENT, m, word)
    return int(spent)


@_part
def _interrupt_is_due(x: Space, y: Space) -> bool:
    """Count the servo interrupt; whether the real-time interrupt follows it (I8)."""
    count = (int(x[reg.SERVO_COUNTER]) + 1) & _WORD
    x[reg.SERVO_COUNTER] = count
    wanted = int(y[reg.SERVO_COUNTER])
    if count != wanted and ((count - wanted) & _WORD) >= 0x800000:
        return False
    y[reg.SERVO_COUNTER] = (count + int(y[reg.RTI_PERIOD]) + 1) & _WORD
    return True


@_aside
def _real_time_interrupt(words: Words, variables: IVariables, plc: Program, task: Task) -> None:
    """PLC 0, where it is there and enabled, and the time that it took."""
    x, y = words.x, words.y
    spent = _INTERRUPT_TIME
    enabled = task.head[H_PLC] != 0 and not y[reg.PLC_TABLE] & 0xC00000
    if enabled and int(vm.read_i(x, y, variables.imap, variables.iscale, 5)) & 1:
        result = _run_program(words, variables, plc)
        spent += PLC_INSTRUCTION_TIME * plc.state[vm.S_STEPS]
        if result == vm.FAULT:
            x[reg.PLC_TABLE] |= 0x800000
            y[reg.PLC_TABLE] |= 0x400000
        if plc.state[vm.S_EVENTS] > 0 or result == vm.FAULT:
            _event(task, EV_PLC, 0, result)
    _note_interrupt_time(x, y, spent)


@_aside
def _note_interrupt_time(x: Space, y: Space, spent: int) -> None:
    """Times of the real-time interrupt and of the background, and the watchdog's count.

    Their timers run on in what interrupts them; how often it comes: User Manual p. 239-240. A PLC 0
    that takes longer than its period keeps its pace all the same: only these times tell.
    """
    phase, servo = int(x[reg.TASK_TIME]), int(y[reg.TASK_TIME])
    interval = max(1, int(x[reg.PHASE_INTERVAL]))
    cycle = interval * (int(x[reg.INTERNAL_SERVO_IC + 2]) + 1)
    elapsed = spent
    for _ in range(8):
        until = phase + servo + elapsed
        longer = spent + (until // interval) * phase + (until // cycle) * servo
        if longer == elapsed:
            break
        elapsed = longer
    x[reg.RTI_TIME] = min(elapsed, _WORD)
    y[reg.RTI_TIME] = max(int(y[reg.RTI_TIME]), int(x[reg.RTI_TIME]))
    busy = phase / interval + (servo + spent / (1.0 + y[reg.RTI_PERIOD])) / cycle
    background = int(_BACKGROUND_TIME / max(_LEAST_LEFT, 1.0 - busy))
    x[reg.BACKGROUND_TIME] = min(background, _WORD)
    y[reg.BACKGROUND_TIME] = max(int(y[reg.BACKGROUND_TIME]), int(x[reg.BACKGROUND_TIME]))
    # The count is reloaded as a background cycle ends: this is where it stands just before.
    reload = int(x[reg.INTERNAL_GLOBAL + 40])
    count = max(0, (reload if reload else _LONGEST_WATCHDOG) - background // cycle)
    y[reg.WATCHDOG_COUNT] = count
    x[reg.WATCHDOG_COUNT] = min(int(x[reg.WATCHDOG_COUNT]), count)


@njit(_nrt=True, forceinline=False)
def _take_changes(
    words: Words, task: Task, motors: MotorData, tables: Tables, world: FloatArray
) -> None:
    """Decode what changed words may have changed, and convert what was latched."""
    x, y, head = words.x, words.y, task.head
    head[H_DIRTY] = words.dirty[0]
    # The table is decoded and run first, so that a new motor starts on its result.
    head[H_ENTRIES], _ = conversion.decode_table(x, y, tables.entries)
    conversion.convert(x, y, tables.entries, head[H_ENTRIES], tables.conversion)
    decode_all(words, task, motors, tables, world)


@_part
def _systems_in_use(motors: MotorData, n_active: int) -> int:
    """Coordinate systems of the active motors and the first, a bit each."""
    used = 1
    for i in range(n_active):
        used |= 1 << motors.addresses[motors.active[0, i], A_CS]
    return int(used)


@_part
def _count(words: Words, task: Task, motors: MotorData, cycle_ms: float) -> None:
    """Counters and timers, and what is due in some cycles only."""
    x, y, head = words.x, words.y, task.head
    head[H_CYCLES] += 1
    _timers(x, y)
    if (head[H_CYCLES] & int(x[reg.INTERNAL_GLOBAL + 60])) == 0:
        _velocity_filters(words, motors, head[H_ACTIVE], head[H_SLOT])
        head[H_SLOT] = (head[H_SLOT] + 1) & 15
        x[1] = head[H_SLOT]
    if head[H_CYCLES] % BACKGROUND_CYCLES == 0:
        _background(words, motors, head[H_ACTIVE])
        ticks = int(head[H_CYCLES] * cycle_ms * 1.024)
        write_long(x, y, reg.CLOCK_1024, ticks)


@_part
def _torque_at_output(words: Words, motors: MotorData, world: FloatArray) -> float:
    """Torque that the output of the motor with the encoder asks of the plant, N m."""
    m = int(world[W_ENCODER_MOTOR])
    if not words.x[0x80 * m + reg.M_STATUS1] & reg.S1_AMPLIFIER_ENABLED:
        return 0.0
    output = motors.addresses[m, A_OUTPUT]
    return float((read_word_signed(words.y, output) >> 8) * world[W_TORQUE_PER_DAC])


@njit(cache=True, _nrt=False)
def servo_cycles(
    card: tuple[tuple[Any, ...], ...], drive: tuple[Any, ...], world: FloatArray, n_cycles: int
) -> int:
    """Run servo cycles until ``n_cycles`` are done or an event wants attention; cycles done.

    ``card`` are the fields of ``CardArrays``, in plain tuples like ``drive`` (state, parameters and
    log of the compiled plant): numba takes three times as long over named ones, at every call.
    """
    words, task, motors = Words(*card[0]), Task(*card[1]), MotorData(*card[2])
    paths, tables, variables = Paths(*card[3]), Tables(*card[4]), IVariables(*card[5])
    plc, open_servo, cycle = Program(*card[6]), Program(*card[7]), Cycle(*card[8])
    x, y, dirty = words
    head = task.head
    entries, conversion_memory, compensation, plan = tables
    state, par, log = drive
    compiled = world[W_KIND] == 1.0
    cycle_ms = world[W_CYCLE_MS]
    for done in range(n_cycles):
        if compiled:
            world[W_ANGLE] = state[plant.S_ANGLE_READ]
            world[W_TABLE] = state[plant.S_TABLE_READ]
        sensors.latch(x, y, world)
        if dirty[0] != head[H_DIRTY]:
            _take_changes(words, task, motors, tables, world)
        else:
            conversion.convert(x, y, entries, head[H_ENTRIES], conversion_memory)
        _time_bases(x, y, _systems_in_use(motors, head[H_ACTIVE]), cycle.time_step)
        _follow_paths(words, motors, paths, task, cycle.time_step, cycle_ms)
        tables_on = _apply_tables(words, task, motors, compensation, cycle)
        spent = _servo_laws(
            words, motors, paths, task, world, variables, open_servo, cycle, tables_on
        )
        # Gathering sees this cycle's latch, command and output.
        gather.gather_cycle(x, y, plan, world[W_INPUT] != 0.0)
        y[reg.TASK_TIME] = min(spent, _WORD)
        _count(words, task, motors, cycle_ms)
        if _interrupt_is_due(x, y):
            _real_time_interrupt(words, variables, plc, task)
        # The plant moves on under the torque that is now at the output.
        torque = _torque_at_output(words, motors, world)
        world[W_TORQUE] = torque
        if not compiled:
            return done + 1
        plant.ballscrew_step(state, par, log, torque)
        if head[H_EVENTS] > 0:
            return done + 1
    return n_cycles


keep_fresh(servo_cycles, comp, conversion, encoder, gather, sensors, vm, reg, law, traj)
keep_fresh(servo_cycles, memory, plant)
