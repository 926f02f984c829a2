"""Lead of the screw off by a constant share."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.LEAD_SLOPE] = values["slope"]


EFFECT = Effect(
    name="lead_linear",
    parameters=(
        parameter(
            "slope",
            "m/m",
            30e-6,
            (-0.05, 0.05),
            scale=10e-6,
            file=("slope_um_per_m", "um/m", UM_PER_M),
        ),
    ),
    apply=_apply,
    where="screw",
    source="Ball-screw facts 2.5: a1 x",
    signature=(
        "table minus motor in proportion to position, the same in both directions, at any time"
    ),
    separating_experiment=(
        "a laser or a second scale: on this bench the slope of the scale leaves exactly the "
        "same trace"
    ),
    look_alikes=("scale_slope", "thermal_growth"),
    starts=({"slope": 30e-6}, {"slope": -30e-6}),
    needs_scale=True,
)
