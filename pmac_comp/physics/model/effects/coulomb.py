"""Coulomb friction at guide, nut and motor (part of the base model)."""

import math

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def apply_bristle(vector: FloatArray, site: int, distance: float, ratio: float) -> None:
    """Set break distance and bristle damping of a site in a kernel vector, shape (N_SLOTS,)."""
    vector[site + s.BREAK] = distance
    apply_bristle_damping(vector, site, distance, ratio)


def apply_bristle_damping(vector: FloatArray, site: int, distance: float, ratio: float) -> None:
    """Set bristle damping by its ratio to the critical one in a vector of shape (N_SLOTS,)."""
    level = vector[site + s.LEVEL]
    if vector[s.RIGID] > 0.5:
        lead = vector[s.LEAD]
        mass = vector[s.RIGID_MASS] * (1.0 if site == s.GUIDE else lead**2)
    else:
        mass = vector[{s.GUIDE: s.M_TABLE, s.NUT: s.J_SCREW, s.MOTOR: s.J_MOTOR}[site]]
    vector[site + s.BRISTLE] = 2.0 * ratio * math.sqrt(max(level, 0.0) / distance * mass)


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    for site, name in ((s.GUIDE, "guide_N"), (s.NUT, "nut_Nm"), (s.MOTOR, "motor_Nm")):
        vector[site + s.LEVEL] = values.get(name, 0.0)
        vector[site + s.BREAK] = 0.0  # true stick: the level acts at once


_GUIDE = parameter(
    "guide_N", "N", 45.0, (0.0, 1e5), description="level at the guide", file=("guide_N", "N", 1.0)
)
EFFECT = Effect(
    name="coulomb",
    parameters=(
        _GUIDE,
        parameter("nut_Nm", "N m", 0.25, (0.0, 1e3), description="level at nut and rear bearing"),
        parameter("motor_Nm", "N m", 0.20, (0.0, 1e3), description="level at motor and bearing"),
    ),
    place_parameters={
        "rigid": (
            parameter(
                "guide_N",
                "N",
                20.0,
                (0.0, 1e5),
                file=("coulomb_N", "N", 1.0),
                description="level of all friction, expressed at the table",
            ),
        )
    },
    apply=_apply,
    where="guide, nut, motor",
    source="Coulomb: friction that depends on the sign of the velocity alone",
    signature=(
        "torque step at each reversal; in table minus motor a step that grows along the screw"
    ),
    separating_experiment="constant speeds in both directions at both ends of the travel",
    look_alikes=("backlash", "presliding"),
)
