"""Friction that falls while the axis warms up."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.WARMUP] = values["fraction"]
    vector[s.WARMUP_TIME] = values["time_constant_s"]


EFFECT = Effect(
    name="friction_warmup",
    parameters=(
        parameter(
            "fraction",
            "1",
            0.3,
            (-2.0, 0.95),
            scale=0.1,
            description="share that vanishes in the end",
        ),
        parameter("time_constant_s", "s", 30.0, (0.05, 1e5)),
    ),
    apply=_apply,
    where="guide, nut, motor",
    source="An exponential with time: F_c (1 - d (1 - exp(-t/tau)))",
    signature="torque and reversal step fall with time, lap by lap",
    separating_experiment="the same lap repeated cold and warm",
    look_alikes=("viscous_nonlinear", "thermal_growth"),
    starts=({"time_constant_s": 3.0}, {"time_constant_s": 30.0}, {"time_constant_s": 300.0}),
    hides_behind=("coulomb.guide_N", "coulomb.nut_Nm", "coulomb.motor_Nm"),
)
