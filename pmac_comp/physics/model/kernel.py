"""The compiled drive: exact steps of the elastic chain, friction solved within each step.

What lives here: numba code only, SI, flat arrays (places in ``slots``). What may not: bench files,
names of effects, units other than SI. Imports ``slots`` only.

Method. Within a substep the position-dependent chain is linear: its exact step matrices (with the
current loop as an exponentially fading input) are tabulated along the screw and interpolated.
Friction elements are integrated exactly over the displacement of the substep and solved together
with that displacement (Newton), so that stick and slip need no events and no small steps.
"""

import math

import numpy as np
from numba import njit

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.model import slots as s

# Inputs of a substep: motor torque, fading motor torque, nut torque, table force, joint force.
N_STATES = 8
N_COLUMNS = 13
_TAYLOR = 9
_HISTORY = 256
_MOST_RISE = 4.0  # of a level over its own part, as far as the bristle's distance follows
_NEAR_LEVEL = 0.01  # share of the level that may be missing while a bristle slips on
# Where one half of a double nut is unloaded, at sqrt(8) preloads, the series for its stiffness ends
# with so much of the stiffness lost.
_SOFTENED = 2.0 / 3.0
_SETTLED = 1e-4  # share of the level by which a sweep may still move a friction force
_COMMAND_RESOLUTION_m = 1e-11  # a thirtieth of the finest unit of a Turbo PMAC register
# Gauss-Legendre, 8 points: distances from the middle and weights.
_GAUSS_X = (0.1834346424956498, 0.5255324099163290, 0.7966664774136267, 0.9602898564975363)
_GAUSS_W = (0.3626837833783620, 0.3137066458778873, 0.2223810344533745, 0.1012285362903763)


@njit(cache=True, nogil=True, error_model="numpy")
def _solve_inverse(matrix: FloatArray, size: int) -> FloatArray:
    """Inverse by Gauss-Jordan with pivoting; small matrices only."""
    work = np.zeros((size, 2 * size))
    for i in range(size):
        for j in range(size):
            work[i, j] = matrix[i, j]
        work[i, size + i] = 1.0
    for i in range(size):
        pivot = i
        for r in range(i + 1, size):
            if abs(work[r, i]) > abs(work[pivot, i]):
                pivot = r
        if pivot != i:
            for c in range(2 * size):
                work[i, c], work[pivot, c] = work[pivot, c], work[i, c]
        scale = 1.0 / work[i, i]
        for c in range(2 * size):
            work[i, c] *= scale
        for r in range(size):
            if r != i:
                factor = work[r, i]
                for c in range(2 * size):
                    work[r, c] -= factor * work[i, c]
    return work[:, size:].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def chain_matrices(par: FloatArray, x_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mass, damping and stiffness of [motor angle, screw angle, screw axial, table] at x."""
    mass = np.zeros((4, 4))
    damping = np.zeros((4, 4))
    stiffness = np.zeros((4, 4))
    length = par[s.LENGTH]
    x = min(max(x_m, 1e-3 * length), length)
    flexibility = 1.0 / par[s.K_COUPLING] + x / par[s.GJ]
    a = 1.0 / par[s.K_COUPLING] / flexibility
    axial = 1.0 / par[s.K_BEARING] + x / par[s.EA]
    b = 1.0 / par[s.K_BEARING] / axial
    near = par[s.J_SCREW] * x / length
    # The coupling output turns by (1-a) theta_m + a theta_s; the screw is linear from there.
    c0 = 1.0 - a
    mass[0, 0] = par[s.J_MOTOR] + (par[s.J_COUPLING] + near / 3.0) * c0 * c0
    mass[0, 1] = (par[s.J_COUPLING] + near / 3.0) * c0 * a + near / 6.0 * c0
    mass[1, 0] = mass[0, 1]
    mass[1, 1] = (
        (par[s.J_COUPLING] + near / 3.0) * a * a
        + near / 3.0 * (a + 1.0)
        + par[s.J_SCREW] * (1.0 - x / length)
    )
    mass[2, 2] = par[s.M_SCREW] * (x / length / 3.0 * (b * b + b + 1.0) + 1.0 - x / length)
    mass[3, 3] = par[s.M_TABLE]
    k_torsion = 1.0 / flexibility
    stiffness[0, 0] += k_torsion
    stiffness[0, 1] -= k_torsion
    stiffness[1, 0] -= k_torsion
    stiffness[1, 1] += k_torsion
    stiffness[2, 2] += 1.0 / axial
    rho = par[s.LEAD]
    v = np.array([0.0, -rho, -1.0, 1.0])
    for i in range(4):
        for j in range(4):
            stiffness[i, j] += par[s.K_NUT] * v[i] * v[j]
            damping[i, j] = par[s.BETA] * stiffness[i, j]
    damping[0, 0] += par[s.MOTOR + s.VISCOUS]
    damping[1, 1] += par[s.NUT + s.VISCOUS]
    damping[3, 3] += par[s.GUIDE + s.VISCOUS]
    return mass, damping, stiffness


@njit(cache=True, nogil=True, error_model="numpy")
def _chain_system(par: FloatArray, x_m: float) -> tuple[FloatArray, float]:
    """Continuous matrices [A | B] (8 x 13) at x and a bound of their rates in 1/s."""
    rho = par[s.LEAD]
    system = np.zeros((N_STATES, N_COLUMNS))
    if par[s.RIGID] > 0.5:
        inertia = par[s.RIGID_MASS] * rho * rho
        drag = (
            par[s.GUIDE + s.VISCOUS] * rho * rho + par[s.NUT + s.VISCOUS] + par[s.MOTOR + s.VISCOUS]
        )
        ratio = np.array([1.0, 1.0, 0.0, rho])
        gain = np.array([1.0, 1.0, 1.0, rho, 0.0])
        for i in range(4):
            system[i, 4] = ratio[i]
            system[4 + i, 4] = -ratio[i] * drag / inertia
            for c in range(5):
                system[4 + i, 8 + c] = ratio[i] * gain[c] / inertia
        return system, drag / inertia
    mass, damping, stiffness = chain_matrices(par, x_m)
    inverse = _solve_inverse(mass, 4)
    columns = np.zeros((4, 5))
    columns[0, 0] = 1.0
    columns[0, 1] = 1.0
    columns[1, 2] = 1.0
    columns[3, 3] = 1.0
    columns[1, 4] = rho
    columns[2, 4] = 1.0
    columns[3, 4] = -1.0
    trace = 0.0
    drag = 0.0
    for i in range(4):
        system[i, 4 + i] = 1.0
        for j in range(4):
            k_sum = 0.0
            c_sum = 0.0
            for n in range(4):
                k_sum += inverse[i, n] * stiffness[n, j]
                c_sum += inverse[i, n] * damping[n, j]
            system[4 + i, j] = -k_sum
            system[4 + i, 4 + j] = -c_sum
            if i == j:
                trace += k_sum
                drag += c_sum
        for c in range(5):
            total = 0.0
            for n in range(4):
                total += inverse[i, n] * columns[n, c]
            system[4 + i, 8 + c] = total
    # The trace of M^-1 K is the sum of the squared natural frequencies: a bound of the largest.
    return system, max(math.sqrt(trace), drag)


@njit(cache=True, nogil=True, error_model="numpy")
def step_matrices(par: FloatArray, x_m: float, step_s: float) -> FloatArray:
    """Exact step of the chain at x over ``step_s``: [A | B], shape (8, 13).

    Taylor series of the scaled exponential, then squaring; the second input fades with the
    current loop.
    """
    system, rate = _chain_system(par, x_m)
    fade = par[s.CURRENT_RATE]
    rate = max(rate, fade)
    halvings = 0
    h = step_s
    while rate * h > 0.25 and halvings < 40:
        h *= 0.5
        halvings += 1
    result = np.zeros((N_STATES, N_COLUMNS))
    low = np.exp(-fade * h)
    for i in range(N_STATES):
        result[i, i] = 1.0
    term = result.copy()
    for n in range(1, _TAYLOR + 1):
        # term <- term * G h / n with G = [[A, B], [0, diag(0, -fade, 0, 0, 0)]]
        following = np.zeros((N_STATES, N_COLUMNS))
        for i in range(N_STATES):
            for j in range(N_COLUMNS):
                total = 0.0
                for m in range(N_STATES):
                    total += term[i, m] * system[m, j]
                if j == 9:
                    total -= term[i, 9] * fade
                following[i, j] = total * h / n
        term = following
        for i in range(N_STATES):
            for j in range(N_COLUMNS):
                result[i, j] += term[i, j]
    for _ in range(halvings):
        squared = np.zeros((N_STATES, N_COLUMNS))
        for i in range(N_STATES):
            for j in range(N_COLUMNS):
                total = 0.0
                for m in range(N_STATES):
                    total += result[i, m] * result[m, j]
                if j == 9:
                    total += result[i, 9] * low
                elif j > 7:
                    total += result[i, j]
                squared[i, j] = total
        low *= low
        result = squared
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def step_bank(par: FloatArray, first_m: float, spacing_m: float, n_nodes: int, step_s: float):  # type: ignore[no-untyped-def] # noqa: ANN201
    """Transposed step matrices at equidistant nodes along the screw, shape (n_nodes, 13, 8)."""
    bank = np.zeros((n_nodes, N_COLUMNS, N_STATES))
    for node in range(n_nodes):
        bank[node] = step_matrices(par, first_m + node * spacing_m, step_s).T
    return bank


@njit(cache=True, nogil=True, error_model="numpy")
def _mean_decay(y: float, start: float, end: float) -> float:
    """Time mean of exp(-y p) along a leg with linear speed from ``start`` to ``end``, same sign.

    p is the share of the leg that is done: p(u) = (start u + (end - start) u^2 / 2) / mean speed.
    """
    mean = 0.5 * (start + end)
    if y < 1e-9 or mean <= 0.0:
        return 1.0
    a = y * start / mean
    b = y - a
    if y > 30.0:
        # Only the beginning counts: at its speed, or from rest as half a Gaussian.
        return min(1.0 / max(a, 1e-300), 0.5 * math.sqrt(math.pi / y))
    if abs(b) < 0.02 * y:
        return (1.0 - math.exp(-y)) / y
    total = 0.0
    for i in range(4):
        for side in range(2):
            u = 0.5 + (0.5 - side) * _GAUSS_X[i]
            total += 0.5 * _GAUSS_W[i] * math.exp(-(a + b * u) * u)
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _dahl(
    force: float,
    moved: float,
    level: float,
    distance: float,
    damping: float,
    mobility: float,
    step: float,
) -> tuple[float, float]:
    """Mean force and end force of one friction element over a substep.

    ``moved`` is the displacement with the force left out and ``step`` the starting speed times
    the substep; the force F follows dF/dx = (level - F sign(x')) / distance and acts back with
    ``mobility``; ``damping`` is that of the bristle divided by the substep, times distance over
    level. Speed is taken as linear within the substep, so a reversal splits it in two legs.
    """
    shift = moved - mobility * force
    # Slipping on: nothing to solve.
    sign = 1.0 if step >= 0.0 else -1.0
    slipping = abs(force - sign * level) < 1e-9 * level
    onward = shift * sign > 0.0 and (2.0 * shift - step) * sign > 0.0
    if slipping and onward:
        return sign * level, sign * level
    gap = level - sign * force
    if onward and abs(gap) < _NEAR_LEVEL * level:
        # Almost slipping: what is missing bends the path by its square only.
        y = abs(shift) / distance
        decay = math.exp(-min(y, 700.0))
        end = sign * (level - gap * decay)
        mean = sign * (level - gap * ((1.0 - decay) / y if y > 1e-6 else 1.0))
        return mean + damping * (end - force), end
    mean = force
    end = force
    for _ in range(5):
        last = 2.0 * shift - step
        middle = force
        share = 0.0
        mean = 0.0
        if step * last < 0.0:
            share = step / (step - last)
            sign = 1.0 if step > 0.0 else -1.0
            y = 0.5 * share * abs(step) / distance
            gap = level - sign * force
            mean = share * sign * (level - gap * _mean_decay(y, abs(step), 0.0))
            middle = sign * (level - gap * math.exp(-y))
            sign = -sign
            rest = 1.0 - share
            y = 0.5 * rest * abs(last) / distance
            gap = level - sign * middle
            mean += rest * sign * (level - gap * _mean_decay(y, 0.0, abs(last)))
        else:
            sign = 1.0 if shift >= 0.0 else -1.0
            rest = 1.0
            y = abs(shift) / distance
            gap = level - sign * force
            mean = sign * (level - gap * _mean_decay(y, abs(step), abs(last)))
        decay = math.exp(-min(y, 700.0))
        end = sign * (level - gap * decay)
        mean += damping * (end - force)
        rate = gap * (0.5 * rest / (1.0 + y) + damping * decay) / distance
        change = (shift - moved + mobility * mean) / (1.0 + mobility * rate)
        shift -= change
        if abs(change) < 1e-6 * distance + 1e-9 * abs(shift):
            break
    return mean, end


@njit(cache=True, nogil=True, error_model="numpy")
def _coulomb(change: float, speed: float, level: float, push: float) -> tuple[float, float]:
    """Mean force and end force of ideal Coulomb friction over a substep.

    ``change`` is what the speed would change by without the force and ``push`` the change per unit
    of force. Speed is linear in time: a reversal ends in stick if the level can hold the drive.
    """
    if level <= 0.0:
        return 0.0, 0.0
    hold = change / push
    sign = 1.0 if speed > 0.0 else -1.0
    if speed == 0.0:
        end = min(max(hold, -level), level)
        return end, end
    last = speed + change - push * sign * level
    if last * sign >= 0.0:
        return sign * level, sign * level
    share = speed / (speed - last)
    end = min(max(hold, -level), level)
    return share * sign * level + (1.0 - share) * end, end


@njit(cache=True, nogil=True, error_model="numpy")
def _three_coulomb(
    speeds: FloatArray,
    d0: float,
    d1: float,
    d2: float,
    v0: float,
    v1: float,
    v2: float,
    l0: float,
    l1: float,
    l2: float,
    m0: float,
    m1: float,
    m2: float,
) -> tuple[float, float, float, float, float, float]:
    """Mean and end forces of ideal Coulomb friction at motor, nut and guide, which act together.

    ``d`` is the change of speed without friction, ``v`` the speed before, ``l`` the level and
    ``m`` the mean force of the last substep, from which the sweeps start.
    """
    s00, s01, s02 = speeds[0, 0], speeds[0, 1], speeds[0, 2]
    s10, s11, s12 = speeds[1, 0], speeds[1, 1], speeds[1, 2]
    s20, s21, s22 = speeds[2, 0], speeds[2, 1], speeds[2, 2]
    e0, e1, e2 = m0, m1, m2
    for _ in range(4):
        old0, old1, old2 = m0, m1, m2
        m0, e0 = _coulomb(d0 - s01 * m1 - s02 * m2, v0, l0, s00)
        m1, e1 = _coulomb(d1 - s10 * m0 - s12 * m2, v1, l1, s11)
        m2, e2 = _coulomb(d2 - s20 * m0 - s21 * m1, v2, l2, s22)
        if (
            abs(m0 - old0) <= 1e-6 * l0
            and abs(m1 - old1) <= 1e-6 * l1
            and abs(m2 - old2) <= 1e-6 * l2
        ):
            break
    return m0, m1, m2, e0, e1, e2


@njit(cache=True, nogil=True, error_model="numpy")
def _slip_elements(
    forces: FloatArray,
    ends: FloatArray,
    par: FloatArray,
    moved: float,
    level: float,
    mobility: float,
    rub: float,
) -> float:
    """Mean force of parallel slip elements over a substep; ``ends`` gets their end forces.

    ``rub`` is the damping of all bristles together divided by the substep; an element that slips
    moves none of them.
    """
    n = int(par[s.GMS_N])
    # Stiffness belongs to the plain Coulomb level, which Stribeck and the like move.
    plain = par[s.GUIDE + s.LEVEL] if par[s.GUIDE + s.LEVEL] > 0.0 else level
    total = 0.0
    stiffness = 0.0
    for i in range(n):
        total += forces[i]
        stiffness += par[s.GMS + 2 * i] * plain / par[s.GMS + 2 * i + 1]
    shift = (moved - mobility * total) / (1.0 + 0.5 * mobility * stiffness)
    mean = 0.0
    for _ in range(2):
        mean = 0.0
        slope = 0.0
        for i in range(n):
            top = par[s.GMS + 2 * i] * level
            spring = par[s.GMS + 2 * i] * plain / par[s.GMS + 2 * i + 1]
            end = forces[i] + spring * shift
            if end > top:
                end = top
            elif end < -top:
                end = -top
            else:
                slope += 0.5 * spring + rub * par[s.GMS + 2 * i]
            mean += 0.5 * (forces[i] + end)
            mean += rub * par[s.GMS + 2 * i] * (end - forces[i]) / spring
        miss = shift - moved + mobility * mean
        shift -= miss / (1.0 + mobility * slope)
    for i in range(n):
        top = par[s.GMS + 2 * i] * level
        end = forces[i] + par[s.GMS + 2 * i] * plain / par[s.GMS + 2 * i + 1] * shift
        ends[i] = min(max(end, -top), top)
    return mean


@njit(cache=True, nogil=True, error_model="numpy")
def joint_force(par: FloatArray, delta_m: float) -> tuple[float, float, float]:
    """Elastic force of the nut joint beyond k_n delta, its derivative, and the share of damping.

    Dead zone (backlash), soft centre (preload loss) and softening of a preloaded double nut.
    """
    k = par[s.K_NUT]
    force = 0.0
    slope = 0.0
    share = 1.0
    half = par[s.GAP_HALF]
    rest = delta_m
    if half > 0.0:
        if abs(delta_m) <= half:
            return -k * delta_m, -k, 0.0
        rest = delta_m - math.copysign(half, delta_m)
        force = -math.copysign(k * half, delta_m)
    soft = par[s.SOFT_HALF]
    if soft > 0.0:
        loss = (1.0 - par[s.SOFT_RATIO]) * k
        if abs(rest) <= soft:
            force -= loss * rest
            slope -= loss
            share = par[s.SOFT_RATIO]
        else:
            force -= loss * math.copysign(soft, rest)
    softening = par[s.HERTZ]
    if softening > 0.0:
        # F = k d (1 - (k d)^2 / (36 F0^2)) up to there, then straight on.
        spring = k * abs(rest)
        knee = math.sqrt(_SOFTENED / (3.0 * softening))
        bend = min(spring, knee)
        lost = softening * bend * bend * bend + _SOFTENED * max(spring - knee, 0.0)
        force -= math.copysign(lost, rest)
        slope -= k * (3.0 * softening * bend * bend if spring <= knee else _SOFTENED)
    return force, slope, share


@njit(cache=True, nogil=True, error_model="numpy")
def _mean_joint(par: FloatArray, first: float, last: float) -> tuple[float, float, float]:
    """Means of ``joint_force`` along a straight path between two deflections.

    At the middle where the path stays on one branch, by Gauss points where it crosses a kink.
    """
    _, slope_0, share_0 = joint_force(par, first)
    _, slope_1, share_1 = joint_force(par, last)
    force, slope, share = joint_force(par, 0.5 * (first + last))
    if share_0 == share_1 and abs(slope_0 - slope_1) < 0.05 * par[s.K_NUT]:
        return force, slope, share
    force = 0.0
    slope = 0.0
    share = 0.0
    for i in range(4):
        for side in range(2):
            u = 0.5 + (0.5 - side) * _GAUSS_X[i]
            f, g, d = joint_force(par, first + u * (last - first))
            force += 0.5 * _GAUSS_W[i] * f
            slope += 0.5 * _GAUSS_W[i] * g
            share += 0.5 * _GAUSS_W[i] * d
    return force, slope, share


@njit(cache=True, nogil=True, error_model="numpy")
def _lead(par: FloatArray, theta: float, grown: float) -> tuple[float, float]:
    """Lead error of the screw at a nut angle, m, and its derivative, m/rad.

    ``grown`` is the thermal strain so far.
    """
    slope = par[s.LEAD] * (par[s.LEAD_SLOPE] + grown)
    error = slope * theta + grown * par[s.X_ORIGIN]
    if par[s.WOBBLE] != 0.0:
        angle = par[s.WOBBLE + 1] * theta + par[s.WOBBLE + 2]
        error += par[s.WOBBLE] * math.cos(angle)
        slope -= par[s.WOBBLE] * par[s.WOBBLE + 1] * math.sin(angle)
    return error, slope


@njit(cache=True, nogil=True, error_model="numpy")
def _stribeck(par: FloatArray, excess: float, speed: float) -> float:
    """Friction above the sliding level at a table speed."""
    ratio = speed / par[s.STRIBECK_SPEED]
    if excess == 0.0 or abs(ratio) > 6.0:
        return 0.0
    return excess * math.exp(-ratio * ratio)


@njit(cache=True, nogil=True, error_model="numpy")
def _strain(par: FloatArray, t: float) -> float:
    """Thermal strain of the screw at a time."""
    if par[s.GROWTH] == 0.0:
        return 0.0
    return float(par[s.GROWTH] * (1.0 - math.exp(-max(t, 0.0) / par[s.GROWTH_TIME])))


@njit(cache=True, nogil=True, error_model="numpy")
def _lookup(values: FloatArray, term: FloatArray, where: float) -> float:
    """Table term at a coordinate: linear between knots, held at the ends or periodic."""
    if term[s.TERM_PERIOD] > 0.0:
        where = where - math.floor(where / term[s.TERM_PERIOD]) * term[s.TERM_PERIOD]
    place = (where - term[s.TERM_START]) / term[s.TERM_STEP]
    last = int(term[s.TERM_COUNT]) - 1
    if not place > 0.0:
        return float(values[0])
    if place >= last:
        return float(values[last])
    i = int(place)
    return float(values[i] + (place - i) * (values[i + 1] - values[i]))


@njit(cache=True, nogil=True, error_model="numpy")
def _strained(par: FloatArray, z: FloatArray, force: FloatArray, slip: FloatArray) -> None:
    """Bristles that hold the torque with which a run begins, and the chain wound up between them.

    An axis that came to rest is held back by its friction, all at the same share of its level; what
    a bias or a cable pulls is not.
    """
    rho = par[s.LEAD]
    motor, nut = par[s.MOTOR + s.LEVEL], par[s.NUT + s.LEVEL]
    guide = par[s.GUIDE + s.LEVEL]
    total = motor + nut + rho * guide
    n_gms = int(par[s.GMS_N])
    longest = max(par[s.MOTOR + s.BREAK], par[s.NUT + s.BREAK], par[s.GUIDE + s.BREAK])
    if total <= 0.0 or (n_gms == 0 and longest <= 0.0):
        return
    load = par[s.BIAS] + par[s.CABLE_K] * (z[3] - par[s.CABLE_CENTRE])
    share = min(max((par[s.RESTING] - rho * load) / total, -1.0), 1.0)
    if par[s.MOTOR + s.BREAK] > 0.0:
        force[0] = share * motor
    if par[s.NUT + s.BREAK] > 0.0:
        force[1] = share * nut
    if n_gms > 0 or par[s.GUIDE + s.BREAK] > 0.0:
        force[2] = share * guide
    for i in range(n_gms):
        slip[i] = share * guide * par[s.GMS + 2 * i]
    if par[s.RIGID] > 0.5:
        return
    place = max(par[s.X_ORIGIN] + z[3], 0.0)
    pull = share * guide + load
    twist = share * nut + rho * pull
    wound = twist * (1.0 / par[s.K_COUPLING] + place / par[s.GJ])
    shift = -pull * (1.0 / par[s.K_BEARING] + place / par[s.EA])
    z[1] -= wound
    z[2] += shift
    z[3] += shift - rho * wound - pull / par[s.K_NUT]


@njit(cache=True, nogil=True, error_model="numpy")
def run(
    par: FloatArray,
    bank: FloatArray,
    first_m: float,
    spacing_m: float,
    n_sub: int,
    desired_m: FloatArray,
    torque_ff_Nm: FloatArray,
    external_N: FloatArray,
    terms: FloatArray,
    term_values: FloatArray,
    start_s: float,
    out: FloatArray,
) -> int:
    """Closed loop over all servo cycles; ``out`` is (5, n): see the last lines of the loop.

    Rows: motor reading m, table reading m, torque command N m, motor torque N m, joint force N.
    Returns the number of cycles that stayed finite.
    """
    n = desired_m.size
    Ts = par[s.PERIOD]
    h = Ts / n_sub
    rho = par[s.LEAD]
    origin = par[s.X_ORIGIN]
    n_nodes = bank.shape[0]
    rigid = par[s.RIGID] > 0.5
    fade = 0.0 if par[s.CURRENT_RATE] <= 0.0 else math.exp(-par[s.CURRENT_RATE] * h)
    ideal_current = par[s.CURRENT_RATE] <= 0.0
    # Transposed, so that a step is a sum of columns (vector instructions).
    W = np.zeros((N_COLUMNS, N_STATES))
    flat = W.reshape(N_COLUMNS * N_STATES)
    flat_bank = bank.reshape((n_nodes, N_COLUMNS * N_STATES))
    moves = np.zeros((3, 3))
    speeds = np.zeros((3, 3))
    z = np.zeros(N_STATES)
    zf = np.zeros(N_STATES)
    history = np.zeros(_HISTORY)
    slip = np.zeros(8)
    delay_steps = par[s.DELAY] / h
    rate_h = 1.0 / h

    use_stribeck = (
        par[s.STRIBECK_GUIDE] != 0.0 or par[s.STRIBECK_NUT] != 0.0 or par[s.STRIBECK_MOTOR] != 0.0
    )
    use_lead = par[s.WOBBLE] != 0.0 or par[s.LEAD_SLOPE] != 0.0 or par[s.GROWTH] != 0.0
    use_kinks = par[s.GAP_HALF] > 0.0 or par[s.SOFT_HALF] > 0.0 or par[s.HERTZ] > 0.0
    use_joint = (use_kinks or use_lead) and not rigid
    use_waves = par[s.COGGING] != 0.0 or par[s.RIPPLE] != 0.0
    use_base = par[s.BASE_MASS] > 0.0
    use_power = par[s.POWER_FORCE] != 0.0
    use_asymmetry = (
        par[s.ASYMMETRY_VISCOUS] != 0.0
        or par[s.ASYMMETRY_SLIDING] != 0.0
        or par[s.ASYMMETRY_ROTARY] != 0.0
    )
    use_dip = par[s.DIP] != 0.0
    use_warmup = par[s.WARMUP] != 0.0
    use_load = par[s.NUT_LOAD] != 0.0 and not rigid
    n_terms = terms.shape[0]
    n_gms = int(par[s.GMS_N])
    guide_sharp = n_gms == 0 and par[s.GUIDE + s.BREAK] <= 0.0
    all_sharp = guide_sharp and par[s.NUT + s.BREAK] <= 0.0 and par[s.MOTOR + s.BREAK] <= 0.0

    # At rest and relaxed on the first desired position.
    theta0 = desired_m[0] / rho
    for _ in range(50):
        wrong = par[s.ECCENTRICITY] * math.cos(
            par[s.ECCENTRICITY + 1] * theta0 + par[s.ECCENTRICITY + 2]
        )
        theta0 = (desired_m[0] - wrong) / rho
    z[0] = theta0
    z[1] = theta0
    z[3] = rho * theta0
    grown = _strain(par, start_s)
    lead, lead_slope = _lead(par, theta0, grown)
    if rigid:
        lead = 0.0
    z[3] += lead
    motor_torque = par[s.RESTING]
    # Friction at motor, nut and guide: force at the end of and mean over the last substep.
    force = np.zeros(3)
    mean = np.zeros(3)
    end_force = np.zeros(3)
    moved = np.zeros(3)
    gained = np.zeros(3)
    start = np.zeros(3)
    slip_end = np.zeros(8)
    if par[s.RESTING] != 0.0:
        _strained(par, z, force, slip)
        mean[:] = force
    base_x = 0.0
    base_v = 0.0
    base_a = 0.0
    table_a = 0.0
    nut_a = 0.0
    motor_a = 0.0
    extreme = theta0
    heading = 1.0
    since = 0.0
    nut_state = 0.0
    guide_state = 0.0

    # Controller memory; the first reading is taken as having always been there.
    old_read = 0.0
    older_read = 0.0
    old_desired = desired_m[0]
    old_vc = 0.0
    vf = 0.0
    integral = 0.0
    n_u1 = 0.0
    n_u2 = 0.0
    n_y1 = 0.0
    n_y2 = 0.0

    for k in range(n):
        t = start_s + k * Ts
        # ---- sensors
        motor_read = rho * z[0]
        if par[s.ECCENTRICITY] != 0.0:
            motor_read += par[s.ECCENTRICITY] * math.cos(
                par[s.ECCENTRICITY + 1] * z[0] + par[s.ECCENTRICITY + 2]
            )
        x_seen = z[3] - par[s.SKEW] * (z[7] - 0.5 * par[s.SKEW] * table_a)
        table_read = x_seen + par[s.SCALE_SLOPE] * x_seen
        if use_lead:
            grown = _strain(par, t)
            if rigid:
                table_read += _lead(par, z[1], grown)[0]
        if par[s.SUBDIVISION] != 0.0:
            table_read += par[s.SUBDIVISION] * math.cos(
                par[s.SUBDIVISION + 1] * x_seen + par[s.SUBDIVISION + 2]
            )
        for j in range(n_terms):
            site = int(terms[j, s.TERM_SITE])
            if 3 <= site <= 4:
                value = _term(
                    terms[j], term_values[j], z[3], z[7], z[0], t, since, guide_state, nut_state
                )
                if site == 3:
                    motor_read += value
                else:
                    table_read += value
        if out.shape[0] > 5:
            out[5, k] = motor_read
            out[6, k] = table_read
        if par[s.MOTOR_STEP] > 0.0:
            motor_read = math.floor(motor_read / par[s.MOTOR_STEP] + 0.5) * par[s.MOTOR_STEP]
        if par[s.TABLE_STEP] > 0.0:
            table_read = math.floor(table_read / par[s.TABLE_STEP] + 0.5) * par[s.TABLE_STEP]
        if k == 0:
            old_read = motor_read
            older_read = motor_read

        # ---- control law
        desired = desired_m[k]
        error = min(max(desired - motor_read, -par[s.FE_LIMIT]), par[s.FE_LIMIT])
        vc = (desired - old_desired) / Ts
        # Round-off of a standing command is no motion.
        command_moves = abs(desired - old_desired) > _COMMAND_RESOLUTION_m
        if par[s.LAW] < 0.5:
            ac = (vc - old_vc) / Ts
            vf += par[s.FILTER] * ((motor_read - old_read) / Ts - vf)
            u = par[s.KP] * error + integral + par[s.KVFF] * vc + par[s.KAFF] * ac - par[s.KD] * vf
            filtered = (
                u
                + par[s.NOTCH] * n_u1
                + par[s.NOTCH + 1] * n_u2
                - par[s.NOTCH + 2] * n_y1
                - par[s.NOTCH + 3] * n_y2
            )
            n_u2 = n_u1
            n_u1 = u
            n_y2 = n_y1
            n_y1 = filtered
            u = filtered
            if command_moves:
                u += math.copysign(par[s.FRICTION_FF], vc)
        else:
            u = par[s.CASCADE_GAIN] * (
                par[s.CASCADE_KP] * error - (motor_read - older_read) / (2.0 * Ts)
            )
        u += par[s.OFFSET] + par[s.RESTING] + torque_ff_Nm[k]
        command = min(max(u, -par[s.LIMIT]), par[s.LIMIT])
        clipped = u - command
        frozen = clipped != 0.0 and (par[s.FREEZE_ALWAYS] > 0.5 or clipped * error > 0.0)
        if not frozen and (par[s.INTEGRATE_AT_REST] < 0.5 or not command_moves):
            integral += par[s.KI] * Ts * error
            integral = min(max(integral, -par[s.INTEGRATOR_LIMIT]), par[s.INTEGRATOR_LIMIT])
        if par[s.TORQUE_STEP] > 0.0:
            command = math.floor(command / par[s.TORQUE_STEP] + 0.5) * par[s.TORQUE_STEP]
        older_read = old_read
        old_read = motor_read
        old_desired = desired
        old_vc = vc
        history[k & (_HISTORY - 1)] = min(
            max(command, -par[s.ACTUATOR_LIMIT]), par[s.ACTUATOR_LIMIT]
        )

        delta = z[3] - rho * z[1] - z[2] - lead
        out[0, k] = motor_read
        out[1, k] = table_read
        out[2, k] = command
        out[3, k] = motor_torque
        out[4, k] = par[s.K_NUT] * delta + (joint_force(par, delta)[0] if use_joint else 0.0)
        if not (abs(z[3]) < 1e6 and abs(z[4]) < 1e9):
            return k

        # ---- step matrices of this cycle
        place = (z[3] + origin - first_m) / spacing_m
        if not place > 0.0:
            place = 0.0
        if place > n_nodes - 1:
            place = n_nodes - 1.0
        node = min(int(place), max(n_nodes - 2, 0))
        w1 = place - node
        after = min(node + 1, n_nodes - 1)
        before, behind = flat_bank[node], flat_bank[after]
        for i in range(N_COLUMNS * N_STATES):
            flat[i] = before[i] + w1 * (behind[i] - before[i])
        # How motor, nut and table move (and speed up) per friction force at each of the three.
        for i in range(3):
            row = 3 if i == 2 else i
            for j in range(3):
                column = 11 if j == 2 else (10 if j == 1 else 8)
                moves[i, j] = W[column, row]
                speeds[i, j] = W[column, 4 + row]
        bends_0 = W[8, 3] - rho * W[8, 1] - W[8, 2]
        bends_1 = W[10, 3] - rho * W[10, 1] - W[10, 2]
        bends_2 = W[11, 3] - rho * W[11, 1] - W[11, 2]
        mobility_joint = -(W[12, 3] - rho * W[12, 1] - W[12, 2])

        warm = 1.0
        if use_warmup:
            warm = 1.0 - par[s.WARMUP] * (1.0 - math.exp(-t / par[s.WARMUP_TIME]))

        for sub in range(n_sub):
            # ---- torque that the drive holds: mean over the substep of the delayed command
            late = k * n_sub + sub - delay_steps
            cell = math.floor(late / n_sub)
            to_next = (cell + 1.0) * n_sub - late
            held = par[s.RESTING]
            if cell >= 0:
                held = history[int(cell) & (_HISTORY - 1)]
            if to_next < 1.0:
                following = par[s.RESTING]
                if cell + 1 >= 0:
                    following = history[int(cell + 1) & (_HISTORY - 1)]
                held = to_next * held + (1.0 - to_next) * following
            fading = motor_torque - held
            if ideal_current:
                fading = 0.0

            # ---- explicit torques and forces at the middle of the substep
            mid_theta = z[0] + 0.5 * h * z[4]
            mid_x = z[3] + 0.5 * h * z[7]
            speed = z[7]
            push_motor = 0.0
            push_nut = 0.0
            push_table = -par[s.BIAS] - external_N[k]
            if use_waves:
                push_motor += par[s.COGGING] * math.cos(
                    par[s.COGGING + 1] * mid_theta + par[s.COGGING + 2]
                )
                push_motor += (
                    par[s.RIPPLE]
                    * (held + 0.5 * (1.0 + fade) * fading)
                    * math.cos(par[s.RIPPLE + 1] * mid_theta + par[s.RIPPLE + 2])
                )
            if par[s.CABLE_K] != 0.0:
                push_table -= par[s.CABLE_K] * (mid_x - par[s.CABLE_CENTRE])
            if par[s.EXTERNAL] != 0.0:
                mid_t = t + (sub + 0.5) * h
                push_table -= par[s.EXTERNAL] * math.sin(
                    par[s.EXTERNAL + 1] * mid_t + par[s.EXTERNAL + 2]
                )
            mid_speed = speed + 0.5 * h * table_a
            if use_power:
                curved = abs(mid_speed) ** par[s.POWER_EXPONENT]
                push_table -= par[s.POWER_FORCE] * math.copysign(curved, mid_speed)
            if use_asymmetry:
                push_table -= (
                    (par[s.ASYMMETRY_VISCOUS] + par[s.ASYMMETRY_SLIDING])
                    * par[s.GUIDE + s.VISCOUS]
                    * abs(mid_speed)
                )
                push_nut -= par[s.ASYMMETRY_ROTARY] * par[s.NUT + s.VISCOUS] * abs(z[5])
                push_motor -= par[s.ASYMMETRY_ROTARY] * par[s.MOTOR + s.VISCOUS] * abs(z[4])
            if use_lead and not rigid:
                # The nut's torque is force times advance per radian, lead error included.
                pull = z[3] - rho * z[1] - z[2] - lead
                push_nut += lead_slope * (par[s.K_NUT] * pull + joint_force(par, pull)[0])
            if use_base:
                # Bed on its foundation, positions relative to the bed: the table feels -M x_b''.
                omega = par[s.BASE_OMEGA]
                base_a = (
                    -par[s.M_TABLE] * table_a
                    - par[s.BASE_MASS] * omega * (2.0 * par[s.BASE_ZETA] * base_v + omega * base_x)
                ) / (par[s.BASE_MASS] + par[s.M_TABLE])
                base_v += h * base_a
                base_x += h * base_v
                push_table -= par[s.M_TABLE] * base_a
            level_guide = par[s.GUIDE + s.LEVEL]
            level_nut = par[s.NUT + s.LEVEL]
            level_motor = par[s.MOTOR + s.LEVEL]
            if use_stribeck:
                level_guide += _stribeck(par, par[s.STRIBECK_GUIDE], mid_speed)
                level_nut += _stribeck(par, par[s.STRIBECK_NUT], rho * (z[5] + 0.5 * h * nut_a))
                level_motor += _stribeck(
                    par, par[s.STRIBECK_MOTOR], rho * (z[4] + 0.5 * h * motor_a)
                )
            if par[s.PER_REV] != 0.0:
                level_nut += par[s.PER_REV] * math.cos(
                    par[s.PER_REV + 1] * (z[1] + 0.5 * h * z[5]) + par[s.PER_REV + 2]
                )
            if use_dip:
                level_nut *= 1.0 - par[s.DIP] * math.exp(-since / par[s.DIP_LENGTH])
            if use_asymmetry:
                # At rest the guide holds unequal forces either way: equal ones about a force.
                # Bristles hold the level of the direction in which they move.
                uneven = par[s.ASYMMETRY_SLIDING]
                if guide_sharp:
                    push_table -= uneven * level_guide * warm
                else:
                    level_guide *= 1.0 + math.copysign(1.0, mid_speed) * uneven
            for j in range(n_terms):
                site = int(terms[j, s.TERM_SITE])
                if 3 <= site <= 4:
                    continue
                value = _term(
                    terms[j],
                    term_values[j],
                    mid_x,
                    mid_speed,
                    mid_theta,
                    t + (sub + 0.5) * h,
                    since,
                    guide_state,
                    nut_state,
                )
                if site == 0:
                    push_motor += value
                elif site == 1:
                    push_nut += value
                elif site == 2:
                    push_table += value
                elif site == 5:
                    level_nut += value
                elif site == 6:
                    level_guide += value
                else:
                    level_motor += value
            level_guide *= warm
            level_nut *= warm
            level_motor *= warm
            # ---- chain without friction
            drive = held + push_motor
            # (scalars first: one loop over the states that the compiler can vectorise)
            z0, z1, z2, z3, z4, z5, z6, z7 = z[0], z[1], z[2], z[3], z[4], z[5], z[6], z[7]
            for i in range(N_STATES):
                zf[i] = (
                    W[8, i] * drive
                    + W[9, i] * fading
                    + W[10, i] * push_nut
                    + W[11, i] * push_table
                    + W[0, i] * z0
                    + W[1, i] * z1
                    + W[2, i] * z2
                    + W[3, i] * z3
                    + W[4, i] * z4
                    + W[5, i] * z5
                    + W[6, i] * z6
                    + W[7, i] * z7
                )

            # ---- joint beyond its linear spring
            middle_lead = 0.0
            if use_joint:
                old_delta = z[3] - rho * z[1] - z[2] - lead
                old_lead = lead
                if use_lead:
                    lead, lead_slope = _lead(par, zf[1], grown)
                    middle_lead = 0.5 * (old_lead + lead)
                new_delta = zf[3] - rho * zf[1] - zf[2] - lead
                # Friction of this substep is not known yet: that of the last one bends the joint.
                new_delta -= bends_0 * mean[0] + bends_1 * mean[1] + bends_2 * mean[2]
                mean_delta = 0.5 * (old_delta + new_delta)
                # The bank's spring and damper follow x - rho theta - u: take the lead out of it.
                damper = par[s.K_NUT] * par[s.BETA]
                base_force = -par[s.K_NUT] * middle_lead - damper * (lead - old_lead) / h
                extra = base_force
                if use_kinks:
                    # Newton for the mean deflection; forces act back on it with half the mobility.
                    gain = 0.5 * mobility_joint
                    guess = mean_delta
                    for _ in range(6):
                        pull, slope, share = _mean_joint(par, old_delta, 2.0 * guess - old_delta)
                        missing = (1.0 - share) * damper * 2.0 / h
                        extra = base_force + pull - missing * (guess - old_delta)
                        rate = 1.0 + gain * (slope - missing)
                        change = (guess - mean_delta + gain * extra) / max(rate, 0.2)
                        guess -= change
                        if abs(change) < 1e-13:
                            break
                for i in range(N_STATES):
                    zf[i] += W[12, i] * extra

            if use_load:
                pull = 0.5 * (z[3] + zf[3] - rho * (z[1] + zf[1]) - z[2] - zf[2]) - middle_lead
                pull -= 0.5 * (bends_0 * mean[0] + bends_1 * mean[1] + bends_2 * mean[2])
                total = par[s.K_NUT] * pull
                if use_joint:
                    total += joint_force(par, pull)[0]
                level_nut += par[s.NUT_LOAD] * rho * abs(total)

            # ---- friction, solved with the motion that it lets through: from the forces of the
            # last substep, site by site, until they agree
            if all_sharp:
                (mean[0], mean[1], mean[2], force[0], force[1], force[2]) = _three_coulomb(
                    speeds,
                    zf[4] - z4,
                    zf[5] - z5,
                    zf[7] - z7,
                    z4,
                    z5,
                    z7,
                    level_motor,
                    level_nut,
                    level_guide,
                    mean[0],
                    mean[1],
                    mean[2],
                )
            else:
                for i in range(3):
                    row = 3 if i == 2 else i
                    start[i] = z[4 + row]
                    moved[i] = zf[row] - z[row]
                    gained[i] = zf[4 + row] - start[i]
                    for j in range(3):
                        moved[i] -= moves[i, j] * mean[j]
                        gained[i] -= speeds[i, j] * mean[j]
                for _ in range(4):
                    largest = 0.0
                    for i in range(3):
                        level = level_motor if i == 0 else (level_nut if i == 1 else level_guide)
                        old = mean[i]
                        if level <= 0.0:
                            new = 0.0
                            end_force[i] = 0.0
                        elif i == 2 and n_gms > 0:
                            free = moved[i] + moves[i, i] * old
                            rub = _faded(par[s.GUIDE + s.BRISTLE], start[i], level) * rate_h
                            new = _slip_elements(slip, slip_end, par, free, level, moves[i, i], rub)
                        else:
                            site = s.GUIDE if i == 2 else (s.NUT if i == 1 else s.MOTOR)
                            if par[site + s.BREAK] <= 0.0:
                                push = speeds[i, i]
                                new, end_force[i] = _coulomb(
                                    gained[i] + push * old, start[i], level, push
                                )
                            else:
                                free = moved[i] + moves[i, i] * old
                                new, end_force[i] = _bristle(
                                    force[i], free, level, par, site, moves[i, i], h, start[i]
                                )
                        step = new - old
                        if step != 0.0:
                            mean[i] = new
                            largest = max(largest, abs(step) - _SETTLED * level)
                            for j in range(3):
                                moved[j] -= moves[j, i] * step
                                gained[j] -= speeds[j, i] * step
                    if largest <= 0.0:
                        break
                for i in range(3):
                    force[i] = end_force[i]
            if n_gms > 0:
                force[2] = 0.0
                for i in range(n_gms):
                    slip[i] = slip_end[i]
                    force[2] += slip_end[i]
            table_a = z[7]
            nut_a = z[5]
            motor_a = z[4]
            mean_0, mean_1, mean_2 = mean[0], mean[1], mean[2]
            for i in range(N_STATES):
                z[i] = zf[i] - W[8, i] * mean_0 - W[10, i] * mean_1 - W[11, i] * mean_2
            table_a = (z[7] - table_a) * rate_h
            nut_a = (z[5] - nut_a) * rate_h
            motor_a = (z[4] - motor_a) * rate_h
            motor_torque = held + fade * fading
            if use_lead and not rigid:
                lead, lead_slope = _lead(par, z[1], grown)
            if n_terms > 0:
                guide_state = force[2] / level_guide if level_guide > 0.0 else 0.0
                nut_state = force[1] / level_nut if level_nut > 0.0 else 0.0

            # ---- distance since reversal of the nut; a reversal is a return by 0.05 mrad
            if not (use_dip or n_terms > 0):
                continue
            if (z[1] - extreme) * heading >= 0.0:
                since += abs(z[1] - extreme)
                extreme = z[1]
            elif (extreme - z[1]) * heading > 5e-5:
                heading = -heading
                since = abs(z[1] - extreme)
                extreme = z[1]
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _faded(bristle: float, speed: float, level: float) -> float:
    """Damping of bristles at a speed: none where it would outgrow the level."""
    if bristle <= 0.0:
        return 0.0
    ratio = speed * bristle / level
    return bristle * math.exp(-ratio * ratio) if abs(ratio) < 5.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _bristle(
    force: float,
    moved: float,
    level: float,
    par: FloatArray,
    site: int,
    mobility: float,
    h: float,
    speed: float,
) -> tuple[float, float]:
    """Bristle element of one site over a substep; its damping fades with speed.

    As in LuGre the stiffness stays where the level moves (Stribeck, warm-up, load): the distance
    follows, but where almost all of the level comes from elsewhere its own says nothing.
    """
    own = max(par[site + s.LEVEL], level / _MOST_RISE)
    distance = par[site + s.BREAK] * level / own
    damping = _faded(par[site + s.BRISTLE], speed, level) * distance / (level * h)
    mean, end = _dahl(force, moved, level, distance, damping, mobility, speed * h)
    return mean, end


@njit(cache=True, nogil=True, error_model="numpy")
def _term(
    term: FloatArray,
    values: FloatArray,
    x: float,
    v: float,
    theta: float,
    t: float,
    since: float,
    guide_state: float,
    nut_state: float,
) -> float:
    """Value of one table term (coordinates and factors: ``terms.py``)."""
    coordinate = int(term[s.TERM_COORDINATE])
    where = t
    if coordinate == 0:
        where = x
    elif coordinate == 1:
        where = v
    elif coordinate == 2:
        where = theta
    elif coordinate == 3:
        where = since
    value: float = _lookup(values, term, where)
    factor = int(term[s.TERM_FACTOR])
    if factor == 1:
        value *= guide_state
    elif factor == 2:
        value *= nut_state
    elif factor == 3:
        value *= v
    return value
