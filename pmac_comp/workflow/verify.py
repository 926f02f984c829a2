"""Before and after: measured on fresh runs, alternating, or read from stored captures.

What lives here: which runs are made, in which order, and what belongs together. What may not: the
statistics (``outcome``), plots (``report``).
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ConfigError
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture, read_capture, write_capture
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.workflow.outcome import (
    Verification,
    error_signals,
    outcome_of,
    sensor_floor_um,
    verdict_remarks,
)

if TYPE_CHECKING:
    from pmac_comp.machine.controller.transaction import Context
    from pmac_comp.workflow.axis import Axis
    from pmac_comp.workflow.compensation_file import Compensation
    from pmac_comp.workflow.motions import Motion
    from pmac_comp.workflow.simulated import Truth

Progress = Callable[[str, float], None]


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
    from pmac_comp.workflow.computing import LATENCY_CYCLES
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
    from pmac_comp.workflow.campaigns import verification_motions
    from pmac_comp.workflow.compensation_file import read_compensation
    from pmac_comp.workflow.deploy import context_of
    from pmac_comp.workflow.identification import load_model
    from pmac_comp.workflow.motions import parse_motion
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
    from pmac_comp.workflow.computing import LATENCY_CYCLES
    from pmac_comp.workflow.deploy import switch

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
