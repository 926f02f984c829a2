"""Example of an effect of your own: guide friction that is higher on a worn stretch of the travel.

    pmac-comp identify runs/*.h5 --bench paper --effects configs/effect_worn_stretch.py \
        --with worn_stretch --out model.json
    pmac-comp predict --bench paper --model model.json --command move.csv --out move.h5 \
        --effects configs/effect_worn_stretch.py
    pmac-comp diagnose runs/*.h5 --bench paper --effects configs/effect_worn_stretch.py

An effect is one ``EFFECT = Effect(...)`` (or a list ``EFFECTS``). It acts through tables over a
coordinate, which the compiled loop interpolates: nothing of yours needs compiling, and the fit
moves its parameters like any other. Values are SI inside; ``file=(name, unit, factor)`` is how
files and tables show them.
"""

from collections.abc import Mapping

import numpy as np

from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model.effect import Effect, no_slots
from pmac_comp.physics.model.parameters import parameter
from pmac_comp.physics.model.terms import Coordinate, Site, TableTerm

KNOTS = 241


def worn_stretch(values: Mapping[str, float], bench: Bench) -> tuple[TableTerm, ...]:
    """Added level of the guide's friction over the table position: a bell around the centre."""
    low_m, high_m = bench.travel.min_mm / MM_PER_M, bench.travel.max_mm / MM_PER_M
    position_m = np.linspace(low_m, high_m, KNOTS)
    distance = (position_m - values["centre_m"]) / values["width_m"]
    return (
        TableTerm(
            coordinate=Coordinate.TABLE_POSITION_M,
            site=Site.GUIDE_FRICTION_N,
            start=low_m,
            step=float(position_m[1] - position_m[0]),
            values=values["excess_N"] * np.exp(-0.5 * distance**2),
        ),
    )


EFFECT = Effect(
    name="worn_stretch",
    # The first parameter is the one that a diagnosis scores.
    parameters=(
        parameter("excess_N", "N", 10.0, (0.0, 1e3), description="added level at the centre"),
        parameter(
            "centre_m", "m", 0.0, (-1.0, 1.0), scale=0.1, file=("centre_mm", "mm", MM_PER_M),
            description="table position of the centre",
        ),
        parameter(
            "width_m", "m", 0.05, (0.005, 0.5), file=("width_mm", "mm", MM_PER_M),
            description="standard deviation of the bell",
        ),
    ),
    apply=no_slots,
    terms=worn_stretch,
    where="guide, over the travel",
    source="own observation: torque of a slow run along the whole travel",
    signature="torque and table lag are higher on a stretch of the travel, at any speed",
    separating_experiment="one slow run over the whole travel, both ways",
    look_alikes=("cable_drag", "friction_per_rev"),
    hides_behind=("coulomb.guide_N",),
)  # fmt: skip
