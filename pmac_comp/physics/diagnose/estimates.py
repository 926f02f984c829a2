"""Parameters of named effects with intervals, and known parameters at the end of their tolerance.

What lives here: covariances that count the correlation of what is left. May import ``refit``.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.physics.diagnose.candidates import ADDITIONS, SPLIT_FRAC
from pmac_comp.physics.diagnose.gram import Gram, Prior, Solution
from pmac_comp.physics.diagnose.growth import Grown
from pmac_comp.physics.diagnose.refit import Fitted, linearised
from pmac_comp.physics.diagnose.result import Estimate, Finding
from pmac_comp.physics.diagnose.workbench import Columns, Direction, Noise, Workbench
from pmac_comp.physics.identify.result import Z95
from pmac_comp.physics.model.chain import USUAL_ONLY
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.parameters import ParameterSpec

_PINNED = 0.9
_BEYOND = 3.0
_LEAST_GROUPS = 4
_MOST_GROUPS = 12
# Where leaving out a part takes so much of what is known of a parameter, the rest does not tell how
# the parts differ: a torque limit is met in one run alone.
_LOST = 20.0
_UNDER_WHITENED = 0.7
# Of the guide's friction, that two careful models of the chain put down to other parts, at least.
_GUIDE_OPEN = 0.02
# A dead time and the lag of the current loop, and the known one of the other.
_LATE = {
    "actuator_delay": "chain.current_bandwidth_Hz",
    "current_bandwidth": "chain.actuator_delay_s",
}


@dataclass(frozen=True)
class Told:
    """A grown model linearised on the fitting samples.

    Parameters
    ----------
    part : Workbench
        Records that have fitting samples.
    point : Fitted
        The model on them.
    gram : Gram
        Products of its columns.
    directions : tuple of Direction
        What each column moves.
    columns : list of ndarray
        Columns per record.
    """

    part: Workbench
    point: Fitted
    gram: Gram
    directions: tuple[Direction, ...]
    columns: Columns

    @classmethod
    def of(cls, grown: Grown) -> "Told":
        """What the fitting samples tell about every parameter of a grown model."""
        part = grown.workbench.fitting_bench()
        point = grown.final_on(part)
        gram, directions, columns = linearised(part, point, None)
        return cls(part, point, gram, tuple(directions), columns)


def estimates_of(
    grown: Grown, told: Told, material: float
) -> tuple[tuple[Estimate, ...], tuple[Finding, ...]]:
    """Parameters of accepted effects with 95 % intervals; known parameters out of tolerance.

    Parameters
    ----------
    grown : Grown
        Result of the growth loop.
    told : Told
        Its model, linearised.
    material : float
        Least drop of chi-square per sample that a finding must be worth.

    Returns
    -------
    tuple of Estimate, tuple of Finding
        Values in the units of files. A finding is a known parameter that the data alone places
        outside its tolerance by more than three standard deviations.
    """
    model = grown.final.model
    part, point, directions, columns = told.part, told.point, told.directions, told.columns
    bounded = told.gram
    gram = bounded.with_bounds(_unbounded(bounded.prior))
    solution = gram.solve(range(gram.n_columns))
    spread = np.sqrt(np.maximum(np.diag(robust_covariance(gram, solution)), 0.0))
    spread = np.maximum(spread, jackknife_spread(gram))
    spread = np.hypot(spread, _weighting_spread(part, point, columns, gram.prior))
    names = {c.effect for c in grown.accepted}
    pairs = zip(directions, spread.tolist(), strict=True)
    known = {d.label: std * d.unit for d, std in pairs if d.run is None}
    found = [
        _estimate(model, direction, std, grown.open_SI.get(direction.label, 0.0), known)
        for direction, std in zip(directions, spread.tolist(), strict=True)
        if direction.label.partition(".")[0] in names
    ]
    return tuple(found), _findings(model, bounded, directions, material)


def _estimate(
    model: DriveModel,
    direction: Direction,
    std: float,
    moved_SI: float,
    known_SI: Mapping[str, float],
) -> Estimate:
    effect, _, bare = direction.label.partition(".")
    spec = model.spec(direction.label)
    value = spec.to_file(model.parameters[direction.label])
    open_ = _tolerance(model, effect, bare)
    if direction.label == "post_reversal_dip.fraction":
        # A fraction of the nut's friction, of which only the sum with the motor's is known.
        open_ = _open_share(model) * abs(model.parameters[direction.label])
    if direction.label == "friction_asymmetry.fraction":
        open_ = _open_guide(model, known_SI) * abs(model.parameters[direction.label])
    width = abs(spec.to_file(math.hypot(std * direction.unit, open_, moved_SI)))
    if effect in _LATE:
        width = math.hypot(width, abs(spec.to_file(_open_lateness(model, effect))))
    if spec.period:
        width = min(width, spec.to_file(0.5 * spec.period) / Z95)  # an angle is never more open
    name = f"{effect}.{spec.file_name or bare}"
    unit = spec.file_unit or spec.unit
    return Estimate(name, value, unit, width, value - Z95 * width, value + Z95 * width)


def _open_share(model: DriveModel) -> float:
    """How far the split of nut and motor friction may be off, as a share of the nut's part."""
    names = [n for n in ("coulomb.nut_Nm", "coulomb.motor_Nm") if n in model.parameters]
    if len(names) < 2:
        return 0.0
    present = [model.parameters[n] for n in names]
    usual = [model.spec(n).nominal for n in names]
    shares = [v[0] / sum(v) for v in (present, usual) if v[0] > 0.0]
    return SPLIT_FRAC / min(shares) if shares else 0.0


def _open_guide(model: DriveModel, known_SI: Mapping[str, float]) -> float:
    """How far the guide's viscous friction may be off, as a share, where a fraction is of that.

    Torque shows what guide, nut and motor take together. Which part is the guide's shows in a few
    tenths of a micrometre between motor and table, where whatever a model idealises about the chain
    pulls it in all runs alike: that is counted once more, beside the fraction's own spread.
    """
    name = "viscous.guide_Ns_per_m"
    if "friction_asymmetry@rotary" in model.effects or name not in known_SI:
        return 0.0
    value = abs(model.parameters[name])
    return math.hypot(_GUIDE_OPEN, known_SI[name] / value) if value > 0.0 else 0.0


def _open_lateness(model: DriveModel, effect: str) -> float:
    """What the bench's tolerance of the other of a dead time and a lag leaves open of one, in SI.

    A loop sees their sum, exactly; their shares it shows only well above its crossover, where what
    the model simplifies about the drive is as large as the difference.
    """
    other = _LATE[effect]
    if other not in model.parameters:
        return 0.0
    spec = model.spec(other)
    share = 0.5 * (spec.tolerance_frac or 0.0)
    if effect == "actuator_delay":
        return share / (2.0 * math.pi * spec.nominal)
    bandwidth_Hz = model.parameters["current_bandwidth.bandwidth_Hz"]
    return share * spec.nominal * 2.0 * math.pi * bandwidth_Hz**2


def _tolerance(model: DriveModel, effect: str, bare: str) -> float:
    """Standard deviation of the known parameter that an effect adds to, in SI."""
    known = ADDITIONS.get(effect)
    if known is None or known not in model.parameters or bare not in known:
        return 0.0
    spec = model.spec(known)
    return 0.5 * abs(spec.nominal) * (spec.tolerance_frac or 0.0)


def _unbounded(prior: Prior) -> Prior:
    """The priors free of bounds, about the present point: what an interval must count."""
    wide = np.full(prior.sigma.size, np.inf)
    return Prior(-wide, wide, np.zeros(prior.sigma.size), prior.sigma)


def robust_covariance(gram: Gram, solution: Solution) -> FloatArray:
    """Sandwich covariance from scores of blocks, shape (s, s), never below that of the weights.

    Source
    ------
    Liang and Zeger (1986): blocks of time are clusters, within which anything may be correlated.
    Priors enter as one further, independent observation of each parameter.
    """
    chosen = solution.indices
    part = gram.blocks[gram.fitting]
    scores = part[:, chosen, -1] - part[:, chosen][:, :, chosen] @ solution.step
    plain = solution.covariance
    meat = scores.T @ scores + np.diag(1.0 / gram.prior.sigma[chosen] ** 2)
    sandwich = plain @ meat @ plain
    larger = np.maximum(np.diag(sandwich), np.diag(plain))
    scale = np.sqrt(larger / np.maximum(np.diag(sandwich), 1e-300))
    return np.asarray(sandwich * np.outer(scale, scale))


def jackknife_spread(gram: Gram) -> FloatArray:
    """Standard deviation of each parameter from leaving out a part of the data, shape (k,).

    What a model lacks pulls its parameters differently in different runs; scores of blocks, which
    sum to zero at the optimum, do not show it. Widened so that 1.96 of it is a 95 % interval of
    Student's t. Parts without which a parameter is hardly known are no witness of its spread.

    Source
    ------
    Delete-a-group jackknife (Quenouille, Tukey).
    """
    groups = _groups(gram)
    count = int(groups.max()) + 1
    if count < _LEAST_GROUPS:
        return np.zeros(gram.n_columns)
    every = range(gram.n_columns)
    known = np.diag(gram.solve(every).covariance)
    steps = np.zeros((count, gram.n_columns))
    told = np.ones((count, gram.n_columns), dtype=np.bool_)
    for g in range(count):
        weights = (gram.fitting & (groups != g)).astype(np.float64)
        solution = gram.solve(every, weights=weights)
        steps[g] = solution.step
        told[g] = np.diag(solution.covariance) < _LOST * known
    parts = np.maximum(told.sum(axis=0), 1)
    away = np.where(told, steps - np.sum(steps * told, axis=0) / parts, 0.0)
    variance = (parts - 1) / parts * np.sum(away**2, axis=0)
    return np.asarray(np.sqrt(variance) * student.ppf(0.975, count - 1) / Z95)


def _weighting_spread(part: Workbench, point: Fitted, columns: Columns, prior: Prior) -> FloatArray:
    """How far parameters move when the same data is weighed otherwise.

    A true model gives the same answer under any weights, but for noise; what a model lacks does
    not, and pulls every part of the data alike, which leaving out parts cannot show. Where noise is
    slow, weights that whiten it less leave an answer by far noisier than the first: of what that
    moves, only what its own noise does not explain is counted.

    Source
    ------
    Hausman (1978): two estimators of which one is robust differ where the model is misspecified;
    the variance of the difference is the difference of the variances.
    """
    noise = part.noise
    if noise is None:
        return np.zeros(prior.sigma.size)
    softer = replace(noise.whitener, lags=_UNDER_WHITENED * noise.whitener.lags)
    residuals = part.residuals(point.simulated)
    every = range(prior.sigma.size)

    def weighed(noise: Noise) -> tuple[Gram, Solution]:
        gram = part.with_noise(noise).gram(residuals, columns, prior)
        return gram, gram.solve(every)

    first, under = weighed(noise), weighed(replace(noise, whitener=softer))
    same = [weighed(replace(noise, robust=None)), weighed(replace(noise, doubtful=None))]
    moved = [np.abs(solution.step - first[1].step) for _, solution in same]
    variances = [np.diag(robust_covariance(*fitted)) for fitted in (under, first)]
    by_noise = Z95**2 * np.maximum(variances[0] - variances[1], 0.0)
    beyond = (under[1].step - first[1].step) ** 2 - by_noise
    return np.asarray(np.max([*moved, np.sqrt(np.maximum(beyond, 0.0))], axis=0))


def _groups(gram: Gram) -> IntArray:
    """Part of the fitting data that each block belongs to: records, or pieces of few records."""
    of_record = np.zeros(gram.rows.size, np.int64) if gram.record is None else gram.record
    groups = np.full(gram.rows.size, -1)
    present = np.unique(of_record[gram.fitting])
    pieces = max(1, -(-_MOST_GROUPS // (2 * max(1, present.size))))
    for i, number in enumerate(present.tolist()):
        mine = np.flatnonzero(gram.fitting & (of_record == number))
        groups[mine] = i * pieces + np.arange(mine.size) * pieces // max(1, mine.size)
    return groups


def _findings(
    model: DriveModel, gram: Gram, directions: Sequence[Direction], material: float
) -> tuple[Finding, ...]:
    found = []
    held = gram.solve(range(gram.n_columns))
    for i, direction in enumerate(directions):
        if direction.run is not None:
            continue
        spec = model.spec(direction.label)
        width = abs(spec.nominal) * (spec.tolerance_frac or 0.0)
        value = model.parameters[spec.name]
        if spec.kind != "known" or width <= 0.0 or spec.name == USUAL_ONLY:
            continue
        if abs(value - spec.nominal) < _PINNED * width:
            continue
        freed = gram.prior.sigma.copy()
        freed[i] = np.inf
        lower, upper = gram.prior.lower.copy(), gram.prior.upper.copy()
        lower[i], upper[i] = -np.inf, np.inf
        alone = gram.with_bounds(Prior(lower, upper, gram.prior.centre, freed))
        solution = alone.solve(range(gram.n_columns))
        std = float(np.sqrt(max(robust_covariance(alone, solution)[i, i], 0.0)))
        free = value + direction.unit * float(solution.step[i])
        if abs(free - spec.nominal) - width < _BEYOND * std * direction.unit:
            continue
        # What the model lacks elsewhere drags parameters along: one must earn as an effect does.
        if held.chi2 - solution.chi2 < material * float(gram.rows[gram.fitting].sum()):
            continue
        found.append(_finding(spec, free, std * direction.unit))
    return tuple(found)


def _finding(spec: ParameterSpec, value: float, std: float) -> Finding:
    shown, nominal = spec.to_file(value), spec.to_file(spec.nominal)
    unit = spec.file_unit or spec.unit
    tolerance = spec.tolerance_frac or 0.0
    text = (
        f"{spec.file_name or spec.name} is outside its tolerance: {shown:.4g} +/- "
        f"{Z95 * abs(spec.to_file(std)):.2g} {unit}, bench file {nominal:.4g} {unit} "
        f"+/- {100 * tolerance:.0f} %"
    )
    return Finding(spec.name, shown, nominal, tolerance, text)


def finding_of(spec: ParameterSpec, part: Workbench, point: Fitted) -> Finding | None:
    """A quantity of the bench file where a model freed of its tolerance holds it; None within."""
    gram, directions, _ = linearised(part, point, None)
    gram = gram.with_bounds(_unbounded(gram.prior))
    index = next(i for i, d in enumerate(directions) if d.label == spec.name)
    solution = gram.solve(range(gram.n_columns))
    robust = np.sqrt(max(robust_covariance(gram, solution)[index, index], 0.0))
    std = float(max(robust, jackknife_spread(gram)[index])) * directions[index].unit
    value = point.model.parameters[spec.name]
    width = abs(spec.nominal) * (spec.tolerance_frac or 0.0)
    if abs(value - spec.nominal) - width < _BEYOND * std:
        return None
    return _finding(spec, value, std)


def possible(
    model: DriveModel, findings: Sequence[Finding]
) -> tuple[tuple[Finding, ...], tuple[str, ...]]:
    """Findings that can be, and what is to be said of those that cannot.

    A quantity freed of its tolerance goes where the gap's slope leads: where what the model lacks
    takes its shape, a stiffness may end below zero.
    """
    kept: list[Finding] = []
    names: list[str] = []
    for finding in findings:
        spec = model.spec(finding.parameter)
        if spec.lower <= spec.from_file(finding.value) <= spec.upper:
            kept.append(finding)
        else:
            names.append(spec.file_name or spec.name)
    told = (
        f"What is left looks like another {name}, but like none that can be: something that the "
        "model lacks takes its shape."
        for name in names
    )
    return tuple(kept), tuple(told)


def pulled(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Findings as what they are beside a remainder without a name: where that pulls the fit."""
    return tuple(
        replace(
            f,
            text=f"{f.text}; but what is left has no name, and the fit may only have moved "
            "this instead of that",
        )
        for f in findings
    )
