"""The compiled drive: the closed loop in substeps, friction solved within each of them.

What lives here: numba code only, SI, flat arrays (places in ``slots``). What may not: bench files,
names of effects, units other than SI. Imports ``slots`` and the sizes of ``kernel_chain`` only.

Method. Within a substep the position-dependent chain is linear: its exact step matrices (with the
current loop as an exponentially fading input) are tabulated along the screw (``kernel_chain``) and
interpolated. Friction elements are integrated exactly over the displacement of the substep and
solved together with that displacement (Newton), so that stick and slip need no events and no small
steps.

One file on purpose: numba's cache on disk looks at the file of the function that is called, so that
a change of a function in another file would go on running as it was.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.kernel_chain import N_COLUMNS, N_STATES, share_of_bed

_HISTORY = 256
_MOST_RISE = 4.0  # of a level over its own part, as far as the bristle's distance follows
_NEAR_LEVEL = 0.01  # share of the level that may be missing while a bristle slips on
# Where one half of a double nut is unloaded, at F = sqrt(8) F0, a linear joint would push with 9/7
# of that: so much over the root of 1 / (36 F0^2). From there on half of the stiffness is lost.
_KNEE = 3.0 * math.sqrt(8.0) / 14.0
_SOFTENED = 0.5
_SETTLED = 1e-4  # share of the level by which a sweep may still move a friction force
_COMMAND_RESOLUTION_m = 1e-11  # a thirtieth of the finest unit of a Turbo PMAC register
# Gauss-Legendre, 8 points: distances from the middle and weights.
_GAUSS_X = (0.1834346424956498, 0.5255324099163290, 0.7966664774136267, 0.9602898564975363)
_GAUSS_W = (0.3626837833783620, 0.3137066458778873, 0.2223810344533745, 0.1012285362903763)
# What the servo keeps from cycle to cycle: readings, command, velocities, integral, notch.
_READ, _OLDER_READ, _DESIRED, _VC, _VF, _INTEGRAL, _U1, _U2, _Y1, _Y2, _MEMORY = range(11)
# Turning of the nut: angle farthest on, direction (1, -1), way since the last reversal in rad.
_EXTREME, _HEADING, _SINCE = range(3)
_LONG_AGO_rad = 1e3  # way since the last reversal of a run that begins under way
# Terms of the sensors, and those of torques, forces and levels of friction.
_READINGS, _FORCES = range(2)
# A part of the loop that allocates nothing: without counts of references to its arrays, which are
# atomic and took half of the time (numba's own string functions do the same).
_part = njit(cache=True, nogil=True, error_model="numpy", _nrt=False, forceinline=True)


class _Has(NamedTuple):
    """What a model has, and the figures of its substeps: looked up once per run."""

    elastic: bool
    lead: bool  # error of the lead, between nut and table
    joint: bool  # more in the joint than its spring and damper
    load: bool  # of the nut, which raises its friction
    way: bool  # since the last reversal, which something depends on
    base: bool
    asymmetry: bool
    guide_sharp: bool
    all_sharp: bool
    h: float
    rate_h: float
    fade: float  # of the current loop over a substep
    delay_steps: float
    begun_Nm: float


class _Chain(NamedTuple):
    """Step matrix at the place of the table, and how forces move the three that rub."""

    W: FloatArray  # transposed, so that a step is a sum of columns (vector instructions)
    moves: FloatArray
    speeds: FloatArray
    bends: FloatArray


class _Axis(NamedTuple):
    """State of the drive, and what is remembered beside it."""

    z: FloatArray  # angles of motor and nut, axial, table; their speeds
    zf: FloatArray  # the same at the end of the substep, as it would be without friction
    turned: FloatArray  # of the nut: ``_EXTREME``, ``_HEADING``, ``_SINCE``
    base: FloatArray


class _Now(NamedTuple):
    """What the last substep ended with besides the state: numbers, which stay in registers."""

    motor_a: float
    nut_a: float
    table_a: float
    torque: float
    lead: float  # its error, m
    lead_slope: float


class _Friction(NamedTuple):
    """Forces at motor, nut and guide at the end of and as means over the last substep."""

    force: FloatArray
    mean: FloatArray
    slip: FloatArray
    slip_end: FloatArray
    work: FloatArray


class _Terms(NamedTuple):
    """Table terms, friction as share of its levels, and room for a value per site."""

    rows: FloatArray
    values: FloatArray
    shares: FloatArray
    places: FloatArray


_Levels = tuple[float, float, float]  # of friction at motor, nut and guide


class _Cycle(NamedTuple):
    """One servo cycle: number, time at its beginning, and what stays as it is meanwhile."""

    k: int
    t: float
    external_N: float
    grown: float  # thermal strain of the screw
    warm: float  # friction levels over those of the cold axis


class _Loads(NamedTuple):
    """Torques, force and friction levels at the middle of a substep."""

    motor: float
    nut: float
    table: float
    level_motor: float
    level_nut: float
    level_guide: float


@_part
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


@_part
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


@_part
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


@_part
def _smooth(change: float, speed: float, level: float, push: float, width: float) -> float:
    """Mean force over a substep of friction that goes through zero with speed.

    ``level tanh(v / width)`` at the substep's mean speed v, which the force moves itself; the other
    arguments are those of ``_coulomb``. With u = v / width, u + a tanh(u) = b is solved by Newton's
    method from below, from where it rises to the root.
    """
    b = (speed + 0.5 * change) / width
    sign = 1.0 if b >= 0.0 else -1.0
    b *= sign
    a = 0.5 * push * level / width
    u = max(b / (1.0 + a), b - a)
    for _ in range(20):
        bent = math.tanh(u)
        step = (b - u - a * bent) / (1.0 + a * (1.0 - bent * bent))
        u += step
        if abs(step) < 1e-9 + 1e-7 * u:
            break
    return sign * level * math.tanh(u)


@_part
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


@_part
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


@_part
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
        # F = k d (1 - F^2 / (36 F0^2)), solved for F, up to there; then straight on.
        spring = k * abs(rest)
        knee = _KNEE / math.sqrt(softening)
        bend = min(spring, knee)
        root = math.sqrt(1.0 + 4.0 * softening * bend * bend)
        lost = bend * (root - 1.0) / (root + 1.0) + _SOFTENED * max(spring - knee, 0.0)
        force -= math.copysign(lost, rest)
        slope -= k * (1.0 - 2.0 / (root * (1.0 + root)) if spring <= knee else _SOFTENED)
    return force, slope, share


@_part
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


@_part
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


@_part
def _stribeck(par: FloatArray, excess: float, speed: float) -> float:
    """Friction above the sliding level at a table speed."""
    ratio = speed / par[s.STRIBECK_SPEED]
    if excess == 0.0 or abs(ratio) > 6.0:
        return 0.0
    return excess * math.exp(-ratio * ratio)


@_part
def _strain(par: FloatArray, t: float) -> float:
    """Thermal strain of the screw at a time."""
    if par[s.GROWTH] == 0.0:
        return 0.0
    return float(par[s.GROWTH] * (1.0 - math.exp(-max(t, 0.0) / par[s.GROWTH_TIME])))


@_part
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


@_part
def _begun_Nm(par: FloatArray) -> float:
    """Torque with which a run begins: what the integrator holds, and the gain on the error left."""
    return float(par[s.START_TORQUE] + par[s.KP] * par[s.START_ERROR])


@_part
def _strained(par: FloatArray, z: FloatArray, force: FloatArray, slip: FloatArray) -> None:
    """Bristles that hold the torque with which a run begins, and the chain wound up between them.

    An axis that came to rest is held back by its friction, all at the same share of its level; what
    a bias or a cable pulls is not. Where it moves already, friction has its full level. A load that
    the guide cannot hold rests on a flank of the nut's clearance.
    """
    rho = par[s.LEAD]
    motor, nut = par[s.MOTOR + s.LEVEL], par[s.NUT + s.LEVEL]
    guide = par[s.GUIDE + s.LEVEL]
    total = motor + nut + rho * guide
    n_gms = int(par[s.GMS_N])
    if total <= 0.0:
        return
    load = par[s.BIAS] + par[s.CABLE_K] * (z[3] - par[s.CABLE_CENTRE])
    share = min(max((_begun_Nm(par) - rho * load) / total, -1.0), 1.0)
    if par[s.START_SPEED] != 0.0:
        share = math.copysign(1.0, par[s.START_SPEED])
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
    if abs(load) > guide:
        z[3] -= _given(par, pull)


@_part
def _given(par: FloatArray, pull: float) -> float:
    """What play and soft zone give under a force in the nut, m."""
    given = math.copysign(par[s.GAP_HALF], pull)
    if par[s.SOFT_HALF] > 0.0:
        loss = 1.0 - par[s.SOFT_RATIO]
        inside = loss * abs(pull) / (par[s.SOFT_RATIO] * par[s.K_NUT])
        given += math.copysign(min(inside, loss * par[s.SOFT_HALF]), pull)
    return given


@_part
def _faded(bristle: float, speed: float, level: float) -> float:
    """Damping of bristles at a speed: none where it would outgrow the level."""
    if bristle <= 0.0:
        return 0.0
    ratio = speed * bristle / level
    return bristle * math.exp(-ratio * ratio) if abs(ratio) < 5.0 else 0.0


@_part
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


@_part
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


@_part
def _relaxed(par: FloatArray, reading_m: float, z: FloatArray) -> None:
    """Chain without forces with the motor's reading on a position, at the speed of the start."""
    theta = reading_m / par[s.LEAD]
    for _ in range(50):
        wrong = par[s.ECCENTRICITY] * math.cos(
            par[s.ECCENTRICITY + 1] * theta + par[s.ECCENTRICITY + 2]
        )
        theta = (reading_m - wrong) / par[s.LEAD]
    z[0] = theta
    z[1] = theta
    z[3] = par[s.LEAD] * theta
    z[4] = par[s.START_SPEED] / par[s.LEAD]
    z[5] = z[4]
    z[7] = par[s.START_SPEED]


@_part
def _add_terms(
    terms: _Terms, kind: int, x: float, v: float, theta: float, t: float, since: float
) -> None:
    """Add the table terms of the readings, or those of torques, forces and friction levels.

    ``places`` has one entry per site (``terms.Site``).
    """
    rows, values, shares = terms.rows, terms.values, terms.shares
    for j in range(rows.shape[0]):
        site = int(rows[j, s.TERM_SITE])
        if (3 <= site <= 4) == (kind == _READINGS):
            terms.places[site] += _term(
                rows[j], values[j], x, v, theta, t, since, shares[0], shares[1]
            )


@_part
def _sense(
    par: FloatArray, axis: _Axis, terms: _Terms, t: float, table_a: float, grown: float
) -> tuple[float, float]:
    """Readings of encoder and scale in m, before they are rounded."""
    z = axis.z
    motor_read = par[s.LEAD] * z[0]
    if par[s.ECCENTRICITY] != 0.0:
        motor_read += par[s.ECCENTRICITY] * math.cos(
            par[s.ECCENTRICITY + 1] * z[0] + par[s.ECCENTRICITY + 2]
        )
    x_seen = z[3] - par[s.SKEW] * (z[7] - 0.5 * par[s.SKEW] * table_a)
    table_read = x_seen + par[s.SCALE_SLOPE] * x_seen
    if par[s.RIGID] > 0.5 and _has_lead_error(par):
        table_read += _lead(par, z[1], grown)[0]
    if par[s.SUBDIVISION] != 0.0:
        table_read += par[s.SUBDIVISION] * math.cos(
            par[s.SUBDIVISION + 1] * x_seen + par[s.SUBDIVISION + 2]
        )
    if terms.rows.shape[0] > 0:
        places = terms.places
        places[3] = motor_read
        places[4] = table_read
        _add_terms(terms, _READINGS, z[3], z[7], z[0], t, axis.turned[_SINCE])
        motor_read = places[3]
        table_read = places[4]
    return motor_read, table_read


@_part
def _rounded(value: float, step: float) -> float:
    """Value on a grid of ``step``; a step of 0 means none."""
    return math.floor(value / step + 0.5) * step if step > 0.0 else value


@_part
def _pid(par: FloatArray, memory: FloatArray, error: float, read: float, vc: float) -> float:
    """PID with velocity and acceleration feed-forward, notch and friction feed-forward, N m."""
    Ts = par[s.PERIOD]
    ac = (vc - memory[_VC]) / Ts
    memory[_VF] += par[s.FILTER] * ((read - memory[_READ]) / Ts - memory[_VF])
    u = (
        par[s.KP] * error
        + memory[_INTEGRAL]
        + par[s.KVFF] * vc
        + par[s.KAFF] * ac
        - par[s.KD] * memory[_VF]
    )
    filtered = (
        u
        + par[s.NOTCH] * memory[_U1]
        + par[s.NOTCH + 1] * memory[_U2]
        - par[s.NOTCH + 2] * memory[_Y1]
        - par[s.NOTCH + 3] * memory[_Y2]
    )
    memory[_U2] = memory[_U1]
    memory[_U1] = u
    memory[_Y2] = memory[_Y1]
    memory[_Y1] = filtered
    return float(filtered)


@_part
def _control(
    par: FloatArray, memory: FloatArray, desired: float, read: float, feedforward: float
) -> float:
    """Torque command of a servo cycle in N m; ``memory`` is what the servo keeps."""
    Ts = par[s.PERIOD]
    error = min(max(desired - read, -par[s.FE_LIMIT]), par[s.FE_LIMIT])
    change = desired - memory[_DESIRED]
    vc = change / Ts
    # Round-off of a standing command is no motion.
    command_moves = abs(change) > _COMMAND_RESOLUTION_m
    if par[s.LAW] < 0.5:
        u = _pid(par, memory, error, read, vc)
        if command_moves:
            u += math.copysign(par[s.FRICTION_FF], vc)
    else:
        u = par[s.CASCADE_GAIN] * (
            par[s.CASCADE_KP] * error - (read - memory[_OLDER_READ]) / (2.0 * Ts)
        )
    u += par[s.OFFSET] + par[s.START_TORQUE] + feedforward
    command = min(max(u, -par[s.LIMIT]), par[s.LIMIT])
    clipped = u - command
    frozen = clipped != 0.0 and (par[s.FREEZE_ALWAYS] > 0.5 or clipped * error > 0.0)
    if not frozen and (par[s.INTEGRATE_AT_REST] < 0.5 or not command_moves):
        integral = memory[_INTEGRAL] + par[s.KI] * Ts * error
        limit = par[s.INTEGRATOR_LIMIT]
        memory[_INTEGRAL] = min(max(integral, -limit), limit)
    memory[_OLDER_READ] = memory[_READ]
    memory[_READ] = read
    memory[_DESIRED] = desired
    memory[_VC] = vc
    return float(_rounded(command, par[s.TORQUE_STEP]))


@_part
def _remember(par: FloatArray, memory: FloatArray, desired: float, read: float) -> None:
    """What the servo keeps of earlier cycles: at rest, or at the speed of the start."""
    step_m = par[s.START_SPEED] * par[s.PERIOD]
    memory[_DESIRED] = desired - step_m
    memory[_READ] = read - step_m
    memory[_OLDER_READ] = read - 2.0 * step_m
    memory[_VC] = par[s.START_SPEED]
    memory[_VF] = par[s.START_SPEED]


@njit(cache=True, nogil=True, error_model="numpy")
def law_Nm(par: FloatArray, desired_m: FloatArray, reading_m: FloatArray) -> FloatArray:
    """Torque command of the law on given readings from its start on, N m."""
    memory = np.zeros(_MEMORY)
    _remember(par, memory, desired_m[0], reading_m[0])
    command = np.zeros(desired_m.size)
    for k in range(desired_m.size):
        command[k] = _control(par, memory, desired_m[k], reading_m[k], 0.0)
    return command


@_part
def _chain_at(flat_bank: FloatArray, place: float, flat: FloatArray) -> None:
    """Step matrix between the nodes of the bank, into ``flat``."""
    n_nodes = flat_bank.shape[0]
    if not place > 0.0:
        place = 0.0
    if place > n_nodes - 1:
        place = n_nodes - 1.0
    node = min(int(place), max(n_nodes - 2, 0))
    w1 = place - node
    before, behind = flat_bank[node], flat_bank[min(node + 1, n_nodes - 1)]
    for i in range(N_COLUMNS * N_STATES):
        flat[i] = before[i] + w1 * (behind[i] - before[i])


@_part
def _mobilities(par: FloatArray, chain: _Chain) -> None:
    """How motor, nut and table move and speed up per force at each of the three.

    ``bends`` is how the joint stretches by them, and at last by its own force.
    """
    W, moves, speeds, bends = chain.W, chain.moves, chain.speeds, chain.bends
    for i in range(3):
        row = 3 if i == 2 else i
        for j in range(3):
            column = 11 if j == 2 else (10 if j == 1 else 8)
            moves[i, j] = W[column, row]
            speeds[i, j] = W[column, 4 + row]
    for j in range(4):
        column = 8 if j == 0 else 9 + j
        bends[j] = W[column, 3] - par[s.LEAD] * W[column, 1] - W[column, 2]


@_part
def _held_torque(
    history: FloatArray, resting: float, place: int, n_sub: int, delay_steps: float
) -> float:
    """Mean over a substep of the delayed torque command; ``place`` counts substeps."""
    late = place - delay_steps
    cell = math.floor(late / n_sub)
    to_next = (cell + 1.0) * n_sub - late
    held = resting
    if cell >= 0:
        held = history[int(cell) & (_HISTORY - 1)]
    if to_next < 1.0:
        following = resting
        if cell + 1 >= 0:
            following = history[int(cell + 1) & (_HISTORY - 1)]
        held = to_next * held + (1.0 - to_next) * following
    return float(held)


@_part
def _shake_base(par: FloatArray, base: FloatArray, table_a: float, h: float) -> float:
    """Force of the moving bed on the table over a substep; ``base`` is its place and speed.

    Bed on its foundation, positions relative to the bed: the table feels -M x_b''. The part of it
    that the table's own acceleration makes is in the chain's mass (``share_of_bed``): felt one
    substep late it would drive the drive's own modes.
    """
    mass, bed, omega = par[s.M_TABLE], par[s.BASE_MASS], par[s.BASE_OMEGA]
    before = omega * (2.0 * par[s.BASE_ZETA] * base[1] + omega * base[0])
    base[1] += h * (-mass * table_a - bed * before) / (bed + mass)
    base[0] += h * base[1]
    after = omega * (2.0 * par[s.BASE_ZETA] * base[1] + omega * base[0])
    return float(mass * share_of_bed(par) * 0.5 * (before + after))


@_part
def _push(
    par: FloatArray,
    mid_theta: float,
    mid_x: float,
    mid_speed: float,
    motor_speed: float,
    nut_speed: float,
    external_N: float,
    torque: float,
    mid_t: float,
) -> tuple[float, float, float]:
    """Explicit torques on motor and nut and force on the table, at the middle of a substep.

    ``torque`` is that of the motor there.
    """
    motor = 0.0
    nut = 0.0
    table = -par[s.BIAS] - external_N
    if par[s.COGGING] != 0.0 or par[s.RIPPLE] != 0.0:
        motor += par[s.COGGING] * math.cos(par[s.COGGING + 1] * mid_theta + par[s.COGGING + 2])
        wave = math.cos(par[s.RIPPLE + 1] * mid_theta + par[s.RIPPLE + 2])
        motor += par[s.RIPPLE] * torque * wave
    if par[s.CABLE_K] != 0.0:
        table -= par[s.CABLE_K] * (mid_x - par[s.CABLE_CENTRE])
    if par[s.EXTERNAL] != 0.0:
        table -= par[s.EXTERNAL] * math.sin(par[s.EXTERNAL + 1] * mid_t + par[s.EXTERNAL + 2])
    if par[s.POWER_FORCE] != 0.0:
        curved = abs(mid_speed) ** par[s.POWER_EXPONENT]
        table -= par[s.POWER_FORCE] * math.copysign(curved, mid_speed)
    if _is_asymmetric(par):
        uneven = par[s.ASYMMETRY_VISCOUS] + par[s.ASYMMETRY_SLIDING]
        table -= uneven * par[s.GUIDE + s.VISCOUS] * abs(mid_speed)
        nut -= par[s.ASYMMETRY_ROTARY] * par[s.NUT + s.VISCOUS] * abs(nut_speed)
        motor -= par[s.ASYMMETRY_ROTARY] * par[s.MOTOR + s.VISCOUS] * abs(motor_speed)
    return motor, nut, table


@_part
def _friction_levels(
    par: FloatArray,
    motor_speed: float,
    nut_speed: float,
    table_speed: float,
    nut_theta: float,
    since: float,
) -> tuple[float, float, float]:
    """Levels of friction at motor, nut and guide, at the middle of a substep."""
    guide = par[s.GUIDE + s.LEVEL]
    nut = par[s.NUT + s.LEVEL]
    motor = par[s.MOTOR + s.LEVEL]
    if par[s.STRIBECK_GUIDE] != 0.0 or par[s.STRIBECK_NUT] != 0.0 or par[s.STRIBECK_MOTOR] != 0.0:
        guide += _stribeck(par, par[s.STRIBECK_GUIDE], table_speed)
        nut += _stribeck(par, par[s.STRIBECK_NUT], par[s.LEAD] * nut_speed)
        motor += _stribeck(par, par[s.STRIBECK_MOTOR], par[s.LEAD] * motor_speed)
    if par[s.PER_REV] != 0.0:
        nut += par[s.PER_REV] * math.cos(par[s.PER_REV + 1] * nut_theta + par[s.PER_REV + 2])
    if par[s.DIP] != 0.0:
        nut *= 1.0 - par[s.DIP] * math.exp(-since / par[s.DIP_LENGTH])
    return motor, nut, guide


@_part
def _kinked_force(
    par: FloatArray, base_force: float, old_delta: float, mean_delta: float, gain: float, h: float
) -> float:
    """Mean force of a joint with kinks over a substep, beyond its linear spring.

    Newton for the mean deflection; forces act back on it with half the mobility, ``gain``.
    """
    damper = par[s.K_NUT] * par[s.BETA]
    extra = base_force
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
    return float(extra)


@_part
def _beyond_spring(
    par: FloatArray,
    old_delta: float,
    delta: float,
    old_lead: float,
    lead: float,
    gain: float,
    h: float,
) -> float:
    """Mean force of the joint over a substep beyond its linear spring: lead error, kinks.

    ``gain`` is half of what the joint gives way per force.
    """
    # The bank's spring and damper follow x - rho theta - u: take the lead out of it.
    damper = par[s.K_NUT] * par[s.BETA]
    extra = -par[s.K_NUT] * (0.5 * (old_lead + lead)) - damper * (lead - old_lead) / h
    if _has_kinks(par):
        extra = _kinked_force(par, extra, old_delta, 0.5 * (old_delta + delta), gain, h)
    return float(extra)


@_part
def _load_friction(par: FloatArray, delta: float) -> float:
    """Torque by which the load of the nut raises its friction."""
    force = par[s.K_NUT] * delta
    if _has_kinks(par) or _has_lead_error(par):
        force += joint_force(par, delta)[0]
    return float(par[s.NUT_LOAD] * par[s.LEAD] * abs(force))


@_part
def _rub(
    par: FloatArray, has: _Has, chain: _Chain, axis: _Axis, friction: _Friction, levels: _Levels
) -> None:
    """Friction solved with the motion that it lets through.

    From the forces of the last substep (``mean``), site by site, until they agree. ``force`` and
    ``slip`` become the forces at the end of the substep; ``work`` is room for (4, 3) numbers.
    """
    n_gms = int(par[s.GMS_N])
    widths = (par[s.SMOOTH_ROTARY], par[s.SMOOTH_ROTARY], par[s.SMOOTH_GUIDE])
    z, zf, moves, speeds = axis.z, axis.zf, chain.moves, chain.speeds
    force, mean, slip, slip_end = friction.force, friction.mean, friction.slip, friction.slip_end
    start, moved = friction.work[0], friction.work[1]
    gained, end_force = friction.work[2], friction.work[3]
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
            level = levels[i]
            old = mean[i]
            push = speeds[i, i]
            free = moved[i] + moves[i, i] * old
            site = s.GUIDE if i == 2 else (s.NUT if i == 1 else s.MOTOR)
            if level <= 0.0:
                new = 0.0
                end_force[i] = 0.0
            elif i == 2 and n_gms > 0:
                rub = _faded(par[s.GUIDE + s.BRISTLE], start[i], level) * has.rate_h
                new = _slip_elements(slip, slip_end, par, free, level, moves[i, i], rub)
            elif widths[i] > 0.0:
                new = _smooth(gained[i] + push * old, start[i], level, push, widths[i])
                end_force[i] = new
            elif par[site + s.BREAK] <= 0.0:
                new, end_force[i] = _coulomb(gained[i] + push * old, start[i], level, push)
            else:
                new, end_force[i] = _bristle(
                    force[i], free, level, par, site, moves[i, i], has.h, start[i]
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


@_part
def _count_way(theta: float, turned: FloatArray) -> None:
    """Distance since reversal of the nut; a reversal is a return by 0.05 mrad."""
    extreme, heading = turned[_EXTREME], turned[_HEADING]
    if (theta - extreme) * heading >= 0.0:
        turned[_SINCE] += abs(theta - extreme)
        turned[_EXTREME] = theta
    elif (extreme - theta) * heading > 5e-5:
        turned[_HEADING] = -heading
        turned[_SINCE] = abs(theta - extreme)
        turned[_EXTREME] = theta


@_part
def _has_lead_error(par: FloatArray) -> bool:
    return bool(par[s.WOBBLE] != 0.0 or par[s.LEAD_SLOPE] != 0.0 or par[s.GROWTH] != 0.0)


@_part
def _has_kinks(par: FloatArray) -> bool:
    return bool(par[s.GAP_HALF] > 0.0 or par[s.SOFT_HALF] > 0.0 or par[s.HERTZ] > 0.0)


@_part
def _is_asymmetric(par: FloatArray) -> bool:
    return bool(
        par[s.ASYMMETRY_VISCOUS] != 0.0
        or par[s.ASYMMETRY_SLIDING] != 0.0
        or par[s.ASYMMETRY_ROTARY] != 0.0
    )


@_part
def _is_sharp(par: FloatArray, site: int) -> bool:
    """Whether friction of a site sets in at once: ideal Coulomb."""
    width = par[s.SMOOTH_GUIDE if site == s.GUIDE else s.SMOOTH_ROTARY]
    at_once = par[site + s.BREAK] <= 0.0 and width <= 0.0
    return bool(at_once and (site != s.GUIDE or par[s.GMS_N] < 0.5))


@_part
def _what_it_has(par: FloatArray, h: float, n_terms: int) -> _Has:
    """Branches of the substeps of a model, and their figures."""
    elastic = par[s.RIGID] <= 0.5
    lead = elastic and _has_lead_error(par)
    guide_sharp = _is_sharp(par, s.GUIDE)
    return _Has(
        elastic=elastic,
        lead=lead,
        joint=elastic and (_has_kinks(par) or lead),
        load=elastic and par[s.NUT_LOAD] != 0.0,
        way=par[s.DIP] != 0.0 or n_terms > 0,
        base=par[s.BASE_MASS] > 0.0,
        asymmetry=_is_asymmetric(par),
        guide_sharp=guide_sharp,
        all_sharp=guide_sharp and _is_sharp(par, s.NUT) and _is_sharp(par, s.MOTOR),
        h=h,
        rate_h=1.0 / h,
        fade=0.0 if par[s.CURRENT_RATE] <= 0.0 else math.exp(-par[s.CURRENT_RATE] * h),
        delay_steps=par[s.DELAY] / h,
        begun_Nm=_begun_Nm(par),
    )


@_part
def _begin(
    par: FloatArray, has: _Has, axis: _Axis, friction: _Friction, reading_m: float, start_s: float
) -> _Now:
    """State in which a run begins: relaxed, or holding a torque, or under way."""
    z, turned = axis.z, axis.turned
    _relaxed(par, reading_m, z)
    turned[_EXTREME] = z[0]
    turned[_HEADING] = 1.0
    if par[s.START_SPEED] != 0.0:
        turned[_HEADING] = math.copysign(1.0, par[s.START_SPEED])
        turned[_SINCE] = _LONG_AGO_rad
    lead, lead_slope = 0.0, 0.0
    if has.elastic:
        lead, lead_slope = _lead(par, z[1], _strain(par, start_s))
    z[3] += lead
    if has.begun_Nm != 0.0 or par[s.START_SPEED] != 0.0:
        _strained(par, z, friction.force, friction.slip)
        for i in range(3):
            friction.mean[i] = friction.force[i]
    return _Now(0.0, 0.0, 0.0, has.begun_Nm, lead, lead_slope)


@_part
def _servo(
    par: FloatArray,
    has: _Has,
    axis: _Axis,
    terms: _Terms,
    memory: FloatArray,
    now: _Now,
    cycle: _Cycle,
    desired_m: float,
    feedforward_Nm: float,
    out: FloatArray,
) -> float:
    """Torque command of a servo cycle, N m; what is known at its beginning goes to ``out``."""
    z, k = axis.z, cycle.k
    motor_read, table_read = _sense(par, axis, terms, cycle.t, now.table_a, cycle.grown)
    if out.shape[0] > 5:
        out[5, k] = motor_read
        out[6, k] = table_read
    motor_read = _rounded(motor_read, par[s.MOTOR_STEP])
    if k == 0:
        _remember(par, memory, desired_m, motor_read)
    command = _control(par, memory, desired_m, motor_read, feedforward_Nm)
    delta = z[3] - par[s.LEAD] * z[1] - z[2] - now.lead
    out[0, k] = motor_read
    out[1, k] = _rounded(table_read, par[s.TABLE_STEP])
    out[2, k] = command
    out[3, k] = now.torque
    out[4, k] = par[s.K_NUT] * delta + (joint_force(par, delta)[0] if has.joint else 0.0)
    return float(command)


@_part
def _warmth(par: FloatArray, t: float) -> float:
    """Friction levels over those of the cold axis."""
    if par[s.WARMUP] == 0.0:
        return 1.0
    return float(1.0 - par[s.WARMUP] * (1.0 - math.exp(-t / par[s.WARMUP_TIME])))


@_part
def _at_middle(
    par: FloatArray,
    has: _Has,
    axis: _Axis,
    terms: _Terms,
    now: _Now,
    cycle: _Cycle,
    torque: float,
    t: float,
) -> _Loads:
    """Explicit torques, forces and friction levels at the middle of a substep, time ``t``."""
    z, h, warm = axis.z, has.h, cycle.warm
    theta, x, speed = z[0] + 0.5 * h * z[4], z[3] + 0.5 * h * z[7], z[7] + 0.5 * h * now.table_a
    motor, nut, table = _push(par, theta, x, speed, z[4], z[5], cycle.external_N, torque, t)
    if has.lead:
        # The nut's torque is force times advance per radian, lead error included.
        pull = z[3] - par[s.LEAD] * z[1] - z[2] - now.lead
        nut += now.lead_slope * (par[s.K_NUT] * pull + joint_force(par, pull)[0])
    if has.base:
        table += _shake_base(par, axis.base, now.table_a, h)
    since = axis.turned[_SINCE]
    level_motor, level_nut, level_guide = _friction_levels(
        par, z[4] + 0.5 * h * now.motor_a, z[5] + 0.5 * h * now.nut_a, speed,
        z[1] + 0.5 * h * z[5], since,
    )  # fmt: skip
    if has.asymmetry:
        # At rest the guide holds unequal forces either way: equal ones about a force.
        # Bristles hold the level of the direction in which they move.
        uneven = par[s.ASYMMETRY_SLIDING]
        if has.guide_sharp:
            table -= uneven * level_guide * warm
        else:
            level_guide *= 1.0 + math.copysign(1.0, speed) * uneven
    if terms.rows.shape[0] > 0:
        places = terms.places
        places[0], places[1], places[2] = motor, nut, table
        places[5], places[6], places[7] = level_nut, level_guide, level_motor
        _add_terms(terms, _FORCES, x, speed, theta, t, since)
        motor, nut, table = places[0], places[1], places[2]
        level_nut, level_guide, level_motor = places[5], places[6], places[7]
    return _Loads(motor, nut, table, level_motor * warm, level_nut * warm, level_guide * warm)


@_part
def _move_freely(W: FloatArray, axis: _Axis, held: float, fading: float, loads: _Loads) -> None:
    """Chain without friction: one loop over the states that the compiler can vectorise."""
    z, zf = axis.z, axis.zf
    z0, z1, z2, z3, z4, z5, z6, z7 = z[0], z[1], z[2], z[3], z[4], z[5], z[6], z[7]
    drive, nut, table = held + loads.motor, loads.nut, loads.table
    for i in range(N_STATES):
        zf[i] = (
            W[8, i] * drive
            + W[9, i] * fading
            + W[10, i] * nut
            + W[11, i] * table
            + W[0, i] * z0
            + W[1, i] * z1
            + W[2, i] * z2
            + W[3, i] * z3
            + W[4, i] * z4
            + W[5, i] * z5
            + W[6, i] * z6
            + W[7, i] * z7
        )


@_part
def _stretch_joint(
    par: FloatArray,
    has: _Has,
    chain: _Chain,
    axis: _Axis,
    mean: FloatArray,
    now: _Now,
    cycle: _Cycle,
) -> tuple[float, float, float]:
    """Forces of the joint beyond its spring; lead, its slope, torque that load adds to friction.

    Friction of this substep is not known yet: that of the last one (``mean``) bends the joint.
    """
    z, zf, bends, rho = axis.z, axis.zf, chain.bends, par[s.LEAD]
    bent = bends[0] * mean[0] + bends[1] * mean[1] + bends[2] * mean[2]
    lead, lead_slope, raised = now.lead, now.lead_slope, 0.0
    if has.joint:
        if has.lead:
            lead, lead_slope = _lead(par, zf[1], cycle.grown)
        old_delta = z[3] - rho * z[1] - z[2] - now.lead
        delta = zf[3] - rho * zf[1] - zf[2] - lead - bent
        extra = _beyond_spring(par, old_delta, delta, now.lead, lead, -0.5 * bends[3], has.h)
        for i in range(N_STATES):
            zf[i] += chain.W[12, i] * extra
    if has.load:
        delta = 0.5 * (z[3] + zf[3] - rho * (z[1] + zf[1]) - z[2] - zf[2])
        delta -= 0.5 * (now.lead + lead)
        raised = _load_friction(par, delta - 0.5 * bent)
    return lead, lead_slope, raised


@_part
def _rub_sharply(chain: _Chain, axis: _Axis, friction: _Friction, levels: _Levels) -> None:
    """Ideal Coulomb friction at all three, solved with the motion that it lets through."""
    z, zf, force, mean = axis.z, axis.zf, friction.force, friction.mean
    (mean[0], mean[1], mean[2], force[0], force[1], force[2]) = _three_coulomb(
        chain.speeds, zf[4] - z[4], zf[5] - z[5], zf[7] - z[7], z[4], z[5], z[7],
        levels[0], levels[1], levels[2], mean[0], mean[1], mean[2],
    )  # fmt: skip


@_part
def _share(shares: FloatArray, force: FloatArray, levels: _Levels) -> None:
    """Friction of guide and nut as shares of their levels, for the table terms."""
    shares[0] = force[2] / levels[2] if levels[2] > 0.0 else 0.0
    shares[1] = force[1] / levels[1] if levels[1] > 0.0 else 0.0


@_part
def _step_on(
    W: FloatArray, axis: _Axis, mean: FloatArray, rate_h: float
) -> tuple[float, float, float]:
    """State at the end of a substep under the friction that was found; the accelerations."""
    z, zf = axis.z, axis.zf
    motor, nut, table = mean[0], mean[1], mean[2]
    z4, z5, z7 = z[4], z[5], z[7]
    for i in range(N_STATES):
        z[i] = zf[i] - W[8, i] * motor - W[10, i] * nut - W[11, i] * table
    return (z[4] - z4) * rate_h, (z[5] - z5) * rate_h, (z[7] - z7) * rate_h


@_part
def _substep(
    par: FloatArray,
    has: _Has,
    chain: _Chain,
    axis: _Axis,
    friction: _Friction,
    terms: _Terms,
    now: _Now,
    cycle: _Cycle,
    held: float,
    t: float,
) -> _Now:
    """Drive under a held torque command over one substep whose middle is at time ``t``."""
    fading = 0.0 if par[s.CURRENT_RATE] <= 0.0 else now.torque - held
    torque = held + 0.5 * (1.0 + has.fade) * fading
    loads = _at_middle(par, has, axis, terms, now, cycle, torque, t)
    _move_freely(chain.W, axis, held, fading, loads)
    lead, lead_slope, raised = _stretch_joint(par, has, chain, axis, friction.mean, now, cycle)
    levels = (loads.level_motor, loads.level_nut + raised, loads.level_guide)
    if has.all_sharp:
        _rub_sharply(chain, axis, friction, levels)
    else:
        _rub(par, has, chain, axis, friction, levels)
    motor_a, nut_a, table_a = _step_on(chain.W, axis, friction.mean, has.rate_h)
    if has.lead:
        lead, lead_slope = _lead(par, axis.z[1], cycle.grown)
    if terms.rows.shape[0] > 0:
        _share(terms.shares, friction.force, levels)
    if has.way:
        _count_way(axis.z[1], axis.turned)
    return _Now(motor_a, nut_a, table_a, held + has.fade * fading, lead, lead_slope)


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
    """Closed loop over all servo cycles; ``out`` is (5, n), or (7, n).

    Rows: motor reading m, table reading m, torque command N m, motor torque N m, joint force N,
    both readings before they are rounded. Returns the number of cycles that stayed finite.
    """
    h = par[s.PERIOD] / n_sub
    has = _what_it_has(par, h, terms.shape[0])
    W = np.zeros((N_COLUMNS, N_STATES))
    flat = W.reshape(N_COLUMNS * N_STATES)
    flat_bank = bank.reshape((bank.shape[0], N_COLUMNS * N_STATES))
    chain = _Chain(W, np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(4))
    z = np.zeros(N_STATES)
    axis = _Axis(z, np.zeros(N_STATES), np.zeros(3), np.zeros(2))
    friction = _Friction(np.zeros(3), np.zeros(3), np.zeros(8), np.zeros(8), np.zeros((4, 3)))
    room = _Terms(terms, term_values, np.zeros(2), np.zeros(8))
    history, memory = np.zeros(_HISTORY), np.zeros(_MEMORY)
    now = _begin(par, has, axis, friction, desired_m[0] - par[s.START_ERROR], start_s)
    limit = par[s.ACTUATOR_LIMIT]
    for k in range(desired_m.size):
        t = start_s + k * par[s.PERIOD]
        cycle = _Cycle(k, t, external_N[k], _strain(par, t), _warmth(par, t))
        command = _servo(
            par, has, axis, room, memory, now, cycle, desired_m[k], torque_ff_Nm[k], out
        )
        history[k & (_HISTORY - 1)] = min(max(command, -limit), limit)
        if not (abs(z[3]) < 1e6 and abs(z[4]) < 1e9):
            return k
        _chain_at(flat_bank, (z[3] + par[s.X_ORIGIN] - first_m) / spacing_m, flat)
        _mobilities(par, chain)
        for sub in range(n_sub):
            place = k * n_sub + sub
            held = _held_torque(history, has.begun_Nm, place, n_sub, has.delay_steps)
            middle = t + (sub + 0.5) * h
            now = _substep(par, has, chain, axis, friction, room, now, cycle, held, middle)
    return desired_m.size
