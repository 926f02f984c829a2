"""Screw softer or stiffer than the bench file says: changes how stiffness falls along the screw."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.EA] *= values["rigidity_factor"]


EFFECT = Effect(
    name="axial_stiffness_position",
    parameters=(
        parameter(
            "rigidity_factor",
            "1",
            0.8,
            (0.05, 20.0),
            scale=0.1,
            description="on the screw rigidity EA",
        ),
    ),
    apply=_apply,
    where="screw",
    source="Bearing and screw in series: 1/k = 1/k_b + x/EA",
    signature=(
        "inertial table lag changes along the screw otherwise than expected: position times "
        "acceleration"
    ),
    separating_experiment="the same sinusoid at three places",
    look_alikes=("payload", "axial_stiffness_nonlinear"),
    starts=({"rigidity_factor": 0.8}, {"rigidity_factor": 1.25}),
    hides_behind=("chain.screw_rigidity_N", "chain.axial_stiffness_N_per_m"),
    rigid=False,
)
