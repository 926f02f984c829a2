"""Candidates that are worth a refit of everything, and their evidence after it.

What lives here: which candidates contend, from which starts, and what each earns. No acceptance.
May import the rest of this package below ``growth``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.optimize import minimize_scalar

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.errors import ModelError
from pmac_comp.physics.diagnose.candidates import Start, relieved, started
from pmac_comp.physics.diagnose.clocks import free_clocks
from pmac_comp.physics.diagnose.lookalikes import alike, justified
from pmac_comp.physics.diagnose.records import gap
from pmac_comp.physics.diagnose.refit import (
    Fitted,
    Frozen,
    empty_gram,
    evaluate,
    refit,
    under_own_weights,
)
from pmac_comp.physics.diagnose.screen import Screened, Screening
from pmac_comp.physics.diagnose.statistics import (
    bic_gain,
    corrected_p,
    effective_size,
    rotation_p,
    sign_flip_p,
)
from pmac_comp.physics.diagnose.workbench import Workbench
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import Effect

ELEMENTARY = frozenset({"coulomb", "viscous"})
"""Friction that every drive has."""
_CLOSE = 0.9
# Share of the best gain from which on the second is worth a refit of everything.
_OPEN = 0.25
# A promise of so much chi-square per sample that a refit with few new columns does not keep to this
# share is refitted further with columns of its own.
_ROUNDS, _MORE_ROUNDS = 4, 8
_LARGE, _KEPT = 0.2, 0.5
# Effects that change the stability of the loop or act in events; from how many values they start
# anew.
_FRESH = frozenset({"actuator_delay", "current_bandwidth", "torque_saturation"})
_MOST_FRESH = 2
# Runs whose largest torques differ by less are not on two sides of a limit; levels between others.
_APART, _LEVELS, _PER_OCTAVE = 1.05, 6, 24
_EXACT = 1e-4  # share of a limit to which it is moved alone
# Friction at the guide, the same at the shaft with the power of the lead between, the shares of it
# that go there for backlash, and gaps that are tried beside each.
_AT_SHAFT = {
    # Force times lead is torque; a speed at the shaft is that of the table over the lead.
    "coulomb.guide_N": ("coulomb.motor_Nm", 1),
    "viscous.guide_Ns_per_m": ("viscous.motor_Nms_per_rad", 2),
}
_TAKEN_BACK = (0.5, 0.75)
_GAPS_m = (1e-6, 2e-6, 4e-6, 8e-6)
_LEADS = 0.5  # of the best candidate's gain: a search of limits takes seconds


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
    material_torque : float
        Share of the torque's mean square left that it may take out of that instead: a constant
        force is all in the integrator and hardly in a position.
    p_certain, material_certain : float
        What does instead where a mass, a delay or a current loop that the bench file states is
        off: a smaller drop of chi-square, if chance is out of the question.
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
    material_torque: float = 0.15
    p_certain: float = 1e-20
    material_certain: float = 0.016
    widened: float = 1.1
    p_value: float = 0.01
    tie_z: float = 3.0
    tie_material: float = 0.015
    tie_share: float = 0.97
    leaders: int = 4
    most_effects: int = 8


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
    torque_Nm: float | None = None
    cost: float = 0.0

    @property
    def gain(self) -> float:
        """What ranks: both gains together, less what times of their own cost the runs."""
        return self.fit_gain + self.judged_gain - self.cost


@dataclass(frozen=True)
class Ground:
    """What every candidate of a round stands on.

    Parameters
    ----------
    workbench : Workbench
        Records and weights.
    before : Fitted
        The model without any of them.
    fitting, rows : ndarray, shape (b,)
        Which blocks are fitted, and the samples of each.
    library : Mapping of str to Effect
        Candidates.
    """

    workbench: Workbench
    before: Fitted
    fitting: BoolArray
    rows: FloatArray
    library: Mapping[str, Effect]

    @classmethod
    def of(cls, workbench: Workbench, before: Fitted, library: Mapping[str, Effect]) -> "Ground":
        """The ground under a model."""
        gram = empty_gram(workbench, before.simulated)
        return cls(workbench, before, gram.fitting, gram.rows, library)


def leaders(
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
            names.add(name)
    # No linear step foretells these; where one of a pair leads, the other is tried all the same.
    chosen += [
        s
        for s in screening.ranked
        if s.start.effect in _FRESH - names and justified(s.start.effect, top.start.effect)
    ]
    second = screening.starts[top.start.effect][1:2]
    return [*chosen, *(s for s in second if s.fit_gain > 0.5 * top.fit_gain)]


def afresh(ground: Ground, screening: Screening, item: Screened) -> list[Contender]:
    """Refits from the bench's own values of what is known, for effects with minima of their own.

    While the effect was missing, the fit dragged what is known to the edges of its tolerance to
    imitate it; beside a delay near the truth those values may not even be stable.
    """
    nominal = {s.name: s.nominal for s in ground.before.model.specs if s.kind == "known"}
    fresh = ground.before.model.with_parameters(nominal)
    if item is screening.starts.get("backlash", (None,))[0]:
        return _loosened(ground, item, fresh)
    if item.start.effect not in _FRESH:
        return []
    part = ground.workbench.fitting_bench()
    leads = item.fit_gain > _LEADS * screening.ranked[0].fit_gain
    limits = item.start.effect == "torque_saturation" and leads
    begun = _limited(part, fresh, screening) if limits else []
    for start in screening.starts[item.start.effect]:
        model = _model_at(fresh, start.start, start.step, ground.library)
        try:
            begun.append((start, evaluate(part, model)))
        except ModelError:
            continue
    found = []
    for start, point in sorted(begun, key=lambda b: b[1].chi2)[:_MOST_FRESH]:
        fitted = refit(part, point, rounds=6)
        if limits:
            fitted = under_own_weights(part, fitted, rounds=6)
        found.append(judged(ground, start, evaluate(ground.workbench, fitted.model)))
    return found


def _loosened(ground: Ground, item: Screened, fresh: DriveModel) -> list[Contender]:
    """Refits of backlash with much of the guide's friction put at the shaft.

    Either holds the table back by the direction of motion: while the gap was missing, the fit took
    friction from the shaft to the guide, and beside that no step towards the gap helps.
    """
    part = ground.workbench.fitting_bench()
    found = []
    for share in _TAKEN_BACK:
        looser = fresh.with_parameters(_with_friction_at_shaft(fresh, share))
        begun = []
        for gap_m in _GAPS_m:
            try:
                begun.append(evaluate(part, looser.with_effect(item.start.key, {"gap_m": gap_m})))
            except ModelError:
                continue
        if begun:
            fitted = refit(part, min(begun, key=lambda b: b.chi2), rounds=_MORE_ROUNDS)
            found.append(judged(ground, item, evaluate(ground.workbench, fitted.model)))
    return found


def _with_friction_at_shaft(model: DriveModel, share: float) -> dict[str, float]:
    """Parameters with a share of each friction of the guide at the shaft, the sum as it was."""
    values: dict[str, float] = {}
    lead = model.bench.lead_m_per_rad
    for guide, (shaft, power) in _AT_SHAFT.items():
        if guide not in model.parameters or shaft not in model.parameters:
            continue
        taken = share * model.parameters[guide]
        values[guide] = model.parameters[guide] - taken
        values[shaft] = model.parameters[shaft] + taken * lead**power
    return values


def _limited(
    part: Workbench, fresh: DriveModel, screening: Screening
) -> list[tuple[Screened, Fitted]]:
    """Limits beside the friction of the runs that never meet them.

    Runs that met the limit made friction of it. Below it lies what the gentle runs ask for and
    above it what the others do, as their controllers go on asking: every such division is tried.
    """
    peaks = [
        0.0 if r.torque_Nm is None else float(np.max(np.abs(r.torque_Nm))) for r in part.records
    ]
    order = np.argsort(peaks).tolist()
    start = screening.starts["torque_saturation"][0]
    name = next(iter(start.start.values))
    found = []
    for count, (low, high) in enumerate(pairwise(sorted(peaks)), start=1):
        if low <= 0.0 or high < _APART * low:
            continue
        gentle = part.of(sorted(order[:count]))
        try:
            fitted = refit(gentle, evaluate(gentle, fresh), rounds=_ROUNDS)
            drive = under_own_weights(gentle, fitted, rounds=_ROUNDS).model
        except ModelError:
            continue
        met = part.of([order[count]])
        for limited in _best_levels(met, drive, start.start.key, name, (low, high)):
            try:
                found.append((start, evaluate(part, limited)))
            except ModelError:
                continue
    return sorted(found, key=lambda f: f[1].chi2)[:_MOST_FRESH]


def _best_levels(
    met: Workbench, drive: DriveModel, key: str, name: str, ends_Nm: tuple[float, float]
) -> list[DriveModel]:
    """The drive at the limits between two torques that fit best the gentlest run that meets one.

    The basin of a limit is narrow, a twentieth of it. Within it the limit alone is moved first: a
    refit of everything from half a level beside it shares that out among masses and friction, as
    torques, masses and friction of another scale move alike wherever the limit is met.
    """
    low, high = ends_Nm

    def left(limit_Nm: float) -> float:
        try:
            return evaluate(met, drive.with_effect(key, {name: limit_Nm})).chi2
        except ModelError:
            return np.inf

    levels = np.geomspace(low, high, max(_LEVELS, round(_PER_OCTAVE * np.log2(high / low))))
    ranked = sorted((left(limit), limit) for limit in levels.tolist())
    apart = float(levels[1] / levels[0])
    found = [
        minimize_scalar(
            left,
            bounds=(limit / apart, limit * apart),
            method="bounded",
            options={"xatol": _EXACT * limit},
        )
        for chi2, limit in ranked[:_MOST_FRESH]
        if np.isfinite(chi2)
    ]
    return [drive.with_effect(key, {name: float(f.x)}) for f in found]


def contend(ground: Ground, item: Screened, frozen: Frozen) -> list[Contender]:
    """Full joint refit of one candidate; nothing where no simulation stays finite."""
    part = ground.workbench.fitting_bench()
    begun = []
    # What the candidate takes over, the others must give up: both at once, unless that went too far
    # for a linear step.
    for own in (item.own_SI, {}):
        try:
            moved = ground.before.model.with_parameters(own)
            model = _model_at(moved, item.start, item.step, ground.library)
            begun.append(evaluate(part, model))
        except ModelError:
            continue
    if not begun:
        return []
    fitted = refit(part, min(begun, key=lambda b: b.chi2), frozen=frozen, rounds=_ROUNDS)
    rows_fit = float(ground.rows[ground.fitting].sum())
    promised, kept = item.fit_gain, ground.before.chi2 - fitted.chi2
    if promised > _LARGE * rows_fit and kept < _KEPT * promised:
        fitted = refit(part, fitted, rounds=_MORE_ROUNDS)
    return [judged(ground, item, evaluate(ground.workbench, fitted.model))]


def judged(ground: Ground, item: Screened, whole: Fitted) -> Contender:
    """A refitted candidate with its evidence."""
    workbench, before = ground.workbench, ground.before
    drop = before.blocks - whole.blocks
    gain = float(drop[ground.fitting].sum())
    size = effective_size(drop) / max(1, drop.size)
    rows = float(sum(np.count_nonzero(m) for m in workbench.fitting)) * workbench.channels
    times = free_clocks(whole.model) if item.start.clocks else 0
    parameters = len(ground.library[item.start.effect].parameters) + times
    left = gap(workbench.calm_records, whole.model, workbench.executor)
    return Contender(
        item.start.effect,
        item.start.key,
        item,
        whole,
        gain,
        float(drop[~ground.fitting].sum()),
        corrected_p(_by_chance(ground, whole, parameters), len(ground.library)),
        bic_gain(gain * size, parameters, rows * size),
        left.position_um,
        left.torque_Nm,
        times * float(np.log(rows)),
    )


def _by_chance(ground: Ground, whole: Fitted, parameters: int) -> float:
    """p-value of the better of two tests: many blocks that gain, or one event explained."""
    by_signs = sign_flip_p(ground.before.blocks - whole.blocks, seed=7)
    by_share = rotation_p(ground.before.blocks, whole.blocks, ground.rows, parameters=parameters)
    return min(1.0, 2.0 * min(by_signs, by_share))


def polished(ground: Ground, contenders: Sequence[Contender]) -> list[Contender]:
    """The best of every effect; the two best refitted anew where the order between them is open."""
    ranked = _best_of_each(contenders)
    if len(ranked) < 2 or ranked[1].gain < _OPEN * ranked[0].gain:
        return ranked
    part = ground.workbench.fitting_bench()
    best = []
    for contender in ranked[:2]:
        fitted = refit(part, evaluate(part, contender.fitted.model), rounds=3)
        whole = evaluate(ground.workbench, fitted.model)
        best.append(judged(ground, contender.screened, whole))
    return _best_of_each([*best, *ranked[2:]])


def _model_at(
    model: DriveModel, start: Start, step: Sequence[float], library: Mapping[str, Effect]
) -> DriveModel:
    """The model with the candidate at the size that the linearised refit found."""
    effect = library[start.effect]
    placed = model.with_effect(start.key, start.values, library={start.effect: effect})
    placed = placed.with_clocks(start.clocks or model.clocks)
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
    plain = [c for c in ranked if c.effect in ELEMENTARY and c.gain > _CLOSE * ranked[0].gain]
    return [*plain, *(c for c in ranked if c not in plain)]
