"""Torque ripple: the motor constant varies with the angle, so it grows with the torque."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.shapes import fill_harmonic, harmonic_Nm

_PEAK_OVER_RATED = 3.0  # where the bench does not state the rated torque


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    rated_Nm = bench.known.rated_torque_Nm or bench.drive.torque_limit_Nm / _PEAK_OVER_RATED
    fill_harmonic(vector, s.RIPPLE, values["amplitude_Nm"] / rated_Nm, values)


EFFECT = Effect(
    name="torque_ripple",
    parameters=harmonic_Nm(0.06, 10.0, description="at rated torque"),
    apply=_apply,
    where="motor",
    source="Fourier series in the motor angle: T (1 + sum of a_k cos)",
    signature="torque harmonics at multiples of the pole pairs that grow with the torque",
    separating_experiment="the same angles at two accelerations: cogging does not change",
    look_alikes=("cogging", "friction_per_rev"),
    starts=({"order_per_rev": 5.0}, {"order_per_rev": 10.0}, {"order_per_rev": 30.0}),
)
