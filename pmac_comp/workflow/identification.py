"""Identification and prediction on files: captures and benches in, models and captures out."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import CaptureError, ConfigError, NotIdentifiable
from pmac_comp.base.progress import Progress
from pmac_comp.base.units import MM_PER_M, MS_PER_S, US_PER_S
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import (
    PREDICTED,
    Capture,
    file_digest,
    predicted_remarks,
    read_capture,
    told_by,
    write_capture,
)
from pmac_comp.files.model_file import ModelFile, read_model, write_model
from pmac_comp.physics.model.start import RELAXED, Start
from pmac_comp.physics.signals.metrics import rms_um
from pmac_comp.workflow.commands import read_command
from pmac_comp.workflow.same_axis import PERIOD_TOLERANCE, captures_of, check_same_drive

if TYPE_CHECKING:
    from pmac_comp.physics.identify.result import Identification
    from pmac_comp.physics.model.drive import DriveModel

Friction = Literal["auto", "coulomb"]
Rounding = Literal["expected", "none"]
_HARDLY_ANY_mm = 0.5  # no motion that anybody identifies a drive from
_COARSEST = 12.0  # servo periods per sample of a command that is interpolated


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


def predict_files(
    bench: str,
    model: Path,
    command: Path,
    out: Path,
    *,
    effects: Path | None = None,
    rounding: Rounding = "expected",
) -> dict[str, Any]:
    """Predict a command and write the capture, for `predict`.

    ``command`` is a command file or a capture; of a capture the corrected command and the load are
    used too where it holds them, and the torque that it held at rest: a run that follows a move
    begins with friction strained and the chain wound up. A command on another grid than the
    servo's is brought onto that, and the answer is given at the times of the command. Positions
    are those before the sensors round them; with ``rounding`` "expected" the loop runs on rounded
    readings and the mean of what can be foreseen of it is given, with "none" on exact ones.
    """
    from pmac_comp.physics.model.drive import simulate
    from pmac_comp.physics.model.expected import expected_response

    loaded = load_bench(bench)
    drive = load_model(model, loaded, effects=effects)
    given = _inputs(command)
    grid = _ServoGrid(given.time_s, loaded.servo_period_s)
    run = simulate if rounding == "none" else expected_response
    start = _start(loaded, given)
    response = run(
        drive,
        grid.onto(given.commanded_m),
        desired_position_m=grid.onto_optional(given.desired_m),
        torque_feedforward_Nm=grid.onto_optional(given.feedforward_Nm),
        external_force_N=grid.onto_optional(given.force_N),
        start=start,
    )
    motor, table = grid.back(response.motor_position_m), grid.back(response.table_position_m)
    desired = given.commanded_m if given.desired_m is None else given.desired_m
    capture = Capture(
        time_s=given.time_s,
        commanded_position_m=given.commanded_m,
        desired_position_m=desired,
        motor_position_m=motor,
        table_position_m=None if loaded.scale is None else table,
        torque_command_Nm=grid.back(response.torque_command_Nm),
        attributes={
            "source": PREDICTED,
            "model": model.name,
            "servo_period_s": loaded.servo_period_s,
        },
    )
    write_capture(out, capture)
    return {
        "out": out,
        "samples": capture.n,
        "effects": list(drive.effects),
        "resampled": grid.note(),
        "mechanical_rms_um": rms_um(table - motor),
        "control_rms_um": rms_um(motor - desired),
    }


@dataclass(frozen=True)
class _Inputs:
    """What drives a prediction, each shape (n,)."""

    time_s: FloatArray
    commanded_m: FloatArray
    desired_m: FloatArray | None = None
    feedforward_Nm: FloatArray | None = None
    force_N: FloatArray | None = None
    motor_m: FloatArray | None = None
    torque_Nm: FloatArray | None = None


def _start(bench: Bench, given: _Inputs) -> Start:
    """What integrator and friction held as a captured run began; nothing of a command alone."""
    from pmac_comp.physics.model.resting import start_of

    if given.motor_m is None:
        return RELAXED
    desired_m = given.commanded_m if given.desired_m is None else given.desired_m
    period_s = float(np.median(np.diff(given.time_s)))
    return start_of(
        bench, desired_m, given.motor_m, given.torque_Nm, period_s, added_Nm=given.feedforward_Nm
    )


def _inputs(command: Path) -> _Inputs:
    from pmac_comp.physics.identify.records import EXTERNAL_FORCE, TORQUE_FEEDFORWARD

    if command.suffix.lower() == ".csv" and not _is_capture(command):
        return _Inputs(*read_command(command))
    capture = read_capture(command)
    if not capture.mask.all():
        raise CaptureError(
            f"{command.name} has {int((~capture.mask).sum())} samples marked as lost or clipped; "
            "the command there is not known.",
            code="PC-IDF-003",
            hint="Give the command as a CSV file with time_s and commanded_position_mm.",
        )
    extra = capture.extra
    return _Inputs(
        capture.time_s,
        capture.commanded_position_m,
        capture.desired_position_m,
        extra.get(TORQUE_FEEDFORWARD),
        extra.get(EXTERNAL_FORCE),
        capture.motor_position_m,
        capture.torque_command_Nm,
    )


def _is_capture(command: Path) -> bool:
    """Whether a CSV file holds what was measured, not only a command."""
    try:
        with command.open(encoding="utf-8-sig") as stream:
            lines = (line for line in stream if line.strip() and not line.startswith("#"))
            header = [name.strip() for name in next(lines, "").split(",")]
    except (OSError, UnicodeDecodeError):
        return False  # ``read_command`` says what is wrong
    return {"motor_position_mm", "desired_position_mm"} <= set(header)


class _ServoGrid:
    """Times of a command and the servo's own, and the way from one to the other."""

    def __init__(self, time_s: FloatArray, period_s: float) -> None:
        self._time = time_s - time_s[0]
        self._period = period_s
        self._given = float(self._time[-1] / (time_s.size - 1))
        self.same = abs(self._given / period_s - 1.0) <= PERIOD_TOLERANCE
        n = math.ceil(self._time[-1] / period_s - 1e-6) + 1
        if self._given > _COARSEST * period_s:
            raise ConfigError(
                f"The command has a step of {self._given * MS_PER_S:.3g} ms, the servo period is "
                f"{period_s * US_PER_S:.2f} us: what happens in between is not in it.",
                code="PC-IDF-002",
                hint="Sample the command at the servo period, or at least every "
                f"{_COARSEST * period_s * MS_PER_S:.1f} ms; time_s is in seconds.",
            )
        self._fine = self._time if self.same else period_s * np.arange(max(n, 2))

    def onto(self, values: FloatArray) -> FloatArray:
        """Values at the servo's times; the last one is held."""
        if self.same:
            return values
        from scipy.interpolate import make_interp_spline

        degree = min(3, values.size - 1)
        inside = np.minimum(self._fine, self._time[-1])
        return np.asarray(make_interp_spline(self._time, values, k=degree)(inside))

    def onto_optional(self, values: FloatArray | None) -> FloatArray | None:
        """``onto``, of nothing nothing."""
        return None if values is None else self.onto(values)

    def back(self, values: FloatArray) -> FloatArray:
        """Values at the times of the command."""
        return values if self.same else np.interp(self._time, self._fine, values)

    def note(self) -> str:
        """What was done to the grid, empty where nothing was."""
        if self.same:
            return ""
        return (
            f"the command's step of {self._given * US_PER_S:.2f} us was brought onto the servo "
            f"period, {self._period * US_PER_S:.2f} us; between servo cycles the prediction is "
            "interpolated"
        )
