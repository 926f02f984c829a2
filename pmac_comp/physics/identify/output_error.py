"""Output-error refinement: the parameters with which the simulated closed loop meets the captures.

Gauss-Newton with bounds on whitened residuals; known parameters carry the bench file as a prior,
scale offsets and the static lead map are projected out. What lives here: the rounds and steps. What
may not: simulation (``problem``), weights (``normal_equations``), verdicts and words.
"""

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.errors import DidNotConverge
from pmac_comp.base.progress import Progress, untold
from pmac_comp.base.threads import working
from pmac_comp.files.bench import Bench
from pmac_comp.physics.identify.covariance import uncertainty_of
from pmac_comp.physics.identify.normal_equations import (
    Normal,
    coloured_filters,
    linear_part,
    normal_equations,
    white_filters,
    without_nuisances,
)
from pmac_comp.physics.identify.problem import Problem, jacobian, problem_of
from pmac_comp.physics.identify.records import Record
from pmac_comp.physics.identify.rounding import (
    QUANTISED_GAINS,
    equations_over_interval,
    settled_with_rounding,
)
from pmac_comp.physics.identify.steps import damped_step
from pmac_comp.physics.identify.whitening import Whitener
from pmac_comp.physics.model.drive import DriveModel

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
_ALL_ROUNDS = _WHITE_ROUNDS + _COLOURED_ROUNDS + len(QUANTISED_GAINS)


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
        Prepared captures and their nuisance columns at the full rate, shape (n, q) each.
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
    tell = progress or untold
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
        settled = settled_with_rounding(problem, theta, _slopes_near(problem, at), filters)
        last = equations_over_interval(problem, settled)
        theta, step = settled.theta, settled.step
        rounds += settled.rounds
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
        theta, step, gain = damped_step(problem, theta, normal, filters)
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
