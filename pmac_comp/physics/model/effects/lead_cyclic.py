"""Lead wobble: the nut advances unevenly within a revolution."""

from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect
from pmac_comp.physics.model.shapes import harmonic_at, harmonic_m

EFFECT = Effect(
    name="lead_cyclic",
    parameters=harmonic_m(1.0),
    apply=harmonic_at(s.WOBBLE, "amplitude_m"),
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
