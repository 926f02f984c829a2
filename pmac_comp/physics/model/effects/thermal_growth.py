"""Screw that grows as it warms up, from the fixed bearing on."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.GROWTH] = values["final"]
    vector[s.GROWTH_TIME] = values["time_constant_s"]


EFFECT = Effect(
    name="thermal_growth",
    parameters=(
        parameter(
            "final",
            "m/m",
            60e-6,
            (-0.01, 0.01),
            scale=20e-6,
            file=("final_um_per_m", "um/m", UM_PER_M),
        ),
        parameter("time_constant_s", "s", 60.0, (0.05, 1e5)),
    ),
    apply=_apply,
    where="screw",
    source="Thermal expansion: alpha times the integral of the temperature rise",
    signature="slope of table minus motor over position that grows with time",
    separating_experiment=(
        "the same slow run every few minutes: the slope of a scale does not change"
    ),
    look_alikes=("lead_linear", "scale_slope", "friction_warmup"),
    starts=({"time_constant_s": 5.0}, {"time_constant_s": 60.0}, {"time_constant_s": 600.0}),
    needs_scale=True,
)
