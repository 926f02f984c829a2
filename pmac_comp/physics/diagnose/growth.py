"""The growth loop: screen, refit the leaders, let the best earn its place, go round again.

What lives here: the order of work. The rules by which a candidate is accepted or tied stand in
``acceptance``. May import the rest of this package.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ModelError
from pmac_comp.physics.diagnose.acceptance import Round, best, earned, tied_with
from pmac_comp.physics.diagnose.contenders import (
    ELEMENTARY,
    Contender,
    Ground,
    Rules,
    afresh,
    contend,
    judged,
    leaders,
    polished,
)
from pmac_comp.physics.diagnose.imitations import true_name
from pmac_comp.physics.diagnose.lookalikes import alike
from pmac_comp.physics.diagnose.noise import noise_floor_um
from pmac_comp.physics.diagnose.onset import with_onset
from pmac_comp.physics.diagnose.records import gap
from pmac_comp.physics.diagnose.refit import Fitted, Frozen, evaluate, refit, settled
from pmac_comp.physics.diagnose.screen import (
    Look,
    Screening,
    look,
    noise_like,
    refreshed,
    screen,
)
from pmac_comp.physics.diagnose.widening import wider
from pmac_comp.physics.diagnose.workbench import Noise, Workbench
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import Effect, split_name

Progress = Callable[[str], None]
# Drop of chi-square per sample, and number of effects, that are looked at afresh in later rounds.
_HINT = 0.002
_MOST_FRESH = 10
# Where a few steps of the others leave so much chi-square per sample, and so much of what an effect
# explained, more steps do not replace it.
_FIRST_LESS, _MORE_LESS = 3, 5
_MISSED, _SLOWLY = 0.5, 0.1


@dataclass(frozen=True)
class Grown:
    """Result of the loop.

    Parameters
    ----------
    bench : Workbench
        With the last noise estimate.
    base, final : Fitted
        Refitted base model and grown model.
    rounds : tuple of Round
        All rounds, the last one without an accepted candidate unless the limit was reached.
    open_SI : Mapping of str to float
        Per parameter, how far it still moved between the last refits.
    """

    bench: Workbench
    base: Fitted
    final: Fitted
    rounds: tuple[Round, ...] = field(default=())
    open_SI: Mapping[str, float] = field(default_factory=dict)

    @property
    def accepted(self) -> tuple[Contender, ...]:
        """Accepted candidates in order."""
        return _accepted(self.rounds)

    def final_on(self, part: Workbench) -> Fitted:
        """The grown model evaluated on some of the records."""
        return evaluate(part, self.final.model)


def _accepted(rounds: Sequence[Round]) -> tuple[Contender, ...]:
    return tuple(r.accepted for r in rounds if r.accepted is not None)


def first_noise(bench: Workbench, model: DriveModel) -> Workbench:
    """Weights before any data was explained: what the sensors' steps do inside the loop."""
    rounded, floor_m = bench.rounded(model), sensor_floor_m(bench, model)
    unruly = bench.unruly(model, rounded)
    noise = Noise(bench.noise_from(rounded, floor_m).whitener, None, bench.doubtful(model), unruly)
    bench = bench.with_noise(noise)
    return bench.with_noise(replace(bench.noise_from(rounded, floor_m), robust=None))


def sensor_floor_m(bench: Workbench, model: DriveModel) -> FloatArray:
    """Least innovation per channel: a tenth of what one coarse sample resolves."""
    description = model.bench
    steps = [description.motor_resolution_m, description.scale_resolution_m or 0.0]
    coarse = 0.1 / np.sqrt(12.0 * bench.records[0].factor)
    return np.asarray(np.maximum(coarse * np.array(steps[: bench.channels]), 1e-10))


def grow(
    bench: Workbench,
    start: DriveModel,
    library: Mapping[str, Effect],
    rules: Rules,
    progress: Progress,
) -> Grown:
    """Refit the base, then add effects while one earns its place.

    Parameters
    ----------
    bench : Workbench
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
    bench = first_noise(bench, start)
    part = bench.fitting_bench()
    point = refit(part, evaluate(part, start), rounds=8)
    rounds: list[Round] = []
    base: Fitted | None = None
    seen: Look | None = None
    for number in range(1, rules.most_effects + 2):
        progress(f"round {number}: looking at {len(library)} effects")
        rounds = [*map(_slim, rounds)]
        bench, point, screening, seen = _look_around(bench, point, library, seen)
        whole = evaluate(bench, point.model)
        base = whole if base is None else base
        done = _round(bench, whole, screening, library, rules, progress)
        if number > rules.most_effects:
            done = replace(done, accepted=None, tied=())
        rounds.append(done)
        if done.accepted is None:
            break
        progress(f"round {number}: {done.accepted.effect} earns its place")
        whole, rounds = _renamed(bench, done.accepted.fitted, rounds, library, rules, progress)
        whole, rounds = _widened(bench, whole, rounds, library, rules, progress)
        whole, rounds = _pruned(bench, whole, rounds, library, rules, progress)
        point = evaluate(bench.fitting_bench(), whole.model)
    open_SI: Mapping[str, float] = {}
    if _accepted(rounds):
        progress("settling all parameters")
        part = bench.fitting_bench()
        point, open_SI = settled(part, evaluate(part, point.model))
        grown, kept = evaluate(bench, point.model), rounds
        whole, rounds = _renamed(bench, grown, kept, library, rules, progress)
        whole, rounds = _pruned(bench, whole, rounds, library, rules, progress)
        if whole is not grown:
            point, open_SI = settled(part, evaluate(part, whole.model))
    progress("looking at how friction sets in")
    final = with_onset(bench, evaluate(bench, point.model))
    grew = base is not None and bool(_accepted(rounds))
    base_model = evaluate(bench, base.model) if base is not None and grew else final
    return Grown(bench, base_model, final, tuple(rounds), open_SI)


def _renamed(
    bench: Workbench,
    whole: Fitted,
    rounds: Sequence[Round],
    library: Mapping[str, Effect],
    rules: Rules,
    progress: Progress,
) -> tuple[Fitted, list[Round]]:
    """The model with effects in corners of their range replaced by those that they are there.

    A cable whose rest lies far outside the travel is a bias: it would be withheld as a name, and
    what it stands for has one.
    """
    kept = list(rounds)
    for i, done in enumerate(kept):
        name = "" if done.accepted is None else true_name(done.accepted.effect, whole.model)
        present = {split_name(n)[0] for n in whole.model.effects}
        if done.accepted is None or name not in done.screening.starts or name in present:
            continue
        progress(f"{done.accepted.effect} is {name} here: refitting with that")
        found = _instead(bench, whole, done, name, library)
        if found is None or not earned(found[0], found[1], rules):
            continue
        tied = tuple(n for n in done.tied if n != name and alike(n, name, library))
        kept[i] = replace(done, accepted=found[0], tied=tied)
        whole = found[0].fitted
    return whole, kept


def _instead(
    bench: Workbench, whole: Fitted, done: Round, name: str, library: Mapping[str, Effect]
) -> tuple[Contender, Round] | None:
    """Another effect in the place of a round's, with the round judged against neither of them."""
    if done.accepted is None:
        return None
    part = bench.fitting_bench()
    bare = whole.model.without_effect(done.accepted.effect)
    try:
        less = evaluate(bench, refit(part, evaluate(part, bare), rounds=_MORE_LESS).model)
    except ModelError:
        return None
    start = replace(done.screening.starts[name][0], own_SI={})
    tried = contend(Ground.of(bench, less, library), start, Frozen((), []))
    left = gap(bench.calm_records, less.model, bench.executor)
    return (tried[0], done.judged_against(left)) if tried else None


def _widened(
    bench: Workbench,
    whole: Fitted,
    rounds: Sequence[Round],
    library: Mapping[str, Effect],
    rules: Rules,
    progress: Progress,
) -> tuple[Fitted, list[Round]]:
    """The model with accepted effects at further places where those earn themselves."""
    kept = list(rounds)
    for i, done in enumerate(kept):
        if done.accepted is None or not library[done.accepted.effect].joint_places:
            continue
        found = wider(Ground.of(bench, whole, library), done.accepted)
        left = gap(bench.calm_records, whole.model, bench.executor)
        if found is None or not earned(found, done.judged_against(left), rules):
            continue
        progress(f"{done.accepted.effect} acts at further places: {found.key}")
        whole = found.fitted
        both = replace(
            found,
            fit_gain=found.fit_gain + done.accepted.fit_gain,
            judged_gain=found.judged_gain + done.accepted.judged_gain,
        )
        kept[i] = replace(done, accepted=both)
    return whole, kept


def _pruned(
    bench: Workbench,
    whole: Fitted,
    rounds: Sequence[Round],
    library: Mapping[str, Effect],
    rules: Rules,
    progress: Progress,
) -> tuple[Fitted, list[Round]]:
    """The model less the effects that no longer earn their place beside the later ones.

    What was added first stood for everything that was missing then; once its true cause is in the
    model, an imitation has nothing left to explain.
    """
    kept = list(rounds)
    while len(_accepted(kept)) > 1:
        for i, done in enumerate(kept):
            less = _without(bench, whole, done, library, rules)
            if less is not None:
                progress("an effect is no longer needed beside those found after it")
                kept[i] = replace(done, accepted=None, tied=())
                whole = less
                break
        else:
            break
    return whole, kept


def _without(
    bench: Workbench, whole: Fitted, done: Round, library: Mapping[str, Effect], rules: Rules
) -> Fitted | None:
    """The model refitted without a round's effect, or None where that earns its place.

    Elementary friction stays: every drive has it, and a flexible form can always stand in for it.
    """
    if done.accepted is None or done.accepted.effect in ELEMENTARY:
        return None
    part = bench.fitting_bench()
    try:
        bare = whole.model.without_effect(done.accepted.effect)
        begun, had = evaluate(part, bare), evaluate(part, whole.model).chi2
        fitted = refit(part, begun, rounds=_FIRST_LESS)
        lost = fitted.chi2 - had
        if lost > max(_MISSED * done.rows_fit, _SLOWLY * (begun.chi2 - had)):
            return None
        less = evaluate(bench, refit(part, fitted, rounds=_MORE_LESS).model)
    except ModelError:
        return None
    left = gap(bench.calm_records, less.model, bench.executor)
    back = judged(Ground.of(bench, less, library), done.accepted.screened, whole)
    needed = left.position_um > rules.widened * back.gap_um
    return None if needed or earned(back, done.judged_against(left), rules) else less


def _look_around(
    bench: Workbench, point: Fitted, library: Mapping[str, Effect], last: Look | None
) -> tuple[Workbench, Fitted, Screening, Look]:
    """Columns at the point, a fresh noise estimate, the point refitted under it, the ranking."""
    unruly = bench.unruly(point.model, bench.rounded(point.model))
    bench = bench.with_noise(replace(bench.known_noise, unruly=unruly))
    part = bench.fitting_bench()
    seen = look(part, point.model.bench, point, library, last)
    left = noise_like(part, point, seen)
    noise = part.noise_from(left, sensor_floor_m(part, point.model))
    part = part.with_noise(noise)
    moved = refit(part, evaluate(part, point.model), frozen=seen.frozen(), rounds=3)
    screening = screen(part, moved, seen)
    if seen.stale:
        seen = refreshed(part, point, seen, _promising(screening))
        screening = screen(part, moved, seen)
    return bench.with_noise(_spread(bench, noise)), moved, screening, seen


def _promising(screening: Screening) -> frozenset[str]:
    """Effects whose columns of an earlier round promise enough to be simulated afresh."""
    worth = [s for s in screening.ranked if s.fit_gain > _HINT * screening.rows_fit]
    return frozenset(s.start.effect for s in worth[:_MOST_FRESH])


def _slim(done: Round) -> Round:
    """A past round without its columns."""
    return replace(done, screening=replace(done.screening, frozen=Frozen((), [])))


def _spread(bench: Workbench, noise: Noise) -> Noise:
    """Noise of the fitting records for all records; judging samples are weighed alike."""
    weights, given = [], iter(noise.robust or ())
    for record, mask in zip(bench.records, bench.fitting, strict=True):
        whole = np.ones((record.usable.size, bench.channels))
        weights.append(next(given) if mask.any() and noise.robust is not None else whole)
    return replace(bench.known_noise, whitener=noise.whitener, robust=tuple(weights))


def _round(
    bench: Workbench,
    before: Fitted,
    screening: Screening,
    library: Mapping[str, Effect],
    rules: Rules,
    progress: Progress,
) -> Round:
    ground = Ground.of(bench, before, library)
    fits, rows = ground.fitting, ground.rows
    rows_fit, rows_judge = float(rows[fits].sum()), float(rows[~fits].sum())
    tried: list[Contender] = []
    for item in leaders(screening, rows_fit, library, rules):
        progress(f"refitting with {item.start.key}")
        tried += [*contend(ground, item, screening.frozen), *afresh(ground, screening, item)]
    contenders = polished(ground, tried)
    left = gap(bench.calm_records, before.model, bench.executor)
    floor_um = noise_floor_um(bench, before.model, calm=True)
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
    tied = tied_with(winner, contenders, library, rows, rules)
    return replace(bare, accepted=winner, tied=tied)
