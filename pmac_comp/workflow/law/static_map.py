"""The static map of slow runs for a route: which dynamic part is removed, how far it may reach."""

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import NotIdentifiable
from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap, lead_map
from pmac_comp.workflow.law.rendering import lead_spacing_m

_HELD_FRAC = 0.02  # of the travel at each end: there the last measured value is held
_FADE_m = 0.01


class Limit(Enum):
    """What to do where a correction passes a limit."""

    REFUSE = "refuse"
    CLIP = "clip"


def static_map(
    bench: Bench,
    route: str,
    slow: Sequence[Capture],
    law: CompensationLaw,
    limit: Limit,
    per_turn_m: Sequence[FloatArray] = (),
) -> LeadMap:
    """Lead map of slow runs, cut to what was measured if the runs do not cover the travel.

    A route with a dynamic law or a known motion carries the friction's wind-up itself; for the
    route ``table`` it is part of the difference of the two directions and goes into the backlash
    table. ``per_turn_m`` is what the torque per turn makes of each run.

    Raises
    ------
    NotIdentifiable
        The runs cover a part of the travel only, and ``limit`` is to refuse.
    """
    none = dict.fromkeys(("coulomb_m", "stribeck_m", "gap_half_m", "drag_m"), 0.0)
    removed = law.with_values(**none) if route == "table" else law
    lead = bench_map(bench, slow, removed, per_turn_m)
    if covered_m(bench, lead) is None:
        return lead
    if limit is Limit.REFUSE:
        require_covered(bench, lead)
    return _faded(bench, lead)


def bench_map(
    bench: Bench,
    slow: Sequence[Capture],
    law: CompensationLaw | None = None,
    per_turn_m: Sequence[FloatArray] = (),
) -> LeadMap:
    """Lead map with the knots of a bench's table; as ``lead_map`` else."""
    return lead_map(
        slow,
        law,
        spacing_m=lead_spacing_m(bench),
        turn_m=bench.pitch_m,
        per_turn_m=per_turn_m,
    )


def require_covered(bench: Bench, lead: LeadMap) -> None:
    """Refuse a map of a part of the travel only.

    Raises
    ------
    NotIdentifiable
        The slow runs do not reach over the travel.
    """
    covered = covered_m(bench, lead)
    if covered is None:
        return
    low, high = (value * MM_PER_M for value in covered)
    raise NotIdentifiable(
        f"The slow runs cover {low:.1f} to {high:.1f} mm of the travel "
        f"{bench.travel.min_mm:g} to {bench.travel.max_mm:g} mm: a table over the travel would "
        "be a guess.",
        code="PC-LEAD-011",
        hint="Capture the whole travel: "
        "`pmac-comp capture URL --bench FILE --campaign lead --out FOLDER`; or correct only what "
        "was measured with --limit.",
    )


def covered_m(bench: Bench, lead: LeadMap) -> tuple[float, float] | None:
    """Range in m that was measured, None if that is the travel but for little at its ends."""
    low, high = bench.travel_m
    known = np.flatnonzero((lead.error_m != 0.0) | (lead.reversal_m != 0.0))
    if known.size == 0:
        return None
    first, last = lead.position_m[known[0]], lead.position_m[known[-1]]
    most = _HELD_FRAC * (high - low) + lead.spacing_m
    inside = first - low <= most and high - last <= most
    return None if inside else (float(first), float(last))


def _faded(bench: Bench, lead: LeadMap) -> LeadMap:
    """The map over the whole travel; beyond what was measured it runs to zero within 10 mm."""
    low, high = bench.travel_m
    spacing, first, last = lead.spacing_m, lead.position_m[0], lead.position_m[-1]
    before = np.arange(1, max(1, round((first - low) / spacing)) + 1)[::-1]
    after = np.arange(1, max(1, round((high - last) / spacing)) + 1)
    fades = [np.clip(1.0 - steps * spacing / _FADE_m, 0.0, 1.0) for steps in (before, after)]

    def extended(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values[0] * fades[0], values, values[-1] * fades[1]])

    position = np.concatenate([first - before * spacing, lead.position_m, last + after * spacing])
    return replace(
        lead,
        position_m=position,
        error_m=extended(lead.error_m),
        reversal_m=extended(lead.reversal_m),
    )
