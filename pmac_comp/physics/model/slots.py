"""Places of the drive parameters in the flat vector that the compiled kernel reads.

What lives here: indices and their meaning. Neutral values (effect off) are zero unless
``neutral_vector`` says otherwise. Imports ``base`` only.
"""

import numpy as np

from pmac_comp.base.arrays import FloatArray

# Chain (SI). X_ORIGIN is the bearing-to-nut distance at table zero.
RIGID = 0  # 1: one mass, all coordinates follow the motor angle
LEAD = 1
X_ORIGIN = 2
LENGTH = 3
J_MOTOR = 4  # rotor with its half of the coupling
J_COUPLING = 5  # screw-side half of the coupling
J_SCREW = 6
M_SCREW = 7
M_TABLE = 8
K_COUPLING = 9
GJ = 10
K_BEARING = 11
K_NUT = 12
EA = 13
BETA = 14  # structural damping time: c = BETA k
RIGID_MASS = 15

# Actuator
PERIOD = 20
CURRENT_RATE = 21  # rad/s; 0 means an ideal current loop
DELAY = 22
ACTUATOR_LIMIT = 23

# Friction sites: guide (table), nut (screw), motor. Four slots each.
GUIDE = 30
NUT = 34
MOTOR = 38
LEVEL, BREAK, BRISTLE, VISCOUS = 0, 1, 2, 3
NUT_LOAD = 42  # mu_e: torque share of rho |F| that opposes the rotation
STRIBECK_GUIDE = 43
STRIBECK_NUT = 44
STRIBECK_MOTOR = 45
STRIBECK_SPEED = 46  # m/s at the table
POWER_FORCE = 47  # N at 1 m/s of the nonlinear viscous term
POWER_EXPONENT = 48
ASYMMETRY_VISCOUS = 49
ASYMMETRY_SLIDING = 50
PER_REV = 51  # amplitude, order, phase
DIP = 54
DIP_LENGTH = 55  # rad at the nut
WARMUP = 56
WARMUP_TIME = 57
GMS_N = 58
GMS = 60  # weight and break distance of up to 8 elements: 60..75
ASYMMETRY_ROTARY = 76
SMOOTH_GUIDE = 77  # m/s over which friction turns over; 0 means at once
SMOOTH_ROTARY = 78  # rad/s, of nut and motor

# Other torques and forces
COGGING = 80  # amplitude, order, phase
RIPPLE = 83  # fraction of the torque, order, phase
BIAS = 86  # force on the table, positive resists positive motion
CABLE_K = 87
CABLE_CENTRE = 88
EXTERNAL = 89  # amplitude, rad/s, phase; positive pushes against positive motion
BASE_MASS = 92
BASE_OMEGA = 93
BASE_ZETA = 94

# Joint
GAP_HALF = 96
SOFT_HALF = 97
SOFT_RATIO = 98
HERTZ = 99  # 1 / (36 F0^2)

# Kinematics and sensors
WOBBLE = 100  # amplitude, order, phase
ECCENTRICITY = 103  # amplitude, order, phase
LEAD_SLOPE = 106
SCALE_SLOPE = 107
GROWTH = 108
GROWTH_TIME = 109
SUBDIVISION = 110  # amplitude, rad/m, phase
SKEW = 113  # scale sample older than encoder sample by this time
MOTOR_STEP = 114  # encoder resolution at the table; 0 means none
TABLE_STEP = 115
TORQUE_STEP = 116

# Controller: 0 PID (pmac, si), 1 cascade
LAW = 120
KP = 121
KI = 122
KD = 123
KVFF = 124
KAFF = 125
FILTER = 126
FRICTION_FF = 127
OFFSET = 128
LIMIT = 129
FE_LIMIT = 130
INTEGRATOR_LIMIT = 131
INTEGRATE_AT_REST = 132
FREEZE_ALWAYS = 133  # 1: any saturation freezes the integrator; 0: only in direction of error
NOTCH = 134  # N1 N2 D1 D2
CASCADE_KP = 138
CASCADE_GAIN = 139  # N m per m/s
START_TORQUE = 140  # N m that the integrator holds when the run begins, later beside the law
START_ERROR = 141  # m by which the motor is behind the command when the run begins
START_SPEED = 142  # m/s of command and axis when the run begins
START = slice(START_TORQUE, START_SPEED + 1)

N_SLOTS = 144

# Table terms: columns of the description of one term.
(
    TERM_COORDINATE,
    TERM_SITE,
    TERM_FACTOR,
    TERM_START,
    TERM_STEP,
    TERM_COUNT,
    TERM_PERIOD,
) = range(7)
TERM_COLUMNS = 7


def neutral_vector() -> FloatArray:
    """Parameter vector with every effect off, shape (N_SLOTS,)."""
    vector = np.zeros(N_SLOTS)
    for index, value in {
        ACTUATOR_LIMIT: 1e300,
        LIMIT: 1e300,
        FE_LIMIT: 1e300,
        INTEGRATOR_LIMIT: 1e300,
        STRIBECK_SPEED: 1.0,
        POWER_EXPONENT: 1.0,
        DIP_LENGTH: 1.0,
        WARMUP_TIME: 1.0,
        GROWTH_TIME: 1.0,
        SOFT_RATIO: 1.0,
        FILTER: 1.0,
    }.items():
        vector[index] = value
    return vector
