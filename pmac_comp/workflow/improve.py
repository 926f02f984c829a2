"""Diagnose, grow the model, recompute, upload, verify, and see whether the error falls again."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pmac_comp.base.atomic import atomic_write_text
from pmac_comp.base.errors import ModelError
from pmac_comp.files.capture import write_capture
from pmac_comp.files.model_file import write_model
from pmac_comp.workflow.axis import Axis, run_all
from pmac_comp.workflow.calibrate import prepare
from pmac_comp.workflow.campaigns import calibration_motions, lead_motions, verification_motions
from pmac_comp.workflow.compensation_file import check_route, write_compensation
from pmac_comp.workflow.computing import compute_compensation
from pmac_comp.workflow.deploy import context_of, deploy
from pmac_comp.workflow.diagnosis import DiagnosisOutcome, diagnose_captures
from pmac_comp.workflow.identification import identify_captures, load_model
from pmac_comp.workflow.session import open_axis
from pmac_comp.workflow.verification import Verification
from pmac_comp.workflow.verify import store, verify_axis

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Improvement:
    """What was measured with the model as it was and with the grown one."""

    diagnosis: DiagnosisOutcome
    before_growth: Verification
    after_growth: Verification

    def rows(self) -> list[tuple[str, float, float, float]]:
        """Motion, mechanical error without, with the first, with the grown model; um rms."""
        return [
            (a.name, a.e_before.value, a.e_r_after.value, b.e_r_after.value)
            for a, b in zip(self.before_growth.motions, self.after_growth.motions, strict=True)
        ]

    def lines(self) -> list[str]:
        """Text for people."""
        out = [*self.diagnosis.lines(), "", "mechanical error, measured rms um"]
        out += [
            f"  {name[:44]:44s} none {none:7.2f}   first {first:6.3f}   grown {grown:6.3f}"
            for name, none, first, grown in self.rows()
        ]
        first = _together([m.total_after.value for m in self.before_growth.motions])
        grown = _together([m.total_after.value for m in self.after_growth.motions])
        out.append(f"  total error, quadratic mean: {first:.2f} -> {grown:.2f} um")
        return out

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        return {
            "kind": "improvement",
            "diagnosis": self.diagnosis.as_result(),
            "first_model": self.before_growth.as_result(),
            "grown_model": self.after_growth.as_result(),
        }


def _together(values: list[float]) -> float:
    return float((sum(v * v for v in values) / max(len(values), 1)) ** 0.5)


def improve_on_controller(
    url: str,
    bench: str,
    out: Path,
    *,
    model: Path | None = None,
    route: str = "law",
    seed: int = 0,
    effects: Path | None = None,
    progress: Progress | None = None,
) -> Improvement:
    """The whole loop on a controller; everything is left in a folder."""
    check_route(route)
    out.mkdir(parents=True, exist_ok=True)
    with open_axis(url, bench) as axis:
        prepare(axis)
        result = improve_axis(
            axis, out, model=model, route=route, seed=seed, effects=effects, progress=progress
        )
        axis.kill()
    atomic_write_text(
        out / "improvement.json", json.dumps(result.as_result(), indent=2, default=str) + "\n"
    )
    return result


def improve_axis(
    axis: Axis,
    out: Path,
    *,
    model: Path | None = None,
    route: str = "law",
    seed: int = 0,
    effects: Path | None = None,
    progress: Progress | None = None,
) -> Improvement:
    """The loop on a connected axis: first model, verify, diagnose, grown model, verify."""
    captures = run_all(axis, calibration_motions(axis.bench), progress=progress, what="capture")
    slow = tuple(run_all(axis, lead_motions(axis.bench), progress=progress, what="lead error"))
    for i, capture in enumerate([*captures, *slow]):
        write_capture(out / f"calibration_{i + 1:02d}.h5", capture)
    if model is None:
        first = identify_captures(captures, axis.bench, progress=progress).identification.model
    else:
        first = load_model(model, axis.bench, effects=effects)
    if first is None:
        raise ModelError("The identification gave no model.", code="PC-IMP-001")
    context = context_of(axis, out / "journal", progress)
    motions = verification_motions(axis.bench, seed)

    def measured(drive: Any, name: str) -> Verification:
        compensation = compute_compensation(
            axis.bench, drive, route=route, slow=slow, captures=tuple(captures), progress=progress
        )
        write_compensation(out / f"compensation_{name}.json", compensation)
        deploy(axis, compensation, context)
        found = verify_axis(axis, context, compensation, motions, drive=drive, progress=progress)
        store(found, out / f"verification_{name}")
        return found

    before = measured(first, "first")
    diagnosis = diagnose_captures(
        captures, axis.bench, model=first, effects=effects, progress=progress
    )
    write_model(out / "grown_model.json", diagnosis.model)
    after = measured(diagnosis.diagnosis.model, "grown")
    return Improvement(diagnosis, before, after)
