"""Lead wobble: the nut advances unevenly within a revolution."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import order, parameter, phase


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.WOBBLE] = values["amplitude_m"]
    vector[s.WOBBLE + 1] = values["order_per_rev"]
    vector[s.WOBBLE + 2] = values["phase_rad"]


EFFECT = Effect(
    name="lead_cyclic",
    parameters=(
        parameter("amplitude_m", "m", 1e-6, (0.0, 1e-3), file=("amplitude_um", "um", UM_PER_M)),
        order(1.0),
        phase(),
    ),
    apply=_apply,
    where="screw",
    source="Ball-screw facts 2.5: A_k cos(2 pi k x/p + phi_k)",
    signature=(
        "table minus motor repeats with the pitch, the same in both directions and at any "
        "speed; none in the torque"
    ),
    separating_experiment=(
        "re-index the coupling by 90 degrees: encoder eccentricity moves with the motor, lead"
        " wobble does not"
    ),
    look_alikes=("encoder_eccentricity", "friction_per_rev"),
    starts=({"order_per_rev": 1.0}, {"order_per_rev": 2.0}),
    min_substeps=4,
)
