"""The question that a refinement asks: which parameters, of which captures, held by which prior.

What lives here: scaled parameters with bounds and prior, residuals of the simulated closed loop and
their derivatives. What may not: weights, steps. Imports ``physics.model`` and ``records``.
"""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.identify.records import Record, nuisance_prior, simulated, thinned
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.parameters import ParameterSpec

# A tolerance is the half-width that a maker states: as a normal prior, two standard deviations.
TOLERANCE_IN_STD = 2.0
# What is left over the rms of the sensors' steps: at most 1.4 on clean drives with 10 and 40
# thousand counts per turn; from 1.5 with effects that move a prediction.
BEYOND_STEPS = 2.0
# Bearing and nut share their friction in a way that most runs cannot see: the split is held by a
# wide prior around the typical figure, so that the sum stays free. What is typical of one drive is
# nothing of a much larger one: what the regressions start from counts as typical where it is more.
_FREE_PRIOR_SCALES = 2.0
_STEP_FRAC = 2e-3
# Rounding inside the loop dithers friction and shifts what the loop does on average; the last
# rounds compare with the mean of rounding simulations at several places of the count.
_DITHERS = 4


@dataclass(frozen=True)
class Problem:
    """Captures, model and prior of one refinement; parameters are scaled, places are of those."""

    records: Sequence[Record]
    nuisance: Sequence[FloatArray]
    model: DriveModel
    specs: tuple[ParameterSpec, ...]
    scales: FloatArray
    centre: FloatArray  # prior mean, scaled
    weight: FloatArray  # prior information, scaled
    floors: Mapping[str, float]
    count_m: float
    executor: Executor
    steady: Sequence[BoolArray] | None  # rows away from rest and reversals
    slope_substeps: int
    latest: dict[bytes, list[FloatArray]] = field(default_factory=dict)  # residuals, last place

    @property
    def nuisance_information(self) -> FloatArray:
        """Prior information of the nuisances, shape (q,)."""
        return nuisance_prior(len(self.records), self.nuisance[0].shape[1])

    @property
    def _roots(self) -> BoolArray:
        return np.array([spec.by_root for spec in self.specs], dtype=bool)

    def values_at(self, theta: FloatArray) -> FloatArray:
        """SI values of scaled parameters, within their bounds to the last digit, shape (p,)."""
        values = self.scales * np.where(self._roots, theta**2, theta)
        low, high = ([getattr(spec, end) for spec in self.specs] for end in ("lower", "upper"))
        return np.clip(values, low, high)

    def theta_of(self, values: Sequence[float]) -> FloatArray:
        """Scaled parameters of SI values, shape (p,)."""
        scaled = np.asarray(values) / self.scales
        return np.where(self._roots, np.sqrt(np.maximum(scaled, 0.0)), scaled)

    def slopes_at(self, theta: FloatArray) -> FloatArray:
        """SI values per scaled parameter, shape (p,)."""
        return self.scales * np.where(self._roots, 2.0 * theta, 1.0)

    def model_at(self, theta: FloatArray) -> DriveModel:
        """Model with scaled parameters, shape (p,)."""
        values = self.values_at(theta)
        return self.model.with_parameters(
            {spec.name: float(value) for spec, value in zip(self.specs, values, strict=True)}
        )

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Least and largest scaled parameters, shape (p,) each."""
        low = self.theta_of([spec.lower for spec in self.specs])
        return low, self.theta_of([spec.upper for spec in self.specs])

    def bounded(self, theta: FloatArray) -> FloatArray:
        """Scaled parameters within their bounds, shape (p,)."""
        return np.clip(theta, *self.bounds)

    def residuals(self, theta: FloatArray) -> list[FloatArray]:
        """Measured minus simulated channels, shape (m, c) per record, at ``theta``, shape (p,).

        They are kept until another place is asked for.
        """
        place = theta.tobytes()
        if place not in self.latest:
            found = self.many([theta], self.model.substeps)[0]
            self.latest.clear()
            self.latest[place] = found
        return self.latest[place]

    def quantised_residuals(self, theta: FloatArray) -> list[FloatArray]:
        """Measured minus the mean of simulations that round as the sensors do, shape (n, c)."""
        place = b"rounded" + theta.tobytes()
        if place not in self.latest:
            self.latest[place] = self._rounded(theta)
        return self.latest[place]

    def _rounded(self, theta: FloatArray) -> list[FloatArray]:
        model = self.model_at(theta)
        shifts = (np.arange(_DITHERS) + 0.5) / _DITHERS - 0.5
        jobs = [(r, model, float(s) * self.count_m) for s in shifts for r in self.records]
        done = list(self.executor.map(_quantised_triple, jobs))
        k = len(self.records)
        return [r.measured - np.stack(done[i::k]).mean(axis=0) for i, r in enumerate(self.records)]

    def mixed_residuals(self, theta: FloatArray, rounded: Sequence[BoolArray]) -> list[FloatArray]:
        """Residuals, of rounding simulations in the channels (per record, shape (c,)) marked."""
        smooth = self.residuals(theta)
        if not any(marks.any() for marks in rounded):
            return smooth
        rough = self.quantised_residuals(theta)
        return [np.where(m, b, a) for a, b, m in zip(smooth, rough, rounded, strict=True)]

    def many(self, thetas: Sequence[FloatArray], substeps: int) -> list[list[FloatArray]]:
        """Residuals, shape (m, c), per place, shape (p,), and record, all simulated at once."""
        models = [self.model_at(theta) for theta in thetas]
        jobs = [(record, model, substeps) for model in models for record in self.records]
        done = list(self.executor.map(_simulated_triple, jobs))
        k = len(self.records)
        return [
            [r.measured - y for r, y in zip(self.records, done[i * k :], strict=False)]
            for i in range(len(models))
        ]


def step_floors(bench: Bench) -> dict[str, float]:
    """Rms that the steps of the sensors make: torque in N m, motor and table minus motor in m."""
    step_m = bench.scale_resolution_m or bench.motor_resolution_m
    return {
        "torque": bench.drive.torque_per_dac_Nm / np.sqrt(12.0),
        "motor": bench.motor_resolution_m / np.sqrt(12.0),
        "difference": np.hypot(step_m, bench.motor_resolution_m) / np.sqrt(12.0),
    }


def problem_of(
    records: Sequence[Record],
    nuisance: Sequence[FloatArray],
    model: DriveModel,
    bench: Bench,
    names: Iterable[str] | None,
    executor: Executor,
    steady: Sequence[BoolArray] | None,
    coarse: int,
) -> Problem:
    """Problem of records, a start, and the parameters that may move.

    ``nuisance`` has shape (n, q) per record, ``steady`` shape (m,).
    """
    wanted = None if names is None else set(names)
    specs = tuple(
        spec
        for spec in model.specs
        if not spec.discrete and (wanted is None or spec.name in wanted)
    )
    scales = np.array([abs(spec.scale) for spec in specs])
    centre = np.array([spec.nominal for spec in specs]) / scales
    sizes = [model.parameters[spec.name] for spec in specs]
    weight = np.array(list(map(_prior_information, specs, sizes))) * scales**2
    return Problem(
        records,
        [thinned(columns, r.factor) for r, columns in zip(records, nuisance, strict=True)],
        model,
        specs,
        scales,
        centre,
        weight,
        step_floors(bench),
        bench.motor_resolution_m,
        executor,
        steady,
        model.coarser_substeps(coarse),
    )


def _prior_information(spec: ParameterSpec, start: float) -> float:
    if spec.kind == "known" and spec.tolerance_frac is not None:
        width = max(spec.tolerance_frac, 1e-6) * abs(spec.nominal or spec.scale)
        return float((TOLERANCE_IN_STD / width) ** 2)
    # Of a wave that came out as nothing, nothing but this tells the phase.
    size = spec.period if spec.period > 0.0 else max(abs(spec.scale), abs(start))
    return float((_FREE_PRIOR_SCALES * size) ** -2)


def _quantised_triple(job: tuple[Record, DriveModel, float]) -> FloatArray:
    record, model, shift_m = job
    return simulated(record, model, shift_m=shift_m, quantise=True)


def _simulated_triple(job: tuple[Record, DriveModel, int]) -> FloatArray:
    record, model, substeps = job
    return simulated(record, model, substeps=substeps)


def jacobian(
    problem: Problem, theta: FloatArray
) -> tuple[list[FloatArray], list[list[FloatArray]]]:
    """Residuals at theta and their one-sided differences per parameter, shape (m, c) per record.

    A step that misses 1 nm of the motion misses the same of both ends of a difference.
    """
    low, high = problem.bounds
    steps = np.where(theta + _STEP_FRAC <= high, _STEP_FRAC, -_STEP_FRAC)
    steps = np.where(theta + steps < low, _STEP_FRAC, steps)
    points = [theta] + [
        theta + step * unit for step, unit in zip(steps, np.eye(theta.size), strict=True)
    ]
    first, *others = problem.many(points, problem.slope_substeps)
    slopes = [
        [(moved - base) / step for moved, base in zip(other, first, strict=True)]
        for other, step in zip(others, steps, strict=True)
    ]
    return problem.residuals(theta), slopes
