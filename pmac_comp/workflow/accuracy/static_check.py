"""Positioning after ISO 230-2: deviations at targets that are approached from both sides.

What lives here: the deviations of stored or fresh captures of a staircase, and the figures before
and after. What may not: the estimators (``physics.signals.metrics``), conversations.

A target is a place at which the axis rests after upward and after downward moves; the overrun
beyond the first and the last one is reached from one side only and does not count. The mean offset
between scale and encoder is unknown and cancels in every figure.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray, stretches
from pmac_comp.base.errors import CaptureError
from pmac_comp.base.units import MM_PER_M, UM_PER_M
from pmac_comp.files.capture import Capture
from pmac_comp.physics.signals.metrics import Positioning, positioning

STATIC_NAME = "positioning after ISO 230-2"
STATIC_RUNS = 5  # ISO 230-2:2014, clause 5.3.2
_RUNS = "Give runs of one `verify --static` on both sides."
_LEAST_REST_s = 0.15
READ_FRAC = 0.4  # last share of a rest that is averaged: the loop has settled
_SAME_m = 1e-6
_COVERAGE = 2.0  # of a standard deviation, as the standard has it
_STILL_m = 1e-10  # per sample: commanded position at rest
FIGURES = (
    ("reversal value B", "reversal_value_m"),
    ("mean reversal", "mean_reversal_m"),
    ("repeatability R", "repeatability_m"),
    ("systematic deviation E", "systematic_m"),
    ("mean bidirectional deviation M", "mean_bidirectional_m"),
    ("accuracy A", "accuracy_m"),
)


@dataclass(frozen=True)
class OneWay:
    """Figures of the approaches from one side only, in m (ISO 230-2:2014, clause 3)."""

    accuracy_m: float
    systematic_m: float
    repeatability_m: float

    @classmethod
    def of(cls, deviation_m: FloatArray) -> "OneWay":
        """Figures of deviations, shape (runs, targets)."""
        mean, double = deviation_m.mean(axis=0), _COVERAGE * deviation_m.std(axis=0, ddof=1)
        return cls(
            float(np.max(mean + double) - np.min(mean - double)),
            float(np.ptp(mean)),
            float(np.max(2.0 * double)),
        )


@dataclass(frozen=True)
class Approaches:
    """Deviations of several runs; table minus target.

    Parameters
    ----------
    target_m : ndarray, shape (p,)
        Targets in rising order.
    up_m, down_m : ndarray, shape (runs, p)
        Deviation of each run, approached upwards and downwards.
    motor_up_m, motor_down_m : ndarray, shape (runs, p)
        The motor's part of it: where it came to rest, less where it was to rest.
    """

    target_m: FloatArray
    up_m: FloatArray
    down_m: FloatArray
    motor_up_m: FloatArray
    motor_down_m: FloatArray

    def figures(self) -> Positioning:
        """Figures after ISO 230-2."""
        return positioning(self.up_m, self.down_m)

    def one_way(self) -> tuple[OneWay, OneWay]:
        """Figures of the upward and of the downward approaches alone."""
        return OneWay.of(self.up_m), OneWay.of(self.down_m)

    def of_motor(self) -> Positioning:
        """The same figures of the standing error that the servo leaves, e_c at rest."""
        return positioning(self.motor_up_m, self.motor_down_m)

    def of_mechanics(self) -> Positioning:
        """The same figures of what lies between motor and table, e_r at rest."""
        return positioning(self.up_m - self.motor_up_m, self.down_m - self.motor_down_m)


# Figures to which the motor's own stop contributes, of each part of the deviation.
_PARTS = (
    ("mean reversal: servo at rest", "mean_reversal_m", Approaches.of_motor),
    ("mean reversal: mechanical", "mean_reversal_m", Approaches.of_mechanics),
    ("repeatability: servo at rest", "repeatability_m", Approaches.of_motor),
    ("repeatability: mechanical", "repeatability_m", Approaches.of_mechanics),
)


@dataclass(frozen=True)
class StaticOutcome:
    """Positioning before and after; one of them is None where it was not measured."""

    before: Approaches | None
    after: Approaches | None
    captures: tuple[Capture, ...] = field(default=(), repr=False)

    @property
    def sides(self) -> tuple[tuple[str, Approaches], ...]:
        """What was measured, by name."""
        both = (("before", self.before), ("after", self.after))
        return tuple((name, side) for name, side in both if side is not None)

    def rows(self) -> list[tuple[str, float | None, float | None]]:
        """Figure, before, after; um."""
        before, after = (None if s is None else s.figures() for s in (self.before, self.after))
        rows = [(name, _figure_um(before, key), _figure_um(after, key)) for name, key in FIGURES]
        for name, key, part in _PARTS:
            first, second = (None if s is None else part(s) for s in (self.before, self.after))
            rows.append((name, _figure_um(first, key), _figure_um(second, key)))
        return rows

    def lines(self) -> list[str]:
        """Table for people."""
        n = max(side.up_m.shape[0] for _, side in self.sides)
        targets = self.sides[0][1].target_m
        out = [
            f"positioning by ISO 230-2: {targets.size} targets from "
            f"{targets[0] * MM_PER_M:.1f} to {targets[-1] * MM_PER_M:.1f} mm, {n} runs, um"
        ]
        for name, before, after in self.rows():
            out.append(f"  {name:32s} {_number(before)} > {_number(after)}")
        if n < STATIC_RUNS:
            out.append(f"  note: the standard wants {STATIC_RUNS} runs, these are {n}")
        return out

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        return {name: _side_result(side) for name, side in self.sides}


ONE_WAY = (
    ("accuracy A", "accuracy_m"),
    ("systematic deviation E", "systematic_m"),
    ("repeatability R", "repeatability_m"),
)


def _figure_um(found: Positioning | None, key: str) -> float | None:
    return None if found is None else float(getattr(found, key)) * UM_PER_M


def _number(value: float | None) -> str:
    return f"{'-':>8s}" if value is None else f"{value:8.3f}"


def _side_result(side: Approaches) -> dict[str, Any]:
    found = side.figures()
    names = ("reversal_B_um", "mean_reversal_um", "repeatability_R_um", "systematic_E_um",
             "mean_bidirectional_M_um", "accuracy_A_um")  # fmt: skip
    return {
        "runs": int(side.up_m.shape[0]),
        "target_mm": (side.target_m * MM_PER_M).tolist(),
        "mean_up_um": (found.mean_up_m * UM_PER_M).tolist(),
        "mean_down_um": (found.mean_down_m * UM_PER_M).tolist(),
        **{
            name: float(getattr(found, key) * UM_PER_M)
            for name, (_, key) in zip(names, FIGURES, strict=True)
        },
        "one_way_um": dict(zip(("up", "down"), map(_one_way_um, side.one_way()), strict=True)),
        "deviation_up_um": (side.up_m * UM_PER_M).tolist(),
        "deviation_down_um": (side.down_m * UM_PER_M).tolist(),
        "parts_um": {
            name: float(getattr(part(side), key) * UM_PER_M) for name, key, part in _PARTS
        },
    }


def _one_way_um(found: OneWay) -> dict[str, float]:
    names = ("accuracy_A", "systematic_E", "repeatability_R")
    values = (found.accuracy_m, found.systematic_m, found.repeatability_m)
    return {name: value * UM_PER_M for name, value in zip(names, values, strict=True)}


def approaches(captures: Sequence[Capture]) -> Approaches:
    """Deviations at the targets of staircases, one row per run.

    Raises
    ------
    CaptureError
        No table position, no target that is approached from both sides, or runs that differ.
    """
    runs = [_rests(capture) for capture in captures]
    targets = [_targets(up, down) for up, down in runs]
    if not targets or any(t.size != targets[0].size for t in targets):
        raise CaptureError(
            "The positioning runs have different targets, or there is none.",
            code="PC-ISO-002",
            hint=_RUNS,
        )
    if any(np.max(np.abs(t - targets[0])) > _SAME_m for t in targets):
        raise CaptureError(
            "The positioning runs have different targets.", code="PC-ISO-002", hint=_RUNS
        )
    pick = [[[_nearest(side, target) for target in targets[0]] for side in run] for run in runs]
    values = np.asarray(pick)
    up, down = values[:, 0], values[:, 1]
    return Approaches(targets[0], up[..., 1], down[..., 1], up[..., 2], down[..., 2])


Rest = tuple[float, float, float]  # target, deviation of the table and of the motor, m


def rests_of(capture: Capture) -> list[slice]:
    """Stretches over which the command rests long enough to be read."""
    still = np.abs(np.diff(capture.commanded_position_m, prepend=capture.commanded_position_m[0]))
    least = round(_LEAST_REST_s / capture.sample_period_s)
    return [rest for rest in stretches(still < _STILL_m) if rest.stop - rest.start >= least]


def _rests(capture: Capture) -> tuple[list[Rest], list[Rest]]:
    """Rests after upward and after downward moves."""
    if not capture.tells_desired:
        raise CaptureError(
            "A positioning run with compensation has no column desired_position_mm: where the "
            "motor should have stopped is not known.",
            code="PC-ISO-004",
            hint="Give the files that `verify` wrote, or leave the positioning runs out.",
        )
    if capture.table_position_m is None:
        raise CaptureError(
            "The capture has no table position.",
            code="PC-ISO-001",
            hint="ISO 230-2 figures need a scale at the table.",
        )
    r = capture.commanded_position_m
    deviation = capture.table_position_m - r
    standing = capture.motor_position_m - capture.desired_m
    up: list[Rest] = []
    down: list[Rest] = []
    last = float(r[0])
    for rest in rests_of(capture):
        first, end = rest.start, rest.stop
        place = float(r[first])
        part = slice(end - max(1, int(READ_FRAC * (end - first))), end)
        side = up if place > last + _SAME_m else down
        if abs(place - last) > _SAME_m:
            side.append((place, float(deviation[part].mean()), float(standing[part].mean())))
        last = place
    return up, down


def _targets(up: Sequence[Rest], down: Sequence[Rest]) -> FloatArray:
    """Places that were approached from both sides, rising."""
    low = np.asarray([place for place, _, _ in down])
    both = [place for place, _, _ in up if low.size and np.min(np.abs(low - place)) < _SAME_m]
    if not both:
        raise CaptureError(
            "No target is approached from both sides.",
            code="PC-ISO-003",
            hint="Run a staircase up and down, as "
            "`pmac-comp verify URL --bench FILE --compensation FILE --static 5` does.",
        )
    return np.sort(np.asarray(both))


def _nearest(side: Sequence[Rest], target: float) -> Rest:
    return min(side, key=lambda rest: abs(rest[0] - target))


def is_static(capture: Capture) -> bool:
    """Whether a capture is one of a positioning run."""
    return str(capture.attributes.get("motion", "")) == STATIC_NAME
