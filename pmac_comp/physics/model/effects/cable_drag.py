"""Cable or cover that pulls like a soft spring."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.CABLE_K] = values["stiffness_N_per_m"]
    vector[s.CABLE_CENTRE] = values["centre_m"]


EFFECT = Effect(
    name="cable_drag",
    parameters=(
        parameter("stiffness_N_per_m", "N/m", 50.0, (-1e5, 1e5), scale=20.0),
        parameter(
            "centre_m",
            "m",
            0.0,
            (-10.0, 10.0),
            scale=0.1,
            file=("centre_mm", "mm", MM_PER_M),
            description="table position without force",
        ),
    ),
    apply=_apply,
    where="table",
    source="A spring: k_d (x - x0)",
    signature="torque in proportion to position, the same in both directions and at any speed",
    separating_experiment="slow runs over the whole travel with and without cable or cover",
    look_alikes=("bias_force", "lead_linear"),
    starts=({"stiffness_N_per_m": 50.0}, {"stiffness_N_per_m": -50.0}),
)
