"""The growth loop: screen, refit the leaders, let the best earn its place, go round again.

What lives here: the order of work and the rules by which a candidate is accepted, tied or dropped.
The rules' figures are collected in ``Rules``. May import the rest of this package.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.errors import ModelError
from pmac_comp.physics.diagnose.candidates import Start, relieved, started
from pmac_comp.physics.diagnose.lookalikes import alike, exact_twins, justified
from pmac_comp.physics.diagnose.noise import noise_floor_um
from pmac_comp.physics.diagnose.records import gap
from pmac_comp.physics.diagnose.refit import Fitted, Frozen, empty_gram, evaluate, refit, settled
from pmac_comp.physics.diagnose.screen import (
    Look,
    Screened,
    Screening,
    look,
    noise_like,
    refreshed,
    screen,
)
from pmac_comp.physics.diagnose.statistics import (
    bic_gain,
    corrected_p,
    effective_size,
    sign_flip_p,
    studentised,
)
from pmac_comp.physics.diagnose.workbench import Noise, Workbench
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import Effect

Progress = Callable[[str], None]
_ELEMENTARY = frozenset({"coulomb", "viscous"})
_CLOSE = 0.9
# Share of the best gain from which on the second is worth a refit of everything.
_OPEN = 0.25
# Drop of chi-square per sample, and number of effects, that are looked at afresh in later rounds.
_HINT = 0.002
_MOST_FRESH = 10


@dataclass(frozen=True)
class Rules:
    """Figures of the decisions.

    Parameters
    ----------
    material : float
        Least drop of chi-square per sample, on fitting and on judging samples alike: an effect
        that changes less than this share of the noise's variance is not worth a name, however
        significant it is (the model's own integration leaves about a quarter of it).
    overwhelming : float
        Multiple of ``material`` on fitting samples that need not be as large on judging ones.
    material_gap : float
        Share of the noise floor that a slow effect must take out of the gap instead.
    widened : float
        Multiple of the gap before beyond which a candidate widens what it should close.
    p_value : float
        Largest p-value, by sign flips over the blocks of fitting and judging runs together (a
        candidate's few parameters take a few units of chi-square of what it earns on the former),
        corrected for the number of candidates.
    tie_z : float
        Paired difference over its standard error below which look-alikes are tied.
    tie_material : float
        Difference per sample below which look-alikes are tied, significant or not.
    tie_share : float
        Share of the winner's gain that effects which are seldom inseparable must reach as well.
    leaders : int
        Candidates that get a full refit.
    most_effects : int
        Most effects added.
    """

    material: float = 0.04
    overwhelming: float = 4.0
    material_gap: float = 0.6
    widened: float = 1.1
    p_value: float = 0.01
    tie_z: float = 3.0
    tie_material: float = 0.015
    tie_share: float = 0.97
    leaders: int = 4
    most_effects: int = 4


@dataclass(frozen=True)
class Contender:
    """A candidate after its full joint refit, judged against the model without it."""

    effect: str
    key: str
    screened: Screened
    fitted: Fitted
    fit_gain: float
    judged_gain: float
    p_value: float
    bic_gain: float
    gap_um: float

    @property
    def gain(self) -> float:
        """What ranks: both gains together."""
        return self.fit_gain + self.judged_gain


@dataclass(frozen=True)
class Round:
    """One round of the loop."""

    before: Fitted
    screening: Screening
    contenders: tuple[Contender, ...]
    accepted: Contender | None
    tied: tuple[str, ...]
    rows_fit: float
    rows_judge: float
    gap_um: float
    floor_um: float


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
        return tuple(r.accepted for r in self.rounds if r.accepted is not None)

    def final_on(self, part: Workbench) -> Fitted:
        """The grown model evaluated on some of the records."""
        return evaluate(part, self.final.model)


def first_noise(bench: Workbench, model: DriveModel) -> Workbench:
    """Weights before any data was explained: what the sensors' steps do inside the loop."""
    sharp = bench.simulate([model])[0]

    def rounded(i: int) -> FloatArray:
        record = bench.records[i]
        response = record.response(model, quantise=True)
        return record.coarsen(record.channels_of(response)) - sharp[i]

    noise = list(bench.executor.map(rounded, range(len(bench.records))))
    whitener = bench.noise_from(noise, sensor_floor_m(bench, model)).whitener
    return bench.with_noise(Noise(whitener, None, bench.doubtful(model)))


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
        point = evaluate(bench.fitting_bench(), done.accepted.fitted.model)
    open_SI: Mapping[str, float] = {}
    if any(r.accepted is not None for r in rounds):
        progress("settling all parameters")
        part = bench.fitting_bench()
        point, open_SI = settled(part, evaluate(part, point.model))
    final = evaluate(bench, point.model)
    grew = base is not None and any(r.accepted is not None for r in rounds)
    base_model = evaluate(bench, base.model) if base is not None and grew else final
    return Grown(bench, base_model, final, tuple(rounds), open_SI)


def _look_around(
    bench: Workbench, point: Fitted, library: Mapping[str, Effect], last: Look | None
) -> tuple[Workbench, Fitted, Screening, Look]:
    """Columns at the point, a fresh noise estimate, the point refitted under it, the ranking."""
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
    doubtful = None if bench.noise is None else bench.noise.doubtful
    return Noise(noise.whitener, tuple(weights), doubtful)


def _round(
    bench: Workbench,
    before: Fitted,
    screening: Screening,
    library: Mapping[str, Effect],
    rules: Rules,
    progress: Progress,
) -> Round:
    gram = empty_gram(bench, before.simulated)
    fits, rows = gram.fitting, gram.rows
    rows_fit, rows_judge = float(rows[fits].sum()), float(rows[~fits].sum())
    contenders = []
    for item in _leaders(screening, rows_fit, library, rules):
        progress(f"refitting with {item.start.key}")
        contender = _contend(bench, before, screening, item, library, fits)
        if contender is not None:
            contenders.append(contender)
    contenders = _polished(bench, before, _best_of_each(contenders), library, fits)
    winner = contenders[0] if contenders else None
    gap_um = gap(bench.judging_records, before.model, bench.executor).position_um
    floor_um = noise_floor_um(bench, before.model)
    bare = Round(
        before, screening, tuple(contenders), None, (), rows_fit, rows_judge, gap_um, floor_um
    )
    if winner is None or not _earned(winner, bare, rules):
        return bare
    tied = _tied(winner, contenders, library, rows, rules)
    return replace(bare, accepted=winner, tied=tied)


def _leaders(
    screening: Screening, rows_fit: float, library: Mapping[str, Effect], rules: Rules
) -> list[Screened]:
    """Candidates worth a full refit: the best few, and the look-alikes of the very best."""
    worth = [s for s in screening.ranked if s.fit_gain > 0.1 * rules.material * rows_fit]
    if not worth:
        return []
    top = worth[0]
    chosen = [s for s in worth[: rules.leaders] if s.fit_gain > 0.05 * top.fit_gain]
    names = {s.start.effect for s in chosen}
    for item in worth:
        name = item.start.effect
        close = item.fit_gain > 0.2 * top.fit_gain
        if name not in names and close and alike(name, top.start.effect, library):
            chosen.append(item)
    second = screening.starts[top.start.effect][1:2]
    return [*chosen, *(s for s in second if s.fit_gain > 0.5 * top.fit_gain)]


def _contend(
    bench: Workbench,
    before: Fitted,
    screening: Screening,
    item: Screened,
    library: Mapping[str, Effect],
    fits: BoolArray,
) -> Contender | None:
    """Full joint refit of one candidate; None where no simulation stays finite."""
    part = bench.fitting_bench()
    start = item.start
    try:
        model = _model_at(before.model, start, item.step, library)
        fitted = refit(part, evaluate(part, model), frozen=screening.frozen, rounds=4)
        whole = evaluate(bench, fitted.model)
    except ModelError:
        return None
    return _contender(bench, before, item, whole, library, fits)


def _contender(
    bench: Workbench,
    before: Fitted,
    item: Screened,
    whole: Fitted,
    library: Mapping[str, Effect],
    fits: BoolArray,
) -> Contender:
    """A refitted candidate with its evidence."""
    start = item.start
    drop = before.blocks - whole.blocks
    judged = drop[~fits]
    gain = float(drop[fits].sum())
    size = effective_size(drop) / max(1, drop.size)
    rows = float(sum(np.count_nonzero(m) for m in bench.fitting)) * bench.channels
    parameters = len(library[start.effect].parameters)
    return Contender(
        start.effect,
        start.key,
        item,
        whole,
        gain,
        float(judged.sum()),
        corrected_p(sign_flip_p(drop, seed=len(start.key)), len(library)),
        bic_gain(gain * size, parameters, rows * size),
        gap(bench.judging_records, whole.model, bench.executor).position_um,
    )


def _polished(
    bench: Workbench,
    before: Fitted,
    contenders: Sequence[Contender],
    library: Mapping[str, Effect],
    fits: BoolArray,
) -> list[Contender]:
    """The two best refitted with columns of their own where the order between them is open."""
    if len(contenders) < 2 or contenders[1].gain < _OPEN * contenders[0].gain:
        return list(contenders)
    part = bench.fitting_bench()
    best = []
    for contender in contenders[:2]:
        fitted = refit(part, evaluate(part, contender.fitted.model), rounds=3)
        best.append(
            _contender(
                bench, before, contender.screened, evaluate(bench, fitted.model), library, fits
            )
        )
    return _best_of_each([*best, *contenders[2:]])


def _model_at(
    model: DriveModel, start: Start, step: Sequence[float], library: Mapping[str, Effect]
) -> DriveModel:
    """The model with the candidate at the size that the linearised refit found."""
    effect = library[start.effect]
    placed = model.with_effect(start.key, start.values, library={start.effect: effect})
    specs = tuple(
        replace(spec, name=spec.name.partition(".")[2])
        for spec in placed.specs
        if spec.name.startswith(f"{start.effect}.")
    )
    values = started(start, step, specs)
    placed = placed.with_parameters({f"{start.effect}.{k}": v for k, v in values.items()})
    return relieved(placed, start.effect)


def _best_of_each(contenders: Sequence[Contender]) -> list[Contender]:
    """The best start of every effect, best effect first."""
    best: dict[str, Contender] = {}
    for contender in sorted(contenders, key=lambda c: -c.gain):
        best.setdefault(contender.effect, contender)
    ranked = list(best.values())
    # Flexible forms can imitate elementary friction to a few per cent: the elementary one goes
    # first and the other may still earn its place beside it.
    plain = [c for c in ranked if c.effect in _ELEMENTARY and c.gain > _CLOSE * ranked[0].gain]
    return [*plain, *(c for c in ranked if c not in plain)]


def _earned(winner: Contender, done: Round, rules: Rules) -> bool:
    """Whether a candidate is worth a name: material, held out, and not by chance."""
    if winner.p_value >= rules.p_value or winner.bic_gain <= 0.0 or not _seen(winner.fitted.model):
        return False
    if winner.gap_um > rules.widened * done.gap_um:
        return False
    fit, judged = winner.fit_gain / done.rows_fit, winner.judged_gain / done.rows_judge
    if min(fit, judged) > rules.material:
        return True
    # Runs for judging need not excite what the fitting runs show beyond doubt.
    if fit > rules.overwhelming * rules.material and judged > 0.0:
        return True
    # Slow effects are large in um and small to a whitener that expects slow noise.
    closed_um2 = done.gap_um**2 - winner.gap_um**2
    return (
        min(fit, judged) > 0.1 * rules.material
        and closed_um2 > (rules.material_gap * done.floor_um) ** 2
    )


def _seen(model: DriveModel) -> bool:
    """Whether presliding is wider than one encoder step: below that it is Coulomb friction."""
    distance_m = model.parameters.get("presliding.distance_m")
    return distance_m is None or distance_m > model.bench.motor_resolution_m


def _tied(
    winner: Contender,
    contenders: Sequence[Contender],
    library: Mapping[str, Effect],
    rows: FloatArray,
    rules: Rules,
) -> tuple[str, ...]:
    """Look-alikes that the data cannot tell from the winner."""
    tied = [
        other.effect
        for other in contenders
        if other.effect != winner.effect
        and alike(other.effect, winner.effect, library)
        and _inseparable(winner, other, rows, rules)
    ]
    tied += [name for name in exact_twins(winner.effect, library) if name not in tied]
    return tuple(tied)


def _inseparable(winner: Contender, other: Contender, rows: FloatArray, rules: Rules) -> bool:
    lost = other.fitted.blocks - winner.fitted.blocks
    per_row = float(lost.sum()) / float(rows.sum())
    if not justified(winner.effect, other.effect):
        close = other.gain > rules.tie_share * winner.gain
        return close and per_row < rules.tie_material and studentised(lost) < rules.tie_z
    return per_row < rules.tie_material or studentised(lost) < rules.tie_z
