"""Current loop slower or faster than the bench file says."""

import math

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.CURRENT_RATE] = 2.0 * math.pi * values["bandwidth_Hz"]


EFFECT = Effect(
    name="current_bandwidth",
    parameters=(parameter("bandwidth_Hz", "Hz", 200.0, (5.0, 1e5), scale=30.0),),
    apply=_apply,
    where="drive",
    source="A lag of first order: 1/(1 + s/(2 pi f))",
    signature=(
        "control error rings at higher frequency; nothing in table minus motor at low frequency"
    ),
    separating_experiment="gain and phase of torque to position up to the bandwidth",
    look_alikes=("actuator_delay", "chain_damping"),
    starts=({"bandwidth_Hz": 100.0}, {"bandwidth_Hz": 250.0}, {"bandwidth_Hz": 600.0}),
    hides_behind=("chain.current_bandwidth_Hz", "chain.actuator_delay_s"),
)
