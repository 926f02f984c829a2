"""Identification and prediction on files: captures and benches in, models and captures out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pmac_comp.base.errors import ConfigError
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture, file_digest, read_capture, write_capture
from pmac_comp.files.model_file import ModelFile, read_model, write_model
from pmac_comp.workflow.commands import read_command

if TYPE_CHECKING:
    from pmac_comp.physics.identify.result import Identification
    from pmac_comp.physics.model.drive import DriveModel

Progress = Callable[[str, float], None]
_PERIOD_TOLERANCE = 1e-3


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

    def statements(self) -> tuple[str, ...]:
        """Identifiability in words."""
        return tuple(self.identification.statements)

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        return {
            "kind": "identification",
            **self.model_file.model_dump(mode="json"),
            "figures": dict(self.identification.figures),
            "method": self.identification.method,
            "statements": list(self.identification.statements),
        }


def load_model(path: Path, bench: Bench, *, effects: Path | None = None) -> "DriveModel":
    """Drive model of a model file, with effects of the user's own file if one is named."""
    from pmac_comp.physics.identify import model_from_file

    return model_from_file(read_model(path), bench, library=user_effects(effects))


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
    progress: Progress | None = None,
) -> IdentificationOutcome:
    """Identify a drive from captures in memory."""
    from pmac_comp.physics.identify import identify, to_model_file

    result = identify(captures, bench, model=model, progress=progress)
    given = list(names) or [
        str(c.attributes.get("motion", f"capture {i + 1}")) for i, c in enumerate(captures)
    ]
    stored = to_model_file(
        result, bench, data=list(zip(given, list(digests) or [""] * len(given), strict=True))
    )
    return IdentificationOutcome(bench, tuple(captures), result, stored)


def identify_files(
    captures: Sequence[Path],
    bench: str,
    *,
    model: Path | None = None,
    added: tuple[str, ...] = (),
    effects: Path | None = None,
    progress: Progress | None = None,
) -> IdentificationOutcome:
    """Identify a drive from capture files.

    Raises
    ------
    ConfigError
        A capture was not sampled at the bench's servo period or a multiple of it.
    """
    loaded = load_bench(bench)
    read = [read_capture(path) for path in captures]
    for path, capture in zip(captures, read, strict=True):
        check_period(capture, loaded, path.name)
    return identify_captures(
        read,
        loaded,
        names=[path.name for path in captures],
        digests=[file_digest(path) for path in captures],
        model=_start_model(loaded, model, added, effects),
        progress=progress,
    )


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


def check_period(capture: Capture, bench: Bench, name: str) -> None:
    """Refuse a capture that does not fit the servo period; multiples of it do."""
    ratio = capture.sample_period_s / bench.servo_period_s
    if ratio < 1.0 - _PERIOD_TOLERANCE or abs(ratio / round(ratio) - 1.0) > _PERIOD_TOLERANCE:
        raise ConfigError(
            f"{name} is sampled every {capture.sample_period_s * 1e6:.2f} us, the servo period of "
            f"the bench is {bench.servo_period_s * 1e6:.2f} us.",
            code="PC-IDF-001",
            hint="Use the bench file of this axis, or capture at the servo rate.",
        )


def predict_files(
    bench: str, model: Path, command: Path, out: Path, *, effects: Path | None = None
) -> dict[str, Any]:
    """Predict a command from rest and write the capture; the contract's ``predict``."""
    from pmac_comp.physics.model.drive import simulate

    loaded = load_bench(bench)
    drive = load_model(model, loaded, effects=effects)
    time_s, position = read_command(command)
    period = float((time_s[-1] - time_s[0]) / (time_s.size - 1))
    if abs(period / loaded.servo_period_s - 1.0) > _PERIOD_TOLERANCE:
        raise ConfigError(
            f"{command.name} has a step of {period * 1e6:.2f} us, the servo period is "
            f"{loaded.servo_period_s * 1e6:.2f} us.",
            code="PC-IDF-002",
            hint="Sample the command at the servo period.",
        )
    response = simulate(drive, position)
    capture = Capture(
        time_s=time_s,
        commanded_position_m=position,
        desired_position_m=response.desired_position_m,
        motor_position_m=response.motor_position_m,
        table_position_m=None if loaded.scale is None else response.table_position_m,
        torque_command_Nm=response.torque_command_Nm,
        attributes={
            "source": "predicted by a model, not measured",
            "model": model.name,
            "servo_period_s": loaded.servo_period_s,
        },
    )
    write_capture(out, capture)
    error = response.table_position_m - response.motor_position_m
    return {
        "out": out,
        "samples": capture.n,
        "effects": list(drive.effects),
        "mechanical_rms_um": float(np.sqrt(np.mean(error**2)) * 1e6),
        "control_rms_um": float(np.sqrt(np.mean(response.control_error_m**2)) * 1e6),
    }
