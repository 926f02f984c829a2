"""Scale longer or shorter than it says."""

from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect
from pmac_comp.physics.model.shapes import SLOPE, SLOPE_STARTS, slope_at

EFFECT = Effect(
    name="scale_slope",
    parameters=SLOPE,
    apply=slope_at(s.SCALE_SLOPE),
    where="scale",
    source="A scale that is too long or too short: s_0 (x - x_ref)",
    signature=(
        "table minus motor in proportion to position, the same in both directions, at any time"
    ),
    separating_experiment=(
        "a laser or a second scale: on this bench the slope of the lead leaves exactly the "
        "same trace"
    ),
    look_alikes=("lead_linear", "thermal_growth"),
    starts=SLOPE_STARTS,
    needs_scale=True,
)
