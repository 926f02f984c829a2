"""Output-error refinement: the parameters with which the simulated closed loop meets the captures.

Gauss-Newton with bounds on whitened residuals; known parameters carry the bench file as a prior,
scale offsets and the static lead map are projected out. What lives here: the rounds and steps. What
may not: simulation (``problem``), weights (``normal_equations``), verdicts and words.
"""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import lsq_linear

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.errors import DidNotConverge
from pmac_comp.files.bench import Bench
from pmac_comp.physics.identify.covariance import root_of_inverse, tempered, uncertainty_of
from pmac_comp.physics.identify.normal_equations import (
    Normal,
    channel_costs,
    coloured_filters,
    cost_at,
    linear_part,
    normal_equations,
    prior_cost,
    white_filters,
    without_nuisances,
)
from pmac_comp.physics.identify.problem import Problem, jacobian, problem_of, working
from pmac_comp.physics.identify.records import Record
from pmac_comp.physics.identify.whitening import Whitener
from pmac_comp.physics.model.drive import DriveModel

Progress = Callable[[str, float], None]
Stages = Literal["all", "outline", "rough", "fine"]

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
_LITTLE = 3e-3  # of the misfit: too little to change which fit is better
# The last rounds compare with rounded simulations and scatter by about one standard deviation.
_LARGEST_LAST_STEP = 3.0
_DAMPING_TRIES = 6
# Each of these rounds sees other chances of rounding: full steps first, then ever smaller shares,
# so that the last points are averages instead of the last throw.
_QUANTISED_GAINS = (1.0, 1.0, 0.5, 0.33, 0.25, 0.2)
_ALL_ROUNDS = _WHITE_ROUNDS + _COLOURED_ROUNDS + len(_QUANTISED_GAINS)
_QUANTISED_DONE = 1.0  # of a standard deviation, after the second round
# The mean of four roundings leaves a quarter of their scatter: more misfit than that is chaos.
_CHAOS = 1.25
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
    freedom : ndarray, shape (p,)
        Degrees of freedom of each variance.
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
    freedom: FloatArray
    rounds: int
    step: float


@dataclass(frozen=True)
class _Point:
    """Where the refinement is: scaled parameters, last step in standard deviations, derivatives."""

    theta: FloatArray
    step: float
    slopes: list[list[FloatArray]] | None
    rounds: int
    slopes_at: FloatArray | None = None


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
    stages : "all", "outline", "rough" or "fine"
        ``outline`` ends where steps are within the noise and leaves rounding out; ``rough`` ends
        with a few rounds of white weights, for a start of another fit; ``fine`` leaves those out:
        from a start that is near already, they lead away and back.
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
    rounding = rounding and stages in {"all", "fine"}
    coarse = _SLOPES_COARSER if rounding else _COMPARED_COARSER
    with working(executor) as workers:
        problem = problem_of(records, nuisance, model, bench, names, workers, steady, coarse)
        return _refine(problem, weights, progress, rounding=rounding, stages=stages)


def _refine(
    problem: Problem, weights: str, progress: Progress | None, *, rounding: bool, stages: Stages
) -> Fit:
    tell = progress or (lambda _text, _fraction: None)
    theta = problem.bounded(
        problem.theta_of([problem.model.parameters[spec.name] for spec in problem.specs])
    )
    filters = white_filters(problem, problem.residuals(theta))
    at = _Point(theta, np.inf, None, 0)
    reweigh = coloured_filters if weights == "coloured" else white_filters
    if stages != "fine":
        at = _stepped(problem, at, filters, _WHITE_ROUNDS, _ROUGHLY_DONE_STEP, tell, exact=False)
    if stages != "rough":
        filters = reweigh(problem, _left_at(problem, at.theta, filters))
        # A fit that is only compared with others need not settle to the last digit; one that is to
        # settle gets near with coarse derivatives first.
        near = replace(problem, slope_substeps=problem.model.coarser_substeps(_COMPARED_COARSER))
        at = _stepped(near, at, filters, _COLOURED_ROUNDS, _ROUGHLY_DONE_STEP, tell, exact=False)
        if rounding:
            at = replace(at, slopes=None, slopes_at=None)
            at = _stepped(problem, at, filters, _COLOURED_ROUNDS, _DONE_STEP, tell, exact=True)
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
        last = normal_equations(problem, filters, problem.residuals(theta), slopes)
    return _finished(problem, theta, last, rounds, step)


def _left_at(
    problem: Problem, theta: FloatArray, filters: list[list[Whitener]]
) -> list[FloatArray]:
    """Residuals less the nuisances."""
    residuals = problem.residuals(theta)
    return without_nuisances(problem, residuals, linear_part(problem, residuals, filters))


def _stepped(
    problem: Problem,
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
        # Derivatives serve twice at least: a second step with them costs next to nothing.
        far = old and step > _SAME_SLOPES and moved > _SAME_SLOPES_FRAC
        stalled = old and (step == 0.0 or step > _STALLED * before)
        before = step
        astray = exact and old and step < done and moved > _OWN_SLOPES_FRAC
        fresh = slopes is None or far or stalled or astray
        if fresh:
            residuals, slopes = jacobian(problem, theta)
            place = theta
        else:
            residuals = problem.residuals(theta)
        old = not fresh
        normal = normal_equations(problem, filters, residuals, slopes or [], scatter=False)
        theta, step, gain = _damped_step(problem, theta, normal, filters)
        rounds += 1
        own = fresh or float(np.abs(theta - place).max()) <= _OWN_SLOPES_FRAC
        settled = step < done and (fresh or step > 0.0)
        if (settled and (own or not exact)) or (gain < _LITTLE and not exact):
            break
    return _Point(theta, step, slopes, rounds, place)


def _slopes_near(problem: Problem, at: _Point) -> list[list[FloatArray]]:
    """Derivatives that hold at a point: those of the last step where that was short."""
    if at.slopes is None or at.slopes_at is None:
        return jacobian(problem, at.theta)[1]
    far = float(np.abs(at.theta - at.slopes_at).max()) > _SAME_SLOPES_FRAC
    return jacobian(problem, at.theta)[1] if far and at.step > _SAME_SLOPES else at.slopes


def _with_rounding(
    problem: Problem, at_start: _Point, filters: list[list[Whitener]]
) -> tuple[FloatArray, Normal | None, int, float]:
    """Point, normal equations, rounds and last step with what rounding does on average.

    Rounding in the loop can be chaos (a motor that hunts between two counts): channels of records
    whose rounding simulations fit clearly worse than the smooth one, and steps that make them so,
    are not followed; without normal equations the smooth ones hold.
    """
    theta, step = at_start.theta, at_start.step
    rounded = _foreseeable(problem, theta, filters)
    best = None
    tried = theta
    slopes = _slopes_near(problem, at_start)  # hardly change over the few deviations moved here
    for i, gain in enumerate(_QUANTISED_GAINS):
        left = problem.mixed_residuals(tried, rounded)
        at = tempered(problem, normal_equations(problem, filters, left, slopes))
        if best is not None and at.cost > _ROUGH * best.cost:
            tried = 0.5 * (theta + tried)
            continue
        theta, best = tried, at
        goal, _ = _plain_step(problem, theta, at)
        std = uncertainty_of(problem, theta, at).std
        step = float(np.sqrt(np.mean(((goal - theta) / std) ** 2)))
        tried = theta + gain * (goal - theta)
        if i > 0 and step < _QUANTISED_DONE:
            return tried, at, i + 1, step
    return theta, best, len(_QUANTISED_GAINS), step


def _foreseeable(
    problem: Problem, theta: FloatArray, filters: list[list[Whitener]]
) -> list[BoolArray]:
    """Per record the channels, shape (c,), whose rounding simulations are no chaos."""
    smooth = channel_costs(problem, problem.residuals(theta), filters)
    rough = channel_costs(problem, problem.quantised_residuals(theta), filters)
    return [b <= _CHAOS * a for a, b in zip(smooth, rough, strict=True)]


def _finished(problem: Problem, theta: FloatArray, final: Normal, rounds: int, step: float) -> Fit:
    found = uncertainty_of(problem, theta, final)
    scales = problem.slopes_at(theta)
    outer = np.outer(scales, scales)
    return Fit(
        model=problem.model_at(theta),
        names=tuple(spec.name for spec in problem.specs),
        covariance=found.covariance * outer,
        information=final.hessian,
        prior=problem.weight,
        scales=scales,
        nuisance=final.nuisance,
        freedom=found.freedom,
        rounds=rounds,
        step=step,
    )


def _damped_step(
    problem: Problem, theta: FloatArray, at: Normal, filters: list[list[Whitener]]
) -> tuple[FloatArray, float, float]:
    """Next point, the step in standard deviations, and the share of the misfit that it takes."""
    prior = np.diag(problem.weight)
    gradient = at.gradient - problem.weight * (theta - problem.centre)
    here = at.cost + prior_cost(problem, theta)
    matrix = at.hessian + prior
    damping = 0.0
    for _ in range(_DAMPING_TRIES):
        damped = matrix + damping * np.diag(np.diag(matrix))
        new = problem.bounded(theta + _bounded_step(problem, theta, damped, gradient))
        cost = cost_at(problem, new, filters)
        if cost <= here * (1.0 + 1e-9):
            move = new - theta
            step = float(np.sqrt(max(float(move @ matrix @ move), 0.0) / theta.size))
            return new, step, 1.0 - cost / here
        damping = 10.0 * damping if damping > 0.0 else 1e-2
    return theta, 0.0, 0.0


def _plain_step(problem: Problem, theta: FloatArray, at: Normal) -> tuple[FloatArray, float]:
    """Undamped step: the misfit to rounded simulations is too rough for a line search."""
    matrix = at.hessian + np.diag(problem.weight)
    gradient = at.gradient - problem.weight * (theta - problem.centre)
    new = problem.bounded(theta + _bounded_step(problem, theta, matrix, gradient))
    move = new - theta
    return new, float(np.sqrt(max(float(move @ matrix @ move), 0.0) / theta.size))


def _bounded_step(
    problem: Problem, theta: FloatArray, matrix: FloatArray, gradient: FloatArray
) -> FloatArray:
    """Gauss-Newton step within the bounds: clipping a free step would break tied sums."""
    low, high = problem.bounds
    root, unroot = root_of_inverse(matrix)
    target = root.T @ gradient
    margin = 1e-12
    found = lsq_linear(
        unroot.T, target, bounds=(low - theta - margin, high - theta + margin), method="bvls"
    )
    return np.asarray(found.x)


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
