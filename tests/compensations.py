"""Compensations of the paper's bench that several tests put on a card."""

from typing import Any

import numpy as np

from pmac_comp.files.bench import Bench
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.physics.model.drive import DriveModel

TRAVEL_m = np.arange(-0.3, 0.3005, 1e-3)


def lead_map(
    slope_um_per_m: float = 35.0,
    *,
    reversal_um: float = 0.0,
    reversal_um_per_m: float = 0.0,
    noise_um: float = 0.0,
) -> LeadMap:
    """A lead error that grows along the travel, with a part that depends on the direction."""
    reversal = reversal_um + reversal_um_per_m * TRAVEL_m
    return LeadMap(TRAVEL_m, 1e-6 * slope_um_per_m * TRAVEL_m, 1e-6 * reversal, 1e-6 * noise_um)


def rubbing_model(bench: Bench) -> DriveModel:
    """A drive with Coulomb friction at guide, nut and motor."""
    friction = {"coulomb.guide_N": 45.0, "coulomb.nut_Nm": 0.25, "coulomb.motor_Nm": 0.2}
    return DriveModel.base(bench, {**friction, "viscous.guide_Ns_per_m": 200.0})


def friction_law(**change: Any) -> CompensationLaw:
    """Inertia and friction, in position and torque; ``change`` replaces coefficients."""
    law: dict[str, Any] = {
        "inertia_s2": 2.2e-6,
        "coulomb_m": 0.9e-6,
        "breakaway_m": 2e-6,
        "torque_coulomb_Nm": 0.4,
        "torque_breakaway_m": 5e-6,
        "torque_limit_Nm": 10.0,
    }
    return CompensationLaw(**{**law, **change})
