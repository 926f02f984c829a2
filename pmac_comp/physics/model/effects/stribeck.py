"""Stribeck friction: the level is higher near standstill and falls with speed."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter

_SPEED = parameter(
    "speed_m_per_s", "m/s", 0.005, (1e-5, 1.0), description="at the table; Stribeck speed v_s"
)
_ROTARY = (parameter("excess_Nm", "N m", 0.1, (0.0, 1e2)), _SPEED)


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    slot = {"guide": s.STRIBECK_GUIDE, "nut": s.STRIBECK_NUT, "motor": s.STRIBECK_MOTOR}[place]
    vector[slot] = values["excess_N" if place == "guide" else "excess_Nm"]
    vector[s.STRIBECK_SPEED] = values["speed_m_per_s"]


EFFECT = Effect(
    name="stribeck",
    parameters=(
        parameter(
            "excess_N", "N", 15.0, (0.0, 1e4), description="level at rest above the sliding level"
        ),
        _SPEED,
    ),
    apply=_apply,
    where="guide, nut or motor",
    source="Canudas de Wit et al. 1995 (LuGre): g(v) = F_c + (F_s - F_c) exp(-(v/v_s)^2)",
    signature=(
        "torque and table lag rise below about 10 mm/s, odd in speed, the same at any "
        "distance from the reversal"
    ),
    separating_experiment="constant speeds from 0.2 to 20 mm/s in both directions",
    look_alikes=("presliding", "viscous_nonlinear", "post_reversal_dip"),
    places=("guide", "nut", "motor"),
    place_parameters={"nut": _ROTARY, "motor": _ROTARY},
    starts=({"speed_m_per_s": 0.002}, {"speed_m_per_s": 0.005}, {"speed_m_per_s": 0.015}),
    hides_behind=("coulomb.guide_N", "coulomb.nut_Nm", "viscous.guide_Ns_per_m"),
)
