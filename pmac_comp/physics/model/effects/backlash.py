"""Backlash in the nut: the table stands still while the nut crosses the gap."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.GAP_HALF] = 0.5 * values["gap_m"]


EFFECT = Effect(
    name="backlash",
    parameters=(
        parameter(
            "gap_m",
            "m",
            3e-6,
            (0.0, 1e-3),
            file=("gap_um", "um", UM_PER_M),
            description="full clearance",
        ),
    ),
    apply=_apply,
    where="nut joint",
    source="A dead zone in the deflection of the joint",
    signature=(
        "table lags by the gap after each force reversal, at any speed and place; no force inside"
    ),
    separating_experiment=(
        "push the table both ways at standstill: it steps at constant motor angle"
    ),
    look_alikes=("preload_loss", "presliding", "coulomb"),
    starts=({"gap_m": 2e-6}, {"gap_m": 6e-6}),
    hides_behind=("coulomb.guide_N", "chain.axial_stiffness_N_per_m"),
    min_substeps=4,
    rigid=False,
)
