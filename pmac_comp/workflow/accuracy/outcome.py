"""Errors before and after in the terms of README, Words: signals, statistics, the promise.

What lives here: pure functions of captures. What may not: conversations, plots (``report``).

A constant offset between scale and encoder is unknown on any machine, so the mean of a run is
taken out of every error signal, before and after alike; the lead map is taken out of the
mechanical error, less what the compensation table gives.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import CaptureError
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.workflow.accuracy.late_scale import read_together

PROMISED = ("e_r_after", "total_after")  # what a promise gives with an interval
ROUNDING = "e_r_rounding_um"  # what the encoder's steps make of e_r through the loop, by the model
WORSE = 1.03  # after over before: less is within what motions differ by
_BLOCK_s = 0.1
_DRAWS = 400
_SEED = 20_261


def quadratic_mean(values: Sequence[float]) -> float:
    """Error of all motions from the rms of each, in its unit; zero without any."""
    return float((sum(v * v for v in values) / max(len(values), 1)) ** 0.5)


@dataclass(frozen=True)
class ErrorSignals:
    """Errors of one run in m, mean taken out; shape (n,) each.

    ``mechanical`` is e without and e_r with compensation, ``control`` e_c, ``total`` their sum.
    NaN where the desired position is not known.
    """

    time_s: FloatArray
    mechanical_m: FloatArray
    control_m: FloatArray
    total_m: FloatArray


def error_signals(
    capture: Capture,
    lead: LeadMap | None = None,
    table_correction: Callable[[FloatArray], FloatArray] | None = None,
    scale_age_s: float = 0.0,
) -> ErrorSignals:
    """Error signals of a capture.

    Parameters
    ----------
    capture : Capture
        With a table position.
    lead : LeadMap or None
        Static error that is not part of the mechanical error.
    table_correction : callable or None
        Correction in m that a compensation table added at a position, for runs in which it was on.
    scale_age_s : float
        Time by which the scale is read after the encoder, taken out.

    Raises
    ------
    CaptureError
        No table position.
    """
    table = read_together(capture, scale_age_s).table_position_m
    if table is None:
        raise CaptureError(
            "The capture has no table position.",
            code="PC-VER-001",
            hint="Verification at the table needs a scale.",
        )
    r, desired = capture.commanded_position_m, capture.desired_m
    mechanical = table - capture.motor_position_m + (desired - r)
    if lead is not None:
        mechanical = mechanical - lead.at(r)
    if table_correction is not None:
        mechanical = mechanical - table_correction(r)
    use = capture.mask
    control = capture.motor_position_m - desired
    if not capture.tells_desired:
        mechanical, control = np.full((2, r.size), np.nan)
    signals = [mechanical, control, table - r]
    centred = [values - float(np.mean(values[use])) for values in signals]
    return ErrorSignals(capture.time_s, *centred)


@dataclass(frozen=True)
class Spread:
    """An rms value with its 95 % interval, um; NaN where it cannot be told."""

    value: float
    lower95: float
    upper95: float
    peak: float

    @property
    def is_known(self) -> bool:
        """Whether the runs tell it."""
        return math.isfinite(self.value)

    @classmethod
    def of(cls, runs: Sequence[FloatArray], period_s: float) -> "Spread":
        """Rms over runs; the interval from a block bootstrap (errors are coloured)."""
        block = max(1, round(_BLOCK_s / period_s))
        squares = [_block_means(np.square(run * UM_PER_M), block) for run in runs]
        pool = np.concatenate(squares)
        rng = np.random.default_rng(_SEED)
        draws = rng.choice(pool, size=(_DRAWS, pool.size)).mean(axis=1)
        low, high = np.sqrt(np.quantile(draws, [0.025, 0.975]))
        peak = max(float(np.max(np.abs(run))) for run in runs) * UM_PER_M
        return cls(float(np.sqrt(pool.mean())), float(low), float(high), peak)


@dataclass(frozen=True)
class Ratio:
    """Rms after over rms before with its 95 % interval."""

    value: float
    lower95: float
    upper95: float

    @classmethod
    def of(
        cls, before: Sequence[FloatArray], after: Sequence[FloatArray], period_s: float
    ) -> "Ratio":
        """Ratio over runs; both sides are drawn anew, block by block."""
        block = max(1, round(_BLOCK_s / period_s))
        rng = np.random.default_rng(_SEED)
        means: list[FloatArray] = []
        for runs in (before, after):
            pool = np.concatenate([_block_means(np.square(run), block) for run in runs])
            drawn = rng.choice(pool, size=(_DRAWS, pool.size)).mean(axis=1)
            means.append(np.concatenate([[pool.mean()], drawn]))
        ratio = np.sqrt(means[1] / np.maximum(means[0], 1e-30))
        low, high = np.quantile(ratio[1:], [0.025, 0.975])
        return cls(float(ratio[0]), float(low), float(high))

    def __str__(self) -> str:
        return f"{self.value:.3f} ({self.lower95:.3f} to {self.upper95:.3f})"


def _block_means(values: FloatArray, block: int) -> FloatArray:
    n = max(1, values.size // block)
    return np.asarray([part.mean() for part in np.array_split(values, n)])


def grown_text(before_um: float, after_um: float) -> str:
    """Two figures in um and by how much the second is larger, for people."""
    return f"{before_um:.2f} -> {after_um:.2f} um ({100 * (after_um / before_um - 1):+.0f} %)"


@dataclass(frozen=True)
class JudgedPromise:
    """One promised interval in um, the most that it allows, and what was measured.

    ``most_um`` is its upper end with the sensors' own steps.
    """

    quantity: str
    lower_um: float
    upper_um: float
    most_um: float
    measured_um: float

    @property
    def is_kept(self) -> bool:
        """Whether what was measured stays below the upper end."""
        return self.measured_um <= self.most_um


@dataclass(frozen=True)
class MotionOutcome:
    """One motion before and after; um.

    Parameters
    ----------
    name : str
        The motion.
    n_pairs : int
        Pairs of runs.
    e_before, e_r_after, e_c_before, e_c_after, total_before, total_after : Spread
        Rms with interval, and peak.
    mechanical, total : Ratio
        After over before with interval.
    promise : Mapping or None
        What the model promised: the same names with ``_um``.
    truth : Mapping or None
        The same on the plant's unquantised positions, simulated cards only.
    """

    name: str
    n_pairs: int
    e_before: Spread
    e_r_after: Spread
    e_c_before: Spread
    e_c_after: Spread
    total_before: Spread
    total_after: Spread
    mechanical: Ratio
    total: Ratio
    promise: Mapping[str, float] | None = None
    truth: Mapping[str, float] | None = None

    def promise_kept(self, floor_um: float) -> bool | None:
        """Whether what was measured lies within the promise's interval and the sensors' steps.

        ``floor_um`` is what these make of table minus motor. Better than promised is kept. The
        interval of what was measured does not excuse a miss: its value is held against the promise.
        None without an interval: a model that was not held against captures promises none.
        """
        judged = self.judged(floor_um)
        return all(one.is_kept for one in judged) if judged else None

    @property
    def rounding_um(self) -> float:
        """What the encoder's steps make of e_r through the loop by the model, um; 0 if unknown."""
        return (self.promise or {}).get(ROUNDING, 0.0)

    def judged(self, floor_um: float) -> list[JudgedPromise]:
        """Each promised interval beside what was measured; quantities without one are left out."""
        promise = self.promise or {}
        found: list[JudgedPromise] = []
        for name in PROMISED:
            upper = promise.get(f"{name}_upper_um")
            measured: Spread = getattr(self, name)
            if upper is not None and measured.is_known:
                lower = promise.get(f"{name}_lower_um", 0.0)
                most = math.hypot(upper, floor_um)
                label = name.removesuffix("_after")
                found.append(JudgedPromise(label, lower, upper, most, measured.value))
        return found

    def e_r_beyond_um(self, floor_um: float) -> float:
        """Rms of e_r in um beyond ``floor_um``, the noise of table minus motor."""
        return math.sqrt(max(self.e_r_after.value**2 - floor_um**2, 0.0))

    def as_result(self) -> dict[str, Any]:
        """Mapping for the JSON of `verify`."""
        return {
            "name": self.name,
            "pairs": self.n_pairs,
            "e_rms_um": asdict(self.e_before),
            "e_r_rms_um": asdict(self.e_r_after),
            "e_c_rms_um": {"before": asdict(self.e_c_before), "after": asdict(self.e_c_after)},
            "total_rms_um": {
                "before": asdict(self.total_before),
                "after": asdict(self.total_after),
            },
            "mechanical_after_over_before": self.mechanical.value,
            "total_after_over_before": self.total.value,
            "ratio_intervals": {
                "mechanical": asdict(self.mechanical),
                "total": asdict(self.total),
            },
            "promise": None if self.promise is None else dict(self.promise),
            "truth": None if self.truth is None else dict(self.truth),
        }


def sensor_floor_um(bench: Bench) -> float:
    """Rms in um of the quantisation of table minus motor: two uniform steps, 1/sqrt(12) each."""
    motor = bench.motor_resolution_m * (1.0 / 32.0 if bench.encoder.extension == "1/T" else 1.0)
    scale = bench.scale_resolution_m or 0.0
    return math.hypot(motor, scale) / math.sqrt(12.0) * UM_PER_M


def outcome_of(
    name: str,
    before: Sequence[Capture],
    after: Sequence[Capture],
    *,
    lead: LeadMap | None = None,
    table_correction: Callable[[FloatArray], FloatArray] | None = None,
    scale_age_s: float = 0.0,
    promise: Mapping[str, float] | None = None,
    truth: Mapping[str, float] | None = None,
) -> MotionOutcome:
    """Outcome of one motion from its runs without and with compensation."""
    first = [error_signals(capture, lead, None, scale_age_s) for capture in before]
    second = [error_signals(capture, lead, table_correction, scale_age_s) for capture in after]
    period = before[0].sample_period_s

    def spread(signals: Sequence[ErrorSignals], which: str) -> Spread:
        return Spread.of([getattr(s, which) for s in signals], period)

    def ratio(which: str) -> Ratio:
        sides = [[getattr(s, which) for s in signals] for signals in (first, second)]
        return Ratio.of(sides[0], sides[1], period)

    return MotionOutcome(
        name=name,
        n_pairs=min(len(before), len(after)),
        e_before=spread(first, "mechanical_m"),
        e_r_after=spread(second, "mechanical_m"),
        e_c_before=spread(first, "control_m"),
        e_c_after=spread(second, "control_m"),
        total_before=spread(first, "total_m"),
        total_after=spread(second, "total_m"),
        mechanical=ratio("mechanical_m"),
        total=ratio("total_m"),
        promise=promise,
        truth=truth,
    )
