"""Viscous friction at guide, nut and motor (part of the base model)."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.GUIDE + s.VISCOUS] = values.get("guide_Ns_per_m", 0.0)
    vector[s.NUT + s.VISCOUS] = values.get("nut_Nms_per_rad", 0.0)
    vector[s.MOTOR + s.VISCOUS] = values.get("motor_Nms_per_rad", 0.0)


EFFECT = Effect(
    name="viscous",
    parameters=(
        parameter("guide_Ns_per_m", "N s/m", 200.0, (0.0, 1e6), description="at the guide"),
        parameter("nut_Nms_per_rad", "N m s/rad", 1e-3, (0.0, 10.0), description="at the nut"),
        parameter("motor_Nms_per_rad", "N m s/rad", 1e-3, (0.0, 10.0), description="at the motor"),
    ),
    place_parameters={
        "rigid": (
            parameter(
                "guide_Ns_per_m",
                "N s/m",
                200.0,
                (0.0, 1e6),
                file=("viscous_N_s_per_m", "N s/m", 1.0),
                description="all viscous friction, expressed at the table",
            ),
        )
    },
    apply=_apply,
    where="guide, nut, motor",
    source="Friction in proportion to the speed: B v",
    signature="torque, and table minus motor, in proportion to speed",
    separating_experiment=(
        "a speed staircase at both ends of the travel: skew does not change there"
    ),
    look_alikes=("channel_skew",),
)
