"""Search for the law that is judged best in a model, from one that was fitted.

What lives here: steps by slopes and, with play, along the coefficients. What may not: the fit
(``design``), what is judged (``judgement``).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import NonFinite
from pmac_comp.base.progress import Progress, untold
from pmac_comp.physics.compensate.free import free_coefficients, with_free
from pmac_comp.physics.compensate.judgement import WORST_FOREMOST, judged, worst_foremost
from pmac_comp.physics.compensate.law import CompensationLaw

# Of the least width of a crossing that a fit by squares is let. On a plant with 4 um of play 0.1 um
# left 1.0 of the aim of a slow sinusoid, 0.05 um 0.7 and 0.025 um 0.6, but then 0.9 in place of 0.7
# of one that just overcomes friction.
_SHARPEST_FRAC = 0.15
# The search that betters the judgement: its rounds, when it ends, the steps of its slopes in the
# usual changes or, where friction turns over, as a share of the way, and what it tries in a round.
_MOST_ROUNDS, _LEAST_GAIN_FRAC = 10, 0.01
_SLOPE_STEP, _SLOPE_SHARE = 0.02, 0.01
_COMPASS_ROUNDS, _COMPASS_STEP = 8, 0.05
_DAMPINGS, _STRIDES = (1e-3, 1e-2, 1e-1, 1.0), (1.0, 0.3)
_NEGLIGIBLE = 1e-12  # of the curvature in all: that of a coefficient that changes nothing
# What the motions that judge tell little of. A constant torque that is not the load's passes for
# friction at the next rest: with 150 N on the nut totals rose by half.
_TOLD_BY_RESTS = ("rest_fade_per_s", "torque_constant_Nm")
_TURNS_OVER_WITHIN = ("breakaway_m", "torque_breakaway_m")
# The search is judged on small slow motions too, which a fit by squares hardly feels: friction may
# turn over sooner than a fit is let.
_LEAST_BREAKAWAY_JUDGED_m = 0.2e-6


def polished(
    law: CompensationLaw,
    errors: Callable[[CompensationLaw], list[tuple[FloatArray, ...]]],
    progress: Progress | None,
    *,
    most_Nm: float = math.inf,
) -> CompensationLaw:
    """The law with the coefficients that are judged best, found by search from its own.

    The sums of squares of a fit weigh what is far within its aim as much as what is beyond it. Here
    each error weighs as much as makes its square the power by which it is judged (iteratively
    reweighted least squares), and of Levenberg's and Marquardt's steps the one is taken that is
    judged best. A tenth to two fifths less is left of the worst of motions that it never saw: with
    play of moves, without of small slow sinusoids. Slopes are taken over steps that a nut's
    crossings of its gap and friction that turns over within a sample do not blur.

    With play there are crossings that come or do not, and slopes end in the wrong place: from there
    each coefficient is tried by itself, up and down (compass search). In models with 2 and 4 um of
    play the worst of slow sinusoids that it never saw went from 0.88 and 1.10 of their aim to 0.73
    and 0.65. Without play it finds nothing more.

    Parameters
    ----------
    law : CompensationLaw
        Where the search begins.
    errors : callable
        What a law leaves, by kind and motion, shape (n,) each (``judgement.errors_on``).
    progress : callable or None
        Called with a step and a fraction.
    most_Nm : float
        Friction torque that the law gets at most, unless it begins with more.
    """
    search = _search_from(law, most_Nm)
    tell = progress or untold
    n_rounds = _MOST_ROUNDS + (_COMPASS_ROUNDS if law.gap_half_m > 0.0 else 0)

    def cost(point: FloatArray) -> float:
        try:
            return judged(errors(search.law_at(point)))
        except NonFinite:
            return math.inf  # a step too far: the loop of the model ran away

    best = search.first
    least = cost(best)
    for k in range(_MOST_ROUNDS):
        tell("polishing the law", (k + 1) / (n_rounds + 1))
        point, before = best, least
        for change in _changes(errors, search, point):
            there = search.within(point + change)
            found = cost(there)
            if found < least:
                best, least = there, found
        if before - least < _LEAST_GAIN_FRAC * min(before, 1.0):
            break
    steps = _COMPASS_STEP * search.sizes
    for k in range(_MOST_ROUNDS, n_rounds):
        tell("polishing the law", (k + 1) / (n_rounds + 1))
        best, least, steps = _compass_round(cost, search, best, least, steps)
    return search.law_at(best)


@dataclass(frozen=True)
class _Search:
    """Coefficients that a search changes.

    Parameters
    ----------
    law : CompensationLaw
        Where it begins.
    names : tuple of str
        The coefficients.
    sizes, lower, upper : ndarray, shape (n,)
        Of each a typical change and the bounds.
    """

    law: CompensationLaw
    names: tuple[str, ...]
    sizes: FloatArray
    lower: FloatArray
    upper: FloatArray

    @property
    def first(self) -> FloatArray:
        """The point of the law where it begins."""
        return np.array([getattr(self.law, name) for name in self.names])

    def within(self, point: FloatArray) -> FloatArray:
        """A point that is no further than the bounds."""
        return np.clip(point, self.lower, self.upper)

    def law_at(self, point: FloatArray) -> CompensationLaw:
        """The law of a point."""
        return with_free(self.law, self.names, self.within(point))

    def slope_steps(self, point: FloatArray) -> FloatArray:
        """Changes over which slopes are taken at a point."""
        share = np.isin(self.names, _TURNS_OVER_WITHIN)
        return np.where(share, _SLOPE_SHARE * self.within(point), _SLOPE_STEP * self.sizes)


def _search_from(law: CompensationLaw, most_Nm: float) -> _Search:
    """Search from a law for one with at most so much friction torque."""
    sizes, lowest = free_coefficients(law)
    for name in _TOLD_BY_RESTS:
        sizes.pop(name, None)
    lowest |= dict.fromkeys(_TURNS_OVER_WITHIN, _LEAST_BREAKAWAY_JUDGED_m)
    if law.gap_half_m > 0.0:
        lowest["gap_width_m"] *= _SHARPEST_FRAC
    highest = {"torque_coulomb_Nm": max(most_Nm, law.torque_coulomb_Nm)}
    return _Search(
        law=law,
        names=tuple(sizes),
        sizes=np.array(list(sizes.values())),
        lower=np.array([lowest.get(name, -np.inf) for name in sizes]),
        upper=np.array([highest.get(name, np.inf) for name in sizes]),
    )


def _compass_round(
    cost: Callable[[FloatArray], float],
    search: _Search,
    point: FloatArray,
    least: float,
    steps: FloatArray,
) -> tuple[FloatArray, float, FloatArray]:
    """A point judged better than one of cost ``least``, its cost, and steps for the next round.

    A step along a coordinate that betters is twice as long the next time, one that does not either
    way is half.
    """
    steps = steps.copy()
    for k, step in enumerate(steps):
        for change in (step, -step):
            there = point.copy()
            there[k] += change
            there = search.within(there)
            found = cost(there)
            if found < least:
                least, point, steps[k] = found, there, 2.0 * change
                break
        else:
            steps[k] = 0.5 * step
    return point, least, steps


def _changes(
    errors: Callable[[CompensationLaw], list[tuple[FloatArray, ...]]],
    search: _Search,
    point: FloatArray,
) -> list[FloatArray]:
    """Steps of Levenberg and Marquardt from a point, of several dampings and lengths."""
    left = errors(search.law_at(point))
    weights = [
        np.linalg.norm(error) ** (WORST_FOREMOST // 2 - 1) / math.sqrt(max(1.0, mean))
        for kind in left
        for mean in [worst_foremost(kind)]
        for error in kind
    ]

    def weighed(kinds: Sequence[Sequence[FloatArray]]) -> FloatArray:
        pairs = zip(weights, chain(*kinds), strict=True)
        return np.concatenate([weight * part for weight, part in pairs])

    now, steps = weighed(left), search.slope_steps(point)
    beside = (errors(search.law_at(point + change)) for change in np.diag(steps))
    slopes = np.stack([weighed(kinds) - now for kinds in beside], axis=1)
    curvature, gradient = slopes.T @ slopes, slopes.T @ now
    own = np.diag(curvature)
    if not own.any():
        return []  # nothing that a coefficient has a say in is left
    own = np.diag(own + _NEGLIGIBLE * own.sum())
    full = [-np.linalg.solve(curvature + damping * own, gradient) * steps for damping in _DAMPINGS]
    return [stride * change for change in full for stride in _STRIDES]
