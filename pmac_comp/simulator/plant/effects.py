"""Physical effects of the simulated drive by name: file parameters to kernel parameters.

What lives here: one entry per effect with its parameters (units in the names), defaults and the
place where it enters the kernel. What may not: the time stepping. Imports ``base`` and the kernel
layout only; nothing here is shared with the model that is fitted.

Sign conventions where the name alone leaves a choice: ``friction_asymmetry.fraction`` is
(positive - negative direction) / sum, at place ``sliding`` of Coulomb and viscous friction of the
guide alike (a difference of the Coulomb level alone is a ``bias_force``); a positive
``channel_skew.time_us`` means that the scale sample is older than the encoder sample;
``torque_ripple.amplitude_Nm`` is reached at rated torque and grows with the torque;
``base_mode.mass_ratio`` is table mass over base mass; ``presliding.elements`` above 0 makes the
guide's presliding one of parallel elements with non-local memory (GMS) in place of a LuGre bristle;
a positive ``bias_force.force_N`` resists positive motion, as the force of ``set_external_force``
does.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ConfigError
from pmac_comp.base.units import MM_PER_M, UM_PER_M, US_PER_S
from pmac_comp.simulator.plant import kernel_ballscrew as k

PlantEffects = Mapping[str, Mapping[str, float | str]]
Values = dict[str, float]
_RIPPLE_REFERENCE = 3.0  # peak over rated torque, if the bench does not state the rated torque


@dataclass(frozen=True)
class PlantEffect:
    """One effect: numeric parameters with defaults and how they act on the kernel vector."""

    defaults: Mapping[str, float]
    apply: Callable[[FloatArray, Values], None]
    places: tuple[str, ...] = ()


def _stribeck(par: FloatArray, values: Values) -> None:
    par[k.P_STRIBECK_N] = values["excess_N"]
    par[k.P_STRIBECK_NM] = values["excess_Nm"]
    par[k.P_STRIBECK_SPEED] = values["speed_m_per_s"]


def _stribeck_motor(par: FloatArray, values: Values) -> None:
    par[k.P_STRIBECK_MOTOR] = values["excess_Nm"]
    par[k.P_STRIBECK_SPEED] = values["speed_m_per_s"]


def _presliding_at(place: str) -> Callable[[FloatArray, Values], None]:
    def apply(par: FloatArray, values: Values) -> None:
        distance_m = values["distance_um"] / UM_PER_M
        ratio = values["damping_ratio"]
        if place == "guide":
            _bristle(par, k.P_GUIDE_LEVEL, distance_m, ratio)
            if values["elements"] > 0.0:
                par[k.P_GUIDE_BRISTLE] = 2.0
        if place in {"nut", "rotary"}:
            _bristle(par, k.P_NUT_LEVEL, distance_m / par[k.P_LEAD], ratio)
        if place in {"motor", "rotary"}:
            _bristle(par, k.P_MOTOR_LEVEL, distance_m / par[k.P_LEAD], ratio)

    return apply


def _bristle(par: FloatArray, level_index: int, distance: float, ratio: float) -> None:
    """LuGre bristles in place of the sharp stick; the distance belongs to 63 % of the level.

    ``ratio`` is their damping over critical damping (Canudas de Wit et al. 1995).
    """
    flag, damping = {
        k.P_GUIDE_LEVEL: (k.P_GUIDE_BRISTLE, k.P_GUIDE_DAMPING),
        k.P_NUT_LEVEL: (k.P_NUT_BRISTLE, k.P_NUT_DAMPING),
        k.P_MOTOR_LEVEL: (k.P_MOTOR_BRISTLE, k.P_MOTOR_DAMPING),
    }[level_index]
    par[level_index + 1] = distance
    par[flag] = 1.0
    inertia = par[k.P_M_TABLE] if level_index == k.P_GUIDE_LEVEL else par[k.P_J_MOTOR]
    par[damping] = 2.0 * ratio * math.sqrt(par[level_index] / distance * inertia)


def _asymmetry(par: FloatArray, values: Values) -> None:
    par[k.P_ASYM_VISCOUS] = values["fraction"]


def _asymmetry_rotary(par: FloatArray, values: Values) -> None:
    par[k.P_ASYM_ROTARY] = values["fraction"]


def _asymmetry_sliding(par: FloatArray, values: Values) -> None:
    par[k.P_ASYM_SLIDING] = values["fraction"]


def _harmonic(amplitude: int) -> Callable[[FloatArray, Values], None]:
    def apply(par: FloatArray, values: Values) -> None:
        _set_harmonic(par, amplitude, values["amplitude_Nm"], values)

    return apply


def _harmonic_um(amplitude: int) -> Callable[[FloatArray, Values], None]:
    def apply(par: FloatArray, values: Values) -> None:
        _set_harmonic(par, amplitude, values["amplitude_um"] / UM_PER_M, values)

    return apply


def _set_harmonic(par: FloatArray, amplitude: int, value: float, values: Values) -> None:
    par[amplitude] = value
    par[amplitude + 1] = values["order_per_rev"]
    par[amplitude + 2] = values["phase_rad"]


def _ripple(par: FloatArray, values: Values) -> None:
    rated_Nm = values["rated_Nm"] or par[k.P_LIMIT] / _RIPPLE_REFERENCE
    _set_harmonic(par, k.P_RIPPLE, values["amplitude_Nm"] / rated_Nm, values)


def _set(*pairs: tuple[int, str, float]) -> Callable[[FloatArray, Values], None]:
    def apply(par: FloatArray, values: Values) -> None:
        for index, name, factor in pairs:
            par[index] = values[name] * factor

    return apply


def _set_known(*pairs: tuple[int, str, float]) -> Callable[[FloatArray, Values], None]:
    """Like ``_set``, but NaN leaves the value of the plant."""

    def apply(par: FloatArray, values: Values) -> None:
        for index, name, factor in pairs:
            if not math.isnan(values[name]):
                par[index] = values[name] * factor

    return apply


def _payload(par: FloatArray, values: Values) -> None:
    par[k.P_M_TABLE] += values["mass_kg"]


def _base_mode(par: FloatArray, values: Values) -> None:
    omega = 2.0 * math.pi * values["frequency_Hz"]
    mass = par[k.P_M_TABLE] / values["mass_ratio"]
    par[k.P_BASE_MASS] = mass
    par[k.P_BASE_K] = mass * omega**2
    par[k.P_BASE_C] = 2.0 * values["damping_ratio"] * mass * omega


def _external(par: FloatArray, values: Values) -> None:
    par[k.P_FORCE] = values["amplitude_N"]
    par[k.P_FORCE_OMEGA] = 2.0 * math.pi * values["frequency_Hz"]
    par[k.P_FORCE_PHASE] = values["phase_rad"]


def _windup(par: FloatArray, values: Values) -> None:
    extra = values["stiffness_Nm_per_rad"]
    par[k.P_K_COUPLING] = 1.0 / (1.0 / par[k.P_K_COUPLING] + 1.0 / extra)


def _rigidity(par: FloatArray, values: Values) -> None:
    par[k.P_EA] *= values["rigidity_factor"]


_PER_UM = 1.0 / UM_PER_M
_PER_US = 1.0 / US_PER_S
_NAN = math.nan
_WAVE_NM = {"amplitude_Nm": 0.03, "order_per_rev": 1.0, "phase_rad": 0.0}
_WAVE_UM = {"amplitude_um": 1.0, "order_per_rev": 1.0, "phase_rad": 0.0}

PLANT_EFFECTS: Mapping[str, PlantEffect] = {
    "stribeck": PlantEffect(
        {"excess_N": 0.0, "excess_Nm": 0.0, "speed_m_per_s": 0.005}, _stribeck, ("guide", "motor")
    ),
    "presliding": PlantEffect(
        {"distance_um": 10.0, "elements": 0.0, "damping_ratio": 0.05},
        _presliding_at("guide"),
        ("guide", "nut", "motor", "rotary"),
    ),
    "viscous_nonlinear": PlantEffect(
        {"coefficient_N": 30.0, "exponent": 0.5},
        _set((k.P_SQRT_N, "coefficient_N", 1.0), (k.P_SQRT_EXPONENT, "exponent", 1.0)),
    ),
    "coulomb": PlantEffect(
        {"guide_N": _NAN, "nut_Nm": _NAN, "motor_Nm": _NAN},
        _set_known(
            (k.P_GUIDE_LEVEL, "guide_N", 1.0),
            (k.P_NUT_LEVEL, "nut_Nm", 1.0),
            (k.P_MOTOR_LEVEL, "motor_Nm", 1.0),
        ),
    ),
    "viscous": PlantEffect(
        {"guide_Ns_per_m": _NAN, "nut_Nms_per_rad": _NAN, "motor_Nms_per_rad": _NAN},
        _set_known(
            (k.P_GUIDE_VISCOUS, "guide_Ns_per_m", 1.0),
            (k.P_NUT_VISCOUS, "nut_Nms_per_rad", 1.0),
            (k.P_MOTOR_VISCOUS, "motor_Nms_per_rad", 1.0),
        ),
    ),
    "friction_asymmetry": PlantEffect(
        {"fraction": 0.2}, _asymmetry, ("viscous", "sliding", "rotary")
    ),
    "friction_per_rev": PlantEffect(_WAVE_NM, _harmonic(k.P_FPR_NM)),
    "post_reversal_dip": PlantEffect(
        {"fraction": 0.25, "length_mm": 1.5},
        _set((k.P_DIP, "fraction", 1.0), (k.P_DIP_LENGTH, "length_mm", 1.0 / MM_PER_M)),
    ),
    "friction_warmup": PlantEffect(
        {"fraction": 0.3, "time_constant_s": 30.0},
        _set((k.P_WARM, "fraction", 1.0), (k.P_WARM_TAU, "time_constant_s", 1.0)),
    ),
    "cogging": PlantEffect(_WAVE_NM | {"order_per_rev": 20.0}, _harmonic(k.P_COG_NM)),
    "torque_ripple": PlantEffect(
        _WAVE_NM | {"amplitude_Nm": 0.06, "order_per_rev": 10.0, "rated_Nm": 0.0}, _ripple
    ),
    "bias_force": PlantEffect({"force_N": 20.0}, _set((k.P_BIAS, "force_N", 1.0))),
    "cable_drag": PlantEffect(
        {"stiffness_N_per_m": 50.0, "centre_mm": 0.0},
        _set((k.P_CABLE_K, "stiffness_N_per_m", 1.0), (k.P_CABLE_X, "centre_mm", 1.0 / MM_PER_M)),
    ),
    "payload": PlantEffect({"mass_kg": 20.0}, _payload),
    "backlash": PlantEffect({"gap_um": 5.0}, _set((k.P_GAP, "gap_um", 0.5 * _PER_UM))),
    "nut_efficiency": PlantEffect(
        {"loss_fraction": 0.08}, _set((k.P_NUT_LOAD, "loss_fraction", 1.0))
    ),
    "axial_stiffness_position": PlantEffect({"rigidity_factor": 0.8}, _rigidity),
    "axial_stiffness_nonlinear": PlantEffect(
        {"preload_N": 1000.0}, _set((k.P_HERTZ, "preload_N", 1.0))
    ),
    "preload_loss": PlantEffect(
        {"half_width_um": 2.0, "stiffness_ratio": 0.4},
        _set((k.P_SOFT_HALF, "half_width_um", _PER_UM), (k.P_SOFT_RATIO, "stiffness_ratio", 1.0)),
    ),
    "coupling_windup": PlantEffect({"stiffness_Nm_per_rad": 6000.0}, _windup),
    "chain_damping": PlantEffect({"time_us": 146.0}, _set((k.P_BETA, "time_us", _PER_US))),
    "base_mode": PlantEffect(
        {"frequency_Hz": 35.0, "mass_ratio": 0.1, "damping_ratio": 0.03}, _base_mode
    ),
    "lead_linear": PlantEffect(
        {"slope_um_per_m": 40.0}, _set((k.P_LEAD_SLOPE, "slope_um_per_m", _PER_UM))
    ),
    "lead_cyclic": PlantEffect(_WAVE_UM, _harmonic_um(k.P_WOBBLE)),
    "thermal_growth": PlantEffect(
        {"final_um_per_m": 60.0, "time_constant_s": 60.0},
        _set((k.P_GROWTH, "final_um_per_m", _PER_UM), (k.P_GROWTH_TAU, "time_constant_s", 1.0)),
    ),
    "encoder_eccentricity": PlantEffect(_WAVE_UM, _harmonic_um(k.P_ECC)),
    "scale_subdivision": PlantEffect(
        {"amplitude_um": 0.2, "period_um": 20.0, "phase_rad": 0.0},
        _set(
            (k.P_SDE, "amplitude_um", _PER_UM),
            (k.P_SDE_PERIOD, "period_um", _PER_UM),
            (k.P_SDE_PHASE, "phase_rad", 1.0),
        ),
    ),
    "scale_slope": PlantEffect(
        {"slope_um_per_m": 40.0}, _set((k.P_SCALE_SLOPE, "slope_um_per_m", _PER_UM))
    ),
    "channel_skew": PlantEffect({"time_us": 5.0}, _set((k.P_SKEW, "time_us", _PER_US))),
    "actuator_delay": PlantEffect({"time_us": 884.0}, _set((k.P_DELAY, "time_us", _PER_US))),
    "current_bandwidth": PlantEffect(
        {"bandwidth_Hz": 200.0}, _set((k.P_BANDWIDTH, "bandwidth_Hz", 2.0 * math.pi))
    ),
    "torque_saturation": PlantEffect({"limit_Nm": 6.0}, _set((k.P_LIMIT, "limit_Nm", 1.0))),
    "external_force": PlantEffect(
        {"amplitude_N": 100.0, "frequency_Hz": 7.0, "phase_rad": 0.0}, _external
    ),
}
"""All effects of the design by name. ``nut_efficiency.loss_fraction`` is the extra torque share."""


def apply_effects(par: FloatArray, effects: PlantEffects) -> None:
    """Switch effects on in a kernel vector, in the order given.

    Raises
    ------
    ConfigError
        Unknown effect, unknown parameter, place that the effect does not have, bad value.
    """
    for name, given in effects.items():
        effect = PLANT_EFFECTS.get(name)
        if effect is None:
            raise ConfigError(
                f"The simulated drive has no effect '{name}'.",
                code="PC-PLT-001",
                hint="Known effects: " + ", ".join(PLANT_EFFECTS),
            )
        _apply_one(par, name, effect, given)


def _apply_one(
    par: FloatArray, name: str, effect: PlantEffect, given: Mapping[str, float | str]
) -> None:
    place = given.get("place", effect.places[0] if effect.places else "")
    numbers = {key: value for key, value in given.items() if key != "place"}
    unknown = sorted(set(numbers) - set(effect.defaults))
    if unknown or (place and place not in effect.places):
        raise ConfigError(
            f"Effect '{name}' of the simulated drive has no "
            f"{', '.join(unknown) or f'place {place}'}.",
            code="PC-PLT-002",
            hint=f"It has {', '.join(effect.defaults)}"
            + (f" and the places {', '.join(effect.places)}." if effect.places else "."),
        )
    values = dict(effect.defaults) | {key: float(value) for key, value in numbers.items()}
    if any(math.isinf(value) for value in values.values()):
        raise ConfigError(f"Effect '{name}' was given an infinite value.", code="PC-PLT-003")
    if name == "nut_efficiency":
        values["loss_fraction"] = par[k.P_NUT_LOAD] + values["loss_fraction"] * par[k.P_LEAD]
    at_place = _AT_PLACE.get((name, str(place)), effect.apply)
    at_place(par, values)


_AT_PLACE: Mapping[tuple[str, str], Callable[[FloatArray, Values], None]] = {
    ("presliding", "nut"): _presliding_at("nut"),
    ("presliding", "motor"): _presliding_at("motor"),
    ("presliding", "rotary"): _presliding_at("rotary"),
    ("friction_asymmetry", "sliding"): _asymmetry_sliding,
    ("friction_asymmetry", "rotary"): _asymmetry_rotary,
    ("stribeck", "motor"): _stribeck_motor,
}
