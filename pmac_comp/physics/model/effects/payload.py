"""Mass on the table beyond that of the bench file."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ModelError
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.M_TABLE] += values["mass_kg"]
    vector[s.RIGID_MASS] += values["mass_kg"]
    moved_kg = vector[s.RIGID_MASS if vector[s.RIGID] > 0.5 else s.M_TABLE]
    if moved_kg <= 0.0:
        raise ModelError(
            f"A payload of {values['mass_kg']:g} kg leaves {moved_kg:g} kg of the table.",
            code="PC-MOD-017",
            hint="Take away less than the table's own mass, table_mass_kg of the bench file.",
        )


EFFECT = Effect(
    name="payload",
    parameters=(parameter("mass_kg", "kg", 20.0, (-1e4, 1e5), scale=5.0, description="added"),),
    apply=_apply,
    where="table",
    source="Newton: (M + dM) C per acceleration",
    signature="torque and table lag per acceleration larger everywhere, resonance lower",
    separating_experiment="torque over acceleration: a soft chain lags more at the same torque",
    look_alikes=("axial_stiffness_position", "coupling_windup", "base_mode"),
    hides_behind=("chain.table_mass_kg", "chain.axial_stiffness_N_per_m"),
)
