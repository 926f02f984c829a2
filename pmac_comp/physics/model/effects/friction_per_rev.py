"""Nut friction that varies with the screw angle: preload that varies, balls passing."""

from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect
from pmac_comp.physics.model.shapes import harmonic_at, harmonic_Nm

EFFECT = Effect(
    name="friction_per_rev",
    parameters=harmonic_Nm(0.03, 1.0),
    apply=harmonic_at(s.PER_REV, "amplitude_Nm"),
    where="nut",
    source="Preload by the turn (Frey, Walther, Verl 2010): T_p0 (1 + a1 cos(theta - p1))",
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
