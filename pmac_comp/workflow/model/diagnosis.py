"""Diagnosis of capture files: the JSON of `diagnose`, the grown model, words for people."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pmac_comp.base.errors import ConfigError
from pmac_comp.base.progress import Progress
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import PREDICTED, Capture, file_digest, read_capture
from pmac_comp.files.model_file import ModelFile, write_model, written_for
from pmac_comp.workflow.bench.same_axis import (
    check_channels,
    check_no_copies,
    check_not_twice,
    check_same_loop,
    check_scales,
)
from pmac_comp.workflow.model.identification import acted_in, load_model, user_effects

if TYPE_CHECKING:
    from pmac_comp.physics.diagnose import Diagnosis
    from pmac_comp.physics.model.drive import DriveModel


@dataclass(frozen=True)
class DiagnosisOutcome:
    """A diagnosis with where its grown model was stored.

    ``removal`` takes a compensation off that stands on the controller, before more runs are made.
    """

    bench: Bench
    diagnosis: "Diagnosis"
    model: ModelFile
    model_path: Path | None
    bench_name: str = "BENCH"
    url: str = "URL"
    sources: tuple[str, ...] = ()
    remark: str = ""
    removal: str = ""

    @property
    def provenance(self) -> str:
        """Where the captures come from, in a sentence; a simulation is never called measured."""
        known = [source for source in self.sources if source]
        return f"Source of the captures: {'; '.join(known) or 'not stated'}."

    def findings(self) -> list[str]:
        """What was found beside the effects, in sentences."""
        remarks = [self.remark] if self.remark else []
        if PREDICTED in self.sources:
            remarks.append("Some captures are predictions of a model, not measurements.")
        return remarks + [f"Finding: {finding.text}." for finding in self.diagnosis.findings]

    def commands(self) -> list[str]:
        """The separating experiment as commands to paste; none where there is none."""
        experiment = self.diagnosis.separating_experiment
        if experiment is None or not experiment.motions:
            return []
        motions = " ".join(f'--motion "{motion}"' for motion in experiment.motions)
        where = f"{shlex.quote(self.url)} --bench {shlex.quote(self.bench_name)}"
        first = [f"  {self.removal}"] if self.removal else []
        return [*first, f"  pmac-comp capture {where} --out separating {motions}"]

    def as_result(self) -> dict[str, Any]:
        """The mapping for ``--json``, with ``model_file`` (path) and the model itself."""
        return {
            **self.diagnosis.to_json(),
            "sources": list(self.sources),
            "remark": self.remark,
            "model_file": None if self.model_path is None else str(self.model_path),
            "model": self.model.model_dump(mode="json"),
        }

    def lines(self) -> list[str]:
        """Sentences and figures for people."""
        d = self.diagnosis
        out = [f"verdict: {d.verdict}" + (f" - {', '.join(d.named)}" if d.named else "")]
        out += [f"  {line}" for line in d.statements]
        out += [f"  {line}" for line in self.findings()]
        if d.separating_experiment is not None:
            out.append(f"the run that would tell more: {d.separating_experiment.text}")
            out += self.commands()
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
    sources = dict.fromkeys(str(c.attributes.get("source", "")) for c in [*captures, *validate])
    return DiagnosisOutcome(
        bench, found, _model_file(found, bench, data), None, sources=tuple(sources)
    )


def _named(capture: Capture, path: Path) -> Capture:
    """The capture by a name under which a person finds it: its own, or its file's."""
    return capture if "name" in capture.attributes else capture.with_attributes(name=path.name)


def diagnose_files(
    captures: Sequence[Path],
    validate: Sequence[Path],
    bench: str,
    *,
    model: Path | None = None,
    base: Sequence[str] = (),
    effects: Path | None = None,
    model_out: Path | None = None,
    progress: Progress | None = None,
) -> DiagnosisOutcome:
    """Diagnose capture files; the grown model goes to ``model_out`` where one is named.

    ``base`` names the effects of the base model instead of Coulomb and viscous friction; ``model``
    gives a whole base model instead.

    Raises
    ------
    ConfigError
        Both are given, or the captures do not belong to the bench.
    """
    loaded = load_bench(bench)
    start = _base_model(loaded, model, base, effects)
    digests = {path: file_digest(path) for path in [*captures, *validate]}
    check_not_twice({str(p): digests[p] for p in captures}, {str(p): digests[p] for p in validate})
    read = {path: _named(read_capture(path), path) for path in digests}
    given = [*captures, *validate]
    check_no_copies([str(path) for path in given], [read[path] for path in given])
    for path, capture in read.items():
        check_scales(capture, loaded, path.name)
        check_same_loop(capture, loaded, path.name)
    remark = " ".join(filter(None, (
        check_channels({path.name: capture for path, capture in read.items()}, loaded),
        _acted_text(acted_in(list(read.values()), loaded, [path.name for path in read]), len(read)),
    )))  # fmt: skip
    outcome = diagnose_captures(
        [read[path] for path in captures],
        loaded,
        validate=[read[path] for path in validate],
        model=start,
        effects=effects,
        data=[(path.name, digests[path]) for path in captures],
        progress=progress,
    )
    if model_out is not None:
        write_model(model_out, outcome.model)
    return replace(outcome, bench_name=bench, model_path=model_out, remark=remark)


def _acted_text(acted: Sequence[str], n_captures: int) -> str:
    """Which runs a compensation acted in; empty where none."""
    if not acted:
        return ""
    return (
        f"{len(acted)} of {n_captures} captures were made with a compensation on: "
        f"{', '.join(acted)}. What a law feeds forward as torque is not in them and looks like the "
        "drive's: leave them out, or make these runs again without (`pmac-comp remove` before "
        "`pmac-comp capture`)."
    )


def _base_model(
    bench: Bench, model: Path | None, base: Sequence[str], effects: Path | None
) -> "DriveModel | None":
    """Base model that was asked for; None for the usual one."""
    from pmac_comp.physics.model.drive import DriveModel
    from pmac_comp.physics.model.effect import effect_library

    if model is not None and base:
        raise ConfigError(
            "Two base models are asked for.",
            code="PC-DIA-013",
            hint="Give either --model FILE or --base EFFECT.",
        )
    if model is not None:
        return load_model(model, bench, effects=effects)
    if not base:
        return None
    known = {**effect_library(), **user_effects(effects)}
    strange = [name for name in base if name.partition("@")[0] not in known]
    if strange:
        raise ConfigError(
            f"There is no effect {', '.join(strange)}.",
            code="PC-DIA-014",
            hint=f"Known effects: {', '.join(sorted(known))}.",
        )
    return DriveModel(bench, tuple(base), {}, library=known)


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
        value = spec.to_file(model.parameters[spec.name])
        e = intervals.get(key) or intervals.get(spec.name)
        if e is not None and abs(e.value - value) > e.std:
            e = None  # told of the named effects alone; beside others it has another size here
        parameters[key] = ModelParameter(
            value=sign * value,
            unit=spec.file_unit,
            std=None if e is None else e.std,
            lower95=None if e is None else e.lower95,
            upper95=None if e is None else e.upper95,
            nominal=spec.to_file(spec.nominal) if known else None,
            tolerance=spec.tolerance_frac if known else None,
        )
    return ModelFile(
        **written_for(bench),
        effects=list(model.effects),
        parameters=parameters,
        data=[DataSource(name=name, sha256=digest) for name, digest in data],
        created_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        notes=[f"diagnosis: {found.verdict}", *found.statements],
    )
