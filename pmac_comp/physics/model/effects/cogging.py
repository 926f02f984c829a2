"""Cogging torque of the motor, fixed to its angle, whatever load, speed or direction."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import order, parameter, phase


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.COGGING] = values["amplitude_Nm"]
    vector[s.COGGING + 1] = values["order_per_rev"]
    vector[s.COGGING + 2] = values["phase_rad"]


EFFECT = Effect(
    name="cogging",
    parameters=(
        parameter("amplitude_Nm", "N m", 0.04, (0.0, 100.0)),
        order(20.0),
        phase(),
    ),
    apply=_apply,
    where="motor",
    source="Ball-screw facts 3: sum of A_k cos(k theta + phi)",
    signature="torque harmonics at slots and poles per revolution, the same in both directions",
    separating_experiment=(
        "a slow run with the motor uncoupled, or at two loads: torque ripple grows with the torque"
    ),
    look_alikes=("torque_ripple", "friction_per_rev"),
    starts=(
        {"order_per_rev": 1.0},
        {"order_per_rev": 10.0},
        {"order_per_rev": 20.0},
        {"order_per_rev": 36.0},
        {"order_per_rev": 60.0},
    ),
)
