"""Before and after: measured on fresh runs, alternating, held against the promise.

What lives here: the error signals of a capture in the terms of the contract, their statistics,
and the verdict on the promise. What may not: plots (``report``).

A constant offset between scale and encoder is unknown on any machine, so the mean of a run is
taken out of every error signal, before and after alike; the lead map is taken out of the
mechanical error, less what the compensation table gives.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import CaptureError, ConfigError
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture, read_capture, write_capture
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap

if TYPE_CHECKING:
    from pmac_comp.machine.controller.transaction import Context
    from pmac_comp.workflow.axis import Axis
    from pmac_comp.workflow.compensation_file import Compensation
    from pmac_comp.workflow.motions import Motion
    from pmac_comp.workflow.simulated import Truth

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


def verify_files(
    bench: str,
    before: Sequence[Path],
    after: Sequence[Path],
    *,
    model: Path | None = None,
    law: Path | None = None,
) -> Verification:
    """Verification of stored captures; pairs are formed by motion, else by order.

    Raises
    ------
    ConfigError
        Numbers of captures differ and no motion names pair them.
    """
    loaded = load_bench(bench)
    first = [read_capture(path) for path in before]
    second = [read_capture(path) for path in after]
    groups = _paired(first, second)
    compensation = None
    if law is not None:
        from pmac_comp.workflow.compensation_file import read_compensation

        compensation = read_compensation(law)
    lead = compensation.lead if compensation else None
    correction = compensation.table_correction(loaded) if compensation else None
    outcomes = tuple(
        outcome_of(
            name,
            a,
            b,
            lead=lead,
            table_correction=correction,
            promise=_promise(loaded, model, compensation, b[0]),
        )
        for name, (a, b) in groups.items()
    )
    floor = sensor_floor_um(loaded)
    simulated = any("simulated" in str(c.attributes.get("source", "")) for c in first + second)
    return Verification(
        outcomes,
        floor,
        simulated,
        tuple(first),
        tuple(second),
        lead,
        correction,
        verdict_remarks(outcomes, floor),
    )


def _promise(
    bench: Bench, model: Path | None, compensation: Any, capture: Capture
) -> Mapping[str, float] | None:
    if model is None or compensation is None:
        return None
    from pmac_comp.physics.compensate.design import model_loop
    from pmac_comp.workflow.deploy import LATENCY_CYCLES
    from pmac_comp.workflow.identification import load_model

    loop = model_loop(load_model(model, bench))
    latency = LATENCY_CYCLES[compensation.route]
    return promised(compensation, loop, capture, latency_cycles=latency)


def _paired(
    before: Sequence[Capture], after: Sequence[Capture]
) -> dict[str, tuple[list[Capture], list[Capture]]]:
    groups: dict[str, tuple[list[Capture], list[Capture]]] = {}
    names = [str(c.attributes.get("motion", "")) for c in [*before, *after]]
    if all(names):
        for side, captures in enumerate((before, after)):
            for capture in captures:
                name = str(capture.attributes["motion"])
                groups.setdefault(name, ([], []))[side].append(capture)
        whole = {name: pair for name, pair in groups.items() if pair[0] and pair[1]}
        if whole:
            return whole
    if len(before) != len(after) or not before:
        raise ConfigError(
            f"{len(before)} captures before and {len(after)} after cannot be paired.",
            code="PC-VER-002",
            hint="Give the same motions on both sides, in the same order.",
        )
    return {f"run {i + 1}": ([a], [b]) for i, (a, b) in enumerate(zip(before, after, strict=True))}


def store(verification: Verification, folder: Path) -> dict[str, list[str]]:
    """Write the captures and the result of a verification into a folder; names by kind."""
    folder.mkdir(parents=True, exist_ok=True)
    written: dict[str, list[str]] = {"before": [], "after": []}
    for side in ("before", "after"):
        for i, capture in enumerate(getattr(verification, side)):
            path = folder / f"{side}_{i + 1:02d}.h5"
            write_capture(path, capture)
            written[side].append(path.name)
    text = json.dumps({**verification.as_result(), "files": written}, indent=2)
    (folder / "verification.json").write_text(text + "\n", encoding="utf-8")
    return written


# On a controller ----------------------------------------------------------------------------------


def verify_on_controller(
    url: str,
    bench: str,
    *,
    model: Path | None = None,
    law: Path | None = None,
    motions: tuple[str, ...] = (),
    repeats: int = 2,
    seed: int = 0,
    refine: int = 0,
    out: Path | None = None,
    progress: Progress | None = None,
) -> Verification:
    """Run motions with and without what is on the controller, and compare.

    Raises
    ------
    ConfigError
        No compensation file is named, so nobody knows what to switch.
    """
    from pmac_comp.workflow.compensation_file import read_compensation
    from pmac_comp.workflow.deploy import context_of
    from pmac_comp.workflow.identification import load_model
    from pmac_comp.workflow.motions import parse_motion, verification_motions
    from pmac_comp.workflow.session import open_axis

    if law is None:
        raise ConfigError(
            "The compensation to verify is not named.",
            code="PC-VER-003",
            hint="Give the uploaded file with --compensation FILE, or stored runs with "
            "--before and --after.",
        )
    compensation = read_compensation(law)
    with open_axis(url, bench) as axis:
        chosen = [parse_motion(text, axis.bench) for text in motions] or verification_motions(
            axis.bench, seed
        )
        context = context_of(axis, Path("pmac-comp-journal"))
        drive = None if model is None else load_model(model, axis.bench)
        verification = verify_axis(
            axis,
            context,
            compensation,
            chosen,
            repeats=repeats,
            drive=drive,
            progress=progress,
        )
        if refine:
            from pmac_comp.workflow.repeated import refine_motion

            learned = refine_motion(axis, context, compensation, chosen[0], refine, progress)
            verification = replace(verification, remarks=(*verification.remarks, *learned.lines()))
    if out is not None:
        store(verification, out)
    return verification


def verify_axis(
    axis: "Axis",
    context: "Context",
    compensation: "Compensation",
    motions: "Sequence[Motion]",
    *,
    repeats: int = 1,
    drive: Any = None,
    truth: "Callable[[], Truth | None] | None" = None,
    progress: Progress | None = None,
) -> Verification:
    """Fresh runs before and after, alternating so that drift does not count as gain."""
    from pmac_comp.workflow.deploy import LATENCY_CYCLES, switch

    correction = compensation.table_correction(axis.bench)
    loop = None
    if compensation.route == "cam":
        from pmac_comp.workflow.cam import cam_axis

        # A cam is for one motion, and only its own program runs the time along.
        axis, motions = cam_axis(axis, compensation)
    elif drive is not None:
        from pmac_comp.physics.compensate.design import model_loop

        loop = model_loop(drive)
    total = 2 * repeats * len(motions)
    runs: list[tuple[str, list[Capture], list[Capture]]] = []
    done = 0
    for motion in motions:
        sides: tuple[list[Capture], list[Capture]] = ([], [])
        for pair in range(repeats):
            # The order changes from pair to pair: a drift over time falls on both alike.
            for on in (False, True) if pair % 2 == 0 else (True, False):
                switch(axis, context, compensation, on=on)
                if progress is not None:
                    progress(
                        f"verifying {motion.name}, {'with' if on else 'without'}", done / total
                    )
                capture = axis.run(motion)
                sides[on].append(capture.with_attributes(compensation="on" if on else "off"))
                done += 1
        runs.append((motion.name, *sides))
    found = truth() if truth is not None else None
    latency = LATENCY_CYCLES[compensation.route]
    outcomes = tuple(
        outcome_of(
            name,
            a,
            b,
            lead=compensation.lead,
            table_correction=correction,
            promise=None
            if loop is None
            else promised(compensation, loop, b[0], latency_cycles=latency),
            truth=None if found is None else true_errors(found, a, b, compensation, correction),
        )
        for name, a, b in runs
    )
    floor = sensor_floor_um(axis.bench)
    return Verification(
        outcomes,
        floor,
        truth is not None,
        tuple(c for _, a, _ in runs for c in a),
        tuple(c for _, _, b in runs for c in b),
        compensation.lead,
        correction,
        verdict_remarks(outcomes, floor),
    )


def promised(
    compensation: "Compensation", loop: Any, capture: Capture, *, latency_cycles: int
) -> Mapping[str, float]:
    """What the model promises for the commanded motion of a capture, mean taken out, um."""
    from pmac_comp.physics.compensate.design import promise
    from pmac_comp.physics.signals.trajectory import Trajectory

    motion = Trajectory(capture.time_s, capture.commanded_position_m)
    # The model promises for its own law: what captures corrected beside it is not its word.
    # Routes without a dynamic law promise nothing beyond the static part.
    law = compensation.law if compensation.route in ("law", "servo") else CompensationLaw()
    trim = law.provenance.get("trim", {})
    law = law.with_values(**{name: getattr(law, name) - change for name, change in trim.items()})
    return asdict(promise(law, loop, motion, latency_cycles=latency_cycles))


def true_errors(
    truth: "Truth",
    before: Sequence[Capture],
    after: Sequence[Capture],
    compensation: "Compensation",
    correction: Callable[[FloatArray], FloatArray] | None,
) -> Mapping[str, float] | None:
    """The same errors on the plant's unquantised positions, um rms; simulated cards only."""
    values: dict[str, list[FloatArray]] = {}
    for side, captures in (("before", before), ("after", after)):
        for capture in captures:
            found = truth.of(capture)
            if found is None:
                return None
            true = replace(capture, motor_position_m=found[0], table_position_m=found[1])
            signals = error_signals(
                true, compensation.lead, correction if side == "after" else None
            )
            names = (
                "e_before" if side == "before" else "e_r_after",
                f"e_c_{side}",
                f"total_{side}",
            )
            parts = (signals.mechanical_m, signals.control_m, signals.total_m)
            for name, part in zip(names, parts, strict=True):
                values.setdefault(f"{name}_um", []).append(part)
    return {
        name: float(np.sqrt(np.mean(np.concatenate(parts) ** 2)) * UM_PER_M)
        for name, parts in values.items()
    }
