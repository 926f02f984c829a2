"""Presliding: friction builds up over a distance after each reversal (Dahl and LuGre)."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.effects.coulomb import apply_bristle
from pmac_comp.physics.model.parameters import parameter

BRISTLE_RATIO = 0.1  # of critical damping: leaves the loop passive


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    lead = bench.lead_m_per_rad
    if place == "guide":
        apply_bristle(vector, s.GUIDE, values["distance_m"], BRISTLE_RATIO)
    if place in {"nut", "rotary"}:
        apply_bristle(vector, s.NUT, values["distance_m"] / lead, BRISTLE_RATIO)
    if place in {"motor", "rotary"}:
        apply_bristle(vector, s.MOTOR, values["distance_m"] / lead, BRISTLE_RATIO)


EFFECT = Effect(
    name="presliding",
    parameters=(
        parameter(
            "distance_m",
            "m",
            10e-6,
            (1e-8, 2e-3),
            file=("distance_um", "um", UM_PER_M),
            description="travel from rest to 63 % of the level",
        ),
    ),
    apply=_apply,
    where="guide, nut, motor, or nut and motor (rotary)",
    source=(
        "Ball-screw facts 2.3 and 3: LuGre with z/g in place of the level; with constant "
        "level it is Dahl's"
    ),
    signature=(
        "smooth S-shaped transition over 5 to 50 um after each reversal, hysteresis in small "
        "motions"
    ),
    separating_experiment=(
        "quasi-static reversals of 5 to 100 um, nested: backlash has a gap without force, "
        "this has none"
    ),
    look_alikes=("backlash", "stribeck", "post_reversal_dip"),
    places=("guide", "nut", "motor", "rotary"),
    starts=({"distance_m": 3e-6}, {"distance_m": 10e-6}, {"distance_m": 40e-6}),
    hides_behind=("coulomb.guide_N", "coulomb.nut_Nm", "coulomb.motor_Nm"),
)
