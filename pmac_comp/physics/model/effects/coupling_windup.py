"""Coupling or journal softer than the bench file says."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    softer = 1.0 / vector[s.K_COUPLING] + values["compliance_rad_per_Nm"]
    vector[s.K_COUPLING] = 1.0 / softer


EFFECT = Effect(
    name="coupling_windup",
    parameters=(
        parameter(
            "compliance_rad_per_Nm",
            "rad/(N m)",
            1.7e-4,
            (0.0, 0.1),
            scale=5e-5,
            description="added to that of the coupling",
        ),
    ),
    apply=_apply,
    where="coupling",
    source="Coupling and screw in series: 1/k_th = 1/k_c + x/GJ",
    signature=(
        "table lag in proportion to the torque that passes the coupling, the same at both "
        "ends of the travel"
    ),
    separating_experiment="clamp the nut side and turn the motor by torque steps",
    look_alikes=("payload", "axial_stiffness_position"),
    hides_behind=("chain.torsional_stiffness_Nm_per_rad", "chain.axial_stiffness_N_per_m"),
    rigid=False,
)
