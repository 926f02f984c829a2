"""Names for the registers of the simulated card.

Offsets of the motor block count from ``motor_base(n)`` = $80*n (motor 1 at $80). Where the manual
gives two words "X/Y" the first is the X half. Registers the manual does not place live in areas the
map leaves free (``INTERNAL_*``), so that every part of the card sees one and the same word.
Source: Turbo PMAC Software Reference Manual p. 495-512, 500-507.
"""

from __future__ import annotations

from typing import Final

MOTORS: Final = 32
COORDINATE_SYSTEMS: Final = 16

# --- global registers --------------------------------------------------------------------------
SERVO_COUNTER: Final = (
    0x000000  # X: counts servo interrupts; Y: count of the next real-time interrupt
)
RTI_PERIOD: Final = 0x000001  # Y: I8
GATHER_PERIOD: Final = 0x000002  # X: counter, Y: I5049
PHASE_EXTENSION: Final = 0x000003  # Y: I7
GLOBAL_STATUS: Final = 0x000006  # X: word 1, Y: word 2 of ???
RTI_TIME: Final = 0x00000B  # X: last, Y: longest real-time interrupt task time, half CPU cycles
CLOCK_1024: Final = 0x000017  # D: 1/1024 s since power-up
BACKGROUND_TIME: Final = 0x000022  # X: last, Y: longest background cycle, half CPU cycles
P_BASE: Final = 0x000024  # X
WATCHDOG_COUNT: Final = 0x000025  # X: lowest since power-up, Y: present
I10_REGISTER: Final = 0x000028  # X
TASK_TIME: Final = 0x000037  # X: phase, Y: servo interrupt tasks, half CPU cycles
HIGHEST_TABLE: Final = 0x000038
PHASE_INTERVAL: Final = 0x07FF8C  # X:$FFFF8C, kept where the memory has it: half CPU cycles
PROGRAM_END: Final = 0x00003E  # Y
DPRAM_END_REGISTER: Final = 0x00003F  # Y: last address + 1
GATHER_MASKS: Final = 0x001094  # X: I5050 at $1094, I5051 at $1095
GATHER_SOURCES: Final = 0x001096  # X: I5001..I5048
PROGRAM_TABLE: Final = 0x003000  # 224 entries, X number, Y storage address
PLC_TABLE: Final = 0x003100  # X execution address, Y storage (bit 22 disabled, bit 23 open)
GATHER_POINTERS: Final = 0x003120  # X start, Y storage pointer
ROTARY_POINTERS: Final = 0x003141
BLCOMP_POINTERS: Final = 0x003152
TCOMP_POINTERS: Final = 0x003172
COMP_POINTERS: Final = 0x003192
MEMORY_END: Final = 0x0031B2  # X: I4908
ECT_BASE: Final = 0x003501  # Y: I8000+k, X: result
ECT_LINES: Final = 192
M_DEFINITIONS: Final = 0x004000
P_VARIABLES: Final = 0x006000
Q_VARIABLES: Final = 0x008000
USER_BUFFER_START: Final = 0x00A000
USER_BUFFER_END_STANDARD: Final = 0x010800  # one past the last long word
DPRAM_GATHER_SIZE: Final = 0x06044F  # Y: size, X: storage pointer
DPRAM_GATHER_DATA: Final = 0x060450

# --- areas the map leaves free -----------------------------------------------------------------
INTERNAL_MOTOR: Final = 0x001100  # 64 X/Y pairs per motor, $1100-$18FF
INTERNAL_MOTOR_STEP: Final = 0x40
INTERNAL_GLOBAL: Final = 0x003200  # $3200-$32FF: I0-I99, one word each (X) where no home is known
INTERNAL_GATHER: Final = 0x0032F0  # X: I5000
INTERNAL_SERVO_IC: Final = 0x003340  # I7m00-I7m99 at +0..+99, X for IC 0, Y for IC 1


def motor_base(motor: int) -> int:
    """Return the address of the register block of motor 1..32."""
    return 0x80 * motor


def internal_motor(motor: int) -> int:
    """Return the address of the reserved block of motor 1..32."""
    return INTERNAL_MOTOR + INTERNAL_MOTOR_STEP * (motor - 1)


def cs_base(coordinate_system: int) -> int:
    """Return the address of the register block of coordinate system 1..16."""
    return 0x002000 + 0x100 * (coordinate_system - 1)


# --- motor block, offsets from motor_base -------------------------------------------------------
M_DESIRED_ACCELERATION: Final = 0x04
M_DESIRED_VELOCITY: Final = 0x06
M_COMMANDED: Final = 0x08  # D, 1/(32*Ixx08) count
M_IXX03_IXX08: Final = 0x09  # X Ixx03, Y Ixx08
M_IXX05: Final = 0x0A  # X Ixx05, Y previous source position
M_ACTUAL: Final = 0x0B  # D
M_IXX07: Final = 0x0C  # X Ixx07, Y previous master source
M_MASTER: Final = 0x0D  # D
M_TIMEBASE_POINTER: Final = 0x0E  # X pointer, Y servo extension timer
M_IXX32_IXX60: Final = 0x0F
M_COMPENSATION: Final = 0x10  # D
M_FOLLOWING_ERROR: Final = 0x11  # D
M_IXX31: Final = 0x12  # X
M_IXX35: Final = 0x13  # Y
M_IXX30: Final = 0x19  # Y
M_IXX64: Final = 0x1A  # Y; X previous desired velocity
M_IXX04_IXX67: Final = 0x1B  # X Ixx04, Y Ixx67
M_IXX65_IXX09: Final = 0x1C  # X Ixx65, Y Ixx09
M_VELOCITY: Final = 0x1D  # X actual velocity, Y previous velocity-loop source
M_INTEGRATOR: Final = 0x1E  # D
M_IXX33_IXX63: Final = 0x1F  # X Ixx33, Y Ixx63
M_IXX36: Final = 0x20  # Y
M_IXX37: Final = 0x21  # Y
M_IXX38: Final = 0x22  # Y
M_IXX39: Final = 0x23  # Y
M_PREVIOUS_NET: Final = 0x25  # D previous net commanded position
M_IXX92: Final = 0x2D  # Y
M_FILTER_RESULT: Final = 0x2E  # X; Y Ixx69 (24-bit form, value*256)
M_IXX69: Final = 0x2E  # Y
M_IXX25_IXX24: Final = 0x2F  # X Ixx25, Y Ixx24
M_STATUS1: Final = 0x30  # X
M_IXX68: Final = 0x31  # Y
M_IXX79_IXX29: Final = 0x33
M_IXX02: Final = 0x3E  # X
M_COMMAND: Final = 0x3F  # X servo command incl. bias (24-bit), Y torque-table bias
M_IXX11: Final = 0x40  # X
M_STATUS2: Final = 0x40  # Y
M_IXX22: Final = 0x41  # L
M_IXX19: Final = 0x42  # L
M_IXX21_IXX20: Final = 0x43
M_IXX15: Final = 0x44  # L
M_IXX28_IXX12: Final = 0x45
M_TARGET_VELOCITY: Final = 0x46  # D
M_TARGET: Final = 0x47  # D target (pre-jog) position
M_IXX16: Final = 0x4A  # L
M_IXX17: Final = 0x4B  # L
M_BIAS: Final = 0x4C  # D position bias
M_IXX26_IXX80: Final = 0x4D
M_HOME_CAPTURE: Final = 0x4E  # Y, counts
M_AXIS_SCALE: Final = 0x4F  # L +$4F..+$52
M_IXX88: Final = 0x53  # X in-position scans so far, Y Ixx88
M_JOG_VARIABLE: Final = 0x57  # L, counts
M_TRIGGER_CAPTURE: Final = 0x58  # Y
M_IXX57_IXX58: Final = 0x59
M_INTEGRATED_CURRENT: Final = 0x5A  # D
M_IXX23: Final = 0x5B  # L
M_IXX13: Final = 0x5C  # D
M_IXX14: Final = 0x5D  # D
M_IXX27: Final = 0x5E  # D
M_IXX85_IXX87: Final = 0x5F
M_BACKLASH_SAVED: Final = 0x60  # D
M_IXX86: Final = 0x61  # X; Y present backlash
M_IXX41: Final = 0x62  # X
M_VELOCITY_FILTERED: Final = 0x6F  # D
M_VELOCITY_HISTORY: Final = 0x70  # D +$70..+$7F

# --- reserved block, offsets from internal_motor ------------------------------------------------
R_IXX10_IXX95: Final = 0x00  # X Ixx10, Y Ixx95
R_IXX40: Final = 0x01  # X: 0..0.999999 with 23 fractional bits
R_IXX62_IXX90: Final = 0x02

# --- status word 1 (X:base+$30) -----------------------------------------------------------------
S1_ACTIVATED: Final = 1 << 23  # Ixx00
S1_NEGATIVE_LIMIT: Final = 1 << 22
S1_POSITIVE_LIMIT: Final = 1 << 21
S1_AMPLIFIER_ENABLED: Final = 1 << 19
S1_OPEN_LOOP: Final = 1 << 18
S1_MOVE_TIMER: Final = 1 << 17
S1_INTEGRATION_MODE: Final = 1 << 16  # Ixx34
S1_DWELL: Final = 1 << 15
S1_DESIRED_VELOCITY_ZERO: Final = 1 << 13
S1_ABORT_DECELERATION: Final = 1 << 12
S1_HOME_SEARCH: Final = 1 << 10
S1_USER_SERVO: Final = 1 << 8  # Ixx59 bit 0
S1_FOLLOWING_OFFSET: Final = 1 << 5  # Ixx06 bit 1
S1_FOLLOWING: Final = 1 << 4  # Ixx06 bit 0
S1_TRIGGER_ON_ERROR: Final = 1 << 3  # Ixx97 bit 1
S1_SOFTWARE_CAPTURE: Final = 1 << 2  # Ixx97 bit 0

# --- status word 2 (Y:base+$40) -----------------------------------------------------------------
S2_CS_SHIFT: Final = 20
S2_AXIS_SHIFT: Final = 16
S2_ASSIGNED: Final = 1 << 15
S2_HOMEZ: Final = 1 << 14
S2_FOREGROUND_IN_POSITION: Final = 1 << 13
S2_DESIRED_LIMIT_STOP: Final = 1 << 12
S2_LIMIT_STOP: Final = 1 << 11
S2_HOME_COMPLETE: Final = 1 << 10
S2_TRIGGER_MOVE: Final = 1 << 7
S2_INTEGRATED_ERROR: Final = 1 << 6
S2_I2T: Final = 1 << 5
S2_BACKLASH_DIRECTION: Final = 1 << 4
S2_AMPLIFIER_FAULT: Final = 1 << 3
S2_FATAL_ERROR: Final = 1 << 2
S2_WARNING_ERROR: Final = 1 << 1
S2_IN_POSITION: Final = 1 << 0

# --- coordinate-system block, offsets from cs_base ----------------------------------------------
C_TIMEBASE_COMMAND: Final = 0x00  # X commanded %, I10 units; Y Q-variable start
C_TIMEBASE_SOURCE: Final = 0x01  # X Isx93; Y hold mode (0 run, 1 feed hold)
C_TIMEBASE: Final = 0x02  # X present time base, I10 units
C_SLEWS: Final = 0x03  # X Isx95, Y Isx94
C_ISX88_ISX87: Final = 0x05
C_ISX89: Final = 0x06  # L
C_ISX90: Final = 0x07  # L
C_ISX98: Final = 0x10  # L
C_ERROR: Final = 0x14  # X calc time, Y run-time error code
C_TIMERS: Final = 0x15  # X Isx11, Y Isx12
C_STATUS2_ADDRESS: Final = 0x3F  # X execution address, Y status word 2 of ??
C_ISX91_BITS: Final = 0x3E  # X Isx91; Y bit 0 Isx50, 20 Isx53, 23 Isx92
C_STATUS13: Final = 0x40  # X status word 1, Y status word 3
C_TARGETS: Final = 0x41  # L +$41..+$49, A B C U V W X Y Z
C_INTERNAL: Final = 0x50  # +$50..+$BF: Isx without a known home

CS1_RUNNING: Final = 1 << 0
CS1_SINGLE_STEP: Final = 1 << 1
CS1_CONTINUOUS: Final = 1 << 2
CS1_TIMED: Final = 1 << 3
CS1_CONTINUOUS_REQUEST: Final = 1 << 4
CS1_RADIUS_INCREMENTAL: Final = 1 << 5
CS1_FIRST_INCREMENTAL_AXIS: Final = 1 << 6  # axis A; two bits further for the next letter
CS1_FIRST_FEED_AXIS: Final = 1 << 7
CS2_MODE0: Final = 1 << 0
CS2_MODE1: Final = 1 << 1
CS2_MODE4: Final = 1 << 4
CS2_ROTARY_FULL: Final = 1 << 16
CS2_RUNTIME_ERROR: Final = 1 << 22
CS3_RESUME_ERROR: Final = 1 << 2

# --- global status ------------------------------------------------------------------------------
G1_GATHERING: Final = 1 << 19
G1_GATHER_TRIGGER: Final = 1 << 17
G1_CHECKSUM: Final = 1 << 13
G1_FLASH_ERROR: Final = 1 << 10
G1_CONFIGURATION: Final = 1 << 7
G1_THIS_CARD: Final = 1 << 0
G2_MOTION_BUFFER_OPEN: Final = 1 << 19
G2_ROTARY_OPEN: Final = 1 << 18
G2_PLC_BUFFER_OPEN: Final = 1 << 17
G2_UMAC: Final = 1 << 16
G2_FIXED_BUFFER_FULL: Final = 1 << 11

# --- servo IC channels --------------------------------------------------------------------------
SERVO_IC_BASES: Final = (0x078000, 0x078100)
CHANNEL_STEP: Final = 0x08


def channel_base(channel: int) -> int:
    """Return the address of encoder channel 1..8 (servo ICs 0 and 1)."""
    ic, index = divmod(channel - 1, 4)
    return SERVO_IC_BASES[ic] + CHANNEL_STEP * index
