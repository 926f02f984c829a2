"""Parameters of named effects with intervals, and known parameters at the end of their tolerance.

What lives here: covariances that count the correlation of what is left. May import ``refit``.
"""

import math
from collections.abc import Sequence

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.diagnose.candidates import ADDITIONS
from pmac_comp.physics.diagnose.gram import Gram, Prior, Solution
from pmac_comp.physics.diagnose.growth import Grown
from pmac_comp.physics.diagnose.refit import linearised
from pmac_comp.physics.diagnose.result import Estimate, Finding
from pmac_comp.physics.diagnose.workbench import Direction
from pmac_comp.physics.identify.result import Z95
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.parameters import ParameterSpec

_PINNED = 0.9
_BEYOND = 3.0


def estimates_of(grown: Grown, material: float) -> tuple[tuple[Estimate, ...], tuple[Finding, ...]]:
    """Parameters of accepted effects with 95 % intervals; known parameters out of tolerance.

    Parameters
    ----------
    grown : Grown
        Result of the growth loop.
    material : float
        Least drop of chi-square per sample that a finding must be worth.

    Returns
    -------
    tuple of Estimate, tuple of Finding
        Values in the units of files. A finding is a known parameter that the data alone places
        outside its tolerance by more than three standard deviations.
    """
    part = grown.bench.fitting_bench()
    model = grown.final.model
    gram, directions, _ = linearised(part, grown.final_on(part), None)
    bounded = gram
    gram = gram.with_bounds(_unbounded(gram.prior))
    solution = gram.solve(range(gram.n_columns))
    spread = np.sqrt(np.maximum(np.diag(robust_covariance(gram, solution)), 0.0))
    names = {c.effect for c in grown.accepted}
    found = [
        _estimate(model, direction, std)
        for direction, std in zip(directions, spread.tolist(), strict=True)
        if direction.label.partition(".")[0] in names
    ]
    return tuple(found), _findings(model, bounded, directions, material)


def _estimate(model: DriveModel, direction: Direction, std: float) -> Estimate:
    effect, _, bare = direction.label.partition(".")
    spec = model.spec(direction.label)
    value = spec.to_file(model.parameters[direction.label])
    width = abs(spec.to_file(math.hypot(std * direction.unit, _tolerance(model, effect, bare))))
    name = f"{effect}.{spec.file_name or bare}"
    unit = spec.file_unit or spec.unit
    return Estimate(name, value, unit, width, value - Z95 * width, value + Z95 * width)


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
    """Sandwich covariance from the scores of the blocks, never below that of the weights.

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


def _findings(
    model: DriveModel, gram: Gram, directions: Sequence[Direction], material: float
) -> tuple[Finding, ...]:
    found = []
    held = gram.solve(range(gram.n_columns))
    for i, direction in enumerate(directions):
        spec = model.spec(direction.label)
        width = abs(spec.nominal) * (spec.tolerance_frac or 0.0)
        value = model.parameters[spec.name]
        if spec.kind != "known" or width <= 0.0 or spec.name == "chain.damping_time_s":
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
