"""Compiled time stepping of the four-degree-of-freedom ball-screw drive.

What lives here: the layout of the parameter and state vectors and one function that advances the
drive by one servo period. What may not: where the figures come from (``ballscrew``, ``effects``).
Imports numba only, and shares nothing with the model that is fitted to the data of this plant.

Generalised coordinates (SI): motor angle, screw angle at the nut, axial displacement of the screw
at the nut, table position. The nut joint couples them by one deflection
``delta = table - (lead * screw_angle + lead_error + screw_axial)``, which carries the torque
transmission too. Integration is leapfrog in the elastic part (velocities live half a fine step
behind the positions) with an unconditionally stable update of the friction bristles, so that a
standing axis truly sticks.

Two grids: friction levels, torque ripple and lead error change slowly and are renewed on
``P_N_COARSE`` points of a servo period; elasticity, bristles and current loop run on the fine grid.
"""

import math

import numpy as np
from numba import njit

from pmac_comp.base.arrays import FloatArray

(
    P_PERIOD,  # servo period, s
    P_N_COARSE,
    P_N_FINE,  # fine steps per coarse step
    P_LEAD,  # m/rad
    P_ORIGIN,  # bearing-to-nut distance at table zero, m
    P_LENGTH,  # screw length, m
    P_J_MOTOR,  # rotor and motor-side half of the coupling, kg m2
    P_J_COUPLING,  # screw-side half of the coupling, kg m2
    P_J_SCREW,  # whole screw, kg m2
    P_M_SCREW,  # whole screw, kg
    P_M_TABLE,  # kg, payload included
    P_K_COUPLING,  # N m/rad
    P_GJ,  # N m2/rad
    P_K_BEARING,  # N/m
    P_EA,  # N
    P_K_NUT,  # N/m
    P_BETA,  # s, structural damping c = beta k
    P_BANDWIDTH,  # rad/s of the current loop
    P_DELAY,  # s
    P_LIMIT,  # N m
    P_MOTOR_LEVEL,  # Coulomb torque at the motor, N m
    P_MOTOR_BREAK,  # bristle distance, rad
    P_MOTOR_VISCOUS,  # N m s/rad
    P_NUT_LEVEL,
    P_NUT_BREAK,
    P_NUT_VISCOUS,
    P_NUT_LOAD,  # load-dependent share, N m per N
    P_GUIDE_LEVEL,  # N
    P_GUIDE_BREAK,  # m
    P_GUIDE_VISCOUS,  # N s/m
    P_MOTOR_BRISTLE,  # 0 elastic-plastic (sharp stick), 1 LuGre
    P_NUT_BRISTLE,
    P_GUIDE_BRISTLE,  # 0 sharp, 1 LuGre, 2 Maxwell-slip elements with non-local memory
    P_MOTOR_DAMPING,  # bristle damping, N m s/rad
    P_NUT_DAMPING,
    P_GUIDE_DAMPING,
    P_STRIBECK_N,
    P_STRIBECK_NM,  # at the nut
    P_STRIBECK_MOTOR,
    P_STRIBECK_SPEED,  # m/s of the table
    P_SQRT_N,  # N per (m/s)^exponent
    P_SQRT_EXPONENT,
    P_ASYM_VISCOUS,
    P_ASYM_SLIDING,
    P_ASYM_ROTARY,  # viscous torque of nut and motor
    P_FPR_NM,
    P_FPR_ORDER,
    P_FPR_PHASE,
    P_DIP,
    P_DIP_LENGTH,
    P_WARM,
    P_WARM_TAU,
    P_COG_NM,
    P_COG_ORDER,
    P_COG_PHASE,
    P_RIPPLE,  # fraction of the torque
    P_RIPPLE_ORDER,
    P_RIPPLE_PHASE,
    P_BIAS,
    P_CABLE_K,
    P_CABLE_X,
    P_GAP,  # half of the clearance, m
    P_SOFT_HALF,  # half width of the soft zone of a nut without preload, m
    P_SOFT_RATIO,
    P_HERTZ,  # preload of a double nut, N; 0 = linear
    P_BASE_MASS,  # kg; 0 = rigid base
    P_BASE_K,
    P_BASE_C,
    P_LEAD_SLOPE,  # m/m
    P_WOBBLE,
    P_WOBBLE_ORDER,
    P_WOBBLE_PHASE,
    P_GROWTH,  # m/m at the end
    P_GROWTH_TAU,
    P_ECC,  # m at the table
    P_ECC_ORDER,
    P_ECC_PHASE,
    P_SDE,
    P_SDE_PERIOD,
    P_SDE_PHASE,
    P_SCALE_SLOPE,
    P_SKEW,  # s
    P_FORCE,
    P_FORCE_OMEGA,
    P_FORCE_PHASE,
    P_STOP_LOW,  # table position where the mechanical stops begin, m
    P_STOP_HIGH,
    P_STOP_K,  # N/m; 0 = no stops
    P_STOP_C,  # N s/m
    N_PARAMETERS,
) = range(90)

# Maxwell-slip elements of the guide (GMS without the slip transient): break-away distances and
# shares of the level; at the stated distance 63 % of the level are built up.
_GMS_DISTANCE = (0.2, 0.5, 0.9, 1.4, 2.2, 3.5)
_GMS_SHARE = (0.06, 0.10, 0.14, 0.20, 0.25, 0.25)
_GMS = 6

_ONE_HALF_FREE = math.sqrt(8.0)  # force per preload at which one half of a double nut carries none

_HISTORY = 32
(
    S_ANGLE_READ,  # rad, what the encoder sees
    S_TABLE_READ,  # m, what the scale sees
    S_TH_MOTOR,
    S_W_MOTOR,
    S_TH_SCREW,
    S_W_SCREW,
    S_AXIAL,
    S_V_AXIAL,
    S_TABLE,
    S_V_TABLE,
    S_BASE,
    S_V_BASE,
    S_TORQUE,
    S_Z_MOTOR,
    S_Z_NUT,
    S_Z_GUIDE,
    S_TIME,
    S_DIRECTION,
    S_TURN,  # screw angle at the last reversal, rad
    S_EXTREME,  # farthest screw angle since then, rad
    S_EXTERNAL,  # N, positive pushes against positive motion
    S_CYCLE,
    S_WOBBLE_ZERO,
    S_RECORDED,
    S_NUT_FORCE,  # N, at the end of the last period
    S_HISTORY,
) = range(26)
S_GMS = S_HISTORY + _HISTORY
N_STATES = S_GMS + _GMS
_STOP_NEAR_m = 2e-3
# A part of the time step that allocates nothing: inlined, and without counts of references to its
# arrays, which are atomic.
_part = njit(cache=True, _nrt=False, forceinline=True)
# Hysteresis of the reversal detector: well below any dip length, above round-off.
_TURN_RAD = 1e-4


@njit(cache=True)
def _warm(par: FloatArray, time_s: float) -> float:
    """Factor of the friction levels after ``time_s`` of running."""
    if par[P_WARM] == 0.0:
        return 1.0
    return float(1.0 - par[P_WARM] * (1.0 - math.exp(-time_s / par[P_WARM_TAU])))


@njit(cache=True)
def lead_error(par: FloatArray, angle_rad: float, time_s: float) -> tuple[float, float]:
    """Static error of the nut position in m and its derivative by the angle in m/rad."""
    rho = par[P_LEAD]
    nut_m = rho * angle_rad
    slope = par[P_LEAD_SLOPE]
    error_m = slope * nut_m
    if par[P_GROWTH] != 0.0:
        # Growth starts at the thrust bearing.
        grown = par[P_GROWTH] * (1.0 - math.exp(-time_s / par[P_GROWTH_TAU]))
        error_m += grown * (par[P_ORIGIN] + nut_m)
        slope += grown
    per_rad = slope * rho
    if par[P_WOBBLE] != 0.0:
        order = par[P_WOBBLE_ORDER]
        phase = order * angle_rad + par[P_WOBBLE_PHASE]
        error_m += par[P_WOBBLE] * (math.cos(phase) - math.cos(par[P_WOBBLE_PHASE]))
        per_rad -= par[P_WOBBLE] * order * math.sin(phase)
    return error_m, per_rad


@njit(cache=True)
def _stop_force(par: FloatArray, table_m: float, speed: float) -> float:
    """Force of the stops at the ends of the travel, which only push the table back, in N."""
    if table_m > par[P_STOP_HIGH]:
        force = par[P_STOP_K] * (table_m - par[P_STOP_HIGH]) + par[P_STOP_C] * speed
        return float(-max(force, 0.0))
    if table_m < par[P_STOP_LOW]:
        force = par[P_STOP_K] * (par[P_STOP_LOW] - table_m) - par[P_STOP_C] * speed
        return float(max(force, 0.0))
    return 0.0


@njit(cache=True)
def _track_reversal(state: FloatArray) -> None:
    """Remember where the screw turned last; the farthest point decides, with a hysteresis."""
    angle = state[S_TH_SCREW]
    way = state[S_DIRECTION]
    if way == 0.0:
        # Fresh from reset: the first motion counts as motion away from a reversal here.
        if abs(angle - state[S_EXTREME]) > _TURN_RAD:
            state[S_DIRECTION] = 1.0 if angle > state[S_EXTREME] else -1.0
            state[S_EXTREME] = angle
    elif (angle - state[S_EXTREME]) * way > 0.0:
        state[S_EXTREME] = angle
    elif (state[S_EXTREME] - angle) * way > _TURN_RAD:
        state[S_TURN] = state[S_EXTREME]
        state[S_EXTREME] = angle
        state[S_DIRECTION] = -way


@njit(cache=True)
def _read_sensors(state: FloatArray, par: FloatArray) -> None:
    """Encoder and scale readings from the true state."""
    angle = state[S_TH_MOTOR]
    if par[P_ECC] != 0.0:
        phase = par[P_ECC_PHASE]
        angle += (
            par[P_ECC]
            / par[P_LEAD]
            * (math.cos(par[P_ECC_ORDER] * angle + phase) - math.cos(phase))
        )
    # A positive skew means that the scale sample is older than the encoder sample.
    table = state[S_TABLE] - par[P_SKEW] * state[S_V_TABLE]
    true_m = table
    table += par[P_SCALE_SLOPE] * true_m
    if par[P_SDE] != 0.0:
        phase = par[P_SDE_PHASE]
        table += par[P_SDE] * (
            math.cos(2.0 * math.pi * true_m / par[P_SDE_PERIOD] + phase) - math.cos(phase)
        )
    state[S_ANGLE_READ] = angle
    state[S_TABLE_READ] = table


@njit(cache=True)
def ballscrew_reset(state: FloatArray, par: FloatArray, table_m: float) -> None:
    """Relaxed drive at rest with the nut at ``table_m``; keeps nothing of the past."""
    external = state[S_EXTERNAL]
    recorded = state[S_RECORDED]
    state[:] = 0.0
    state[S_EXTERNAL] = external
    state[S_RECORDED] = recorded
    angle = table_m / par[P_LEAD]
    state[S_TH_MOTOR] = angle
    state[S_TH_SCREW] = angle
    state[S_TURN] = angle
    state[S_EXTREME] = angle
    error_m, _ = lead_error(par, angle, 0.0)
    state[S_TABLE] = table_m + error_m
    _read_sensors(state, par)


@_part
def _delayed_commands(
    state: FloatArray, par: FloatArray, command: float
) -> tuple[float, float, float]:
    """Newer and older command of a delay, and the time in this period of the switch between them.

    Transport delay: whole cycles from the ring, the rest as a switch inside the period.
    """
    cycle = int(state[S_CYCLE])
    state[S_HISTORY + cycle % _HISTORY] = command
    delay_cycles = par[P_DELAY] / par[P_PERIOD]
    whole = int(delay_cycles)
    newer = 0.0
    older = 0.0
    if cycle - whole >= 0:
        newer = state[S_HISTORY + (cycle - whole) % _HISTORY]
    if cycle - whole - 1 >= 0:
        older = state[S_HISTORY + (cycle - whole - 1) % _HISTORY]
    return newer, older, (delay_cycles - whole) * par[P_PERIOD]


@_part
def _chain(par: FloatArray, angle_rad: float) -> tuple[float, float, float, float, float, float]:
    """Stiffnesses and consistent masses of the chain with the nut at ``angle_rad``.

    Torsional and axial stiffness, the inverse of the rotary mass matrix (11, 12, 22), and the
    inverse of the screw's axial mass.
    """
    x = par[P_ORIGIN] + par[P_LEAD] * angle_rad
    x = min(max(x, 1e-3), par[P_LENGTH])
    c_coupling = 1.0 / par[P_K_COUPLING]
    c_torsion = c_coupling + x / par[P_GJ]
    share = c_coupling / c_torsion
    c_axial = 1.0 / par[P_K_BEARING] + x / par[P_EA]
    near = x / par[P_LENGTH]
    j_near = par[P_J_SCREW] * near
    j_c = par[P_J_COUPLING]
    m11 = par[P_J_MOTOR] + (j_near / 3.0 + j_c) * (1.0 - share) ** 2
    m12 = (1.0 - share) * (j_near / 3.0 * (share + 0.5) + j_c * share)
    m22 = par[P_J_SCREW] * (1.0 - near) + j_near / 3.0 * (share * share + share + 1.0)
    m22 += j_c * share * share
    det = m11 * m22 - m12 * m12
    b = 1.0 / (par[P_K_BEARING] * c_axial)
    m_axial = par[P_M_SCREW] * (near / 3.0 * (b * b + b + 1.0) + 1.0 - near)
    return 1.0 / c_torsion, 1.0 / c_axial, m22 / det, -m12 / det, m11 / det, 1.0 / m_axial


@_part
def _friction_levels(
    state: FloatArray, par: FloatArray, angle_rad: float, speed_m_per_s: float, nut_force_N: float
) -> tuple[float, float, float]:
    """Coulomb levels of motor (N m), nut (N m) and guide (N), one value a coarse step."""
    warm = _warm(par, state[S_TIME])
    motor = par[P_MOTOR_LEVEL] * warm
    nut = par[P_NUT_LEVEL]
    if par[P_FPR_NM] != 0.0:
        nut += par[P_FPR_NM] * math.cos(par[P_FPR_ORDER] * angle_rad + par[P_FPR_PHASE])
    if par[P_DIP] != 0.0:
        travelled = par[P_LEAD] * abs(angle_rad - state[S_TURN])
        nut *= 1.0 - par[P_DIP] * math.exp(-travelled / par[P_DIP_LENGTH])
    guide = par[P_GUIDE_LEVEL]
    if abs(speed_m_per_s) < 6.0 * par[P_STRIBECK_SPEED]:
        bump = math.exp(-((speed_m_per_s / par[P_STRIBECK_SPEED]) ** 2))
        guide += par[P_STRIBECK_N] * bump
        nut += par[P_STRIBECK_NM] * bump
        motor += par[P_STRIBECK_MOTOR] * warm * bump
    nut *= warm
    guide *= warm
    nut += par[P_NUT_LOAD] * abs(nut_force_N)
    return max(motor, 1e-9), max(nut, 1e-6), max(guide, 1e-6)


@_part
def _viscous(
    par: FloatArray, speed_m_per_s: float, screw_rad_per_s: float
) -> tuple[float, float, float]:
    """Viscous coefficients of motor, nut and guide; a slowly varying law is linearised here."""
    turning = 1.0 + par[P_ASYM_ROTARY] * (1.0 if screw_rad_per_s >= 0.0 else -1.0)
    uneven = par[P_ASYM_VISCOUS] + par[P_ASYM_SLIDING]
    forward = 1.0 if speed_m_per_s >= 0.0 else -1.0
    guide = par[P_GUIDE_VISCOUS] * (1.0 + uneven * forward)
    speed = abs(speed_m_per_s)
    if par[P_SQRT_N] != 0.0 and speed > 0.0:
        root = par[P_SQRT_N] * speed ** (par[P_SQRT_EXPONENT] - 1.0)
        guide += min(root, 5.0e4)
    return par[P_MOTOR_VISCOUS] * turning, par[P_NUT_VISCOUS] * turning, guide


@_part
def _motor_waves(par: FloatArray, angle_rad: float) -> tuple[float, float]:
    """Cogging torque in N m, and the factor of torque ripple."""
    cog = 0.0
    if par[P_COG_NM] != 0.0:
        cog = par[P_COG_NM] * math.cos(par[P_COG_ORDER] * angle_rad + par[P_COG_PHASE])
    ripple = 1.0
    if par[P_RIPPLE] != 0.0:
        ripple += par[P_RIPPLE] * math.cos(par[P_RIPPLE_ORDER] * angle_rad + par[P_RIPPLE_PHASE])
    return cog, ripple


@_part
def _table_load(state: FloatArray, par: FloatArray, table_m: float) -> float:
    """Force on the table from outside, in N."""
    load = -par[P_BIAS] - state[S_EXTERNAL] - par[P_CABLE_K] * (table_m - par[P_CABLE_X])
    if par[P_FORCE] != 0.0:
        load -= par[P_FORCE] * math.sin(par[P_FORCE_OMEGA] * state[S_TIME] + par[P_FORCE_PHASE])
    return float(load)


@_part
def _hertzian(linear_N: float, preload_N: float) -> float:
    """Force F of a double nut that a linear one of stiffness k would press with ``linear_N``.

    It has k (1 - (F / F0)^2 / 36) up to 2.83 F0, and from there on half of k.
    """
    all_N = 9.0 / 7.0 * _ONE_HALF_FREE * preload_N  # linear, where F is 2.83 F0
    push_N = min(abs(linear_N), all_N)
    force_N = 2.0 * push_N / (1.0 + math.sqrt(1.0 + (push_N / (3.0 * preload_N)) ** 2))
    return math.copysign(force_N + 0.5 * (abs(linear_N) - push_N), linear_N)


@_part
def _nut_force(par: FloatArray, delta_m: float, closing_m_per_s: float) -> float:
    """Force of the nut joint: clearance, a soft zone, Hertzian contact, damping."""
    k_nut = par[P_K_NUT]
    beta = par[P_BETA]
    gap = par[P_GAP]
    soft = par[P_SOFT_HALF]
    hertz = par[P_HERTZ]
    if not (gap > 0.0 or soft > 0.0 or hertz > 0.0):
        return float(k_nut * (delta_m + beta * closing_m_per_s))
    stretch = delta_m
    damp = 1.0
    if gap > 0.0:
        if delta_m > gap:
            stretch = delta_m - gap
        elif delta_m < -gap:
            stretch = delta_m + gap
        else:
            stretch = 0.0
            damp = 0.0
    if soft > 0.0:
        ratio = par[P_SOFT_RATIO]
        if stretch > soft:
            stretch -= soft * (1.0 - ratio)
        elif stretch < -soft:
            stretch += soft * (1.0 - ratio)
        else:
            stretch *= ratio
            damp = min(damp, ratio)
    force = k_nut * stretch
    if hertz > 0.0:
        force = _hertzian(force, hertz)
    return float(force + damp * k_nut * beta * closing_m_per_s)


@_part
def _bent(z: float, move: float, low: float, high: float, is_lugre: bool) -> float:  # noqa: FBT001
    """Deflection of a bristle after ``move``: stable for any speed."""
    if is_lugre:
        return (z + move) / (1.0 + abs(move) / high)
    return min(max(z + move, -low), high)


@_part
def _rub(
    z: float,
    bending: float,
    dt: float,
    stiffness: float,
    damping: float,
    low: float,
    high: float,
    is_lugre: bool,  # noqa: FBT001
) -> float:
    """Force of a bristle bent by ``z``, ``bending`` of it in the last ``dt``.

    The sharp form is an elastic-plastic return map whose damping, there to let a stuck axis come
    to rest, never adds to the level.
    """
    force = stiffness * z + damping * bending / dt
    return force if is_lugre else min(max(force, -low), high)


@_part
def _maxwell_slip(
    state: FloatArray,
    par: FloatArray,
    move: float,
    dt: float,
    stiffness: float,
    low: float,
    high: float,
) -> float:
    """Force of the guide's Maxwell-slip elements, whose deflections move on."""
    force = 0.0
    for e in range(_GMS):
        part = _GMS_DISTANCE[e]
        old = state[S_GMS + e]
        z = min(max(old + move, -part * low), part * high)
        force += _GMS_SHARE[e] * (stiffness * z / part + par[P_GUIDE_DAMPING] * (z - old) / dt)
        state[S_GMS + e] = z
    return force


@_part
def _record(state: FloatArray, par: FloatArray, log: FloatArray) -> None:
    """End a period: count it, read the sensors, keep the true values."""
    state[S_CYCLE] += 1.0
    _read_sensors(state, par)
    if log.shape[0] > 0:
        row = int(state[S_RECORDED]) % log.shape[0]
        log[row, 0] = state[S_CYCLE]
        log[row, 1] = par[P_LEAD] * state[S_TH_MOTOR]
        log[row, 2] = state[S_TABLE]
        log[row, 3] = state[S_TORQUE]
        state[S_RECORDED] += 1.0


@njit(cache=True)
def ballscrew_step(
    state: FloatArray, par: FloatArray, log: FloatArray, torque_command: float
) -> None:
    """Advance the drive by one servo period with the torque command held.

    Parameters
    ----------
    state, par : ndarray
        Layout of this module. ``state[S_ANGLE_READ]`` and ``state[S_TABLE_READ]`` are the sensor
        readings latched at the end of the period.
    log : ndarray, shape (n, 4)
        Ring of true values (cycle, motor position m, table position m, shaft torque N m);
        shape (0, 4) records nothing.
    torque_command : float
        Torque command in N m, before the limit of the drive.
    """
    n_coarse = int(par[P_N_COARSE])
    n_fine = int(par[P_N_FINE])
    dt = par[P_PERIOD] / (n_coarse * n_fine)
    rho = par[P_LEAD]
    beta = par[P_BETA]
    command = min(max(torque_command, -par[P_LIMIT]), par[P_LIMIT])
    newer, older, switch_s = _delayed_commands(state, par, command)
    lag = 1.0 - math.exp(-dt * par[P_BANDWIDTH])
    k_th, k_ax, i11, i12, i22, inv_m_axial = _chain(par, state[S_TH_SCREW])
    inv_m_table = 1.0 / par[P_M_TABLE]
    flexible_base = par[P_BASE_MASS] > 0.0
    # Looked at once per period: no table covers a millimetre in it.
    free = par[P_STOP_LOW] + _STOP_NEAR_m < state[S_TABLE] < par[P_STOP_HIGH] - _STOP_NEAR_m
    stops = par[P_STOP_K] > 0.0 and not free
    # Bristle stiffness belongs to the cold Coulomb level; the level itself may vary.
    sigma_m = par[P_MOTOR_LEVEL] / par[P_MOTOR_BREAK]
    sigma_n = par[P_NUT_LEVEL] / par[P_NUT_BREAK]
    sigma_g = par[P_GUIDE_LEVEL] / par[P_GUIDE_BREAK]
    lugre_m = par[P_MOTOR_BRISTLE] > 0.5
    lugre_n = par[P_NUT_BRISTLE] > 0.5
    lugre_g = par[P_GUIDE_BRISTLE] == 1.0
    gms_g = par[P_GUIDE_BRISTLE] == 2.0

    th_m = state[S_TH_MOTOR]
    w_m = state[S_W_MOTOR]
    th_s = state[S_TH_SCREW]
    w_s = state[S_W_SCREW]
    u = state[S_AXIAL]
    v_u = state[S_V_AXIAL]
    xt = state[S_TABLE]
    v = state[S_V_TABLE]
    xb = state[S_BASE]
    v_b = state[S_V_BASE]
    torque = state[S_TORQUE]
    z_m = state[S_Z_MOTOR]
    z_n = state[S_Z_NUT]
    z_g = state[S_Z_GUIDE]
    f_n = state[S_NUT_FORCE]
    elapsed = 0.0
    for _ in range(n_coarse):
        state[S_TH_SCREW] = th_s
        _track_reversal(state)
        motor_level, nut_level, guide_level = _friction_levels(state, par, th_s, v, f_n)
        motor_viscous, nut_viscous, guide_viscous = _viscous(par, v, w_s)
        cog, ripple = _motor_waves(par, th_m)
        load = _table_load(state, par, xt)
        static_m, per_rad = lead_error(par, th_s, state[S_TIME])
        anchor = th_s
        arm = rho + per_rad
        end_m = motor_level / sigma_m
        end_n = nut_level / sigma_n
        forward = 1.0 if v >= 0.0 else -1.0
        end_g = guide_level / sigma_g * (1.0 + par[P_ASYM_SLIDING] * forward)
        # At rest the guide holds as much in either direction as it slides with in that one.
        end_low = guide_level / sigma_g * (1.0 - par[P_ASYM_SLIDING])
        end_high = guide_level / sigma_g * (1.0 + par[P_ASYM_SLIDING])
        low_N, high_N = sigma_g * end_low, sigma_g * end_high
        end_over = end_g if lugre_g else end_high
        for _ in range(n_fine):
            t_k = k_th * (th_m - th_s + beta * (w_m - w_s))
            delta = xt - (rho * th_s + static_m + per_rad * (th_s - anchor) + u)
            f_n = _nut_force(par, delta, v - arm * w_s - v_u)

            z_old, z_m = z_m, _bent(z_m, w_m * dt, end_m, end_m, lugre_m)
            damping = par[P_MOTOR_DAMPING]
            t_fm = _rub(z_m, z_m - z_old, dt, sigma_m, damping, motor_level, motor_level, lugre_m)
            z_old, z_n = z_n, _bent(z_n, w_s * dt, end_n, end_n, lugre_n)
            damping = par[P_NUT_DAMPING]
            t_fn = _rub(z_n, z_n - z_old, dt, sigma_n, damping, nut_level, nut_level, lugre_n)
            f_g = guide_viscous * v
            if gms_g:
                f_g += _maxwell_slip(state, par, v * dt, dt, sigma_g, end_low, end_high)
            else:
                z_old, z_g = z_g, _bent(z_g, v * dt, end_low, end_over, lugre_g)
                damping = par[P_GUIDE_DAMPING]
                f_g += _rub(z_g, z_g - z_old, dt, sigma_g, damping, low_N, high_N, lugre_g)

            r1 = torque * ripple + cog - t_k - t_fm - motor_viscous * w_m
            r2 = t_k + arm * f_n - t_fn - nut_viscous * w_s
            bearing = k_ax * (u + beta * v_u)
            a_u = (f_n - bearing) * inv_m_axial
            a_t = (load - f_n - f_g) * inv_m_table
            if stops:
                a_t += _stop_force(par, xt, v) * inv_m_table
            if flexible_base:
                a_b = bearing + f_g - par[P_BASE_K] * xb - par[P_BASE_C] * v_b
                a_b /= par[P_BASE_MASS]
                a_u -= a_b
                a_t -= a_b
                v_b += dt * a_b
                xb += dt * v_b
            # The current loop moves on after its torque was used: leapfrog takes forces at the
            # start of the step. A delay that ends within a step switches there, not at its edge.
            before = min(max((switch_s - elapsed) / dt, 0.0), 1.0)
            drive = before * older + (1.0 - before) * newer
            torque += lag * (drive - torque)
            elapsed += dt
            w_m += dt * (i11 * r1 + i12 * r2)
            w_s += dt * (i12 * r1 + i22 * r2)
            v_u += dt * a_u
            v += dt * a_t
            th_m += dt * w_m
            th_s += dt * w_s
            u += dt * v_u
            xt += dt * v
        state[S_TIME] += n_fine * dt

    state[S_TH_MOTOR] = th_m
    state[S_W_MOTOR] = w_m
    state[S_TH_SCREW] = th_s
    state[S_W_SCREW] = w_s
    state[S_AXIAL] = u
    state[S_V_AXIAL] = v_u
    state[S_TABLE] = xt
    state[S_V_TABLE] = v
    state[S_BASE] = xb
    state[S_V_BASE] = v_b
    state[S_TORQUE] = torque
    state[S_Z_MOTOR] = z_m
    state[S_Z_NUT] = z_n
    state[S_NUT_FORCE] = f_n
    state[S_Z_GUIDE] = z_g
    _record(state, par, log)


@njit(cache=True)
def ballscrew_run(
    state: FloatArray, par: FloatArray, log: FloatArray, torque: FloatArray, out: FloatArray
) -> None:
    """Open-loop run: ``out[k]`` = (angle, table) latched at the end of period ``k``."""
    for k in range(torque.shape[0]):
        ballscrew_step(state, par, log, torque[k])
        out[k, 0] = state[S_ANGLE_READ]
        out[k, 1] = state[S_TABLE_READ]


def empty_log() -> FloatArray:
    """Log that records nothing."""
    return np.zeros((0, 4))
