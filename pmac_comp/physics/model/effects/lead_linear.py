"""Lead of the screw off by a constant share."""

from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect
from pmac_comp.physics.model.shapes import SLOPE, SLOPE_STARTS, slope_at

EFFECT = Effect(
    name="lead_linear",
    parameters=SLOPE,
    apply=slope_at(s.LEAD_SLOPE),
    where="screw",
    source="A pitch other than nominal: a1 x",
    signature=(
        "table minus motor in proportion to position, the same in both directions, at any time"
    ),
    separating_experiment=(
        "a laser or a second scale: on this bench the slope of the scale leaves exactly the "
        "same trace"
    ),
    look_alikes=("scale_slope", "thermal_growth"),
    starts=SLOPE_STARTS,
    needs_scale=True,
)
