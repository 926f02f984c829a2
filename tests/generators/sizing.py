"""How large a hidden effect is against the noise once the base has been refitted; measured.

The plant is run without and with the effect and sensors of 32 times the resolution. Of the
difference at the table, what small changes of the plant's own friction, inertias and stiffnesses
within the tolerances of the bench can imitate is taken away: that is what a refit of the base
absorbs. The rest, rms over the judging runs, is compared with what quantisation, scale jitter and
random force do there. Nothing of the fitted model is used.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear
from scipy.signal import lfilter

from pmac_comp.files.bench import Bench
from pmac_comp.simulator.plant import kernel_ballscrew as k
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.plant.ballscrew import BallscrewPlant
from pmac_comp.simulator.servo.closed_loop import run_closed_loop
from tests.generators.effects import EFFECTS, MOST, Values
from tests.generators.motions import Command

Signal = NDArray[np.float64]
_DECIMATION = 8
_FRICTION_FREE = 0.9  # friction is not known: the refit may change it by this share
_STEP = 0.02
_ROUNDS = 8

# What a refit of the base may change: kernel parameters that move together, and the tolerance.
_OWN: Sequence[tuple[tuple[int, ...], str | None]] = (
    ((k.P_J_MOTOR, k.P_J_COUPLING), "motor_inertia_kgm2"),
    ((k.P_J_SCREW,), "screw_inertia_kgm2"),
    ((k.P_M_TABLE,), "table_mass_kg"),
    ((k.P_K_COUPLING,), "torsional_stiffness_Nm_per_rad"),
    ((k.P_K_BEARING, k.P_K_NUT), "axial_stiffness_N_per_um"),
    ((k.P_EA,), "screw_rigidity_N"),
    ((k.P_BANDWIDTH,), "current_bandwidth_Hz"),
    ((k.P_DELAY,), "actuator_delay_us"),
    ((k.P_NUT_LOAD,), "efficiency"),
    ((k.P_MOTOR_LEVEL,), None),
    ((k.P_NUT_LEVEL,), None),
    ((k.P_GUIDE_LEVEL,), None),
    ((k.P_MOTOR_VISCOUS,), None),
    ((k.P_NUT_VISCOUS,), None),
    ((k.P_GUIDE_VISCOUS,), None),
)


@dataclass(frozen=True)
class Surroundings:
    """What is random in a case besides the effect."""

    seed: int
    spread: float = 1.0
    jitter_um: float = 0.0
    force_N: float = 0.0


def drive(bench: Bench, around: Surroundings, effects: dict[str, Values]) -> BallscrewPlant:
    """The drawn plant with effects."""
    return make_plant(bench, effects=effects, seed=around.seed, spread=around.spread)


def random_force(around: Surroundings, run: int, n: int, period_s: float) -> Signal | None:
    """Force on the table that no model knows, below some 30 Hz."""
    if around.force_N == 0.0:
        return None
    white = np.random.default_rng([around.seed, 5, run]).standard_normal(n)
    pole = np.exp(-2.0 * np.pi * 30.0 * period_s)
    slow = lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], white)
    return np.asarray(around.force_N * slow)


def fine_scale(bench: Bench) -> Bench:
    """The bench with a scale of 0.1 nm: what its scale sees before the steps."""
    if bench.scale is None:
        raise ValueError("the generator needs a bench with a scale")
    scale = bench.scale.model_copy(update={"resolution_um": 1e-4})
    return bench.model_copy(update={"scale": scale})


def jittered(around: Surroundings, run: int, seen_m: Signal, step_m: float) -> Signal:
    """Scale reading with jitter before its quantisation."""
    noise = np.random.default_rng([around.seed, 6, run]).standard_normal(seen_m.size)
    return np.asarray(np.round((seen_m + 1e-6 * around.jitter_um * noise) / step_m) * step_m)


class Sizing:
    """Effect over noise for one drawn bench and its commands.

    Parameters
    ----------
    bench : Bench
        The bench file.
    around : Surroundings
        Seed of the drawn plant and its noise.
    fit, judge : sequence of ndarray
        Commands for fitting (where the refit happens) and judging (where the ratio is taken).
    """

    def __init__(
        self,
        bench: Bench,
        around: Surroundings,
        fit: Sequence[Command],
        judge: Sequence[Command],
    ) -> None:
        self._fine = fine_scale(bench)
        self._sharp = self._fine.model_copy(
            update={"encoder": bench.encoder.model_copy(update={"extension": "1/T"})}
        )
        self._bench, self._around = bench, around
        self._commands = [*fit, *judge]
        self._n_fit = len(fit)
        self._clean = self._tables(drive(bench, around, {}))
        self.noise_um = self._noise_um()
        self._columns = self._sensitivities()

    def ratio(self, effects: dict[str, Values]) -> float:
        """Rms at the judging tables that no refit of the base absorbs, over the noise.

        Infinite where the loop is not stable with the effects.
        """
        moved = self._tables(drive(self._bench, self._around, effects))
        if not all(np.isfinite(m).all() for m in moved):
            return float("inf")
        return self._left_um([m - c for m, c in zip(moved, self._clean, strict=True)])

    def _left_um(self, change: Sequence[Signal]) -> float:
        n = self._n_fit
        columns, widths = self._columns
        matrix = np.concatenate([np.stack([c[i] for c in columns], axis=1) for i in range(n)])
        bounds = (-np.array(widths), np.array(widths))
        moves = lsq_linear(matrix, np.concatenate([_level(d) for d in change[:n]]), bounds).x
        left = [
            _level(d) - np.stack([c[i] for c in columns], axis=1) @ moves
            for i, d in enumerate(change)
            if i >= n
        ]
        return float(np.sqrt(np.mean(np.concatenate(left) ** 2)) * 1e6) / self.noise_um

    def _tables(self, plant: BallscrewPlant) -> list[Signal]:
        return [
            run_closed_loop(self._sharp, plant, command)["table_position_m"]
            for command in self._commands
        ]

    def _noise_um(self) -> float:
        plant = drive(self._bench, self._around, {})
        step = self._bench.scale_resolution_m or 1e-9
        errors = []
        for i in range(self._n_fit, len(self._commands)):
            command = self._commands[i]
            push = random_force(self._around, i, command.size, self._bench.servo_period_s)
            run = run_closed_loop(self._fine, plant, command, external_force_N=push)
            seen = jittered(self._around, i, run["table_position_m"], step)
            errors.append(_level(seen - self._clean[i], decimation=1))
        return float(1e6 * np.sqrt(np.mean(np.concatenate(errors) ** 2)))

    def _sensitivities(self) -> tuple[list[list[Signal]], list[float]]:
        """Change of the tables per relative change of each own parameter, and how far it may go."""
        columns, widths = [], []
        for indices, key in _OWN:
            plant = drive(self._bench, self._around, {})
            # The torque lost in the nut goes with one less the efficiency.
            lever = 1.0 / (1.0 - plant.truth.efficiency) if key == "efficiency" else 1.0
            for index in indices:
                plant.par[index] *= 1.0 + lever * _STEP
            moved = self._tables(plant)
            columns.append(
                [_level((m - c) / _STEP) for m, c in zip(moved, self._clean, strict=True)]
            )
            widths.append(_FRICTION_FREE if key is None else getattr(self._bench.tolerance, key))
        return columns, widths


def _level(values: Signal, *, decimation: int = _DECIMATION) -> Signal:
    """Every so many samples, less the capture's mean: a constant offset is no disagreement."""
    thin = values[::decimation]
    return np.asarray(thin - thin.mean())


def sized(
    sizing: Sizing, name: str, seed: int, bench: Bench, target: float
) -> tuple[Values, float]:
    """Values of an effect that make it ``target`` times the noise, and the ratio reached.

    Some effects cannot be that large within what physics allows; the ratio says how far it went.
    """
    strength, low, high = 1.0, 0.0, 1.02 * MOST.get(name, 60.0)
    best: tuple[Values, float] | None = None
    for _ in range(_ROUNDS):
        values = EFFECTS[name](np.random.default_rng([seed, 3]), strength, bench)
        ratio = sizing.ratio({name: values})
        if np.isfinite(ratio) and (best is None or _miss(ratio, target) < _miss(best[1], target)):
            best = values, ratio
        if _miss(ratio, target) < 0.1:
            break
        low, high = (strength, high) if ratio < target else (low, strength)
        aimed = strength * float(np.clip(target / max(ratio, 1e-9), 0.3, 3.0))
        strength = aimed if low < aimed < high else _between(low, high)
    if best is None:
        raise ValueError(f"{name}: no size of it leaves the loop stable on this bench")
    return best


def _miss(ratio: float, target: float) -> float:
    return float(abs(np.log(max(ratio, 1e-9) / target)))


def _between(low: float, high: float) -> float:
    return float(np.sqrt(low * high)) if low > 0.0 else 0.3 * high
