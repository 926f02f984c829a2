"""Nut friction that is lower after a reversal and recovers with travel."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.DIP] = values["fraction"]
    vector[s.DIP_LENGTH] = values["length_m"] / bench.lead_m_per_rad


EFFECT = Effect(
    name="post_reversal_dip",
    parameters=(
        parameter(
            "fraction",
            "1",
            0.25,
            (0.0, 0.95),
            scale=0.1,
            description="share of the nut friction that is missing",
        ),
        parameter("length_m", "m", 1.5e-3, (2e-5, 0.1), file=("length_mm", "mm", MM_PER_M)),
    ),
    apply=_apply,
    where="nut",
    source="Ninomiya et al., JSPE 2002 (effect); form chosen here: T_p (1 - b exp(-d/l))",
    signature="torque lower over the first 0.5 to 5 mm after each reversal",
    separating_experiment=(
        "compare the torque after a reversal with that at the same place in a long move"
    ),
    look_alikes=("presliding", "stribeck", "backlash"),
    starts=({"length_m": 5e-4}, {"length_m": 1.5e-3}, {"length_m": 5e-3}),
    hides_behind=("coulomb.nut_Nm",),
)
