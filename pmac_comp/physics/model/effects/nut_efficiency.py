"""Load-dependent nut friction beyond the efficiency of the bench file."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.NUT_LOAD] += values["loss_fraction"]


EFFECT = Effect(
    name="nut_efficiency",
    parameters=(
        parameter(
            "loss_fraction",
            "1",
            0.08,
            (-0.5, 2.0),
            scale=0.02,
            description="torque share of rho |F| that opposes the rotation, added",
        ),
    ),
    apply=_apply,
    where="nut",
    source="Screw with rolling friction, both directions in one: T = rho F + s mu rho |F|",
    signature="torque grows with |force|, with the sign of the motion",
    separating_experiment="torque over external load in both directions",
    look_alikes=("coulomb", "payload"),
    hides_behind=("chain.efficiency", "coulomb.nut_Nm"),
    rigid=False,
)
