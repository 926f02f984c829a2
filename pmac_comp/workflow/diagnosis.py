"""Diagnosis of capture files: the contract's JSON, the grown model, words for people."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture, file_digest, read_capture
from pmac_comp.files.model_file import ModelFile, write_model
from pmac_comp.workflow.identification import check_period, load_model, user_effects

if TYPE_CHECKING:
    from pmac_comp.physics.diagnose import Diagnosis
    from pmac_comp.physics.model.drive import DriveModel

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class DiagnosisOutcome:
    """A diagnosis with where its grown model was stored."""

    bench: Bench
    diagnosis: "Diagnosis"
    model: ModelFile
    model_path: Path | None

    def as_result(self) -> dict[str, Any]:
        """The contract's mapping, with ``model_file`` (path) and the model itself."""
        return {
            **self.diagnosis.to_json(),
            "model_file": None if self.model_path is None else str(self.model_path),
            "model": self.model.model_dump(mode="json"),
        }

    def lines(self) -> list[str]:
        """Sentences and figures for people."""
        d = self.diagnosis
        out = [f"verdict: {d.verdict}" + (f" - {', '.join(d.named)}" if d.named else "")]
        out += [f"  {line}" for line in d.statements]
        out.append(
            f"gap ({d.gap_channel}, captures not used for fitting): {d.gap_before_um:.3f} -> "
            f"{d.gap_after_um:.3f} um rms, noise floor {d.noise_floor_um:.3f} um"
        )
        out += [
            f"  {e.name} = {e.value:.4g} {e.unit} (95 %: {e.lower95:.4g} .. {e.upper95:.4g})"
            for e in d.estimates
        ]
        out += [f"tied: {' / '.join(group)}" for group in d.tied]
        if d.separating_experiment is not None:
            out.append(f"to separate them: {d.separating_experiment.text}")
            out += [
                f"  pmac-comp capture ... --motion {m}" for m in d.separating_experiment.motions
            ]
        out += [f"left over: {region.describe()}" for region in d.residual]
        out += [f"finding: {finding.text}" for finding in d.findings]
        if self.model_path is not None:
            out.append(f"grown model: {self.model_path}")
        return out


def diagnose_captures(
    captures: Sequence[Capture],
    bench: Bench,
    *,
    validate: Sequence[Capture] = (),
    model: "DriveModel | None" = None,
    effects: Path | None = None,
    data: Sequence[tuple[str, str]] = (),
    progress: Progress | None = None,
) -> DiagnosisOutcome:
    """Diagnose captures in memory."""
    from pmac_comp.physics.diagnose import diagnose
    from pmac_comp.physics.model.effect import effect_library

    own = user_effects(effects)

    def told(text: str) -> None:
        if progress is not None:
            progress(text, -1.0)

    found = diagnose(
        captures,
        bench,
        validate=validate,
        model=model,
        effects={**effect_library(), **own} if own else None,
        progress=told,
    )
    return DiagnosisOutcome(bench, found, _model_file(found, bench, data), None)


def diagnose_files(
    captures: Sequence[Path],
    validate: Sequence[Path],
    bench: str,
    *,
    model: Path | None = None,
    effects: Path | None = None,
    model_out: Path | None = None,
    progress: Progress | None = None,
) -> DiagnosisOutcome:
    """Diagnose capture files; the grown model goes to ``model_out`` where one is named."""
    loaded = load_bench(bench)
    read = {path: read_capture(path) for path in [*captures, *validate]}
    for path, capture in read.items():
        check_period(capture, loaded, path.name)
    outcome = diagnose_captures(
        [read[path] for path in captures],
        loaded,
        validate=[read[path] for path in validate],
        model=None if model is None else load_model(model, loaded, effects=effects),
        effects=effects,
        data=[(path.name, file_digest(path)) for path in captures],
        progress=progress,
    )
    if model_out is None:
        return outcome
    write_model(model_out, outcome.model)
    return DiagnosisOutcome(loaded, outcome.diagnosis, outcome.model, model_out)


def _model_file(found: "Diagnosis", bench: Bench, data: Sequence[tuple[str, str]]) -> ModelFile:
    """Grown model in files' units; intervals only of the effects that were named."""
    from datetime import UTC, datetime

    from pmac_comp.files.model_file import DataSource, ModelParameter
    from pmac_comp.physics.identify.persistence import file_key

    model = found.model
    intervals = {e.name: e for e in found.estimates}
    parameters: dict[str, ModelParameter] = {}
    for spec in model.specs:
        key = file_key(spec, rigid=model.is_rigid)
        sign = -1.0 if key == "offset_N" else 1.0
        known = spec.kind == "known"
        e = intervals.get(key) or intervals.get(spec.name)
        parameters[key] = ModelParameter(
            value=sign * spec.to_file(model.parameters[spec.name]),
            unit=spec.file_unit,
            std=None if e is None else e.std,
            lower95=None if e is None else e.lower95,
            upper95=None if e is None else e.upper95,
            nominal=spec.to_file(spec.nominal) if known else None,
            tolerance=spec.tolerance_frac if known else None,
        )
    return ModelFile(
        bench_digest=bench.digest,
        effects=list(model.effects),
        parameters=parameters,
        data=[DataSource(name=name, sha256=digest) for name, digest in data],
        created_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        notes=[f"diagnosis: {found.verdict}", *found.statements],
    )
