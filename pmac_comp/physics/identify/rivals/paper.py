"""The quasi-static model of the paper's kind, without and with torque transmission in the nut."""

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ModelError
from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.identify.rivals.base import Rival, Signals


def without_error_m(signals: Signals, theta: FloatArray, bench: Bench) -> FloatArray:
    """``e = -(c0 + x / EA) (M a + B v + F s)`` in m, with the stated mass, shape (n,)."""
    c0, viscous, coulomb = theta
    compliance = c0 + signals.x_m / bench.screw_rigidity_N
    return np.asarray(-compliance * _force_N(signals, bench, viscous, coulomb))


def with_error_m(signals: Signals, theta: FloatArray, bench: Bench) -> FloatArray:
    """The same with the thrust's torque ``rho F``, nut drag and screw inertia, shape (n,)."""
    c0, viscous, coulomb, nut_Nm = theta
    rho, x = bench.lead_m_per_rad, signals.x_m
    twist = 1.0 / _torsional_stiffness(bench) + x / bench.torsional_rigidity_Nm2
    compliance = c0 + x / bench.screw_rigidity_N + rho**2 * twist
    force = _force_N(signals, bench, viscous, coulomb)
    windup = rho * twist * nut_Nm * signals.direction
    return np.asarray(-compliance * force - windup - _screw_term(x, bench) * signals.a_m_per_s2)


def _force_N(signals: Signals, bench: Bench, viscous: float, coulomb: float) -> FloatArray:
    mass = bench.nominal.table_mass_kg
    if mass is None:
        raise ModelError(
            "This rival needs [nominal] table_mass_kg in the bench file.", code="PC-CMP-002"
        )
    inertia = mass * signals.a_m_per_s2
    return np.asarray(inertia + viscous * signals.v_m_per_s + coulomb * signals.direction)


def _torsional_stiffness(bench: Bench) -> float:
    return bench.nominal.torsional_stiffness_Nm_per_rad or np.inf


def _screw_term(x_m: FloatArray, bench: Bench) -> FloatArray:
    """c_J of ``model.quasi_static`` in s2, without the coupling's own inertia."""
    inertia = bench.nominal.screw_inertia_kgm2 or 0.0
    length = bench.screw.length_mm / MM_PER_M
    twisted = (length * x_m - 0.5 * x_m**2) / (length * bench.torsional_rigidity_Nm2)
    return np.asarray(inertia * (1.0 / _torsional_stiffness(bench) + twisted))


_COMMON = (
    ("compliance_m_per_N", 1.03e-8),
    ("guide_viscous_Ns_per_m", 200.0),
    ("guide_coulomb_N", 45.0),
)
WITHOUT_TORQUE_TRANSMISSION = Rival(
    name="axial chain, no torque transmission",
    source="quasi-static reconstruction of the paper's model, thrust does not twist the screw",
    parameters=_COMMON,
    error_m=without_error_m,
)
WITH_TORQUE_TRANSMISSION = Rival(
    name="axial chain with torque transmission",
    source="quasi-static reconstruction of the paper's model, thrust twists the screw by rho^2 F",
    parameters=(*_COMMON, ("nut_coulomb_Nm", 0.25)),
    error_m=with_error_m,
)
