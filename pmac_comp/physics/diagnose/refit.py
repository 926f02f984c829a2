"""Nonlinear joint refits: Gauss-Newton through the closed loop with priors and bounds.

What lives here: how a model moves to where the data wants it. No decisions about effects. May
import ``workbench``, ``candidates`` and ``gram``.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ModelError
from pmac_comp.physics.diagnose.candidates import STEP_FRAC, own_directions
from pmac_comp.physics.diagnose.clocks import first_guesses, moved_clocks, needs_clocks
from pmac_comp.physics.diagnose.gram import Gram, Solution
from pmac_comp.physics.diagnose.workbench import Columns, Direction, Workbench, prior_of
from pmac_comp.physics.model.drive import DriveModel

_HALVINGS = 4
_CLOCK_ROUNDS = 3
_ENOUGH = 0.5  # chi-square: below one, no parameter moves by a standard deviation
_LARGEST_STEPS = 60.0
_TRUSTED = 0.8
_SETTLING = (STEP_FRAC, STEP_FRAC / 5, STEP_FRAC / 20)
_SETTLING_ROUNDS = 8
_WEIGHINGS = 4
_FORGIVEN = 0.5  # chi-square per sample: weights for twice the power that is left


@dataclass(frozen=True)
class Fitted:
    """A model at the end of a refit, with what it leaves.

    Parameters
    ----------
    model : DriveModel
        Refitted model.
    simulated : list of ndarray
        Coarse channels of the model in every record.
    chi2 : float
        Weighted sum of squares on fitting samples with priors.
    blocks : ndarray, shape (b,)
        Weighted sum of squares in every block.
    """

    model: DriveModel
    simulated: list[FloatArray]
    chi2: float
    blocks: FloatArray


@dataclass(frozen=True)
class Frozen:
    """Columns that a refit may reuse: sensitivities hardly change along the way."""

    directions: tuple[Direction, ...]
    columns: Columns


def evaluate(workbench: Workbench, model: DriveModel) -> Fitted:
    """What a model leaves; raises ModelError as ``simulate`` does."""
    if needs_clocks(model):
        for judge in workbench.judges():
            model = _clocked(judge, model)
    return _fitted(workbench, model, workbench.simulate([model])[0])


def _clocked(judge: Workbench, model: DriveModel) -> DriveModel:
    """The model with the time at which a judging run began: no fit of others can tell it."""
    tried = [evaluate(judge, guess) for guess in first_guesses(model, judge.records[0])]
    best = min(tried, key=lambda t: t.chi2)
    return refit(judge, best, rounds=_CLOCK_ROUNDS, clocks_only=True).model


def _fitted(workbench: Workbench, model: DriveModel, simulated: list[FloatArray]) -> Fitted:
    gram = empty_gram(workbench, simulated)
    blocks = gram.blocks[:, -1, -1]
    chi2 = float(blocks[gram.fitting].sum()) + prior_cost(model)
    return Fitted(model, simulated, chi2, np.asarray(blocks))


def empty_gram(workbench: Workbench, simulated: Sequence[FloatArray]) -> Gram:
    """Gram matrices of the residual alone; ``simulated`` of shape (m, channels) per record."""
    none: Columns = [np.zeros((*s.shape, 0), dtype=np.float32) for s in simulated]
    return workbench.gram(workbench.residuals(simulated), none, prior_of([]))


def prior_cost(model: DriveModel) -> float:
    """Sum of squares that known parameters cost for leaving the bench's values."""
    return float(
        sum((d.centre / d.sigma) ** 2 for d in own_directions(model) if math.isfinite(d.sigma))
    )


def refit(
    workbench: Workbench,
    start: Fitted,
    *,
    frozen: Frozen | None = None,
    rounds: int = 4,
    step_frac: float = STEP_FRAC,
    clocks_only: bool = False,
) -> Fitted:
    """Model moved to the least weighted squares on the fitting samples.

    Parameters
    ----------
    workbench : Workbench
        Records and weights.
    start : Fitted
        Where to begin.
    frozen : Frozen or None
        Columns of parameters that need not be simulated again; all others are, in each round.
    rounds : int
        Most Gauss-Newton rounds.
    step_frac : float
        Size of the differences: wide ones see past the roughness that sticking leaves in the sum
        of squares, narrow ones find the bottom.
    clocks_only : bool
        Find when the runs began and leave the drive as it is.

    Returns
    -------
    Fitted
        Never worse than the start.
    """
    best = start
    held = frozen
    for _ in range(rounds):
        gram, directions, columns = linearised(
            workbench, best, held, step_frac=step_frac, clocks_only=clocks_only
        )
        solution = gram.solve(range(gram.n_columns))
        moved = _line_search(workbench, best, directions, solution)
        if moved is None:
            if held is frozen:
                return best
            held = frozen
            continue
        promised, gain = best.chi2 - solution.chi2, best.chi2 - moved.chi2
        best = moved
        little = gain < max(_ENOUGH, 1e-4 * best.chi2)
        if little and held is frozen:
            return best
        # Columns that foretold their step well serve once more; that little is left in used ones
        # says nothing of what fresh ones would find.
        well = not little and _TRUSTED * promised < gain < promised / _TRUSTED
        held = Frozen(tuple(directions), columns) if well else frozen
    return best


def settled(workbench: Workbench, start: Fitted) -> tuple[Fitted, dict[str, float]]:
    """Refits with ever narrower differences until none helps, and how far they still moved.

    Parameters
    ----------
    workbench : Workbench
        Records and weights.
    start : Fitted
        Where to begin.

    Returns
    -------
    Fitted
        Never worse than the start.
    dict
        Per parameter, the largest distance in SI from the end of an earlier refit: what friction's
        roughness leaves open although the sum of squares hardly tells.
    """
    ends: list[Fitted] = []
    best = start
    for step_frac in _SETTLING:
        best = refit(workbench, best, rounds=_SETTLING_ROUNDS, step_frac=step_frac)
        ends.append(best)
    final = best.model.parameters
    return best, {k: max(abs(v - e.model.parameters[k]) for e in ends) for k, v in final.items()}


def under_own_weights(workbench: Workbench, start: Fitted, *, rounds: int) -> Fitted:
    """A model refitted under the weights of what it leaves itself, as long as these are too loose.

    Parameters
    ----------
    workbench : Workbench
        Records, all fitted, with weights that were taken from more than is left by now: under them
        hardly anything that could still be closed counts.
    start : Fitted
        A model refitted under those.
    rounds : int
        Most Gauss-Newton rounds under each of the weights.

    Returns
    -------
    Fitted
        With the figures of the last weights.
    """
    best = start
    for _ in range(_WEIGHINGS):
        if not _forgiven(workbench, best):
            break
        left = workbench.residuals(best.simulated)
        workbench = workbench.with_noise(
            workbench.noise_from(left, workbench.floor_m(best.model.bench))
        )
        best = refit(workbench, evaluate(workbench, best.model), rounds=rounds)
    return best


def _forgiven(workbench: Workbench, point: Fitted) -> bool:
    """Whether a model leaves far less than the weights were taken from: chi-square below one."""
    gram = empty_gram(workbench, point.simulated)
    left = float(point.blocks[gram.fitting].sum())
    return left < _FORGIVEN * float(gram.rows[gram.fitting].sum())


def linearised(
    workbench: Workbench,
    point: Fitted,
    frozen: Frozen | None,
    *,
    step_frac: float = STEP_FRAC,
    clocks_only: bool = False,
) -> tuple[Gram, list[Direction], Columns]:
    """Gram matrices of a model's own directions at a point, with directions and columns."""
    known = {} if frozen is None else {d.label: i for i, d in enumerate(frozen.directions)}
    directions = workbench.concerned(own_directions(point.model, step_frac=step_frac))
    if clocks_only:
        directions = [d for d in directions if d.run is not None]
    fresh = [d for d in directions if d.label not in known]
    kept = [d for d in directions if d.label in known]
    columns = _columns(workbench, point.model, fresh, step_frac)
    if frozen is not None and kept:
        index = [known[d.label] for d in kept]
        # A frozen column counts in steps of the point where it was taken.
        ratio = np.array([d.unit / frozen.directions[known[d.label]].unit for d in kept]).astype(
            np.float32
        )
        columns = [
            np.concatenate([c, f[:, :, index] * ratio], axis=2)
            for c, f in zip(columns, frozen.columns, strict=True)
        ]
    ordered = [*fresh, *kept]
    gram = workbench.gram(workbench.residuals(point.simulated), columns, prior_of(ordered))
    return gram, ordered, columns


def _columns(
    workbench: Workbench, model: DriveModel, fresh: Sequence[Direction], step_frac: float
) -> Columns:
    """Columns of directions at a model; those of all its own serve again as long as it stands."""
    whole = [d.label for d in fresh] == [d.label for d in own_directions(model)]
    if not whole or any(d.run is not None for d in fresh):
        return workbench.columns(model, fresh)
    missing = [
        i for i, r in enumerate(workbench.records) if r.recent.columns(model, step_frac) is None
    ]
    made = workbench.of(missing).columns(model, fresh) if missing else []
    for i, column in zip(missing, made, strict=True):
        workbench.records[i].recent.keep_columns(model, step_frac, column)
    new = dict(zip(missing, made, strict=True))
    kept = (r.recent.columns(model, step_frac) for r in workbench.records)
    return [new[i] if c is None else c for i, c in enumerate(kept)]


def moved_values(
    model: DriveModel, directions: Sequence[Direction], step: Sequence[float]
) -> Mapping[str, float]:
    """Parameters after a step along own directions, inside their bounds."""
    values = {}
    for direction, size in zip(directions, step, strict=True):
        if direction.run is not None:
            continue
        spec = model.spec(direction.label)
        value = model.parameters[direction.label] + size * direction.unit
        if spec.period:
            value = math.remainder(value, spec.period)
        values[direction.label] = float(np.clip(value, spec.lower, spec.upper))
    return values


def _line_search(
    workbench: Workbench, point: Fitted, directions: Sequence[Direction], solution: Solution
) -> Fitted | None:
    """The step, halved until it helps; None if none does."""
    ordered = [directions[i] for i in solution.indices.tolist()]
    share = min(1.0, _LARGEST_STEPS / max(1e-9, float(np.max(np.abs(solution.step), initial=0.0))))
    for _ in range(_HALVINGS):
        try:
            step = (share * solution.step).tolist()
            model = point.model.with_parameters(moved_values(point.model, ordered, step))
            model = model.with_clocks(moved_clocks(model, ordered, step))
            tried = evaluate(workbench, model)
        except ModelError:
            share *= 0.25
            continue
        if tried.chi2 < point.chi2:
            return tried
        share *= 0.4
    return None
