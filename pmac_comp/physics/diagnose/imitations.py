"""Corners of an effect's range in which it is another effect.

What lives here: which, in words, and the effect that it is. No evidence. May import
``physics.model``.
"""

from collections.abc import Callable, Mapping

from pmac_comp.base.units import MM_PER_M
from pmac_comp.physics.model.drive import DriveModel

_SHORTEST_DIP_m = 0.15e-3  # dips are half to five millimetres long, presliding 5 to 50 um
_SHORTEST_PRESLIDING_m = 1e-6
_SHORTEST_GROWTH_s = 0.5  # screws warm over minutes
_LEAST_CURVE = 0.05  # of an exponent: so far from 0 (Coulomb friction) and from 1 (viscous)
ONSET = "it is so short that the friction is Coulomb friction, which nowhere sets in at once"
"""Of presliding within what the encoder resolves."""


def _far_cable(model: DriveModel) -> str:
    travel = model.bench.travel
    reach_m = (travel.max_mm - travel.min_mm) / MM_PER_M
    middle_m = 0.5 * (travel.max_mm + travel.min_mm) / MM_PER_M
    if abs(model.parameters["cable_drag.centre_m"] - middle_m) < 1.5 * reach_m:
        return ""
    return "its centre lies so far outside the travel that its force is constant: a bias"


def _no_ratio(model: DriveModel) -> str:
    if model.parameters["preload_loss.stiffness_ratio"] > 0.02:
        return ""
    return "its soft zone has no stiffness left: a backlash"


def _no_mode(model: DriveModel) -> str:
    if model.parameters["base_mode.damping_ratio"] < 0.7:
        return ""
    return "its damping leaves no resonance"


def _no_curve(model: DriveModel) -> str:
    exponent = model.parameters["viscous_nonlinear.exponent"]
    # Beyond 1 it is a drag (2 is a fluid's), as much a curve as below.
    if min(exponent, abs(exponent - 1.0)) > _LEAST_CURVE:
        return ""
    return "its exponent makes it Coulomb or viscous friction"


def _short_dip(model: DriveModel) -> str:
    if model.parameters["post_reversal_dip.length_m"] > _SHORTEST_DIP_m:
        return ""
    return "its length is that of presliding"


def _grown_at_once(model: DriveModel) -> str:
    if model.parameters["thermal_growth.time_constant_s"] > _SHORTEST_GROWTH_s:
        return ""
    return "it is over before the run has begun: a slope of lead or scale"


def _onset(model: DriveModel) -> str:
    shortest = max(_SHORTEST_PRESLIDING_m, model.bench.motor_resolution_m)
    return "" if model.parameters["presliding.distance_m"] > shortest else ONSET


# Corners of an effect's range where it is another effect.
_IMITATIONS: Mapping[str, Callable[[DriveModel], str]] = {
    "cable_drag": _far_cable,
    "preload_loss": _no_ratio,
    "base_mode": _no_mode,
    "viscous_nonlinear": _no_curve,
    "post_reversal_dip": _short_dip,
    "presliding": _onset,
    "thermal_growth": _grown_at_once,
}


def imitation(effect: str, model: DriveModel) -> str:
    """What an effect of a model is in truth, in words; nothing where it is itself."""
    told = _IMITATIONS.get(effect)
    return "" if told is None else told(model)


# What such a corner is, where that is an effect of the library which the base model lacks.
_TRUE_NAMES: Mapping[str, str] = {
    "cable_drag": "bias_force",
    "preload_loss": "backlash",
    "post_reversal_dip": "presliding",
    "thermal_growth": "lead_linear",
}


def as_true_name(effect: str, model: DriveModel) -> DriveModel:
    """The model with an effect in such a corner replaced by what it is, of the same size.

    Without the effect alone where its parameters do not tell the size of the other.
    """
    bare = model.without_effect(effect)
    if effect != "preload_loss":
        return bare
    # The stiff spring beyond a soft zone begins where that one's force leaves it.
    half_m = model.parameters["preload_loss.half_width_m"]
    soft = model.parameters["preload_loss.stiffness_ratio"]
    return bare.with_effect("backlash", {"gap_m": 2.0 * half_m * (1.0 - soft)})


def in_its_corner(effect: str) -> str:
    """What an effect is in a corner of its range, wherever it is now; nothing if there is none."""
    return _TRUE_NAMES.get(effect, "")


def true_name(effect: str, model: DriveModel) -> str:
    """The effect that an effect of a model is in truth; nothing where it is itself."""
    return in_its_corner(effect) if imitation(effect, model) else ""
