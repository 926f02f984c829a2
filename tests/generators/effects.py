"""Effects that are hidden in the simulated plant, each as a draw of its values for a strength.

Nothing of ``pmac_comp.physics`` may be imported here: the code that makes the data shares nothing
with the model that is fitted to it. Strength 1 is a moderate size; ``sizing`` scales the strength
until the effect is as many times the noise as a case asks for.
"""

from collections.abc import Callable, Mapping

import numpy as np

from pmac_comp.files.bench import Bench

Values = Mapping[str, float | str]
Draw = Callable[[np.random.Generator, float, Bench], Values]

NOT_HIDDEN: Mapping[str, str] = {
    "coulomb": "part of the base model: every case has it, so it cannot be missing",
    "viscous": "part of the base model: every case has it, so it cannot be missing",
    "smooth_coulomb": "a form of Coulomb friction that `identify` looks for at rests",
    "presliding_gms": "another form of presliding; half of the guide's presliding has this form",
}
"""Effects of the library without a case of their own, and why."""


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _phase(rng: np.random.Generator) -> float:
    return float(rng.uniform(-np.pi, np.pi))


def _wave(key: str, size: float, orders: tuple[float, ...]) -> Draw:
    def draw(rng: np.random.Generator, strength: float, bench: Bench) -> Values:
        return {
            key: size * strength,
            "order_per_rev": float(rng.choice(orders)),
            "phase_rad": _phase(rng),
        }

    return draw


def _signed(key: str, size: float) -> Draw:
    return lambda rng, strength, bench: {key: _sign(rng) * size * strength}


def _positive(key: str, size: float) -> Draw:
    return lambda rng, strength, bench: {key: size * strength}


def _stribeck(rng: np.random.Generator, strength: float, bench: Bench) -> Values:
    speed = float(rng.uniform(0.003, 0.012))
    if rng.random() < 0.5:
        return {"excess_N": 40.0 * strength, "speed_m_per_s": speed}
    return {"excess_Nm": 0.06 * strength, "speed_m_per_s": speed}


def _presliding(rng: np.random.Generator, strength: float, bench: Bench) -> Values:
    place = str(rng.choice(["guide", "nut", "motor"]))
    distance = 25.0 * strength * float(rng.uniform(0.7, 1.4))
    elements = float(rng.choice([0.0, 1.0])) if place == "guide" else 0.0
    return {"distance_um": distance, "place": place, "elements": elements}


def _asymmetry(rng: np.random.Generator, strength: float, bench: Bench) -> Values:
    fraction = float(np.clip(0.3 * strength, 0.0, 0.8)) * _sign(rng)
    return {"fraction": fraction, "place": str(rng.choice(["viscous", "sliding"]))}


def _warmup(rng: np.random.Generator, strength: float, bench: Bench) -> Values:
    return {"fraction": min(0.9, 0.4 * strength), "time_constant_s": float(rng.uniform(2.0, 8.0))}


def _dip(rng: np.random.Generator, strength: float, bench: Bench) -> Values:
    return {"fraction": min(0.9, 0.35 * strength), "length_mm": float(rng.uniform(0.7, 4.0))}


def _cable(rng: np.random.Generator, strength: float, bench: Bench) -> Values:
    return {
        "stiffness_N_per_m": 250.0 * strength,
        "centre_mm": float(rng.uniform(-100.0, 100.0)),
    }


def _preload_loss(rng: np.random.Generator, strength: float, bench: Bench) -> Values:
    return {
        "half_width_um": float(rng.uniform(0.8, 2.0)) * strength,
        "stiffness_ratio": float(rng.uniform(0.2, 0.5)),
    }


def _base_mode(rng: np.random.Generator, strength: float, bench: Bench) -> Values:
    return {"frequency_Hz": float(rng.uniform(20.0, 60.0)), "mass_ratio": 0.06 * strength}


def _thermal(rng: np.random.Generator, strength: float, bench: Bench) -> Values:
    return {
        "final_um_per_m": 40.0 * strength,
        "time_constant_s": float(rng.uniform(3.0, 12.0)),
    }


def _subdivision(rng: np.random.Generator, strength: float, bench: Bench) -> Values:
    return {"amplitude_um": 0.6 * strength, "period_um": 20.0, "phase_rad": _phase(rng)}


def _delay(rng: np.random.Generator, strength: float, bench: Bench) -> Values:
    # The parameter is the total dead time, not an addition to it.
    return {"time_us": _nominal(bench, "actuator_delay_us", 442.0) * (1.0 + strength)}


def _current_loop(rng: np.random.Generator, strength: float, bench: Bench) -> Values:
    nominal_Hz = _nominal(bench, "current_bandwidth_Hz", 300.0)
    return {"bandwidth_Hz": nominal_Hz / (1.0 + 1.2 * strength)}


def _nominal(bench: Bench, key: str, otherwise: float) -> float:
    value = getattr(bench.nominal, key)
    return otherwise if value is None else float(value)


def _external(rng: np.random.Generator, strength: float, bench: Bench) -> Values:
    return {
        "amplitude_N": 40.0 * strength,
        "frequency_Hz": float(rng.uniform(2.0, 12.0)),
        "phase_rad": _phase(rng),
    }


EFFECTS: Mapping[str, Draw] = {
    "stribeck": _stribeck,
    "presliding": _presliding,
    "viscous_nonlinear": lambda rng, s, bench: {"coefficient_N": 150.0 * s, "exponent": 0.5},
    "friction_asymmetry": _asymmetry,
    "friction_per_rev": _wave("amplitude_Nm", 0.06, (1.0, 2.0)),
    "post_reversal_dip": _dip,
    "friction_warmup": _warmup,
    "cogging": _wave("amplitude_Nm", 0.06, (4.0, 10.0, 20.0)),
    "torque_ripple": _wave("amplitude_Nm", 0.5, (2.0, 5.0, 10.0)),
    "bias_force": _signed("force_N", 40.0),
    "cable_drag": _cable,
    "payload": _positive("mass_kg", 25.0),
    "backlash": _positive("gap_um", 4.0),
    "nut_efficiency": _positive("loss_fraction", 0.15),
    "axial_stiffness_position": lambda rng, s, bench: {"rigidity_factor": 1.0 / (1.0 + 0.35 * s)},
    "axial_stiffness_nonlinear": lambda rng, s, bench: {"preload_N": 900.0 / s},
    "preload_loss": _preload_loss,
    "coupling_windup": lambda rng, s, bench: {"stiffness_Nm_per_rad": 5000.0 / s},
    "chain_damping": lambda rng, s, bench: {"time_us": 73.0 * (1.0 + 3.0 * s)},
    "base_mode": _base_mode,
    "lead_linear": _signed("slope_um_per_m", 25.0),
    "lead_cyclic": _wave("amplitude_um", 1.5, (1.0, 2.0)),
    "thermal_growth": _thermal,
    "encoder_eccentricity": _wave("amplitude_um", 1.5, (1.0, 2.0)),
    "scale_subdivision": _subdivision,
    "scale_slope": _signed("slope_um_per_m", 25.0),
    "channel_skew": _signed("time_us", 8.0),
    "actuator_delay": _delay,
    "current_bandwidth": _current_loop,
    "torque_saturation": lambda rng, s, bench: {"limit_Nm": 5.0 / s},
    "external_force": _external,
}
"""Every effect of the library except ``NOT_HIDDEN``: values for a strength on a bench."""

MOST: Mapping[str, float] = {
    "actuator_delay": 3.0,
    # The plant's law has no stiffness left at 2.3 preloads and jumps there: the heaviest table in
    # the hardest run, 920 N, stays below.
    "axial_stiffness_nonlinear": 2.1,
    "axial_stiffness_position": 6.0,
    "base_mode": 5.0,
    "chain_damping": 8.0,
    "coupling_windup": 8.0,
    "current_bandwidth": 5.0,
    "friction_asymmetry": 2.6,
    "friction_warmup": 2.2,
    "nut_efficiency": 4.0,
    "payload": 6.0,
    "post_reversal_dip": 2.5,
    "preload_loss": 4.0,
    "torque_ripple": 6.0,
    "torque_saturation": 4.0,
}
"""Strength beyond which an effect is no longer physical, or the loop no longer stable."""


def truth_of(name: str, values: Values, *, damping_time_us: float = 0.0) -> dict[str, float]:
    """Hidden values under the names and meanings of the diagnosis' parameters.

    The plant takes totals where a library effect adds to the bench: the damping of the chain, and
    the coupling as a stiffness in series rather than an added compliance.
    """
    truth = {key: float(value) for key, value in values.items() if key not in {"place", "elements"}}
    if name == "coupling_windup":
        return {"compliance_rad_per_Nm": 1.0 / truth["stiffness_Nm_per_rad"]}
    if name == "chain_damping":
        return {"time_us": truth["time_us"] - damping_time_us}
    return truth
