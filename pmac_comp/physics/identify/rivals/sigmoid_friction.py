"""Zhu and Fujimoto: stiffness on each side of the nut, friction as a sigmoid of the speed."""

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.identify.rivals.base import Rival, Signals

_LEAST_SPEED_m_per_s = 1e-5


def error_m(signals: Signals, theta: FloatArray, bench: Bench) -> FloatArray:
    """``e = -(1 + kappa x) [alpha a + beta v + gamma tanh(v / v_0)]`` in m, shape (n,)."""
    alpha, beta, gamma, kappa, speed = theta
    v_0 = max(abs(float(speed)), _LEAST_SPEED_m_per_s)
    elastic = alpha * signals.a_m_per_s2 + beta * signals.v_m_per_s
    friction = gamma * np.tanh(signals.v_m_per_s / v_0)
    return np.asarray(-(1.0 + kappa * signals.x_m) * (elastic + friction))


RIVAL = Rival(
    name="sigmoid friction (Zhu, Fujimoto)",
    source="Zhu and Fujimoto, IEEE/ASME T-Mech 2015 (abstract): torsion on both sides of the nut, "
    "bearing stiffness, guide friction, sigmoid for fast reversals; the sinc form for slow ones "
    "is not public enough to be repeated",
    parameters=(
        ("alpha_s2", 1.4e-6),
        ("beta_s", 2.3e-6),
        ("gamma_m", 0.5e-6),
        ("kappa_1_per_m", 1.3),
        ("speed_m_per_s", 2e-3),
    ),
    error_m=error_m,
)
