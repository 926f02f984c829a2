"""Periodic force on the table: a process, a pump, a neighbour."""

import math

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter, phase


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.EXTERNAL] = values["amplitude_N"]
    vector[s.EXTERNAL + 1] = 2.0 * math.pi * values["frequency_Hz"]
    vector[s.EXTERNAL + 2] = values["phase_rad"]


EFFECT = Effect(
    name="external_force",
    parameters=(
        parameter("amplitude_N", "N", 50.0, (0.0, 1e5)),
        parameter("frequency_Hz", "Hz", 7.0, (1e-3, 1e3), scale=0.05),
        phase(),
    ),
    apply=_apply,
    where="table",
    source="Force on the table, through the compliance: -C F_ext",
    signature=(
        "lines in torque and table at a frequency that is fixed in time, not in place; the "
        "phase is that in the first run, others begin when they do"
    ),
    separating_experiment="stand still and listen: the lines stay",
    look_alikes=("base_mode", "cogging"),
    starts=(
        {"frequency_Hz": 3.0},
        {"frequency_Hz": 7.0},
        {"frequency_Hz": 15.0},
        {"frequency_Hz": 50.0},
    ),
)
