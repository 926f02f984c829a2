"""Captures of a drive in which an effect is hidden, made by the simulated plant alone.

Nothing of ``pmac_comp.physics`` may be imported here: the code that makes the data shares nothing
with the model that is fitted to it. Motions are computed here a second time for the same reason.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.simulator.closed_loop import closed_loop_capture
from pmac_comp.simulator.plant import make_plant

Values = Mapping[str, float | str]
Draw = Callable[[np.random.Generator, float], Values]
TAU = 2.0 * np.pi


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _wave(key: str, size: float, orders: tuple[float, ...]) -> Draw:
    def draw(rng: np.random.Generator, strength: float) -> Values:
        return {
            key: size * strength,
            "order_per_rev": float(rng.choice(orders)),
            "phase_rad": float(rng.uniform(-np.pi, np.pi)),
        }

    return draw


def _signed(key: str, size: float, **rest: float | str) -> Draw:
    return lambda rng, strength: {key: _sign(rng) * size * strength, **rest}


def _positive(key: str, size: float, **rest: float | str) -> Draw:
    return lambda rng, strength: {key: size * strength, **rest}


def _stribeck(rng: np.random.Generator, strength: float) -> Values:
    speed = float(rng.uniform(0.003, 0.012))
    if rng.random() < 0.5:
        return {"excess_N": 40.0 * strength, "speed_m_per_s": speed}
    return {"excess_Nm": 0.06 * strength, "speed_m_per_s": speed}


def _presliding(rng: np.random.Generator, strength: float) -> Values:
    place = str(rng.choice(["guide", "nut", "motor"]))
    return {"distance_um": 25.0 * strength * float(rng.uniform(0.7, 1.4)), "place": place}


def _asymmetry(rng: np.random.Generator, strength: float) -> Values:
    fraction = float(np.clip(0.3 * strength, 0.0, 0.8)) * _sign(rng)
    return {"fraction": fraction, "place": "viscous"}


# Size at strength 1 is a moderate effect: some three to ten times the noise on this campaign.
EFFECTS: dict[str, Draw] = {
    "stribeck": _stribeck,
    "presliding": _presliding,
    "viscous_nonlinear": lambda rng, s: {"coefficient_N": 150.0 * s, "exponent": 0.5},
    "friction_asymmetry": _asymmetry,
    "friction_per_rev": _wave("amplitude_Nm", 0.06, (1.0, 2.0)),
    "post_reversal_dip": lambda rng, s: {
        "fraction": min(0.9, 0.35 * s),
        "length_mm": float(rng.uniform(0.7, 4.0)),
    },
    "friction_warmup": lambda rng, s: {
        "fraction": min(0.9, 0.4 * s),
        "time_constant_s": float(rng.uniform(2.0, 8.0)),
    },
    "cogging": _wave("amplitude_Nm", 0.06, (4.0, 10.0, 20.0)),
    "torque_ripple": _wave("amplitude_Nm", 0.5, (2.0, 5.0, 10.0)),
    "bias_force": _signed("force_N", 40.0),
    "cable_drag": lambda rng, s: {
        "stiffness_N_per_m": 250.0 * s,
        "centre_mm": float(rng.uniform(-100, 100)),
    },
    "payload": _positive("mass_kg", 25.0),
    "backlash": _positive("gap_um", 4.0),
    "nut_efficiency": _positive("loss_fraction", 0.15),
    "axial_stiffness_position": lambda rng, s: {"rigidity_factor": 1.0 / (1.0 + 0.35 * s)},
    "axial_stiffness_nonlinear": lambda rng, s: {"preload_N": 900.0 / s},
    "preload_loss": lambda rng, s: {
        "half_width_um": float(rng.uniform(0.8, 2.0)) * s,
        "stiffness_ratio": float(rng.uniform(0.2, 0.5)),
    },
    "coupling_windup": lambda rng, s: {"stiffness_Nm_per_rad": 5000.0 / s},
    "chain_damping": lambda rng, s: {"time_us": 73.0 * (1.0 + 3.0 * s)},
    "base_mode": lambda rng, s: {
        "frequency_Hz": float(rng.uniform(20.0, 60.0)),
        "mass_ratio": 0.06 * s,
    },
    "lead_linear": _signed("slope_um_per_m", 25.0),
    "lead_cyclic": _wave("amplitude_um", 1.5, (1.0, 2.0)),
    "thermal_growth": lambda rng, s: {
        "final_um_per_m": 40.0 * s,
        "time_constant_s": float(rng.uniform(3.0, 12.0)),
    },
    "encoder_eccentricity": _wave("amplitude_um", 1.5, (1.0, 2.0)),
    "scale_subdivision": lambda rng, s: {
        "amplitude_um": 0.6 * s,
        "period_um": 20.0,
        "phase_rad": float(rng.uniform(-np.pi, np.pi)),
    },
    "scale_slope": _signed("slope_um_per_m", 25.0),
    "channel_skew": _signed("time_us", 8.0),
    "actuator_delay": lambda rng, s: {"time_us": 442.0 * (1.0 + s)},
    "current_bandwidth": lambda rng, s: {"bandwidth_Hz": 300.0 / (1.0 + 1.2 * s)},
    "torque_saturation": lambda rng, s: {"limit_Nm": 5.0 / s},
    "external_force": lambda rng, s: {
        "amplitude_N": 40.0 * s,
        "frequency_Hz": float(rng.uniform(2.0, 12.0)),
        "phase_rad": float(rng.uniform(-np.pi, np.pi)),
    },
}
"""Effects with the size drawn for a strength; ``coulomb`` and ``viscous`` belong to the base."""


def smooth(x: np.ndarray) -> np.ndarray:
    """Ramp from 0 to 1 with zero slope at both ends."""
    y = np.clip(x, 0.0, 1.0)
    return y**3 * (10 - 15 * y + 6 * y * y)


def sine(bench: Bench, amplitude_m: float, frequency_Hz: float, seconds: float, centre_m: float):
    t = bench.servo_period_s * np.arange(int(seconds / bench.servo_period_s))
    envelope = smooth(t * frequency_Hz / 1.0) * smooth((seconds - t) * frequency_Hz / 1.0)
    return centre_m + amplitude_m * envelope * np.sin(TAU * frequency_Hz * t)


def tones(bench: Bench, seconds: float, centre_m: float, rng: np.random.Generator):
    t = bench.servo_period_s * np.arange(int(seconds / bench.servo_period_s))
    f = rng.uniform([0.3, 0.9, 2.0, 4.0], [0.6, 1.6, 3.5, 7.0])
    a = np.array([0.025, 0.010, 0.0025, 0.0005])
    total = sum(
        ai * np.sin(TAU * fi * t + p)
        for ai, fi, p in zip(a, f, rng.uniform(0, TAU, 4), strict=True)
    )
    return centre_m + smooth(t / 0.5) * smooth((seconds - t) / 0.5) * total


def strokes(bench: Bench, centre_m: float, half_m: float, speeds: list[float], acceleration: float):
    """Back and forth between two ends at the given speeds, trapezoidal with cosine edges."""
    ts = bench.servo_period_s
    parts, position, side = [np.full(int(0.1 / ts), centre_m - half_m)], centre_m - half_m, 1.0
    for speed in speeds:
        ramp = 1.5 * speed / acceleration
        cruise = max(0.0, 2 * half_m / speed - ramp)
        t = ts * np.arange(int((2 * ramp + cruise) / ts))
        v = speed * smooth(t / ramp) * smooth((2 * ramp + cruise - t) / ramp)
        step = np.cumsum(v) * ts
        step *= 2 * half_m / step[-1]
        parts.append(position + side * step)
        position += side * 2 * half_m
        side = -side
        parts.append(np.full(int(0.05 / ts), position))
    return np.concatenate(parts)


def campaign(bench: Bench, seed: int, *, seconds: float = 10.0) -> list[np.ndarray]:
    """Six commands that a careful user would run: three places, several speeds and shapes."""
    rng = np.random.default_rng([seed, 1])
    ends = rng.uniform(0.18, 0.24)
    commands = [
        sine(bench, 0.012, rng.uniform(2.5, 3.5), seconds, -ends),
        sine(bench, 0.012, rng.uniform(2.5, 3.5), seconds, ends),
        sine(bench, 0.045, rng.uniform(0.7, 1.1), seconds, rng.uniform(-0.05, 0.05)),
        tones(bench, seconds, rng.uniform(-0.1, 0.1), rng),
        strokes(bench, 0.0, 0.2, [0.25, 0.25, 0.4, 0.4, 0.12, 0.3], rng.uniform(2.0, 4.0)),
        strokes(
            bench,
            rng.uniform(-0.1, 0.1),
            0.006,
            [0.002, 0.003, 0.005, 0.008, 0.02, 0.02, 0.04],
            1.0,
        ),
    ]
    most = int(seconds / bench.servo_period_s)
    return [c[:most] for c in commands]


def judging_campaign(bench: Bench, seed: int, *, seconds: float = 10.0) -> list[np.ndarray]:
    """Three commands for validation, of other sizes and places."""
    rng = np.random.default_rng([seed, 2])
    commands = [
        sine(bench, 0.025, rng.uniform(1.2, 2.0), seconds, rng.uniform(-0.2, 0.2)),
        strokes(bench, 0.0, 0.15, [0.2, 0.35, 0.1, 0.3], rng.uniform(2.0, 4.0)),
        tones(bench, seconds, rng.uniform(-0.15, 0.15), rng),
    ]
    most = int(seconds / bench.servo_period_s)
    return [c[:most] for c in commands]


@dataclass(frozen=True)
class Case:
    """Captures for fitting and judging, and what was hidden in them."""

    hidden: Mapping[str, Values]
    fit: list[Capture]
    judge: list[Capture]
    seed: int


def make_case(
    bench: Bench,
    effects: list[str],
    *,
    seed: int,
    strength: float = 1.0,
    seconds: float = 10.0,
    spread: float = 1.0,
) -> Case:
    """A bench within its tolerances with the named effects hidden at a random size."""
    rng = np.random.default_rng([seed, 3])
    hidden = {name: EFFECTS[name](rng, strength) for name in effects}
    plant = make_plant(bench, effects=hidden, seed=seed, spread=spread)

    def run(command: np.ndarray) -> Capture:
        return closed_loop_capture(bench, plant, np.ascontiguousarray(command))

    return Case(
        hidden,
        [run(c) for c in campaign(bench, seed, seconds=seconds)],
        [run(c) for c in judging_campaign(bench, seed, seconds=seconds)],
        seed,
    )
