"""Viscous friction that is not linear in speed: |v|^n sgn v."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.POWER_FORCE] = values["coefficient_N"]
    vector[s.POWER_EXPONENT] = values["exponent"]


EFFECT = Effect(
    name="viscous_nonlinear",
    parameters=(
        parameter("coefficient_N", "N", 30.0, (-1e4, 1e4), description="force at 1 m/s"),
        parameter("exponent", "1", 0.5, (0.1, 3.0), scale=0.1),
    ),
    apply=_apply,
    where="guide",
    source="A power of the speed: B |v|^n sgn v, n 0.5 to 0.7 in most data",
    signature="curved torque over speed: residual even in |v| after a linear fit",
    separating_experiment="a speed staircase with a warm axis",
    look_alikes=("viscous", "stribeck", "friction_warmup"),
    starts=({"exponent": 0.5}, {"exponent": 2.0, "coefficient_N": 100.0}),
    hides_behind=("viscous.guide_Ns_per_m", "coulomb.guide_N"),
)
