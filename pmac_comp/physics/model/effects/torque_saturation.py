"""Drive that gives less torque than its command asks for."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.ACTUATOR_LIMIT] = min(vector[s.ACTUATOR_LIMIT], values["limit_Nm"])


EFFECT = Effect(
    name="torque_saturation",
    parameters=(parameter("limit_Nm", "N m", 6.0, (1e-3, 1e6), scale=1.0),),
    apply=_apply,
    where="drive",
    source="The drive's torque limit: T is cut off there",
    signature="control error jumps while the torque command passes a level",
    separating_experiment="acceleration steps of growing size",
    look_alikes=("payload",),
    starts=({"limit_Nm": 3.0}, {"limit_Nm": 6.0}, {"limit_Nm": 10.0}),
)
