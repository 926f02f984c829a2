"""Preload of the nut lost: the joint is soft around zero force."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.SOFT_HALF] = values["half_width_m"]
    vector[s.SOFT_RATIO] = values["stiffness_ratio"]


EFFECT = Effect(
    name="preload_loss",
    parameters=(
        parameter(
            "half_width_m",
            "m",
            2e-6,
            (0.0, 1e-3),
            file=("half_width_um", "um", UM_PER_M),
            description="deflection up to which the joint is soft",
        ),
        parameter(
            "stiffness_ratio",
            "1",
            0.4,
            (0.0, 1.0),
            scale=0.1,
            description="soft over full stiffness",
        ),
    ),
    apply=_apply,
    where="nut joint",
    source="Ball-screw facts 2.4 and 3: two-slope spring",
    signature="table lag per force larger for small forces; a ratio of zero is backlash",
    separating_experiment="load steps of both signs at standstill: the slope changes at a force",
    look_alikes=("backlash", "axial_stiffness_nonlinear"),
    starts=({"half_width_m": 1e-6}, {"half_width_m": 4e-6}),
    hides_behind=("coulomb.guide_N", "chain.axial_stiffness_N_per_m"),
    min_substeps=4,
    rigid=False,
)
