"""Structural damping of the chain beyond the usual 3 %."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import US_PER_S
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.BETA] = max(vector[s.BETA] + values["time_s"], 0.0)


EFFECT = Effect(
    name="chain_damping",
    parameters=(
        parameter(
            "time_s",
            "s",
            7e-5,
            (-7e-5, 2e-3),
            scale=5e-5,
            file=("time_us", "us", US_PER_S),
            description="damping over stiffness, added",
        ),
    ),
    apply=_apply,
    where="chain",
    source="One damped mode below its resonance: 2 zeta / omega^3 times jerk",
    signature="ringing after steps of acceleration dies out otherwise; nothing at constant speed",
    separating_experiment="the ring-down after a jerk-unlimited move",
    look_alikes=("actuator_delay",),
    hides_behind=("chain.damping_time_s",),
    rigid=False,
)
