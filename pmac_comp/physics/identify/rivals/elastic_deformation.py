"""Kamalzadeh's elastic deformation model: position-dependent stiffness, driven by the torque."""

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.identify.rivals.base import Rival, Signals


def error_m(signals: Signals, theta: FloatArray, bench: Bench) -> FloatArray:
    """``e = -(c0 + c1 x) (T - J theta'' - B theta' - T_c s) / rho`` in m, shape (n,)."""
    c0, c1, inertia, viscous, coulomb = theta
    rho = bench.lead_m_per_rad
    drag_Nm = inertia * signals.a_m_per_s2 / rho + viscous * signals.v_m_per_s / rho
    force_N = (signals.torque_Nm - drag_Nm - coulomb * signals.direction) / rho
    return np.asarray(-(c0 + c1 * signals.x_m) * force_N)


RIVAL = Rival(
    name="elastic deformation from torque (Kamalzadeh)",
    source="Kamalzadeh, Gordon, Erkorkmaz 2010: position-dependent stiffness, viscous and Coulomb "
    "friction of the rotating parts, driven by the control torque in real time",
    parameters=(
        ("compliance_m_per_N", 1.1e-8),
        ("compliance_slope_1_per_N", 1.4e-8),
        ("rotating_inertia_kgm2", 8e-4),
        ("rotating_viscous_Nms_per_rad", 2e-3),
        ("rotating_coulomb_Nm", 0.45),
    ),
    error_m=error_m,
    needs_torque=True,
)
