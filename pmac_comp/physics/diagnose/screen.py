"""Screening: every effect of the library in one linearised joint refit, flexible rivals beside it.

What lives here: one look at a working point. It ranks; it decides nothing. May import the rest of
this package below ``growth``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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
    """

    own: tuple[Direction, ...]
    starts: tuple[Start, ...]
    columns: Columns
    prior: Prior
    n_flexible: int


def look(
    bench: Workbench, description: Bench, point: Fitted, library: Mapping[str, Effect]
) -> Look:
    """Simulate all columns at a working point.

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
    columns = bench.columns(point.simulated, directions)
    rivals = flexible_columns(
        bench.records, point.model, point.simulated, description.pitch_m, bench.executor
    )
    n_flexible = rivals[0].shape[2]
    joined: Columns = [
        np.concatenate([c, r.astype(np.float32)], axis=2)
        for c, r in zip(columns, rivals, strict=True)
    ]
    return Look(own, starts, joined, _with_flexible(prior_of(directions), n_flexible), n_flexible)


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
    at = n_own
    for start in seen.starts:
        mine = list(range(at, at + len(start.directions)))
        at += len(start.directions)
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
    flexible = gram.solve([*own, *range(at, gram.n_columns)])
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
