"""Drive that acts later than the bench file says."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import US_PER_S
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.DELAY] = values["time_s"]


EFFECT = Effect(
    name="actuator_delay",
    parameters=(
        parameter(
            "time_s",
            "s",
            8e-4,
            (0.0, 0.05),
            scale=1e-4,
            file=("time_us", "us", US_PER_S),
            description="from sample to torque, in all",
        ),
    ),
    apply=_apply,
    where="drive",
    source="A dead time: exp(-s tau)",
    signature=(
        "control error rings at higher frequency; nothing in table minus motor at low frequency"
    ),
    separating_experiment="slope of the phase of torque to position over frequency",
    look_alikes=("current_bandwidth", "chain_damping"),
    starts=({"time_s": 4e-4}, {"time_s": 9e-4}),
    hides_behind=("chain.actuator_delay_s", "chain.current_bandwidth_Hz"),
)
