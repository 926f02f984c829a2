"""Presliding: friction builds up over a distance after each reversal (Dahl and LuGre)."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.effects.coulomb import apply_bristle
from pmac_comp.physics.model.parameters import ParameterSpec, parameter

# Of critical damping. LuGre's guides have some hundredths, Dahl's form none; a tenth is common in
# simulations. Nobody knows it of a drive beforehand, so it is fitted with the distance.
_DAMPING_RATIO = 0.05


def damping_parameter(name: str, description: str) -> ParameterSpec:
    """Ratio of the damping of bristles to the critical one."""
    return parameter(name, "1", _DAMPING_RATIO, (0.0, 1.0), description=description)


_DISTANCE = parameter(
    "distance_m",
    "m",
    10e-6,
    (1e-8, 2e-3),
    file=("distance_um", "um", UM_PER_M),
    description="travel from rest to 63 % of the level",
    by_root=True,
)
_ROTARY = parameter(
    "rotary_m",
    "m",
    5e-6,
    (1e-8, 2e-3),
    file=("rotary_um", "um", UM_PER_M),
    description="the same for nut and motor, expressed at the table",
    by_root=True,
)


DAMPING = damping_parameter("damping_ratio", "damping of the bristles over critical damping")
_ROTARY_DAMPING = damping_parameter("rotary_damping_ratio", "the same for nut and motor")


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    lead = bench.lead_m_per_rad
    turning_m = values.get("rotary_m", values["distance_m"])
    damping = values["damping_ratio"]
    turning_damping = values.get("rotary_damping_ratio", damping)
    if place in {"guide", "all"}:
        apply_bristle(vector, s.GUIDE, values["distance_m"], damping)
    if place in {"nut", "rotary", "all"}:
        apply_bristle(vector, s.NUT, turning_m / lead, turning_damping)
    if place in {"motor", "rotary", "all"}:
        apply_bristle(vector, s.MOTOR, turning_m / lead, turning_damping)


EFFECT = Effect(
    name="presliding",
    parameters=(_DISTANCE, DAMPING),
    apply=_apply,
    where="guide, nut, motor, nut and motor (rotary), or all of them with a distance of each kind",
    source=(
        "LuGre (Canudas de Wit et al. 1995) with z/g in place of the "
        "level; with constant level it is Dahl's (1968)"
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
    joint_places=("all",),
    place_parameters={"all": (_DISTANCE, _ROTARY, DAMPING, _ROTARY_DAMPING)},
    starts=({"distance_m": 3e-6}, {"distance_m": 10e-6}, {"distance_m": 40e-6}),
    hides_behind=("coulomb.guide_N", "coulomb.nut_Nm", "coulomb.motor_Nm"),
)
