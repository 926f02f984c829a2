"""Identification on files: captures and a bench in, a model file and words for people out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pmac_comp.base.errors import NotIdentifiable
from pmac_comp.base.progress import Progress
from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import (
    Capture,
    file_digest,
    predicted_remarks,
    told_by,
)
from pmac_comp.files.model_file import ModelFile, read_model, write_model
from pmac_comp.workflow.bench.same_axis import captures_of, check_same_drive

if TYPE_CHECKING:
    from pmac_comp.physics.identify.result import Identification
    from pmac_comp.physics.model.drive import DriveModel

Friction = Literal["auto", "coulomb"]
_HARDLY_ANY_mm = 0.5  # no motion that anybody identifies a drive from


@dataclass(frozen=True)
class IdentificationOutcome:
    """An identification with its captures and its model file."""

    bench: Bench
    captures: tuple[Capture, ...]
    identification: "Identification"
    model_file: ModelFile

    def write(self, path: Path) -> None:
        """Store the model file."""
        write_model(path, self.model_file)

    def rows(self) -> list[tuple[Any, ...]]:
        """Parameters for people: name, value, unit, std, interval, value of the bench file."""
        return [
            (
                name + (" (fixed)" if p.fixed else ""),
                p.value,
                p.unit,
                p.std,
                p.lower95,
                p.upper95,
                p.nominal,
            )
            for name, p in self.model_file.parameters.items()
        ]

    def left(self) -> list[tuple[str, float, str]]:
        """What the model leaves of the captures, rms: channel, figure and unit."""
        noise = self.model_file.noise
        return [
            (what, value, unit)
            for what, value, unit in (
                ("motor position", noise.motor_um, "um"),
                ("table minus motor", noise.table_um, "um"),
                ("torque", noise.torque_Nm, "N m"),
            )
            if value is not None
        ]

    def statements(self) -> tuple[str, ...]:
        """Identifiability in words."""
        return (*predicted_remarks(self.captures), *self.identification.statements)

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        return {
            "kind": "identification",
            **self.model_file.model_dump(mode="json"),
            "figures": dict(self.identification.figures),
            "method": self.identification.method,
            "sources": told_by(self.captures, "source"),  # a simulation is never called measured
            "statements": list(self.statements()),
        }


def load_model(path: Path, bench: Bench, *, effects: Path | None = None) -> "DriveModel":
    """Drive model of a model file, with effects of the user's own file if one is named.

    Raises
    ------
    ConfigError
        The model was identified on another axis than the bench file states.
    ModelError
        Not a model file, or it holds effects or parameters that are not known.
    """
    from pmac_comp.physics.identify import model_from_file

    stored = read_model(path)
    check_same_drive(stored, bench, path.name)
    return model_from_file(stored, bench, library=user_effects(effects))


def user_effects(path: Path | None) -> dict[str, Any]:
    """Effects of a user's Python file that a person named; none without one."""
    if path is None:
        return {}
    from pmac_comp.physics.model.effect import load_effects

    return dict(load_effects(path))


def identify_captures(
    captures: Sequence[Capture],
    bench: Bench,
    *,
    names: Sequence[str] = (),
    digests: Sequence[str] = (),
    model: "DriveModel | None" = None,
    friction: Friction = "coulomb",
    progress: Progress | None = None,
) -> IdentificationOutcome:
    """Identify a drive from captures in memory."""
    from pmac_comp.physics.identify import identify, identify_with_friction, to_model_file

    if model is None and friction == "auto":
        result = identify_with_friction(captures, bench, progress=progress)
    else:
        result = identify(captures, bench, model=model, progress=progress)
    given = list(names) or [
        str(c.attributes.get("motion", f"capture {i + 1}")) for i, c in enumerate(captures)
    ]
    told = _made_with_compensation(captures, bench, given)
    result = replace(result, statements=(*told, *result.statements))
    stored = to_model_file(
        result, bench, data=list(zip(given, list(digests) or [""] * len(given), strict=True))
    )
    return IdentificationOutcome(bench, tuple(captures), result, stored)


def base_friction(captures: Sequence[Capture], bench: Bench) -> Friction:
    """Friction to begin from: Coulomb's, but for a drive that creeps at rest, which none fits."""
    from pmac_comp.physics.identify.smooth import smooth_values
    from pmac_comp.physics.model.drive import DriveModel

    return "coulomb" if smooth_values(captures, DriveModel.base(bench)) is None else "auto"


def acted_in(captures: Sequence[Capture], bench: Bench, names: Sequence[str]) -> list[str]:
    """Names of the captures in which a compensation acted."""
    return [
        name
        for capture, name in zip(captures, names, strict=True)
        if capture.largest_added_m > bench.motor_resolution_m
        or capture.attributes.get("compensation") == "on"
    ]


def _made_with_compensation(
    captures: Sequence[Capture], bench: Bench, names: Sequence[str]
) -> tuple[str, ...]:
    """That a compensation acted in runs: the torque that a law adds is not in their columns."""
    acted = acted_in(captures, bench, names)
    if not acted:
        return ()
    return (
        f"{len(acted)} of {len(names)} captures were made with a compensation on ({acted[0]}"
        f"{', ...' if len(acted) > 1 else ''}). What a law feeds forward as torque is not in them "
        "and bends the fit: identify from runs without (`pmac-comp rollback` or `remove` before "
        "`capture`).",
    )


def identify_files(
    captures: Sequence[Path],
    bench: str,
    *,
    model: Path | None = None,
    added: tuple[str, ...] = (),
    effects: Path | None = None,
    friction: Friction = "auto",
    progress: Progress | None = None,
) -> IdentificationOutcome:
    """Identify a drive from capture files.

    Parameters
    ----------
    captures, bench : sequence of Path, str
        What was measured, and the bench file or its name.
    model, added, effects : Path or None, tuple of str, Path or None
        Model to start from, effects to add, file with effects of the user's own.
    friction : "auto" or "coulomb"
        ``auto`` chooses the form of friction by what the captures show, unless a model or effects
        are given; ``coulomb`` keeps to the base model.

    Raises
    ------
    ConfigError
        A capture is of another axis, or not sampled at its servo period or a multiple of it.
    """
    loaded = load_bench(bench)
    read = captures_of(captures, loaded)
    try:
        return identify_captures(
            read,
            loaded,
            names=[path.name for path in captures],
            digests=[file_digest(path) for path in captures],
            model=_start_model(loaded, model, added, effects),
            friction=friction,
            progress=progress,
        )
    except NotIdentifiable as error:
        longest_mm = max(float(np.ptp(c.commanded_position_m)) for c in read) * MM_PER_M
        if longest_mm == 0.0:
            error.add_note("Nothing moves: the command of every capture is at rest.")
        elif longest_mm < _HARDLY_ANY_mm:
            error.add_note(
                f"No capture commands more than {longest_mm:.3g} mm: are its positions in m? They "
                "are in mm."
            )
        raise


def _start_model(
    bench: Bench, model: Path | None, added: tuple[str, ...], effects: Path | None
) -> "DriveModel | None":
    if model is None and not added and effects is None:
        return None
    from pmac_comp.physics.model.drive import DriveModel

    library = user_effects(effects)  # also without --with, so that a wrong file is told
    drive = DriveModel.base(bench) if model is None else load_model(model, bench, effects=effects)
    for name in added:
        drive = drive.with_effect(name, library=library)
    return drive
