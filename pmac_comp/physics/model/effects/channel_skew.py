"""Scale and encoder are not sampled at the same time."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import US_PER_S
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.SKEW] = values["time_s"]


EFFECT = Effect(
    name="channel_skew",
    parameters=(
        parameter(
            "time_s",
            "s",
            5e-6,
            (-1e-3, 1e-3),
            scale=2e-6,
            file=("time_us", "us", US_PER_S),
            description=(
                "age of the scale sample against the encoder sample; positive: the table is read "
                "late, so that it lags in proportion to speed"
            ),
        ),
    ),
    apply=_apply,
    where="sensors",
    source="Position read at another time: v dt",
    signature=(
        "table minus motor strictly in proportion to speed, the same at both ends of the "
        "travel, none in the torque"
    ),
    separating_experiment=(
        "speed staircases at both ends of the travel: viscous deformation grows along the "
        "screw, skew does not"
    ),
    look_alikes=("viscous",),
    starts=({"time_s": 3e-6}, {"time_s": -3e-6}),
    hides_behind=("viscous.guide_Ns_per_m", "viscous.nut_Nms_per_rad"),
    needs_scale=True,
)
