"""Encoder disc off centre: the reading wobbles with the motor angle."""

from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect
from pmac_comp.physics.model.shapes import harmonic_at, harmonic_m

EFFECT = Effect(
    name="encoder_eccentricity",
    parameters=harmonic_m(1.0),
    apply=harmonic_at(s.ECCENTRICITY, "amplitude_m"),
    where="encoder",
    source="A graduated disc off its axis: A_e cos(theta + phi)",
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
