"""Friction that differs between the two directions."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    if place == "rotary":
        vector[s.ASYMMETRY_ROTARY] = values["fraction"]
    else:
        slot = s.ASYMMETRY_VISCOUS if place == "viscous" else s.ASYMMETRY_SLIDING
        vector[slot] = values["fraction"]


EFFECT = Effect(
    name="friction_asymmetry",
    parameters=(
        parameter(
            "fraction",
            "1",
            0.1,
            (-0.99, 0.99),
            scale=0.1,
            description="positive minus negative direction over their sum",
        ),
    ),
    apply=_apply,
    where="guide (viscous or all sliding friction), or nut and motor (viscous)",
    source="Janot, Gautier, Brunot 2019 (EMPS): 166.7 against 240.4 N s/m",
    signature="different slope of torque over speed in the two directions",
    separating_experiment="a speed staircase in both directions: a bias force only shifts it",
    look_alikes=("bias_force",),
    places=("viscous", "sliding", "rotary"),
    starts=({"fraction": 0.1}, {"fraction": -0.1}),
    hides_behind=("viscous.guide_Ns_per_m", "coulomb.guide_N"),
)
