"""Error of the scale within one signal period."""

import math

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter, phase


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.SUBDIVISION] = values["amplitude_m"]
    vector[s.SUBDIVISION + 1] = 2.0 * math.pi / values["period_m"]
    vector[s.SUBDIVISION + 2] = values["phase_rad"]


EFFECT = Effect(
    name="scale_subdivision",
    parameters=(
        parameter("amplitude_m", "m", 0.2e-6, (0.0, 1e-5), file=("amplitude_um", "um", UM_PER_M)),
        parameter(
            "period_m", "m", 20e-6, (1e-7, 1e-2), file=("period_um", "um", UM_PER_M), discrete=True
        ),
        phase(),
    ),
    apply=_apply,
    where="scale",
    source="Error of an interpolated signal period: A cos(2 pi x / 20 um)",
    signature="table minus motor repeats with the signal period of the scale",
    separating_experiment="a slow scan over 100 um",
    starts=({"period_m": 20e-6}, {"period_m": 4e-6}, {"period_m": 40e-6}),
    needs_scale=True,
)
