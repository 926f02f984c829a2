"""Kamalzadeh and Erkorkmaz: two masses, one axial spring with damping, viscous friction."""

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.identify.derivatives import central_difference
from pmac_comp.physics.identify.rivals.base import Rival, Signals, table_acceleration

_ROUNDS = 2


def error_m(signals: Signals, theta: FloatArray, bench: Bench) -> FloatArray:
    """``e = -(m2 x2'' + b2 x2' + c e') / k`` with constant k, in m, shape (n,)."""
    mass, friction, damping = theta
    error = -mass * signals.a_m_per_s2 - friction * signals.v_m_per_s
    for _ in range(_ROUNDS):
        slope = central_difference(error, signals.period_s)
        speed = signals.v_m_per_s + slope
        error = -mass * table_acceleration(signals, error) - friction * speed - damping * slope
    return np.asarray(error)


RIVAL = Rival(
    name="two masses, axial (Kamalzadeh, Erkorkmaz)",
    source="Kamalzadeh and Erkorkmaz, CIRP Annals 2007: equivalent axial stiffness, viscous "
    "friction in bearings and guides, damping in the nut",
    parameters=(
        ("mass_over_stiffness_s2", 2e-6),
        ("viscous_over_stiffness_s", 4e-6),
        ("damping_over_stiffness_s", 7e-5),
    ),
    error_m=error_m,
)
