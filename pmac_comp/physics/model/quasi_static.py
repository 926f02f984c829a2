"""Closed forms of the mechanical tracking error, with the inertia of the chain neglected.

What lives here: compliances, the forces that stretch the drive and the error that follows, static
errors of lead and scale, modes of the chain. Valid well below the first resonance. Imports the
model only.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from pmac_comp.base.arrays import FloatArray, finite_array
from pmac_comp.base.errors import ModelError
from pmac_comp.base.units import MM_PER_M
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.drive import DriveModel


@dataclass(frozen=True)
class RegressionCoefficients:
    """e_m = -(a0 + a1 x) a - (b0 + b1 x) v - (g0 + g1 x) sgn v with x from the bearing, SI."""

    acceleration: tuple[float, float]
    velocity: tuple[float, float]
    direction: tuple[float, float]


def compliance_m_per_N(model: DriveModel, table_position_m: FloatArray | float) -> FloatArray:
    """Table displacement per force on the table with the motor held, m/N, shape (n,).

    Parameters
    ----------
    model : DriveModel
        The drive.
    table_position_m : float or ndarray, shape (n,)
        Table position in m.

    Source
    ------
    Springs in series: C = 1/k_b + 1/k_n + x/EA + rho^2 C_th, C_th = 1/k_c + x/GJ.
    """
    vector = _elastic(model)
    x = _screw_position(vector, table_position_m)
    axial = 1.0 / vector[s.K_BEARING] + 1.0 / vector[s.K_NUT] + x / vector[s.EA]
    return np.asarray(axial + vector[s.LEAD] ** 2 * _torsion(vector, x))


def torsional_compliance_rad_per_Nm(
    model: DriveModel, table_position_m: FloatArray | float
) -> FloatArray:
    """Wind-up between motor and nut per torque at the nut, rad/(N m), shape (n,)."""
    vector = _elastic(model)
    return _torsion(vector, _screw_position(vector, table_position_m))


def screw_windup_m_per_m_per_s2(
    model: DriveModel, table_position_m: FloatArray | float
) -> FloatArray:
    """Table lag per acceleration from the screw's own inertia, c_J in s2, shape (n,).

    Source
    ------
    Derived here: c_J = (J_s + J_c/2)/k_c + j_s (L x - x^2/2)/GJ.
    """
    vector = _elastic(model)
    x = _screw_position(vector, table_position_m)
    per_length = vector[s.J_SCREW] / vector[s.LENGTH]
    coupling = (vector[s.J_SCREW] + vector[s.J_COUPLING]) / vector[s.K_COUPLING]
    return np.asarray(coupling + per_length * (vector[s.LENGTH] * x - 0.5 * x**2) / vector[s.GJ])


def table_force_N(
    model: DriveModel,
    position_m: FloatArray,
    velocity_m_per_s: FloatArray,
    acceleration_m_per_s2: FloatArray,
    direction: FloatArray,
    external_force_N: FloatArray | float = 0.0,
) -> FloatArray:
    """Force that the nut must push the table with, N, shape (n,); arguments as below."""
    vector = model.kernel_vector()
    x, v, a, sense = _four(position_m, velocity_m_per_s, acceleration_m_per_s2, direction)
    level = vector[s.GUIDE + s.LEVEL] * (1.0 + vector[s.ASYMMETRY_SLIDING] * sense)
    level = level + vector[s.STRIBECK_GUIDE] * np.exp(-((v / vector[s.STRIBECK_SPEED]) ** 2))
    uneven = vector[s.ASYMMETRY_VISCOUS] + vector[s.ASYMMETRY_SLIDING]
    viscous = vector[s.GUIDE + s.VISCOUS] * (v + uneven * np.abs(v))
    power = vector[s.POWER_FORCE] * np.abs(v) ** vector[s.POWER_EXPONENT] * np.sign(v)
    cable = vector[s.CABLE_K] * (x - vector[s.CABLE_CENTRE])
    inertia = vector[s.M_TABLE] * a
    force = inertia + viscous + power + level * sense + cable + vector[s.BIAS] + external_force_N
    return np.asarray(force)


def mechanical_error_m(
    model: DriveModel,
    position_m: FloatArray,
    velocity_m_per_s: FloatArray,
    acceleration_m_per_s2: FloatArray,
    direction: FloatArray | None = None,
    external_force_N: FloatArray | float = 0.0,
) -> FloatArray:
    """Dynamic mechanical tracking error (table minus motor, without lead errors) in m.

    Parameters
    ----------
    model : DriveModel
        The drive; effects of friction, bias, cable, backlash and compliance are taken into account.
    position_m, velocity_m_per_s, acceleration_m_per_s2 : ndarray, shape (n,)
        Motion of the table.
    direction : ndarray, shape (n,), or None
        Direction of motion, -1 to 1 (the friction state); None takes the sign of the velocity.
    external_force_N : float or ndarray, shape (n,)
        Force on the table, positive pushes against positive motion.

    Returns
    -------
    ndarray, shape (n,)
        Error in m.

    Source
    ------
    Equations of motion of the chain without its own inertia, s the sense of motion; derived here::

        e = -C F - rho C_th ((T_n + mu rho |F|) s + B_n v/rho) - c_J a
        F = M a + B v + F_c s + F_ext

    and of a gap or a soft stretch in the nut half its width, in the direction of F.

    Assumes
    -------
    Motion well below the first resonance; friction at its level, not within presliding.
    """
    vector = _elastic(model)
    sense = np.sign(velocity_m_per_s) if direction is None else direction
    x, v, a, sense = _four(position_m, velocity_m_per_s, acceleration_m_per_s2, sense)
    force = table_force_N(model, x, v, a, sense, external_force_N)
    torque = vector[s.NUT + s.LEVEL] * sense
    torque = torque + vector[s.NUT_LOAD] * vector[s.LEAD] * np.abs(force) * sense
    torque = torque + vector[s.NUT + s.VISCOUS] * v / vector[s.LEAD]
    windup = vector[s.LEAD] * torsional_compliance_rad_per_Nm(model, x) * torque
    gap = vector[s.GAP_HALF] * np.sign(force)
    soft = vector[s.SOFT_HALF] * (1.0 - vector[s.SOFT_RATIO])
    knee = vector[s.K_NUT] * vector[s.SOFT_HALF] * vector[s.SOFT_RATIO]
    lost = soft * np.clip(force / knee, -1.0, 1.0) if knee > 0.0 else soft * np.sign(force)
    own = screw_windup_m_per_m_per_s2(model, x) * a
    return np.asarray(-compliance_m_per_N(model, x) * force - windup - own - gap - lost)


def static_error_m(
    model: DriveModel, position_m: FloatArray, time_s: FloatArray | float = 0.0
) -> FloatArray:
    """Static errors of lead, scale and temperature (table minus motor) in m, shape (n,)."""
    vector = model.kernel_vector()
    x = finite_array("position_m", np.atleast_1d(position_m))
    angle = x / vector[s.LEAD]
    slope = (vector[s.LEAD_SLOPE] + vector[s.SCALE_SLOPE]) * x
    wobble = vector[s.WOBBLE] * np.cos(vector[s.WOBBLE + 1] * angle + vector[s.WOBBLE + 2])
    wrong = vector[s.ECCENTRICITY] * np.cos(
        vector[s.ECCENTRICITY + 1] * angle + vector[s.ECCENTRICITY + 2]
    )
    fine = vector[s.SUBDIVISION] * np.cos(vector[s.SUBDIVISION + 1] * x + vector[s.SUBDIVISION + 2])
    warm = -np.expm1(-np.asarray(time_s, dtype=np.float64) / vector[s.GROWTH_TIME])
    grown = vector[s.GROWTH] * warm * (x + vector[s.X_ORIGIN])
    return np.asarray(slope + wobble - wrong + fine + grown)


def motor_torque_Nm(
    model: DriveModel,
    position_m: FloatArray,
    velocity_m_per_s: FloatArray,
    acceleration_m_per_s2: FloatArray,
    direction: FloatArray | None = None,
) -> FloatArray:
    """Motor torque of a rigid motion in N m, shape (n,); arguments as ``mechanical_error_m``.

    Source
    ------
    Newton's law at the motor: inertia, friction of all sites, force of the table, efficiency.
    """
    vector = model.kernel_vector()
    sense = np.sign(velocity_m_per_s) if direction is None else direction
    x, v, a, sense = _four(position_m, velocity_m_per_s, acceleration_m_per_s2, sense)
    lead = vector[s.LEAD]
    force = table_force_N(model, x, v, a, sense)
    if model.is_rigid:
        return np.asarray(lead * force)
    inertia = vector[s.J_MOTOR] + vector[s.J_COUPLING] + vector[s.J_SCREW]
    viscous = vector[s.MOTOR + s.VISCOUS] + vector[s.NUT + s.VISCOUS]
    levels = vector[s.MOTOR + s.LEVEL] + vector[s.NUT + s.LEVEL]
    load = vector[s.NUT_LOAD] * lead * np.abs(force)
    torque = (inertia * a + viscous * v) / lead + (levels + load) * sense + lead * force
    return np.asarray(torque)


def regression_coefficients(model: DriveModel) -> RegressionCoefficients:
    """Six numbers of the regression R1, intercept at the bearing and slope per m.

    Source
    ------
    ``mechanical_error_m``, which is linear in a, v and s, each times 1 and x. The quadratic part of
    c_J is replaced by its chord over the travel.
    """
    vector = _elastic(model)
    travel = model.bench.travel
    ends = np.array([travel.min_mm, travel.max_mm]) / MM_PER_M
    x = _screw_position(vector, ends)
    C = compliance_m_per_N(model, ends)
    own = screw_windup_m_per_m_per_s2(model, ends)
    wind = vector[s.LEAD] * torsional_compliance_rad_per_Nm(model, ends)
    nut = vector[s.NUT + s.LEVEL] + vector[s.NUT_LOAD] * vector[s.LEAD] * vector[s.GUIDE + s.LEVEL]
    return RegressionCoefficients(
        _line(x, C * vector[s.M_TABLE] + own),
        _line(x, C * vector[s.GUIDE + s.VISCOUS]
              + wind * vector[s.NUT + s.VISCOUS] / vector[s.LEAD]),
        _line(x, C * vector[s.GUIDE + s.LEVEL] + wind * nut),
    )  # fmt: skip


def modes_Hz(model: DriveModel, table_position_m: float, *, motor_held: bool = False) -> FloatArray:
    """Natural frequencies of the undamped chain in Hz, ascending, shape (3,), no rigid one.

    Parameters
    ----------
    model : DriveModel
        The drive.
    table_position_m : float
        Table position in m.
    motor_held : bool
        Motor angle held (anti-resonances of torque to motor angle) instead of free.

    Source
    ------
    Eigenvalues of K over M of the chain of four degrees of freedom.
    """
    from pmac_comp.physics.model.kernel_chain import chain_matrices

    vector = _elastic(model)
    x = float(_screw_position(vector, table_position_m)[0])
    mass, _, stiffness = chain_matrices(vector, x)
    first = 1 if motor_held else 0
    squares = eigh(stiffness[first:, first:], mass[first:, first:], eigvals_only=True)
    found = np.sqrt(np.clip(squares, 0.0, None)) / (2.0 * math.pi)
    return np.asarray(found if motor_held else found[1:])


def _line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    slope = float((y[1] - y[0]) / (x[1] - x[0]))
    return float(y[0] - slope * x[0]), slope


def _elastic(model: DriveModel) -> FloatArray:
    if model.is_rigid:
        raise ModelError(
            "The bench is one rigid mass: it has no elastic deformation.",
            code="PC-MOD-016",
            hint="State [nominal] table_mass_kg and axial_stiffness_N_per_um.",
        )
    return model.kernel_vector()


def _screw_position(vector: FloatArray, table_position_m: FloatArray | float) -> FloatArray:
    x = finite_array("table_position_m", np.atleast_1d(table_position_m)) + vector[s.X_ORIGIN]
    return np.asarray(np.clip(x, 0.0, vector[s.LENGTH]))


def _torsion(vector: FloatArray, x: FloatArray) -> FloatArray:
    return np.asarray(1.0 / vector[s.K_COUPLING] + x / vector[s.GJ])


def _four(
    position_m: FloatArray,
    velocity_m_per_s: FloatArray,
    acceleration_m_per_s2: FloatArray,
    direction: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    arrays = [
        finite_array(name, np.atleast_1d(value))
        for name, value in (
            ("position_m", position_m),
            ("velocity_m_per_s", velocity_m_per_s),
            ("acceleration_m_per_s2", acceleration_m_per_s2),
            ("direction", direction),
        )
    ]
    if len({array.size for array in arrays}) != 1:
        raise ModelError(
            f"Position, velocity, acceleration and direction have "
            f"{[array.size for array in arrays]} samples.",
            code="PC-MOD-014",
        )
    return arrays[0], arrays[1], arrays[2], arrays[3]
