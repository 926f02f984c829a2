"""Preload of the nut lost: the joint is soft around zero force, or beyond a threshold.

Without any preload the balls bear only once the play is taken up: soft in the middle. With too
little of it one half of the nut lifts off beyond some force, and the other bears alone.
"""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import ParameterSpec, parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.SOFT_HALF] = values["half_width_m"]
    vector[s.SOFT_RATIO] = values["stiffness_ratio"]
    if place == "beyond":
        # The kernel's spring is the one far out; its middle is stiffer by the inverse.
        vector[s.K_NUT] *= values["stiffness_ratio"]
        vector[s.SOFT_RATIO] = 1.0 / values["stiffness_ratio"]


def _half_width(description: str) -> ParameterSpec:
    return parameter(
        "half_width_m",
        "m",
        2e-6,
        (0.0, 1e-3),
        file=("half_width_um", "um", UM_PER_M),
        description=description,
    )


_LIFTS_OFF = (
    parameter(
        "stiffness_ratio",
        "1",
        0.5,
        (0.05, 1.0),
        scale=0.1,
        description="stiffness beyond the threshold over that below it",
    ),
    _half_width("deflection up to which both halves bear"),
)


EFFECT = Effect(
    name="preload_loss",
    parameters=(
        _half_width("deflection up to which the joint is soft"),
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
    where="nut joint: around zero force, or beyond a threshold of it",
    source="A spring of two slopes",
    signature=(
        "table lag per force changes at a threshold: larger for small forces (a ratio of zero is "
        "backlash), or larger beyond it"
    ),
    separating_experiment="load steps of both signs at standstill: the slope changes at a force",
    look_alikes=("backlash", "axial_stiffness_nonlinear"),
    places=("centre", "beyond"),
    place_parameters={"beyond": _LIFTS_OFF},
    starts=(
        {"half_width_m": 1e-6},
        {"half_width_m": 4e-6},
        {"half_width_m": 1e-6, "stiffness_ratio": 0.8},
        {"half_width_m": 3e-6, "stiffness_ratio": 0.8},
    ),
    hides_behind=("coulomb.guide_N", "chain.axial_stiffness_N_per_m"),
    min_substeps=4,
    rigid=False,
)
