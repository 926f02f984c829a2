"""The last rounds of a refinement: residuals of simulations that round as the sensors do.

What lives here: which of them can be foreseen, and steps on their mean. What may not: smooth rounds
(``output_error``), simulation (``problem``). Imports this package.
"""

from dataclasses import dataclass, replace

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.physics.identify.considered import considered_scores
from pmac_comp.physics.identify.covariance import tempered, uncertainty_of
from pmac_comp.physics.identify.normal_equations import (
    Normal,
    channel_costs,
    coloured_filters,
    linear_part,
    normal_equations,
    without_nuisances,
)
from pmac_comp.physics.identify.problem import Problem, jacobian
from pmac_comp.physics.identify.secants import Slopes, over_interval
from pmac_comp.physics.identify.steps import plain_step
from pmac_comp.physics.identify.whitening import Whitener

Filters = list[list[Whitener]]

# Each of these rounds sees other chances of rounding: full steps first, then ever smaller shares,
# so that the last points are averages instead of the last throw.
QUANTISED_GAINS = (1.0, 1.0, 0.5, 0.33, 0.25, 0.2)
_QUANTISED_DONE = 1.0  # of a standard deviation, after the second round
# The mean of four roundings leaves a quarter of their scatter: more misfit than that is chaos.
_CHAOS = 1.25
_ROUGH = 1.1
_ESCAPE_ROUNDS = 4


@dataclass(frozen=True)
class Settled:
    """Where the refinement ended, and what its equations are made of.

    Parameters
    ----------
    theta : ndarray, shape (p,)
        Scaled parameters.
    step : float
        Last step in standard deviations.
    rounds : int
        Steps that were tried.
    slopes, filters, left
        Derivatives, weights and residuals, per record.
    """

    theta: FloatArray
    step: float
    rounds: int
    slopes: Slopes
    filters: Filters
    left: list[FloatArray]


def settled_with_rounding(
    problem: Problem, theta: FloatArray, slopes: Slopes, filters: Filters
) -> Settled:
    """Where the refinement goes with what rounding does on average.

    Rounding in the loop can be chaos (a motor that hunts between two counts): channels of records
    whose rounding simulations fit clearly worse than the smooth one, and steps that make them so,
    are not followed.

    Parameters
    ----------
    problem : Problem
        What is fitted.
    theta : ndarray, shape (p,)
        Scaled parameters at which the smooth simulation fits.
    slopes : list of list of ndarray
        Derivatives there, per parameter and record; they hardly change over the few deviations
        moved here.
    filters : list of list of Whitener
        Weights, per record and channel.

    Returns
    -------
    Settled
    """
    rounded = _foreseeable(problem, theta, filters)
    before, step = 0, np.inf
    if not all(marks.all() for marks in rounded):
        moved = _away_from_smooth(problem, theta, slopes, filters)
        if moved is not None:
            theta, slopes, filters, before = moved
            rounded = _foreseeable(problem, theta, filters)
    cost, left = np.inf, []
    tried = theta
    for i, gain in enumerate(QUANTISED_GAINS):
        here = problem.mixed_residuals(tried, rounded)
        at = tempered(problem, normal_equations(problem, filters, here, slopes))
        if at.cost > _ROUGH * cost:
            tried = 0.5 * (theta + tried)
            continue
        theta, left, cost = tried, here, at.cost
        goal, _ = plain_step(problem, theta, at)
        std = uncertainty_of(problem, theta, at).std
        step = float(np.sqrt(np.mean(((goal - theta) / std) ** 2)))
        tried = theta + gain * (goal - theta)
        if i > 0 and step < _QUANTISED_DONE:
            return Settled(tried, step, before + i + 1, slopes, filters, left)
    return Settled(theta, step, before + len(QUANTISED_GAINS), slopes, filters, left)


def equations_over_interval(problem: Problem, at: Settled) -> Normal:
    """Normal equations at the end whose derivatives hold over the interval that they leave.

    Their scores scatter by what is held at a stated value too.
    """

    def equations(slopes: Slopes) -> Normal:
        return normal_equations(problem, at.filters, at.left, slopes, scatter=False)

    slopes = over_interval(problem, at.theta, at.slopes, equations)
    found = normal_equations(problem, at.filters, at.left, slopes)
    held = considered_scores(problem, at.theta, at.filters, slopes)
    return tempered(problem, replace(found, prior_scores=found.prior_scores + held))


def _away_from_smooth(
    problem: Problem,
    theta: FloatArray,
    slopes: Slopes,
    filters: Filters,
) -> tuple[FloatArray, Slopes, Filters, int] | None:
    """Place, derivatives, weights, rounds where rounding simulations fit clearly better, or None.

    Coarse counts dither friction in the loop. A smooth fit imitates that by other friction, with
    which rounding simulations stick and hunt as the drive does not: what looks like chaos there is
    a place that is wrong, if steps on the rounding simulations of all channels lead out of it.
    """
    started = cost = _rounded_cost(problem, theta, filters)
    best, tried = (theta, slopes), theta
    for _ in range(_ESCAPE_ROUNDS):
        left = problem.quantised_residuals(tried)
        normal = tempered(problem, normal_equations(problem, filters, left, slopes))
        tried, step = plain_step(problem, tried, normal)
        slopes = jacobian(problem, tried)[1]
        now = _rounded_cost(problem, tried, filters)
        if now < cost:
            best, cost = (tried, slopes), now
        if step < _QUANTISED_DONE:
            break
    if cost > started / _ROUGH:
        return None
    theta, slopes = best
    left = problem.quantised_residuals(theta)
    left = without_nuisances(problem, left, linear_part(problem, left, filters))
    return theta, slopes, coloured_filters(problem, left), _ESCAPE_ROUNDS


def _rounded_cost(problem: Problem, theta: FloatArray, filters: Filters) -> float:
    """Misfit of the rounding simulations at a place."""
    left = problem.quantised_residuals(theta)
    return float(sum(cost.sum() for cost in channel_costs(problem, left, filters)))


def _foreseeable(problem: Problem, theta: FloatArray, filters: Filters) -> list[BoolArray]:
    """Per record the channels, shape (c,), whose rounding simulations are no chaos."""
    smooth = channel_costs(problem, problem.residuals(theta), filters)
    rough = channel_costs(problem, problem.quantised_residuals(theta), filters)
    return [b <= _CHAOS * a for a, b in zip(smooth, rough, strict=True)]
