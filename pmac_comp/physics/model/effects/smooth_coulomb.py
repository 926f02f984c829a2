"""Smooth Coulomb friction: it turns over with speed, and holds nothing at rest."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import ParameterSpec, parameter


def _speed(side: str, description: str) -> ParameterSpec:
    """Speed over which the friction of one side turns over, expressed at the table."""
    return parameter(
        f"{side}_m_per_s",
        "m/s",
        1e-3,
        (1e-5, 0.1),
        file=(f"{side}_mm_per_s", "mm/s", MM_PER_M),
        description=description,
        by_root=True,
    )


_SPEED = _speed("speed", "at which the guide's friction has 76 % of its level")
_ROTARY = _speed("rotary", "the same for nut and motor, expressed at the table")


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.SMOOTH_GUIDE] = values["speed_m_per_s"]
    turning = values.get("rotary_m_per_s", values["speed_m_per_s"])
    vector[s.SMOOTH_ROTARY] = turning / bench.lead_m_per_rad


EFFECT = Effect(
    name="smooth_coulomb",
    parameters=(_SPEED, _ROTARY),
    place_parameters={"rigid": (_SPEED,)},
    apply=_apply,
    where="guide, nut and motor",
    source=(
        "F tanh(v / v_c), the usual regularisation of Coulomb friction (Andersson, Soderberg and "
        "Bjorklund 2007), as grease and seals shear"
    ),
    signature=(
        "the drive creeps at rest under any torque that is left, and settles without friction's "
        "lag; friction sets in with speed, not with travel"
    ),
    separating_experiment="rests of a second after moves: torque that fades while the motor creeps",
    look_alikes=("presliding", "stribeck", "viscous_nonlinear"),
    hides_behind=("coulomb.guide_N", "viscous.guide_Ns_per_m", "coulomb.motor_Nm"),
)
