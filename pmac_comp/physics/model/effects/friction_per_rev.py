"""Nut friction that varies with the screw angle: preload that varies, balls passing."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import order, parameter, phase


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.PER_REV] = values["amplitude_Nm"]
    vector[s.PER_REV + 1] = values["order_per_rev"]
    vector[s.PER_REV + 2] = values["phase_rad"]


EFFECT = Effect(
    name="friction_per_rev",
    parameters=(
        parameter("amplitude_Nm", "N m", 0.03, (0.0, 100.0)),
        order(1.0),
        phase(),
    ),
    apply=_apply,
    where="nut",
    source="Ball-screw facts 2.3 and 3: T_p0 (1 + a1 cos(theta - p1))",
    signature="torque harmonics locked to the screw angle that change sign with the direction",
    separating_experiment=(
        "a slow run in both directions, spectrum over the angle: cogging keeps its sign"
    ),
    look_alikes=("cogging", "torque_ripple", "lead_cyclic"),
    starts=(
        {"order_per_rev": 1.0},
        {"order_per_rev": 2.0},
        {"order_per_rev": 7.5},
        {"order_per_rev": 9.7},
    ),
    hides_behind=("coulomb.nut_Nm",),
)
