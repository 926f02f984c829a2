"""Machine bed on its foundation, or a bracket, that swings against the table."""

import math

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    ratio = values["mass_ratio"]
    vector[s.BASE_MASS] = vector[s.M_TABLE] / ratio if ratio > 0.0 else 0.0
    vector[s.BASE_OMEGA] = 2.0 * math.pi * values["frequency_Hz"]
    vector[s.BASE_ZETA] = values["damping_ratio"]


EFFECT = Effect(
    name="base_mode",
    parameters=(
        parameter("frequency_Hz", "Hz", 35.0, (2.0, 500.0), scale=2.0),
        parameter(
            "mass_ratio", "1", 0.1, (0.0, 2.0), scale=0.02, description="table mass over bed mass"
        ),
        parameter("damping_ratio", "1", 0.03, (0.0, 1.0), scale=0.02),
    ),
    apply=_apply,
    where="bed",
    source="One mass on a spring: second order at f_base; positions are relative to the bed",
    signature="ringing at 5 to 80 Hz after each acceleration, in torque and table",
    separating_experiment="an accelerometer on bed and bracket",
    look_alikes=("payload", "chain_damping"),
    # A bed that is hardly damped is found from within a sixth of its frequency.
    starts=tuple({"frequency_Hz": f} for f in (20.0, 35.0, 60.0, 8.5, 11.5, 15.0, 26.0, 45.0)),
    hides_behind=("chain.table_mass_kg",),
)
