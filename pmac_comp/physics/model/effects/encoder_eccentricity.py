"""Encoder disc off centre: the reading wobbles with the motor angle."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import order, parameter, phase


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.ECCENTRICITY] = values["amplitude_m"]
    vector[s.ECCENTRICITY + 1] = values["order_per_rev"]
    vector[s.ECCENTRICITY + 2] = values["phase_rad"]


EFFECT = Effect(
    name="encoder_eccentricity",
    parameters=(
        parameter("amplitude_m", "m", 1e-6, (0.0, 1e-3), file=("amplitude_um", "um", UM_PER_M)),
        order(1.0),
        phase(),
    ),
    apply=_apply,
    where="encoder",
    source="Ball-screw facts 2.5: A_e cos(theta + phi)",
    signature=(
        "table minus motor repeats with the pitch; at high speed the loop follows it and the "
        "torque shows it"
    ),
    separating_experiment=(
        "run fast and slow: the servo follows the wrong reading; or remount the encoder "
        "turned by 180 degrees"
    ),
    look_alikes=("lead_cyclic", "friction_per_rev"),
    starts=({"order_per_rev": 1.0}, {"order_per_rev": 2.0}),
)
