"""Constant force on the table: tilt, gravity, a spring of constant force."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.BIAS] = values["force_N"]


EFFECT = Effect(
    name="bias_force",
    parameters=(
        parameter(
            "force_N",
            "N",
            10.0,
            (-1e5, 1e5),
            scale=10.0,
            description="positive resists positive motion, as external forces do",
        ),
    ),
    apply=_apply,
    where="table",
    source="A constant force F_b",
    signature="torque and table shift by the same amount in both directions",
    separating_experiment=(
        "the mean of both directions at constant speed, and the axis tilted by a known angle"
    ),
    look_alikes=("friction_asymmetry", "cable_drag"),
    starts=({"force_N": 5.0}, {"force_N": -5.0}),
    hides_behind=("coulomb.guide_N",),
)
