"""Errors before and after in the terms of the contract: signals, statistics, the promise.

What lives here: pure functions of captures. What may not: conversations, plots (``report``).

A constant offset between scale and encoder is unknown on any machine, so the mean of a run is
taken out of every error signal, before and after alike; the lead map is taken out of the
mechanical error, less what the compensation table gives.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import CaptureError
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.lead import LeadMap

if TYPE_CHECKING:
    pass

Progress = Callable[[str, float], None]

_BLOCK_s = 0.1
_DRAWS = 400
_SEED = 20_261


@dataclass(frozen=True)
class ErrorSignals:
    """Errors of one run in m, mean taken out; shape (n,) each.

    ``mechanical`` is e without and e_r with compensation, ``control`` e_c, ``total`` their sum.
    """

    time_s: FloatArray
    mechanical_m: FloatArray
    control_m: FloatArray
    total_m: FloatArray


def error_signals(
    capture: Capture,
    lead: LeadMap | None = None,
    table_correction: Callable[[FloatArray], FloatArray] | None = None,
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

    Raises
    ------
    CaptureError
        No table position.
    """
    if capture.table_position_m is None:
        raise CaptureError(
            "The capture has no table position.",
            code="PC-VER-001",
            hint="Verification at the table needs a scale.",
        )
    r, desired = capture.commanded_position_m, capture.desired_m
    mechanical = capture.table_position_m - capture.motor_position_m + (desired - r)
    if lead is not None:
        mechanical = mechanical - lead.at(r)
    if table_correction is not None:
        mechanical = mechanical - table_correction(r)
    use = capture.mask
    signals = [mechanical, capture.motor_position_m - desired, capture.table_position_m - r]
    centred = [values - float(np.mean(values[use])) for values in signals]
    return ErrorSignals(capture.time_s, *centred)


@dataclass(frozen=True)
class Spread:
    """An rms value with its 95 % interval, um."""

    value: float
    lower95: float
    upper95: float
    peak: float

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


def _block_means(values: FloatArray, block: int) -> FloatArray:
    n = max(1, values.size // block)
    return np.asarray([part.mean() for part in np.array_split(values, n)])


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
    promise: Mapping[str, float] | None = None
    truth: Mapping[str, float] | None = None

    @property
    def mechanical_ratio(self) -> float:
        """Mechanical error after over before."""
        return self.e_r_after.value / max(self.e_before.value, 1e-12)

    @property
    def total_ratio(self) -> float:
        """Total error after over before."""
        return self.total_after.value / max(self.total_before.value, 1e-12)

    def promise_kept(self, floor_um: float) -> bool | None:
        """Whether the promised residual lies within the interval widened by the sensor noise."""
        if self.promise is None:
            return None
        expected = math.hypot(self.promise["e_r_after_um"], floor_um)
        return self.e_r_after.value <= 1.5 * expected + 0.1

    def as_result(self) -> dict[str, Any]:
        """Mapping of the contract for ``--json``."""
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
            "mechanical_after_over_before": self.mechanical_ratio,
            "total_after_over_before": self.total_ratio,
            "promise": None if self.promise is None else dict(self.promise),
            "truth": None if self.truth is None else dict(self.truth),
        }


@dataclass(frozen=True)
class Verification:
    """All motions of a verification, with the runs they came from."""

    motions: tuple[MotionOutcome, ...]
    floor_um: float
    simulated: bool
    before: tuple[Capture, ...] = field(default=(), repr=False)
    after: tuple[Capture, ...] = field(default=(), repr=False)
    lead: LeadMap | None = field(default=None, repr=False)
    table_correction: Callable[[FloatArray], FloatArray] | None = field(default=None, repr=False)
    remarks: tuple[str, ...] = ()

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        return {
            "kind": "verification",
            "simulated": self.simulated,
            "sensor_floor_um": self.floor_um,
            "motions": [m.as_result() for m in self.motions],
            "remarks": list(self.remarks),
        }

    def lines(self) -> list[str]:
        """Table and remarks for people."""
        head = f"  {'motion':44s} {'e -> e_r um':>17s} {'e_c um':>17s} {'total um':>17s}  ratio"
        out = ["measured rms before -> after (mean of a run taken out)", head]
        for m in self.motions:
            out.append(
                f"  {m.name[:44]:44s} {_pair(m.e_before, m.e_r_after)} "
                f"{_pair(m.e_c_before, m.e_c_after)} {_pair(m.total_before, m.total_after)}  "
                f"{m.mechanical_ratio:.2f} mech, {m.total_ratio:.2f} total"
            )
            if m.promise is not None:
                out.append(
                    f"  {'  promised by the model':44s} "
                    f"{m.promise['e_before_um']:8.2f}>{m.promise['e_r_after_um']:8.3f} "
                    f"{m.promise['e_c_before_um']:8.2f}>{m.promise['e_c_after_um']:8.2f} "
                    f"{m.promise['total_before_um']:8.2f}>{m.promise['total_after_um']:8.2f}"
                )
            if m.truth is not None:
                out.append(
                    f"  {'  on the true positions of the plant':44s} "
                    f"{m.truth['e_before_um']:8.2f}>{m.truth['e_r_after_um']:8.3f} "
                    f"{m.truth['e_c_before_um']:8.2f}>{m.truth['e_c_after_um']:8.2f} "
                    f"{m.truth['total_before_um']:8.2f}>{m.truth['total_after_um']:8.2f}"
                )
        out += [f"  note: {line}" for line in self.remarks]
        return out


def _pair(before: Spread, after: Spread) -> str:
    return f"{before.value:8.2f}>{after.value:8.3f}"


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
    promise: Mapping[str, float] | None = None,
    truth: Mapping[str, float] | None = None,
) -> MotionOutcome:
    """Outcome of one motion from its runs without and with compensation."""
    first = [error_signals(capture, lead) for capture in before]
    second = [error_signals(capture, lead, table_correction) for capture in after]
    period = before[0].sample_period_s

    def spread(signals: Sequence[ErrorSignals], which: str) -> Spread:
        return Spread.of([getattr(s, which) for s in signals], period)

    return MotionOutcome(
        name=name,
        n_pairs=min(len(before), len(after)),
        e_before=spread(first, "mechanical_m"),
        e_r_after=spread(second, "mechanical_m"),
        e_c_before=spread(first, "control_m"),
        e_c_after=spread(second, "control_m"),
        total_before=spread(first, "total_m"),
        total_after=spread(second, "total_m"),
        promise=promise,
        truth=truth,
    )


def verdict_remarks(outcomes: Sequence[MotionOutcome], floor_um: float) -> tuple[str, ...]:
    """What a person should know beside the figures."""
    remarks: list[str] = []
    missed = [m.name for m in outcomes if m.promise_kept(floor_um) is False]
    if missed:
        remarks.append(
            f"the promise was missed on {len(missed)} motion(s) ({'; '.join(missed)}): "
            "run `pmac-comp diagnose` on the captures"
        )
    grew = [m for m in outcomes if m.e_r_after.lower95 > m.e_before.upper95]
    fell = {m.name for m in grew if m.total_after.upper95 < m.total_before.lower95}
    if fell:
        remarks.append(
            f"the offset also cancels the lag of the loop on: {'; '.join(sorted(fell))}; there "
            "e_r contains that part by its definition, and the total error is what counts"
        )
    worse = [m.name for m in grew if m.name not in fell]
    if worse:
        remarks.append(f"the mechanical error grew on: {'; '.join(worse)}")
    return tuple(remarks)
