"""The growth loop: screen, refit the leaders, let the best earn its place, go round again.

What lives here: the order of work. The rules by which a candidate is accepted or tied stand in
``acceptance``, second thoughts about accepted ones in ``revision``. May import the rest of this
package.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from pmac_comp.base.progress import Tell
from pmac_comp.physics.diagnose.acceptance import Round, best, earned, tied_with
from pmac_comp.physics.diagnose.contenders import (
    Contender,
    Ground,
    Rules,
    afresh,
    contend,
    leaders,
    polished,
)
from pmac_comp.physics.diagnose.noise import noise_floor_um
from pmac_comp.physics.diagnose.onset import freed, not_outgrown, with_onset
from pmac_comp.physics.diagnose.records import gap
from pmac_comp.physics.diagnose.refit import Fitted, Frozen, evaluate, refit, settled
from pmac_comp.physics.diagnose.revision import Reviser, accepted_of
from pmac_comp.physics.diagnose.screen import (
    Look,
    Screening,
    look,
    noise_like,
    refreshed,
    screen,
)
from pmac_comp.physics.diagnose.workbench import Noise, Workbench
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import Effect

# Drop of chi-square per sample, and number of effects, that are looked at afresh in later rounds.
_HINT = 0.002
_MOST_FRESH = 10
# Friction that no bench file states may begin ten times too large, and no step takes more than a
# third of it: what a base fit that broke off on the way leaves gets any name. Where little is left
# to gain, going on bends the drive to what is missing.
_BASE_ROUNDS, _LEG_ROUNDS, _MOST_LEGS = 8, 4, 13
_ON_THE_WAY = 0.5  # of the misfit is left after a leg, at most
# Effects that later ones replace take rounds too, and no other's place.
_ROUNDS_PER_EFFECT = 2


@dataclass(frozen=True)
class Grown:
    """Result of the loop.

    Parameters
    ----------
    workbench : Workbench
        With the last noise estimate.
    base, final : Fitted
        Refitted base model and grown model.
    rounds : tuple of Round
        All rounds, the last one without an accepted candidate unless the limit was reached.
    open_SI : Mapping of str to float
        Per parameter, how far it still moved between the last refits.
    beside_onset : Screening or None
        What flexible rivals earn beside the final model, where its friction sets in over a
        distance that the model of the last round did not have.
    """

    workbench: Workbench
    base: Fitted
    final: Fitted
    rounds: tuple[Round, ...] = field(default=())
    open_SI: Mapping[str, float] = field(default_factory=dict)
    beside_onset: Screening | None = None

    @property
    def rivals(self) -> Screening:
        """The look that tells what flexible rivals earn beside the final model."""
        return self.rounds[-1].screening if self.beside_onset is None else self.beside_onset

    @property
    def accepted(self) -> tuple[Contender, ...]:
        """Accepted candidates in order."""
        return accepted_of(self.rounds)

    def final_on(self, part: Workbench) -> Fitted:
        """The grown model evaluated on some of the records."""
        return evaluate(part, self.final.model)


def first_noise(workbench: Workbench, model: DriveModel) -> Workbench:
    """Weights before any data was explained: what the sensors' steps do inside the loop."""
    rounded, floor_m = workbench.rounded(model), workbench.floor_m(model.bench)
    unruly = workbench.unruly(model, rounded)
    noise = Noise(
        workbench.noise_from(rounded, floor_m).whitener, None, workbench.doubtful(model), unruly
    )
    workbench = workbench.with_noise(noise)
    return workbench.with_noise(replace(workbench.noise_from(rounded, floor_m), robust=None))


def grow(
    workbench: Workbench,
    start: DriveModel,
    library: Mapping[str, Effect],
    rules: Rules,
    progress: Tell,
) -> Grown:
    """Refit the base, then add effects while one earns its place.

    Parameters
    ----------
    workbench : Workbench
        Records, no noise yet.
    start : DriveModel
        Base model.
    library : Mapping of str to Effect
        Candidates.
    rules : Rules
        Figures of the decisions.
    progress : callable
        Told in words what is being done.

    Returns
    -------
    Grown
    """
    progress("fitting the base model")
    workbench = first_noise(workbench, start)
    part = workbench.fitting_bench()
    point = _based(part, start)
    rounds: list[Round] = []
    base: Fitted | None = None
    seen: Look | None = None
    last = _ROUNDS_PER_EFFECT * rules.most_effects + 1
    for number in range(1, last + 1):
        progress(f"round {number}: looking at {len(library)} effects")
        rounds = [*map(_slim, rounds)]
        workbench, point, screening, seen = _look_around(workbench, point, library, seen)
        whole = evaluate(workbench, point.model)
        base = whole if base is None else base
        done = _round(workbench, whole, screening, library, rules, progress)
        if len(accepted_of(rounds)) >= rules.most_effects or number == last:
            done = replace(done, accepted=None, tied=())
        rounds.append(done)
        if done.accepted is None:
            break
        progress(f"round {number}: {done.accepted.effect} earns its place")
        reviser = Reviser(workbench, library, rules, progress)
        whole, rounds = reviser.renamed(done.accepted.fitted, rounds)
        whole, rounds = reviser.widened(whole, rounds)
        whole, rounds = reviser.pruned(whole, rounds)
        point = evaluate(workbench.fitting_bench(), whole.model)
    open_SI: Mapping[str, float] = {}
    if accepted_of(rounds):
        progress("settling all parameters")
        part = workbench.fitting_bench()
        point, open_SI = settled(part, evaluate(part, point.model))
        grown = evaluate(workbench, point.model)
        reviser = Reviser(workbench, library, rules, progress)
        whole, rounds = reviser.renamed(grown, rounds)
        whole, rounds = reviser.pruned(whole, rounds)
        if whole is not grown:
            point, open_SI = settled(part, evaluate(part, whole.model))
        rounds = reviser.likened(evaluate(workbench, point.model), rounds)
    progress("looking at how friction sets in")
    final = with_onset(workbench, evaluate(workbench, point.model))
    beside_onset: Screening | None = None
    if final.model.effects != point.model.effects:
        # What stood for how friction sets in need not stay beside it, nor do flexible rivals.
        final, rounds = Reviser(workbench, library, rules, progress).pruned(final, rounds)
        workbench = _calmed(workbench, final.model)
        final = not_outgrown(workbench, freed(workbench, final))
        beside_onset = _rivals_of(workbench, final.model)
    grew = base is not None and bool(accepted_of(rounds))
    base_model = evaluate(workbench, base.model) if base is not None and grew else final
    return Grown(workbench, base_model, final, tuple(rounds), open_SI, beside_onset)


def _based(workbench: Workbench, start: DriveModel) -> Fitted:
    """The base model fitted, on and on as long as most of the misfit goes."""
    point = refit(workbench, evaluate(workbench, start), rounds=_BASE_ROUNDS)
    for _ in range(_MOST_LEGS):
        further = refit(workbench, point, rounds=_LEG_ROUNDS)
        if further.chi2 > _ON_THE_WAY * point.chi2:
            break
        point = further
    return point


def _look_around(
    workbench: Workbench, point: Fitted, library: Mapping[str, Effect], last: Look | None
) -> tuple[Workbench, Fitted, Screening, Look]:
    """Columns at the point, a fresh noise estimate, the point refitted under it, the ranking."""
    workbench = _calmed(workbench, point.model)
    part = workbench.fitting_bench()
    seen = look(part, point.model.bench, point, library, last)
    left = noise_like(part, point, seen)
    noise = part.noise_from(left, part.floor_m(point.model.bench), foretold=False)
    part = part.with_noise(noise)
    moved = refit(part, evaluate(part, point.model), frozen=seen.frozen(), rounds=3)
    screening = screen(part, moved, seen)
    if seen.stale:
        seen = refreshed(part, point, seen, _promising(screening))
        screening = screen(part, moved, seen)
    return workbench.with_noise(_spread(workbench, noise)), moved, screening, seen


def _calmed(workbench: Workbench, model: DriveModel) -> Workbench:
    """The workbench without evidence from where, by this model, rounding decides the motion."""
    unruly = workbench.unruly(model, workbench.rounded(model))
    return workbench.with_noise(replace(workbench.known_noise, unruly=unruly))


def _rivals_of(workbench: Workbench, model: DriveModel) -> Screening:
    """What flexible rivals earn beside a model, without any candidate."""
    part = workbench.fitting_bench()
    point = evaluate(part, model)
    return screen(part, point, look(part, model.bench, point, {}))


def _promising(screening: Screening) -> frozenset[str]:
    """Effects whose columns of an earlier round promise enough to be simulated afresh."""
    worth = [s for s in screening.ranked if s.fit_gain > _HINT * screening.rows_fit]
    return frozenset(s.start.effect for s in worth[:_MOST_FRESH])


def _slim(done: Round) -> Round:
    """A past round without its columns."""
    return replace(done, screening=replace(done.screening, frozen=Frozen((), [])))


def _spread(workbench: Workbench, noise: Noise) -> Noise:
    """Noise of the fitting records for all records; judging samples are weighed alike."""
    weights, given = [], iter(noise.robust or ())
    for record, mask in zip(workbench.records, workbench.fitting, strict=True):
        whole = np.ones((record.usable.size, workbench.channels))
        weights.append(next(given) if mask.any() and noise.robust is not None else whole)
    return replace(workbench.known_noise, whitener=noise.whitener, robust=tuple(weights))


def _round(
    workbench: Workbench,
    before: Fitted,
    screening: Screening,
    library: Mapping[str, Effect],
    rules: Rules,
    progress: Tell,
) -> Round:
    ground = Ground.of(workbench, before, library)
    fits, rows = ground.fitting, ground.rows
    rows_fit, rows_judge = float(rows[fits].sum()), float(rows[~fits].sum())
    tried: list[Contender] = []
    for item in leaders(screening, rows_fit, library, rules):
        progress(f"refitting with {item.start.key}")
        tried += [*contend(ground, item, screening.frozen), *afresh(ground, screening, item)]
    contenders = polished(ground, tried)
    left = gap(workbench.calm_records, before.model, workbench.executor)
    floor_um = noise_floor_um(workbench, before.model, calm=True)
    bare = Round(
        before,
        screening,
        tuple(contenders),
        None,
        (),
        rows_fit,
        rows_judge,
        left.position_um,
        floor_um,
        left.torque_Nm,
    )
    winner = best([c for c in contenders if earned(c, bare, rules)], contenders, left.position_um)
    if winner is None:
        return bare
    tied = tied_with(winner, contenders, library, rows, rules, gap_um=left.position_um)
    return replace(bare, accepted=winner, tied=tied)
