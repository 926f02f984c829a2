"""The sheet of a positioning test as it is handed over: figures both ways and one way, run scheme.

What lives here: what stands on the sheet of ISO 230-2, computed from the approaches. What may not:
reading captures (``static_check``), layout (``report``).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import MM_PER_M, UM_PER_M
from pmac_comp.files.capture import Capture, told_by
from pmac_comp.workflow.accuracy.static_check import (
    FIGURES,
    ONE_WAY,
    READ_FRAC,
    STATIC_RUNS,
    Approaches,
    StaticOutcome,
    rests_of,
)

_ORDER = (
    "accuracy A", "systematic deviation E", "mean bidirectional deviation M", "repeatability R",
    "reversal value B", "mean reversal",
)  # fmt: skip
_TO_THE_SECOND = 19  # characters of an ISO 8601 time

Row = tuple[str, float | None, float | None]


@dataclass(frozen=True)
class TargetRow:
    """One target (mm); mean and std upwards, the same downwards, and the reversal value (um)."""

    target_mm: float
    figures_um: tuple[float, ...]


def sheet_rows(static: StaticOutcome) -> list[Row]:
    """Figure, before, after; um: both ways, each way alone, then what motor and mechanics add."""
    rows = static.rows()
    n = len(FIGURES)
    both = sorted(rows[:n], key=lambda row: _ORDER.index(row[0]))
    return [*both, *_one_way_rows(static), *rows[n:]]


def _one_way_rows(static: StaticOutcome) -> list[Row]:
    pairs = [None if s is None else s.one_way() for s in (static.before, static.after)]
    rows: list[Row] = []
    for name, key in ONE_WAY:
        for way, arrow in enumerate("↑↓"):
            values = [None if p is None else getattr(p[way], key) * UM_PER_M for p in pairs]
            rows.append((f"{name} {arrow}", values[0], values[1]))
    return rows


def by_target(side: Approaches) -> list[TargetRow]:
    """Target by target, less the mean of all deviations."""
    middle = float(np.mean([side.up_m, side.down_m]))
    up, down = side.up_m.mean(axis=0) - middle, side.down_m.mean(axis=0) - middle
    spread = [values.std(axis=0, ddof=1) for values in (side.up_m, side.down_m)]
    columns = np.stack([up, spread[0], down, spread[1], up - down]) * UM_PER_M
    return [
        TargetRow(float(target * MM_PER_M), tuple(map(float, column)))
        for target, column in zip(side.target_m, columns.T, strict=True)
    ]


def run_scheme(static: StaticOutcome) -> list[tuple[str, str]]:
    """How it was measured: item and value; what no capture tells is left out."""
    targets = static.sides[0][1].target_m * MM_PER_M
    runs = ", ".join(f"{side.up_m.shape[0]} {name}" for name, side in static.sides)
    out = [
        ("targets", f"{targets.size}, from {targets[0]:.3f} to {targets[-1]:.3f} mm"),
        ("approaches of a target from each side", f"{runs}; the standard wants {STATIC_RUNS}"),
        ("order", "up through all targets, then down; runs before and after take turns"),
    ]
    return out + (_as_run(static.captures, targets) if static.captures else [])


def _as_run(captures: Sequence[Capture], target_mm: FloatArray) -> list[tuple[str, str]]:
    """Overrun, speed and rests of runs that are alike, and when they were made."""
    first = captures[0]
    r_mm, period_s = first.commanded_position_m * MM_PER_M, first.sample_period_s
    beyond_mm = max(target_mm[0] - r_mm.min(), r_mm.max() - target_mm[-1])
    fastest_mm_per_s = float(np.max(np.abs(np.diff(r_mm)))) / period_s
    rest_s = float(np.median([rest.stop - rest.start for rest in rests_of(first)])) * period_s
    out = [
        ("overrun beyond the first and last target", f"{beyond_mm:.1f} mm"),
        ("speed between targets, at most", f"{fastest_mm_per_s:.0f} mm/s"),
        ("rest at a target", f"{rest_s:.2f} s; its last {100 * READ_FRAC:.0f} % are averaged"),
    ]
    return [*out, *begun(sorted(told_by(captures, "start_utc")))]


def begun(starts: Sequence[str]) -> list[tuple[str, str]]:
    """When the first and the last of runs began: item and value, from sorted ISO 8601 times."""
    if not starts:
        return []
    first, last = (text[:_TO_THE_SECOND].replace("T", " ") for text in (starts[0], starts[-1]))
    return [("first and last run begun", f"{first} and {last} UTC")]
