"""Output-error refinement: the parameters with which the simulated closed loop meets the captures.

Gauss-Newton with bounds on whitened residuals; known parameters carry the bench file as a prior,
scale offsets and the static lead map are projected out. What may not live here: verdicts and words.
Imports ``physics.model``, ``base`` and this package.
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.errors import DidNotConverge, NonFinite
from pmac_comp.files.bench import Bench
from pmac_comp.physics.identify.records import Record, nuisance_prior, simulated, thinned
from pmac_comp.physics.identify.whitening import Whitener, fit_whitener, white
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.parameters import ParameterSpec

Progress = Callable[[str, float], None]
Stages = Literal["all", "rough", "fine"]

# A tolerance is the half-width that a maker states: as a normal prior, two standard deviations.
TOLERANCE_IN_STD = 2.0
# Bearing and nut share their friction in a way that most runs cannot see: the split is held by a
# wide prior around the typical figure, so that the sum stays free.
_FREE_PRIOR_SCALES = 2.0
_STEP_FRAC = 2e-3
BLOCK_s = 0.4
_WHITE_ROUNDS = 3
_COLOURED_ROUNDS = 12
_DONE_STEP, _ROUGHLY_DONE_STEP = 0.3, 1.0  # of a standard deviation
# Steps that stay this near, in standard deviations or in scaled parameters, change the derivatives
# too little to take them anew; a fit ends with derivatives of its last place.
_SAME_SLOPES = 1.0
_SAME_SLOPES_FRAC = 0.1
# Derivatives of a place this near, in scaled parameters, err by as much of a standard deviation
# in where a fit ends: they count as its own.
_OWN_SLOPES_FRAC = 0.05
# Substeps of the model over those with which derivatives are taken; also in a fit that is only
# compared with others. Half of them miss a derivative by less than 1 % (the delay's by 2), a
# quarter by 2 % (the damping's of bristles by 8): steps go astray by that, where they end does not.
_SLOPES_COARSER, _COMPARED_COARSER = 2, 4
_STALLED = 0.7  # of the step before, with old derivatives
# The last rounds compare with rounded simulations and scatter by about one standard deviation.
_LARGEST_LAST_STEP = 3.0
_DAMPING_TRIES = 6
# Rounding inside the loop dithers friction and shifts what the loop does on average; the last
# rounds compare with the mean of rounding simulations at several places of the count.
_DITHERS = 4
# A block that decides a direction alone says nothing about its own scatter: beyond this share of
# the information its score is not enlarged further.
_MAX_LEVERAGE = 0.7
_BASE = ("chain", "coulomb", "viscous")
# Each of these rounds sees other chances of rounding: full steps first, then ever smaller shares,
# so that the last points are averages instead of the last throw.
_QUANTISED_GAINS = (1.0, 1.0, 0.5, 0.33, 0.25, 0.2)
_ALL_ROUNDS = _WHITE_ROUNDS + _COLOURED_ROUNDS + len(_QUANTISED_GAINS)
_QUANTISED_DONE = 1.0  # of a standard deviation, after the second round
# The mean of four roundings leaves a quarter of their scatter: so much more misfit is normal.
_CHAOS = 1.5
_ROUGH = 1.1


@dataclass(frozen=True)
class Fit:
    """Result of the refinement in SI.

    Parameters
    ----------
    model : DriveModel
        Model at the estimate.
    names : tuple of str
        Estimated parameters.
    covariance : ndarray, shape (p, p)
        Sandwich covariance, prior included.
    information : ndarray, shape (p, p)
        Information of the captures alone, in units of the prior (scaled parameters).
    scales : ndarray, shape (p,)
        Scale of each parameter.
    nuisance : ndarray, shape (q,)
        Scale offsets and map coefficients.
    freedom : int
        Blocks of time less parameters: degrees of freedom of the covariance.
    rounds : int
        Steps that were tried.
    step : float
        Last step in standard deviations.
    """

    model: DriveModel
    names: tuple[str, ...]
    covariance: FloatArray
    information: FloatArray
    prior: FloatArray
    scales: FloatArray
    nuisance: FloatArray
    freedom: int
    rounds: int
    step: float


@dataclass(frozen=True)
class _Problem:
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
        values = self.values_at(theta)
        return self.model.with_parameters(
            {spec.name: float(value) for spec, value in zip(self.specs, values, strict=True)}
        )

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        low = self.theta_of([spec.lower for spec in self.specs])
        return low, self.theta_of([spec.upper for spec in self.specs])

    def bounded(self, theta: FloatArray) -> FloatArray:
        return np.clip(theta, *self.bounds)

    def residuals(self, theta: FloatArray) -> list[FloatArray]:
        """Measured minus simulated channels per record; kept until another place is asked for."""
        place = theta.tobytes()
        if place not in self.latest:
            found = self.many([theta], self.model.substeps)[0]
            self.latest.clear()
            self.latest[place] = found
        return self.latest[place]

    def quantised_residuals(self, theta: FloatArray) -> list[FloatArray]:
        """Measured minus the mean of simulations that round as the sensors do, shape (n, c)."""
        model = self.model_at(theta)
        shifts = (np.arange(_DITHERS) + 0.5) / _DITHERS - 0.5
        jobs = [(r, model, float(s) * self.count_m) for s in shifts for r in self.records]
        done = list(self.executor.map(_quantised_triple, jobs))
        k = len(self.records)
        return [r.measured - np.stack(done[i::k]).mean(axis=0) for i, r in enumerate(self.records)]

    def many(self, thetas: Sequence[FloatArray], substeps: int) -> list[list[FloatArray]]:
        models = [self.model_at(theta) for theta in thetas]
        jobs = [(record, model, substeps) for model in models for record in self.records]
        done = list(self.executor.map(_simulated_triple, jobs))
        k = len(self.records)
        return [
            [r.measured - y for r, y in zip(self.records, done[i * k :], strict=False)]
            for i in range(len(models))
        ]


@dataclass(frozen=True)
class _Point:
    """Where the refinement is: scaled parameters, last step in standard deviations, derivatives."""

    theta: FloatArray
    step: float
    slopes: list[list[FloatArray]] | None
    rounds: int
    slopes_at: FloatArray | None = None


@dataclass(frozen=True)
class _Normal:
    """Whitened normal equations with the nuisances projected out."""

    hessian: FloatArray
    gradient: FloatArray
    cost: float
    scores: FloatArray
    block_hessians: FloatArray
    prior_scores: FloatArray
    nuisance: FloatArray
    steady: tuple[FloatArray, FloatArray] | None = None  # Hessian and gradient of steady rows alone


def refine(
    records: Sequence[Record],
    nuisance: Sequence[FloatArray],
    model: DriveModel,
    bench: Bench,
    *,
    names: Iterable[str] | None = None,
    weights: Literal["coloured", "white"] = "coloured",
    rounding: bool = True,
    stages: Stages = "all",
    steady: Sequence[BoolArray] | None = None,
    progress: Progress | None = None,
    executor: Executor | None = None,
) -> Fit:
    """Parameters that minimise the whitened output error plus the prior.

    Parameters
    ----------
    records, nuisance : sequences
        Prepared captures and their nuisance columns at the full rate.
    model : DriveModel
        Start; its effects stay.
    bench : Bench
        Resolutions of the sensors.
    names : iterable of str or None
        Parameters to estimate; None means all but orders of harmonics.
    weights : "coloured" or "white"
        Whether residuals are whitened by an autoregressive model. What a rigid model leaves of a
        real drive is mostly its own error, not sensor noise: ``white`` then keeps the simulated
        position near the measured one at all frequencies alike.
    rounding : bool
        Whether the last rounds account for what the encoder's rounding does on average.
    stages : "all", "rough" or "fine"
        ``rough`` ends with a few rounds of white weights, for a start of another fit; ``fine``
        leaves them out: from a start that is near already, they lead away and back.
    steady : sequence of ndarray of bool, or None
        Rows of each record that friction in detail does not touch. Where these alone would put the
        base parameters elsewhere, the intervals are widened by the distance.
    progress : callable or None
        Called with a text and the fraction done.
    executor : Executor or None
        Where simulations run; None uses threads on all cores.

    Raises
    ------
    DidNotConverge
        No step reduces the misfit from the start.
    NonFinite
        The model is unstable at the start.
    """
    coarse = _SLOPES_COARSER if rounding else _COMPARED_COARSER
    if executor is not None:
        problem = _problem(records, nuisance, model, bench, names, executor, steady, coarse)
        return _refine(problem, weights, progress, rounding=rounding, stages=stages)
    with ThreadPoolExecutor(max_workers=os.cpu_count() or 2) as own:
        problem = _problem(records, nuisance, model, bench, names, own, steady, coarse)
        return _refine(problem, weights, progress, rounding=rounding, stages=stages)


def _quantised_triple(job: tuple[Record, DriveModel, float]) -> FloatArray:
    record, model, shift_m = job
    return simulated(record, model, shift_m=shift_m, quantise=True)


def _simulated_triple(job: tuple[Record, DriveModel, int]) -> FloatArray:
    record, model, substeps = job
    return simulated(record, model, substeps=substeps)


def _problem(
    records: Sequence[Record],
    nuisance: Sequence[FloatArray],
    model: DriveModel,
    bench: Bench,
    names: Iterable[str] | None,
    executor: Executor,
    steady: Sequence[BoolArray] | None,
    coarse: int,
) -> _Problem:
    wanted = None if names is None else set(names)
    specs = tuple(
        spec
        for spec in model.specs
        if not spec.discrete and (wanted is None or spec.name in wanted)
    )
    scales = np.array([abs(spec.scale) for spec in specs])
    centre = np.array([spec.nominal for spec in specs]) / scales
    weight = np.array([_prior_information(spec) for spec in specs]) * scales**2
    step_m = bench.scale_resolution_m or bench.motor_resolution_m
    floors = {
        "torque": bench.drive.torque_per_dac_Nm / np.sqrt(12.0),
        "motor": bench.motor_resolution_m / np.sqrt(12.0),
        "difference": np.hypot(step_m, bench.motor_resolution_m) / np.sqrt(12.0),
    }
    return _Problem(
        records,
        [thinned(columns, r.factor) for r, columns in zip(records, nuisance, strict=True)],
        model,
        specs,
        scales,
        centre,
        weight,
        floors,
        bench.motor_resolution_m,
        executor,
        steady,
        model.coarser_substeps(coarse),
    )


def _prior_information(spec: ParameterSpec) -> float:
    if spec.kind == "known" and spec.tolerance_frac is not None:
        width = max(spec.tolerance_frac, 1e-6) * abs(spec.nominal or spec.scale)
        return float((TOLERANCE_IN_STD / width) ** 2)
    if spec.period > 0.0:
        return 0.0
    return float((_FREE_PRIOR_SCALES * abs(spec.scale)) ** -2)


def _refine(
    problem: _Problem, weights: str, progress: Progress | None, *, rounding: bool, stages: Stages
) -> Fit:
    tell = progress or (lambda _text, _fraction: None)
    theta = problem.bounded(
        problem.theta_of([problem.model.parameters[spec.name] for spec in problem.specs])
    )
    filters = _white_filters(problem, problem.residuals(theta))
    at = _Point(theta, np.inf, None, 0)
    reweigh = _coloured_filters if weights == "coloured" else _white_filters
    if stages != "fine":
        at = _stepped(problem, at, filters, _WHITE_ROUNDS, _ROUGHLY_DONE_STEP, tell, exact=False)
    if stages != "rough":
        filters = reweigh(problem, _left_at(problem, at.theta, filters))
        # A fit that is only compared with others need not settle to the last digit.
        done = _DONE_STEP if rounding else _ROUGHLY_DONE_STEP
        at = _stepped(problem, at, filters, _COLOURED_ROUNDS, done, tell, exact=True)
    theta = at.theta
    filters = reweigh(problem, _left_at(problem, theta, filters))
    last, rounds, step = None, at.rounds, at.step
    if weights == "coloured" and rounding:
        tell("accounting for what the encoder rounds", rounds / _ALL_ROUNDS)
        theta, last, more, step = _with_rounding(problem, at, filters)
        rounds += more
    tell("refined", 1.0)
    if last is None:
        slopes = at.slopes if stages == "rough" else None
        slopes = _slopes_near(problem, at) if slopes is None else slopes
        last = _normal(problem, filters, problem.residuals(theta), slopes)
    return _finished(problem, theta, last, rounds, step)


def _left_at(
    problem: _Problem, theta: FloatArray, filters: list[list[Whitener]]
) -> list[FloatArray]:
    """Residuals less the nuisances."""
    residuals = problem.residuals(theta)
    return _without(problem, residuals, _linear_part(problem, residuals, filters))


def _stepped(
    problem: _Problem,
    at: _Point,
    filters: list[list[Whitener]],
    limit: int,
    done: float,
    tell: Progress,
    *,
    exact: bool,
) -> _Point:
    """Steps until one is shorter than ``done``; ``exact``: taken with derivatives of that place."""
    theta, step, slopes, rounds = at.theta, at.step, at.slopes, at.rounds
    place = theta if at.slopes_at is None else at.slopes_at
    old, before = True, np.inf
    for _ in range(limit):
        tell(f"refining friction and stiffness, round {rounds + 1}", rounds / _ALL_ROUNDS)
        # Settled with old derivatives: once more with new ones.
        moved = float(np.abs(theta - place).max())
        far = step > _SAME_SLOPES and moved > _SAME_SLOPES_FRAC
        stalled = old and step > _STALLED * before
        before = step
        astray = exact and old and step < done and moved > _OWN_SLOPES_FRAC
        fresh = slopes is None or far or stalled or astray
        if fresh:
            residuals, slopes = _jacobian(problem, theta)
            place = theta
        else:
            residuals = problem.residuals(theta)
        old = not fresh
        normal = _normal(problem, filters, residuals, slopes or [])
        theta, step = _damped_step(problem, theta, normal, filters)
        rounds += 1
        own = fresh or float(np.abs(theta - place).max()) <= _OWN_SLOPES_FRAC
        if step < done and (own or not exact):
            break
    return _Point(theta, step, slopes, rounds, place)


def _slopes_near(problem: _Problem, at: _Point) -> list[list[FloatArray]]:
    """Derivatives that hold at a point: those of the last step where that was short."""
    if at.slopes is None or at.slopes_at is None:
        return _jacobian(problem, at.theta)[1]
    far = float(np.abs(at.theta - at.slopes_at).max()) > _SAME_SLOPES_FRAC
    return _jacobian(problem, at.theta)[1] if far and at.step > _SAME_SLOPES else at.slopes


def _with_rounding(
    problem: _Problem, at_start: _Point, filters: list[list[Whitener]]
) -> tuple[FloatArray, _Normal | None, int, float]:
    """Point, normal equations, rounds and last step with what rounding does on average.

    Rounding in the loop can be chaos (a motor that hunts between two counts): where the rounding
    simulations fit clearly worse than the smooth one, or a step makes them so, they are not
    followed; without normal equations the smooth ones hold.
    """
    theta, step = at_start.theta, at_start.step
    smooth = _cost(problem, theta, filters) - _prior_cost(problem, theta)
    best = None
    tried = theta
    slopes = _slopes_near(problem, at_start)  # hardly change over the few deviations moved here
    for i, gain in enumerate(_QUANTISED_GAINS):
        at = _normal(problem, filters, problem.quantised_residuals(tried), slopes)
        if best is None and at.cost > _CHAOS * smooth:
            return theta, None, i + 1, step
        if best is not None and at.cost > _ROUGH * best.cost:
            tried = 0.5 * (theta + tried)
            continue
        theta, best = tried, at
        goal, _ = _plain_step(problem, theta, at)
        std = np.sqrt(np.diag(_covariance(problem, theta, at)))
        step = float(np.sqrt(np.mean(((goal - theta) / std) ** 2)))
        tried = theta + gain * (goal - theta)
        if i > 0 and step < _QUANTISED_DONE:
            return tried, at, i + 1, step
    return theta, best, len(_QUANTISED_GAINS), step


def _covariance(problem: _Problem, theta: FloatArray, final: _Normal) -> FloatArray:
    """Sandwich covariance of the scaled parameters, prior included, shape (p, p)."""
    prior = np.diag(problem.weight)
    inverse = np.asarray(np.linalg.inv(final.hessian + prior), dtype=np.float64)
    scores = _jackknifed(final, inverse)
    meat = scores.T @ scores + final.prior_scores
    covariance = inverse @ (meat + prior) @ inverse
    if final.steady is not None:
        shift = _shift_on_steady_rows(problem, theta, *final.steady)
        covariance = covariance + np.outer(shift, shift)
    return np.asarray(covariance)


def _finished(
    problem: _Problem, theta: FloatArray, final: _Normal, rounds: int, step: float
) -> Fit:
    covariance = _covariance(problem, theta, final)
    scales = problem.slopes_at(theta)
    outer = np.outer(scales, scales)
    return Fit(
        model=problem.model_at(theta),
        names=tuple(spec.name for spec in problem.specs),
        covariance=covariance * outer,
        information=final.hessian,
        prior=problem.weight,
        scales=scales,
        nuisance=final.nuisance,
        freedom=max(final.scores.shape[0] - theta.size, 1),
        rounds=rounds,
        step=step,
    )


def _shift_on_steady_rows(
    problem: _Problem, theta: FloatArray, hessian: FloatArray, gradient: FloatArray
) -> FloatArray:
    """Where the base parameters would go on the steady rows alone, less where they are, shape (p,).

    A model that is wrong about the moments after a reversal is pulled by them, and blocks of time
    that all pull the same way do not show it as scatter (a specification test of Hausman's kind).
    """
    base = np.array([spec.name.partition(".")[0] in _BASE for spec in problem.specs])
    gradient = gradient - problem.weight * (theta - problem.centre)
    matrix = hessian + np.diag(problem.weight)
    shift = np.zeros(theta.size)
    shift[base] = np.linalg.solve(matrix[np.ix_(base, base)], gradient[base])
    return shift


def _jackknifed(final: _Normal, inverse: FloatArray) -> FloatArray:
    """Block scores enlarged by what each block pulls the estimate to itself, shape (b, p).

    Source: cluster-robust covariance CR3 (Bell and McCaffrey 2002), the jackknife over blocks.
    """
    root = np.linalg.cholesky(inverse)
    enlarged = []
    for hessian, score in zip(final.block_hessians, final.scores, strict=True):
        share, turn = np.linalg.eigh(root.T @ hessian @ root)
        factor = 1.0 / (1.0 - np.clip(share, 0.0, _MAX_LEVERAGE))
        weights = solve_triangular(root, turn * factor, lower=True, trans="T")
        enlarged.append(weights @ (turn.T @ (root.T @ score)))
    return np.stack(enlarged)


def _white_filters(problem: _Problem, residuals: list[FloatArray]) -> list[list[Whitener]]:
    return [
        [
            white(max(_robust_std(residual[record.valid, c]), problem.floors[name]))
            for c, name in enumerate(record.channels)
        ]
        for record, residual in zip(problem.records, residuals, strict=True)
    ]


def _coloured_filters(problem: _Problem, residuals: list[FloatArray]) -> list[list[Whitener]]:
    return [
        [
            fit_whitener(residual[:, c], record.valid, problem.floors[name])
            for c, name in enumerate(record.channels)
        ]
        for record, residual in zip(problem.records, residuals, strict=True)
    ]


def _robust_std(values: FloatArray) -> float:
    if values.size == 0:
        return 0.0
    centred = values - np.median(values)
    return float(np.sqrt(np.mean(np.clip(centred, *np.quantile(centred, [0.02, 0.98])) ** 2)))


def _jacobian(
    problem: _Problem, theta: FloatArray
) -> tuple[list[FloatArray], list[list[FloatArray]]]:
    """Residuals at theta and their one-sided differences, per parameter and record.

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


def _normal(
    problem: _Problem,
    filters: list[list[Whitener]],
    residuals: Sequence[FloatArray],
    slopes: Sequence[Sequence[FloatArray]],
) -> _Normal:
    parts = []
    for i, record in enumerate(problem.records):
        columns = [-slope[i] for slope in slopes]
        for c, whitener in enumerate(filters[i]):
            nuisance = _nuisance_of(problem, i, record, c)
            stack = np.column_stack(
                [residuals[i][:, c], *[column[:, c] for column in columns], nuisance]
            )
            rows = whitener.rows(record.valid)
            parts.append((i, c, np.where(rows[:, None], whitener.apply(stack), 0.0)))
    whole = _assembled(problem, parts, len(slopes))
    if problem.steady is None:
        return whole
    kept = [(i, c, part * filters[i][c].rows(problem.steady[i])[:, None]) for i, c, part in parts]
    some = _assembled(problem, kept, len(slopes))
    return replace(whole, steady=(some.hessian, some.gradient))


def _nuisance_of(problem: _Problem, i: int, record: Record, c: int) -> FloatArray:
    columns = problem.nuisance[i]
    return columns if record.channels[c] == "difference" else np.zeros_like(columns)


def _assembled(problem: _Problem, parts: list[tuple[int, int, FloatArray]], p: int) -> _Normal:
    gram = _gram([part for _, _, part in parts])
    inner = slice(1, 1 + p)
    rest = slice(1 + p, None)
    known = problem.nuisance_information
    solve = np.linalg.pinv(gram[rest, rest] + np.diag(known), hermitian=True)
    on_slopes = solve @ gram[rest, inner]
    on_residual = solve @ gram[rest, 0]
    hessian = gram[inner, inner] - gram[inner, rest] @ on_slopes
    gradient = gram[inner, 0] - gram[inner, rest] @ on_residual
    cost = float(gram[0, 0] - gram[0, rest] @ on_residual)
    scores, hessians = _block_scores(problem, parts, on_slopes, on_residual, p)
    return _Normal(
        hessian=hessian,
        gradient=gradient,
        cost=cost,
        scores=scores,
        block_hessians=hessians,
        prior_scores=on_slopes.T @ (known[:, None] * on_slopes),
        nuisance=np.asarray(on_residual),
    )


def _gram(parts: Sequence[FloatArray]) -> FloatArray:
    total = np.zeros((parts[0].shape[1], parts[0].shape[1]))
    for part in parts:
        total += part.T @ part
    return total


def _block_scores(
    problem: _Problem,
    parts: list[tuple[int, int, FloatArray]],
    on_slopes: FloatArray,
    on_residual: FloatArray,
    p: int,
) -> tuple[FloatArray, FloatArray]:
    """Score and Gauss-Newton matrix of each block of time, all channels of a block together."""
    scores: dict[tuple[int, int], FloatArray] = {}
    hessians: dict[tuple[int, int], FloatArray] = {}
    for i, _, part in parts:
        slopes = part[:, 1 : 1 + p] - part[:, 1 + p :] @ on_slopes
        left = part[:, 0] - part[:, 1 + p :] @ on_residual
        block = max(round(BLOCK_s / problem.records[i].period_s), 1)
        for b, start in enumerate(range(0, left.size, block)):
            rows = slice(start, start + block)
            scores[i, b] = scores.get((i, b), 0.0) + slopes[rows].T @ left[rows]
            hessians[i, b] = hessians.get((i, b), 0.0) + slopes[rows].T @ slopes[rows]
    return np.stack(list(scores.values())), np.stack(list(hessians.values()))


def _damped_step(
    problem: _Problem, theta: FloatArray, at: _Normal, filters: list[list[Whitener]]
) -> tuple[FloatArray, float]:
    """Next point and the length of the step in standard deviations."""
    prior = np.diag(problem.weight)
    gradient = at.gradient - problem.weight * (theta - problem.centre)
    here = at.cost + _prior_cost(problem, theta)
    matrix = at.hessian + prior
    damping = 0.0
    for _ in range(_DAMPING_TRIES):
        damped = matrix + damping * np.diag(np.diag(matrix))
        new = problem.bounded(theta + _bounded_step(problem, theta, damped, gradient))
        cost = _cost(problem, new, filters)
        if cost <= here * (1.0 + 1e-9):
            move = new - theta
            return new, float(np.sqrt(max(float(move @ matrix @ move), 0.0) / theta.size))
        damping = 10.0 * damping if damping > 0.0 else 1e-2
    return theta, 0.0


def _plain_step(problem: _Problem, theta: FloatArray, at: _Normal) -> tuple[FloatArray, float]:
    """Undamped step: the misfit to rounded simulations is too rough for a line search."""
    matrix = at.hessian + np.diag(problem.weight)
    gradient = at.gradient - problem.weight * (theta - problem.centre)
    new = problem.bounded(theta + _bounded_step(problem, theta, matrix, gradient))
    move = new - theta
    return new, float(np.sqrt(max(float(move @ matrix @ move), 0.0) / theta.size))


def _bounded_step(
    problem: _Problem, theta: FloatArray, matrix: FloatArray, gradient: FloatArray
) -> FloatArray:
    """Gauss-Newton step within the bounds: clipping a free step would break tied sums."""
    low, high = problem.bounds
    lower = np.linalg.cholesky(matrix)
    target = solve_triangular(lower, gradient, lower=True)
    margin = 1e-12
    found = lsq_linear(
        lower.T, target, bounds=(low - theta - margin, high - theta + margin), method="bvls"
    )
    return np.asarray(found.x)


def _prior_cost(problem: _Problem, theta: FloatArray) -> float:
    return float(problem.weight @ (theta - problem.centre) ** 2)


def _cost(problem: _Problem, theta: FloatArray, filters: list[list[Whitener]]) -> float:
    try:
        residuals = problem.residuals(theta)
    except NonFinite:
        return np.inf
    parts = _whitened_residuals(problem, residuals, filters)
    gram = _gram(parts)
    rest = _nuisance_solution(problem, gram)
    return float(gram[0, 0] - gram[0, 1:] @ rest) + _prior_cost(problem, theta)


def _linear_part(
    problem: _Problem, residuals: list[FloatArray], filters: list[list[Whitener]]
) -> FloatArray:
    parts = _whitened_residuals(problem, residuals, filters)
    gram = _gram(parts)
    return _nuisance_solution(problem, gram)


def _nuisance_solution(problem: _Problem, gram: FloatArray) -> FloatArray:
    matrix = gram[1:, 1:] + np.diag(problem.nuisance_information)
    return np.asarray(np.linalg.pinv(matrix, hermitian=True) @ gram[1:, 0])


def _whitened_residuals(
    problem: _Problem, residuals: list[FloatArray], filters: list[list[Whitener]]
) -> list[FloatArray]:
    parts = []
    for i, record in enumerate(problem.records):
        for c, whitener in enumerate(filters[i]):
            nuisance = _nuisance_of(problem, i, record, c)
            stack = np.column_stack([residuals[i][:, c], nuisance])
            rows: BoolArray = whitener.rows(record.valid)
            parts.append(np.where(rows[:, None], whitener.apply(stack), 0.0))
    return parts


def _without(
    problem: _Problem, residuals: Sequence[FloatArray], eta: FloatArray
) -> list[FloatArray]:
    cleaned = []
    for i, record in enumerate(problem.records):
        left = residuals[i].copy()
        for c, name in enumerate(record.channels):
            if name == "difference":
                left[:, c] -= problem.nuisance[i] @ eta
        cleaned.append(left)
    return cleaned


def require_converged(fit: Fit) -> None:
    """Raise DidNotConverge where the last step was still large."""
    if fit.step > _LARGEST_LAST_STEP:
        raise DidNotConverge(
            f"The refinement still moved by {fit.step:.1f} standard deviations after "
            f"{fit.rounds} rounds.",
            code="PC-IDN-020",
            hint="Check the bench file (gains, travel origin, directions) against the captures; "
            "`pmac-comp diagnose` shows where simulation and measurement part.",
            context={"step": fit.step},
        )
