"""Lim's two inertias with a torsion spring: constant stiffness, no friction."""

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.identify.rivals.base import Rival, Signals, table_acceleration

_ROUNDS = 2


def error_m(signals: Signals, theta: FloatArray, bench: Bench) -> FloatArray:
    """Wind-up ``J_2 theta_2'' / k`` of the load inertia, at the table in m, shape (n,)."""
    error = -theta[0] * signals.a_m_per_s2
    for _ in range(_ROUNDS):  # acceleration of the load, not of the motor
        error = -theta[0] * table_acceleration(signals, error)
    return np.asarray(error)


RIVAL = Rival(
    name="two inertias, torsion (Lim)",
    source="Lim et al.: torsion-only two-inertia model, constant stiffness, no friction",
    parameters=(("inertia_over_stiffness_s2", 2e-6),),
    error_m=error_m,
)
