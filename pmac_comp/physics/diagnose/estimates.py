"""Parameters of named effects with intervals, and known parameters at the end of their tolerance.

What lives here: covariances that count the correlation of what is left. May import ``refit``.
"""

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.diagnose.candidates import TEMPER
from pmac_comp.physics.diagnose.gram import Gram, Prior, Solution
from pmac_comp.physics.diagnose.growth import Grown
from pmac_comp.physics.diagnose.refit import linearised
from pmac_comp.physics.diagnose.result import Estimate, Finding
from pmac_comp.physics.identify.result import Z95

_PINNED = 0.985


def estimates_of(grown: Grown) -> tuple[Estimate, ...]:
    """Parameters of the accepted effects, in the unit of files, with 95 % intervals."""
    if not grown.accepted:
        return ()
    part = grown.bench.fitting_bench()
    model = grown.final.model
    gram, directions, _ = linearised(part, grown.final_on(part), None)
    gram = gram.with_bounds(untempered(gram.prior))
    solution = gram.solve(range(gram.n_columns))
    spread = np.sqrt(np.maximum(np.diag(robust_covariance(gram, solution)), 0.0))
    found = []
    names = {c.effect for c in grown.accepted}
    for direction, std in zip(directions, spread.tolist(), strict=True):
        effect, _, bare = direction.label.partition(".")
        if effect not in names:
            continue
        spec = model.spec(direction.label)
        value = spec.to_file(model.parameters[direction.label])
        width = abs(spec.to_file(std * direction.unit))
        name = f"{effect}.{spec.file_name or bare}"
        unit = spec.file_unit or spec.unit
        found.append(Estimate(name, value, unit, width, value - Z95 * width, value + Z95 * width))
    return tuple(found)


def untempered(prior: Prior) -> Prior:
    """Priors as the bench file states them, free of bounds: what an interval must count."""
    wide = np.full(prior.sigma.size, np.inf)
    return Prior(-wide, wide, np.zeros(prior.sigma.size), prior.sigma * np.sqrt(TEMPER))


def robust_covariance(gram: Gram, solution: Solution) -> FloatArray:
    """Sandwich covariance from the scores of the blocks, never below that of the weights.

    Source
    ------
    Liang and Zeger (1986): blocks of time are clusters, within which anything may be correlated.
    """
    chosen = solution.indices
    part = gram.blocks[gram.fitting]
    scores = part[:, chosen, -1] - part[:, chosen][:, :, chosen] @ solution.step
    meat = scores.T @ scores
    plain = solution.covariance
    sandwich = plain @ meat @ plain
    larger = np.maximum(np.diag(sandwich), np.diag(plain))
    scale = np.sqrt(larger / np.maximum(np.diag(sandwich), 1e-300))
    return np.asarray(sandwich * np.outer(scale, scale))


def findings_of(grown: Grown) -> tuple[Finding, ...]:
    """Known parameters that the refit pushed to the end of their tolerance, or beyond."""
    found = []
    model = grown.final.model
    for spec in model.specs:
        width = abs(spec.nominal) * (spec.tolerance_frac or 0.0)
        if spec.kind != "known" or width <= 0.0 or spec.name == "chain.damping_time_s":
            continue
        value = model.parameters[spec.name]
        if abs(value - spec.nominal) < _PINNED * width:
            continue
        shown, nominal = spec.to_file(value), spec.to_file(spec.nominal)
        unit = spec.file_unit or spec.unit
        text = (
            f"{spec.file_name or spec.name} is at the end of its tolerance: "
            f"{shown:.4g} {unit}, bench file {nominal:.4g} {unit} "
            f"+/- {100 * (spec.tolerance_frac or 0.0):.0f} %"
        )
        found.append(Finding(spec.name, shown, nominal, spec.tolerance_frac or 0.0, text))
    return tuple(found)
