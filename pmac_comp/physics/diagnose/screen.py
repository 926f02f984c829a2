"""Screening: every effect of the library in one linearised joint refit, flexible rivals beside it.

What lives here: one look at a working point. It ranks; it decides nothing. May import the rest of
this package below ``growth``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.diagnose.candidates import Start, own_directions, starts_of
from pmac_comp.physics.diagnose.clocks import WAVES
from pmac_comp.physics.diagnose.flexible import flexible_columns
from pmac_comp.physics.diagnose.gram import Prior, Solution
from pmac_comp.physics.diagnose.refit import Fitted, Frozen, moved_values
from pmac_comp.physics.diagnose.spectra import peaks_of
from pmac_comp.physics.diagnose.statistics import Whitener
from pmac_comp.physics.diagnose.workbench import Columns, Direction, Workbench, combined, prior_of
from pmac_comp.physics.model.effect import Effect

# A flexible rival may be as large as it likes, but not infinite: it shrinks to nothing where the
# data says nothing.
_FLEXIBLE_SIGMA_m = 20.0
_FLEXIBLE_SIGMA_Nm = 2.0
_WHOLE_s = 1e6  # one block per stretch: sums over it are all that a ranking asks for


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
    own_SI : Mapping of str to float
        Where the model's own parameters move meanwhile.
    """

    start: Start
    fit_gain: float
    heldout_gain: float
    step: tuple[float, ...]
    own_SI: Mapping[str, float] = field(default_factory=dict)

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
    ranked : tuple of Screened
        Best start of every effect, best first.
    starts : Mapping[str, tuple of Screened]
        All starts of every effect, best first.
    rows_fit : float
        Number of whitened samples that are fitted.
    rival_drop : ndarray, shape (b,)
        Drop of chi-square that the flexible rivals earn in every block.
    fitting : ndarray of bool, shape (b,)
        Blocks that are fitted.
    """

    frozen: Frozen
    ranked: tuple[Screened, ...]
    starts: Mapping[str, tuple[Screened, ...]]
    rows_fit: float
    rival_drop: FloatArray
    fitting: BoolArray

    @property
    def rival_gain(self) -> float:
        """Drop of chi-square that the flexible rivals earn on fitting samples."""
        return float(self.rival_drop[self.fitting].sum())


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

    def frozen(self) -> Frozen:
        """Columns of the model's own parameters, apart from the others, which are many."""
        return Frozen(self.own, [c[:, :, : len(self.own)].copy() for c in self.columns])

    def places(self) -> list[range]:
        """Columns of every start."""
        ends = np.cumsum([len(self.own), *(len(s.directions) for s in self.starts)]).tolist()
        return [range(a, b) for a, b in pairwise(ends)]


def look(
    workbench: Workbench,
    description: Bench,
    point: Fitted,
    library: Mapping[str, Effect],
    last: Look | None = None,
) -> Look:
    """Columns at a working point: simulated, or those of an earlier point where it had them.

    Parameters
    ----------
    workbench : Workbench
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
    own = tuple(workbench.concerned(own_directions(point.model)))
    responses = list(workbench.executor.map(lambda r: r.response(point.model), workbench.records))
    peaks = peaks_of(workbench.records, responses, point.model)
    starts = tuple(
        start
        for effect in library.values()
        for start in starts_of(effect, point.model, description, peaks)
    )
    directions = [*own, *(d for start in starts for d in start.directions)]
    if last is None:
        columns = flexible_columns(
            workbench.records,
            point.model,
            description.pitch_m,
            workbench.executor,
            room=len(directions),
        )
        workbench.columns(point.model, directions, into=columns, at=range(len(directions)))
        n_flexible = columns[0].shape[2] - len(directions)
        prior = _with_flexible(prior_of(directions), n_flexible)
        return Look(own, starts, columns, prior, n_flexible)
    return _with_old_columns(workbench, point, own, starts, last)


def _identity(start: Start) -> tuple[str, tuple[tuple[str, float], ...], tuple[float, ...]]:
    # Phases found in what is left differ a little from round to round.
    begun = () if start.effect in WAVES else tuple(start.clocks.values())
    return start.key, tuple(sorted(start.values.items())), begun


def _with_old_columns(
    workbench: Workbench,
    point: Fitted,
    own: tuple[Direction, ...],
    starts: tuple[Start, ...],
    last: Look,
) -> Look:
    """Own columns and those of new starts simulated; the others from an earlier look."""
    old = dict(zip(map(_identity, last.starts), last.places(), strict=True))
    stale = frozenset(i for i, start in enumerate(starts) if _identity(start) in old)
    directions = list(own)
    fresh: list[int] = list(range(len(own)))
    kept: list[int] = []
    source: list[int] = []
    for i, start in enumerate(starts):
        mine = range(len(directions), len(directions) + len(start.directions))
        directions += start.directions
        if i in stale:
            kept += mine
            source += old[_identity(start)]
        else:
            fresh += mine
    width = len(directions) + last.n_flexible
    kept += range(len(directions), width)
    source += range(last.prior.lower.size - last.n_flexible, last.prior.lower.size)
    columns: Columns = []
    for i in range(len(last.columns)):
        moved = np.empty((*last.columns[i].shape[:2], width), dtype=np.float32)
        for to, at in zip(kept, source, strict=True):
            moved[:, :, to] = last.columns[i][:, :, at]
        columns.append(moved)
        # The earlier look ends here: old and new columns need not coexist.
        last.columns[i] = np.empty((0, 0, 0), dtype=np.float32)
    workbench.columns(point.model, [directions[j] for j in fresh], into=columns, at=fresh)
    prior = _with_flexible(prior_of(directions), last.n_flexible)
    return Look(own, starts, columns, prior, last.n_flexible, stale)


def refreshed(workbench: Workbench, point: Fitted, seen: Look, effects: frozenset[str]) -> Look:
    """The look with the columns of some effects simulated at the present point.

    Parameters
    ----------
    workbench : Workbench
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
    directions = [d for i in chosen for d in seen.starts[i].directions]
    workbench.columns(point.model, directions, into=seen.columns, at=index)
    return replace(seen, stale=seen.stale - set(chosen))


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


def noise_like(workbench: Workbench, point: Fitted, seen: Look) -> list[FloatArray]:
    """What neither a candidate nor a flexible rival explains, shape (m, channels) per record.

    It is the best picture of the noise.

    Weights that forgive slow motion let many columns leave more of it than there ever was; taken
    for noise, that would be forgiven all the more. Then columns are fitted by plain squares.
    """
    residuals = workbench.residuals(point.simulated)
    left = _left_by_all(workbench, residuals, seen)
    before = _power_m2(workbench, residuals)
    if np.all(_power_m2(workbench, left) <= before):
        return left
    return _left_by_all(_plain(workbench, before), residuals, seen)


def _left_by_all(
    workbench: Workbench, residuals: Sequence[FloatArray], seen: Look
) -> list[FloatArray]:
    gram = workbench.gram(residuals, seen.columns, seen.prior, longest_s=_WHOLE_s)
    shrunk = np.where(np.isfinite(seen.prior.sigma), seen.prior.sigma, 10.0)
    relaxed = Prior(
        np.full(shrunk.size, -np.inf), np.full(shrunk.size, np.inf), np.zeros(shrunk.size), shrunk
    )
    solution = gram.with_bounds(relaxed).solve(range(gram.n_columns))
    return workbench.left_by(residuals, seen.columns, solution)


def _plain(workbench: Workbench, power_m2: FloatArray) -> Workbench:
    """The workbench with the weights of white noise, channel by channel."""
    noise = workbench.known_noise
    lags = np.zeros_like(noise.whitener.lags)
    white = Whitener(lags, np.diag(1.0 / np.sqrt(power_m2)))
    return workbench.with_noise(replace(noise, whitener=white, robust=None, doubtful=None))


def _power_m2(workbench: Workbench, series: Sequence[FloatArray]) -> FloatArray:
    """Mean square of each channel about its mean in each run as fitted, shape (channels,)."""
    fitted = [u & f for u, f in zip(workbench.counted, workbench.fitting, strict=True)]
    pairs = zip(series, fitted, strict=True)
    level = [x[u] - x[u].mean(axis=0) for x, u in pairs if u.any()]
    return np.asarray(np.mean(np.concatenate(level) ** 2, axis=0))


def screen(workbench: Workbench, point: Fitted, seen: Look) -> Screening:
    """Rank all candidates by their linearised joint refits.

    Parameters
    ----------
    workbench : Workbench
        Records with their noise.
    point : Fitted
        Working point.
    seen : Look
        Columns at that point.

    Returns
    -------
    Screening
    """
    residuals = workbench.residuals(point.simulated)
    gram = workbench.gram(residuals, seen.columns, seen.prior, longest_s=_WHOLE_s)
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
                moved_values(point.model, seen.own, solution.step[:n_own].tolist()),
            )
        )
    starts = {k: tuple(sorted(v, key=lambda s: -s.gain)) for k, v in found.items()}
    rivals = range(gram.n_columns - seen.n_flexible, gram.n_columns)
    flexible = gram.solve([*own, *rivals])
    return Screening(
        seen.frozen(),
        tuple(sorted((v[0] for v in starts.values()), key=lambda s: -s.gain)),
        starts,
        float(gram.rows[gram.fitting].sum()),
        *_rival_drops(workbench, residuals, seen, base, flexible),
    )


def _rival_drops(
    workbench: Workbench,
    residuals: Sequence[FloatArray],
    seen: Look,
    base: Solution,
    flexible: Solution,
) -> tuple[FloatArray, BoolArray]:
    """Drop of chi-square from one refit to the other in every block, and which blocks fit."""
    both: Columns = [
        np.stack(
            [combined(c, s.indices, s.step) for s in (base, flexible)], axis=2, dtype=np.float32
        )
        for c in seen.columns
    ]
    free = np.full(2, np.inf)
    gram = workbench.gram(residuals, both, Prior(-free, free, np.zeros(2), free))
    left = [gram.block_chi2(Solution(np.array([i]), np.ones(1), np.eye(1), 0.0)) for i in (0, 1)]
    return left[0] - left[1], gram.fitting
