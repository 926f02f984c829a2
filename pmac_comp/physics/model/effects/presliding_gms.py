"""Presliding as a generalised Maxwell slip model: several elements with memory of their own."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.effects.coulomb import apply_bristle_damping
from pmac_comp.physics.model.effects.presliding import DAMPING
from pmac_comp.physics.model.parameters import parameter

# A virgin curve 1 - exp(-d) has elements of break distance d with density d exp(-d): eighths of it.
_DISTANCES = (0.3848, 0.7883, 1.1321, 1.488, 1.8906, 2.3894, 3.1028, 4.8241)
_SHARES = (0.125,) * 8


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.GMS_N] = len(_SHARES)
    for i, (share, distance) in enumerate(zip(_SHARES, _DISTANCES, strict=True)):
        vector[s.GMS + 2 * i] = share
        vector[s.GMS + 2 * i + 1] = distance * values["distance_m"]
    apply_bristle_damping(vector, s.GUIDE, values["distance_m"], values["damping_ratio"])


EFFECT = Effect(
    name="presliding_gms",
    parameters=(
        parameter(
            "distance_m",
            "m",
            10e-6,
            (1e-8, 2e-3),
            file=("distance_um", "um", UM_PER_M),
            description="travel from rest to 63 % of the level",
            by_root=True,
        ),
        DAMPING,
    ),
    apply=_apply,
    where="guide",
    source=(
        "GMS (Al-Bender, Lampaert, Swevers 2005); element strengths so that the virgin curve is "
        "1 - exp(-d/distance), elements that stick damped as LuGre's bristles are"
    ),
    signature="as presliding, but inner loops close: memory of earlier reversals",
    separating_experiment=(
        "nested quasi-static reversals: inner loops close with slip elements and drift with "
        "one bristle"
    ),
    look_alikes=("presliding", "backlash"),
    hides_behind=("coulomb.guide_N",),
)
