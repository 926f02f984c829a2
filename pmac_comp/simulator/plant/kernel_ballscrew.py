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
    limit = par[P_LIMIT]
    command = min(max(torque_command, -limit), limit)

    # Transport delay: whole cycles from the ring, the rest as a switch inside the period.
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
    switch_s = (delay_cycles - whole) * par[P_PERIOD]
    lag = 1.0 - math.exp(-dt * par[P_BANDWIDTH])

    # Position-dependent elasticity and consistent masses, once per period.
    x = par[P_ORIGIN] + rho * state[S_TH_SCREW]
    x = min(max(x, 1e-3), par[P_LENGTH])
    c_coupling = 1.0 / par[P_K_COUPLING]
    c_torsion = c_coupling + x / par[P_GJ]
    k_th = 1.0 / c_torsion
    share = c_coupling / c_torsion
    c_axial = 1.0 / par[P_K_BEARING] + x / par[P_EA]
    k_ax = 1.0 / c_axial
    near = x / par[P_LENGTH]
    j_near = par[P_J_SCREW] * near
    j_c = par[P_J_COUPLING]
    m11 = par[P_J_MOTOR] + (j_near / 3.0 + j_c) * (1.0 - share) ** 2
    m12 = (1.0 - share) * (j_near / 3.0 * (share + 0.5) + j_c * share)
    m22 = par[P_J_SCREW] * (1.0 - near) + j_near / 3.0 * (share * share + share + 1.0)
    m22 += j_c * share * share
    det = m11 * m22 - m12 * m12
    i11 = m22 / det
    i12 = -m12 / det
    i22 = m11 / det
    b = 1.0 / (par[P_K_BEARING] * c_axial)
    m_axial = par[P_M_SCREW] * (near / 3.0 * (b * b + b + 1.0) + 1.0 - near)
    inv_m_axial = 1.0 / m_axial
    inv_m_table = 1.0 / par[P_M_TABLE]
    k_nut = par[P_K_NUT]
    gap = par[P_GAP]
    soft = par[P_SOFT_HALF]
    hertz = par[P_HERTZ]
    nonlinear_nut = gap > 0.0 or soft > 0.0 or hertz > 0.0
    flexible_base = par[P_BASE_MASS] > 0.0
    # Looked at once per period: no table covers a millimetre in it.
    free = par[P_STOP_LOW] + _STOP_NEAR_m < state[S_TABLE] < par[P_STOP_HIGH] - _STOP_NEAR_m
    stops = par[P_STOP_K] > 0.0 and not free

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
    time = state[S_TIME]
    f_n = state[S_NUT_FORCE]

    # Bristle stiffness belongs to the cold Coulomb level; the level itself may vary.
    sigma_m = par[P_MOTOR_LEVEL] / par[P_MOTOR_BREAK]
    sigma_n = par[P_NUT_LEVEL] / par[P_NUT_BREAK]
    sigma_g = par[P_GUIDE_LEVEL] / par[P_GUIDE_BREAK]
    lugre_m = par[P_MOTOR_BRISTLE] > 0.5
    lugre_n = par[P_NUT_BRISTLE] > 0.5
    lugre_g = par[P_GUIDE_BRISTLE] == 1.0
    gms_g = par[P_GUIDE_BRISTLE] == 2.0
    z_e = state[S_GMS : S_GMS + _GMS]
    elapsed = 0.0
    for _ in range(n_coarse):
        state[S_TH_SCREW] = th_s
        _track_reversal(state)
        warm = _warm(par, time)
        speed = abs(v)
        motor_level = par[P_MOTOR_LEVEL] * warm
        nut_level = par[P_NUT_LEVEL]
        if par[P_FPR_NM] != 0.0:
            nut_level += par[P_FPR_NM] * math.cos(par[P_FPR_ORDER] * th_s + par[P_FPR_PHASE])
        if par[P_DIP] != 0.0:
            travelled = rho * abs(th_s - state[S_TURN])
            nut_level *= 1.0 - par[P_DIP] * math.exp(-travelled / par[P_DIP_LENGTH])
        guide_level = par[P_GUIDE_LEVEL]
        if speed < 6.0 * par[P_STRIBECK_SPEED]:
            bump = math.exp(-((v / par[P_STRIBECK_SPEED]) ** 2))
            guide_level += par[P_STRIBECK_N] * bump
            nut_level += par[P_STRIBECK_NM] * bump
            motor_level += par[P_STRIBECK_MOTOR] * warm * bump
        nut_level *= warm
        guide_level *= warm
        forward = 1.0 if v >= 0.0 else -1.0
        turning = 1.0 + par[P_ASYM_ROTARY] * (1.0 if w_s >= 0.0 else -1.0)
        motor_viscous = par[P_MOTOR_VISCOUS] * turning
        nut_viscous = par[P_NUT_VISCOUS] * turning
        uneven = par[P_ASYM_VISCOUS] + par[P_ASYM_SLIDING]
        guide_viscous = par[P_GUIDE_VISCOUS] * (1.0 + uneven * forward)
        nut_level += par[P_NUT_LOAD] * abs(f_n)
        nut_level = max(nut_level, 1e-6)
        guide_level = max(guide_level, 1e-6)
        motor_level = max(motor_level, 1e-9)
        # Friction of a slowly varying law is linearised about the coarse point.
        root = 0.0
        if par[P_SQRT_N] != 0.0 and speed > 0.0:
            root = par[P_SQRT_N] * speed ** (par[P_SQRT_EXPONENT] - 1.0)
            guide_viscous += min(root, 5.0e4)
        cog = 0.0
        if par[P_COG_NM] != 0.0:
            cog = par[P_COG_NM] * math.cos(par[P_COG_ORDER] * th_m + par[P_COG_PHASE])
        ripple = 1.0
        if par[P_RIPPLE] != 0.0:
            ripple += par[P_RIPPLE] * math.cos(par[P_RIPPLE_ORDER] * th_m + par[P_RIPPLE_PHASE])
        static_m, per_rad = lead_error(par, th_s, time)
        anchor = th_s
        arm = rho + per_rad
        load = -par[P_BIAS] - state[S_EXTERNAL] - par[P_CABLE_K] * (xt - par[P_CABLE_X])
        if par[P_FORCE] != 0.0:
            load -= par[P_FORCE] * math.sin(par[P_FORCE_OMEGA] * time + par[P_FORCE_PHASE])
        end_m = motor_level / sigma_m
        end_n = nut_level / sigma_n
        end_g = guide_level / sigma_g * (1.0 + par[P_ASYM_SLIDING] * forward)
        # At rest the guide holds as much in either direction as it slides with in that one.
        end_low = guide_level / sigma_g * (1.0 - par[P_ASYM_SLIDING])
        end_high = guide_level / sigma_g * (1.0 + par[P_ASYM_SLIDING])
        for _ in range(n_fine):
            t_k = k_th * (th_m - th_s + beta * (w_m - w_s))
            delta = xt - (rho * th_s + static_m + per_rad * (th_s - anchor) + u)
            closing = v - arm * w_s - v_u
            if nonlinear_nut:
                stretch = delta
                damp = 1.0
                if gap > 0.0:
                    if delta > gap:
                        stretch = delta - gap
                    elif delta < -gap:
                        stretch = delta + gap
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
                f_n = k_nut * stretch
                if hertz > 0.0:
                    f_n *= max(1.0 - (f_n / hertz) ** 2 / 36.0, 0.5)
                f_n += damp * k_nut * beta * closing
            else:
                f_n = k_nut * (delta + beta * closing)

            # Bristles: stable for any speed. The sharp form is an elastic-plastic return map whose
            # damping, there to let a stuck axis come to rest, never adds to the level.
            if lugre_m:
                z_new = (z_m + w_m * dt) / (1.0 + abs(w_m) * dt / end_m)
            else:
                z_new = min(max(z_m + w_m * dt, -end_m), end_m)
            t_fm = sigma_m * z_new + par[P_MOTOR_DAMPING] * (z_new - z_m) / dt
            if not lugre_m:
                t_fm = min(max(t_fm, -motor_level), motor_level)
            z_m = z_new
            if lugre_n:
                z_new = (z_n + w_s * dt) / (1.0 + abs(w_s) * dt / end_n)
            else:
                z_new = min(max(z_n + w_s * dt, -end_n), end_n)
            t_fn = sigma_n * z_new + par[P_NUT_DAMPING] * (z_new - z_n) / dt
            if not lugre_n:
                t_fn = min(max(t_fn, -nut_level), nut_level)
            z_n = z_new
            f_g = guide_viscous * v
            if gms_g:
                for e in range(_GMS):
                    part = _GMS_DISTANCE[e]
                    z_new = min(max(z_e[e] + v * dt, -part * end_low), part * end_high)
                    f_g += _GMS_SHARE[e] * (
                        sigma_g * z_new / part + par[P_GUIDE_DAMPING] * (z_new - z_e[e]) / dt
                    )
                    z_e[e] = z_new
            else:
                if lugre_g:
                    z_new = (z_g + v * dt) / (1.0 + abs(v) * dt / end_g)
                else:
                    z_new = min(max(z_g + v * dt, -end_low), end_high)
                rubs = sigma_g * z_new + par[P_GUIDE_DAMPING] * (z_new - z_g) / dt
                if not lugre_g:
                    rubs = min(max(rubs, -sigma_g * end_low), sigma_g * end_high)
                f_g += rubs
                z_g = z_new

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
        time += n_fine * dt

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
    state[S_TIME] = time
    state[S_CYCLE] = cycle + 1.0
    _read_sensors(state, par)
    if log.shape[0] > 0:
        row = int(state[S_RECORDED]) % log.shape[0]
        log[row, 0] = cycle + 1.0
        log[row, 1] = rho * th_m
        log[row, 2] = xt
        log[row, 3] = torque
        state[S_RECORDED] += 1.0


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
