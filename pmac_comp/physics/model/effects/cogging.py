"""Cogging torque of the motor, fixed to its angle, whatever load, speed or direction."""

from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect
from pmac_comp.physics.model.shapes import harmonic_at, harmonic_Nm

EFFECT = Effect(
    name="cogging",
    parameters=harmonic_Nm(0.04, 20.0),
    apply=harmonic_at(s.COGGING, "amplitude_Nm"),
    where="motor",
    source="Fourier series in the motor angle: sum of A_k cos(k theta + phi)",
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
