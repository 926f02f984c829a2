"""Coulomb friction at guide, nut and motor (part of the base model)."""

import math

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter

# Distance over which the level builds up. A reversal that is 0.2 ms late in force shows as 1 um at
# the table, so it is far below any sensor step: true stick, as far as the loop can see.
SHARP_m = 0.02e-6
_BRISTLE_RATIO = 0.0  # no damping of its own: it would delay the change of sign


def apply_bristle(vector: FloatArray, site: int, distance: float, ratio: float) -> None:
    """Break distance of a site and the bristle damping that belongs to it."""
    level = vector[site + s.LEVEL]
    if vector[s.RIGID] > 0.5:
        lead = vector[s.LEAD]
        mass = vector[s.RIGID_MASS] * (1.0 if site == s.GUIDE else lead**2)
    else:
        mass = vector[{s.GUIDE: s.M_TABLE, s.NUT: s.J_SCREW, s.MOTOR: s.J_MOTOR}[site]]
    vector[site + s.BREAK] = distance
    vector[site + s.BRISTLE] = 2.0 * ratio * math.sqrt(max(level, 0.0) / distance * mass)


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    for site, name, distance in (
        (s.GUIDE, "guide_N", SHARP_m),
        (s.NUT, "nut_Nm", SHARP_m / bench.lead_m_per_rad),
        (s.MOTOR, "motor_Nm", SHARP_m / bench.lead_m_per_rad),
    ):
        vector[site + s.LEVEL] = values.get(name, 0.0)
        apply_bristle(vector, site, distance, _BRISTLE_RATIO)


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
    source="Ball-screw facts 2.3: friction that depends on the sign of the velocity alone",
    signature=(
        "torque step at each reversal; in table minus motor a step that grows along the screw"
    ),
    separating_experiment="constant speeds in both directions at both ends of the travel",
    look_alikes=("backlash", "presliding"),
)
