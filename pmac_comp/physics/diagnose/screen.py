"""Screening: every effect of the library in one linearised joint refit, flexible rivals beside it.

What lives here: one look at a working point. It ranks; it decides nothing. May import the rest of
this package below ``growth``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.diagnose.candidates import Start, own_directions, starts_of
from pmac_comp.physics.diagnose.flexible import flexible_columns
from pmac_comp.physics.diagnose.gram import Gram, Prior, Solution
from pmac_comp.physics.diagnose.refit import Fitted, Frozen
from pmac_comp.physics.diagnose.spectra import peaks_of
from pmac_comp.physics.diagnose.workbench import Columns, Direction, Workbench, prior_of
from pmac_comp.physics.model.effect import Effect

# A flexible rival may be as large as it likes, but not infinite: it shrinks to nothing where the
# data says nothing.
_FLEXIBLE_SIGMA_m = 20.0
_FLEXIBLE_SIGMA_Nm = 2.0


@dataclass(frozen=True)
class Screened:
    """What one start of a candidate earns in the linearised joint refit.

    Parameters
    ----------
    start : Start
        Candidate and start.
    fit_gain : float
        Drop of chi-square on fitting samples, priors included.
    heldout_gain : float
        Drop of chi-square on judging samples.
    step : tuple of float
        Size along the start's directions.
    """

    start: Start
    fit_gain: float
    heldout_gain: float
    step: tuple[float, ...]

    @property
    def gain(self) -> float:
        """What ranks: both gains together."""
        return self.fit_gain + self.heldout_gain


@dataclass(frozen=True)
class Screening:
    """One look at a working point.

    Parameters
    ----------
    frozen : Frozen
        Columns of the model's own parameters, for refits to reuse.
    gram : Gram
        Products of own, candidate and flexible columns.
    n_own, n_flexible : int
        Number of columns of each; own ones come first, flexible ones last.
    ranked : tuple of Screened
        Best start of every effect, best first.
    starts : Mapping[str, tuple of Screened]
        All starts of every effect, best first.
    base : Solution
        Refit of the own parameters alone.
    flexible : Solution
        Refit of own parameters with the flexible rivals.
    """

    frozen: Frozen
    gram: Gram
    n_own: int
    n_flexible: int
    ranked: tuple[Screened, ...]
    starts: Mapping[str, tuple[Screened, ...]]
    base: Solution
    flexible: Solution

    @property
    def own(self) -> IntArray:
        """Columns of the model's own parameters."""
        return np.arange(self.n_own)

    def flexible_gains(self) -> tuple[float, float]:
        """Drop of chi-square that the flexible rivals earn on fitting and judging samples."""
        before = self.gram.block_chi2(self.base)
        after = self.gram.block_chi2(self.flexible)
        fits = self.gram.fitting
        return float((before - after)[fits].sum()), float((before - after)[~fits].sum())


@dataclass(frozen=True)
class Look:
    """Simulated columns of a working point, before they are weighed.

    Parameters
    ----------
    own : tuple of Direction
        The model's parameters.
    starts : tuple of Start
        Candidates.
    columns : list of ndarray
        Own, then candidates, then flexible rivals.
    prior : Prior
        Of all columns.
    n_flexible : int
        How many of them are flexible.
    stale : frozenset of int
        Starts whose columns were simulated at an earlier working point.
    """

    own: tuple[Direction, ...]
    starts: tuple[Start, ...]
    columns: Columns
    prior: Prior
    n_flexible: int
    stale: frozenset[int] = frozenset()

    def places(self) -> list[range]:
        """Columns of every start."""
        ends = np.cumsum([len(self.own), *(len(s.directions) for s in self.starts)]).tolist()
        return [range(a, b) for a, b in pairwise(ends)]


def look(
    bench: Workbench,
    description: Bench,
    point: Fitted,
    library: Mapping[str, Effect],
    last: Look | None = None,
) -> Look:
    """Columns at a working point: simulated, or those of an earlier point where it had them.

    Parameters
    ----------
    bench : Workbench
        Records.
    description : Bench
        Bench file.
    point : Fitted
        Working point.
    library : Mapping of str to Effect
        Candidates.
    last : Look or None
        Look at an earlier point: its candidates' columns serve to choose those that are worth
        being simulated again (``refreshed``).

    Returns
    -------
    Look
    """
    own = tuple(own_directions(point.model))
    responses = list(bench.executor.map(lambda r: r.response(point.model), bench.records))
    peaks = peaks_of(bench.records, responses, description.pitch_m)
    starts = tuple(
        start
        for effect in library.values()
        for start in starts_of(effect, point.model, description, peaks)
    )
    directions = [*own, *(d for start in starts for d in start.directions)]
    if last is None:
        rivals = flexible_columns(bench.records, point.model, description.pitch_m, bench.executor)
        columns = bench.columns(point.model, directions)
        joined: Columns = [
            np.concatenate([c, r.astype(np.float32)], axis=2)
            for c, r in zip(columns, rivals, strict=True)
        ]
        n_flexible = rivals[0].shape[2]
        prior = _with_flexible(prior_of(directions), n_flexible)
        return Look(own, starts, joined, prior, n_flexible)
    return _with_old_columns(bench, point, own, starts, last)


def _identity(start: Start) -> tuple[str, tuple[tuple[str, float], ...]]:
    return start.key, tuple(sorted(start.values.items()))


def _with_old_columns(
    bench: Workbench,
    point: Fitted,
    own: tuple[Direction, ...],
    starts: tuple[Start, ...],
    last: Look,
) -> Look:
    """Own columns and those of new starts simulated; the others from an earlier look."""
    old = dict(zip(map(_identity, last.starts), last.places(), strict=True))
    stale = frozenset(i for i, start in enumerate(starts) if _identity(start) in old)
    new = [d for i, start in enumerate(starts) if i not in stale for d in start.directions]
    fresh = bench.columns(point.model, [*own, *new])
    # Places in fresh columns (first) and old ones (behind them) in the order of this look.
    width, order, at = fresh[0].shape[2], list(range(len(own))), len(own)
    for start in starts:
        if _identity(start) in old:
            order += [width + i for i in old[_identity(start)]]
        else:
            order += range(at, at + len(start.directions))
            at += len(start.directions)
    everything = last.columns[0].shape[2]
    order += range(width + everything - last.n_flexible, width + everything)
    columns: Columns = [
        np.concatenate([f, c], axis=2)[:, :, order]
        for f, c in zip(fresh, last.columns, strict=True)
    ]
    directions = [*own, *(d for start in starts for d in start.directions)]
    prior = _with_flexible(prior_of(directions), last.n_flexible)
    return Look(own, starts, columns, prior, last.n_flexible, stale)


def refreshed(bench: Workbench, point: Fitted, seen: Look, effects: frozenset[str]) -> Look:
    """The look with the columns of some effects simulated at the present point.

    Parameters
    ----------
    bench : Workbench
        Records.
    point : Fitted
        Working point.
    seen : Look
        Look with old columns.
    effects : frozenset of str
        Effects to simulate afresh.

    Returns
    -------
    Look
    """
    chosen = [i for i in sorted(seen.stale) if seen.starts[i].effect in effects]
    places = seen.places()
    index = [j for i in chosen for j in places[i]]
    fresh = bench.columns(point.model, [d for i in chosen for d in seen.starts[i].directions])
    columns: Columns = []
    for old, new in zip(seen.columns, fresh, strict=True):
        old[:, :, index] = new  # the look with old columns serves no more
        columns.append(old)
    return replace(seen, columns=columns, stale=seen.stale - set(chosen))


def _with_flexible(prior: Prior, count: int) -> Prior:
    """Priors of the flexible rivals behind those of the directions: readings, then torques."""
    half = count // 2
    sigma = np.concatenate(
        [np.full(half, _FLEXIBLE_SIGMA_m), np.full(count - half, _FLEXIBLE_SIGMA_Nm)]
    )
    infinite = np.full(count, np.inf)
    return Prior(
        np.concatenate([prior.lower, -infinite]),
        np.concatenate([prior.upper, infinite]),
        np.concatenate([prior.centre, np.zeros(count)]),
        np.concatenate([prior.sigma, sigma]),
    )


def noise_like(bench: Workbench, point: Fitted, seen: Look) -> list[FloatArray]:
    """What neither a candidate nor a flexible rival can explain: the best picture of the noise."""
    residuals = bench.residuals(point.simulated)
    gram = bench.gram(residuals, seen.columns, seen.prior)
    shrunk = np.where(np.isfinite(seen.prior.sigma), seen.prior.sigma, 10.0)
    relaxed = Prior(
        np.full(shrunk.size, -np.inf), np.full(shrunk.size, np.inf), np.zeros(shrunk.size), shrunk
    )
    solution = gram.with_bounds(relaxed).solve(range(gram.n_columns))
    return bench.left_by(residuals, seen.columns, solution)


def screen(bench: Workbench, point: Fitted, seen: Look) -> Screening:
    """Rank all candidates by their linearised joint refits.

    Parameters
    ----------
    bench : Workbench
        Records with their noise.
    point : Fitted
        Working point.
    seen : Look
        Columns at that point.

    Returns
    -------
    Screening
    """
    gram = bench.gram(bench.residuals(point.simulated), seen.columns, seen.prior)
    n_own = len(seen.own)
    own = list(range(n_own))
    base = gram.solve(own)
    left = gram.block_chi2(base)
    found: dict[str, list[Screened]] = {}
    for start, mine in zip(seen.starts, seen.places(), strict=True):
        solution = gram.solve([*own, *mine])
        judged = (left - gram.block_chi2(solution))[~gram.fitting]
        found.setdefault(start.effect, []).append(
            Screened(
                start,
                base.chi2 - solution.chi2,
                float(judged.sum()),
                tuple(solution.step[n_own:].tolist()),
            )
        )
    starts = {k: tuple(sorted(v, key=lambda s: -s.gain)) for k, v in found.items()}
    rivals = range(gram.n_columns - seen.n_flexible, gram.n_columns)
    flexible = gram.solve([*own, *rivals])
    return Screening(
        Frozen(seen.own, [c[:, :, :n_own] for c in seen.columns]),
        gram,
        n_own,
        seen.n_flexible,
        tuple(sorted((v[0] for v in starts.values()), key=lambda s: -s.gain)),
        starts,
        base,
        flexible,
    )


def names_of(items: Sequence[Screened]) -> list[str]:
    """Effects of screened candidates in order."""
    return [item.start.effect for item in items]
