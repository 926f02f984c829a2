"""A command and a model to a capture: `predict` on files, on whatever grid the command has.

What lives here: reading the command, the way to the servo's grid and back. What may not: the
simulation (``physics.model``).
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import CaptureError, ConfigError
from pmac_comp.base.units import MS_PER_S, US_PER_S
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import (
    EXTERNAL_FORCE,
    PREDICTED,
    TORQUE_FEEDFORWARD,
    Capture,
    read_capture,
    write_capture,
)
from pmac_comp.physics.model.start import RELAXED, Start
from pmac_comp.physics.signals.metrics import rms_um
from pmac_comp.workflow.bench.same_axis import PERIOD_TOLERANCE
from pmac_comp.workflow.model.identification import load_model
from pmac_comp.workflow.motion.commands import read_command

Rounding = Literal["expected", "none"]
_COARSEST = 12.0  # servo periods per sample of a command that is interpolated


def predict_files(
    bench: str,
    model: Path,
    command: Path,
    out: Path,
    *,
    effects: Path | None = None,
    rounding: Rounding = "expected",
) -> dict[str, Any]:
    """Predict a command and write the capture; where it lies and what it says, for `predict`.

    Parameters
    ----------
    bench, model
        Bench file or its name, and model file.
    command : Path
        A command file, on the servo's grid or another one, or a capture. Of a capture the corrected
        command and the load are used too where it holds them, and the torque that it held at rest:
        a run that follows a move begins with friction strained and the chain wound up.
    out : Path
        The capture, at the times of the command; its positions are those before the sensors round
        them.
    effects : Path or None
        File with effects of the user's own.
    rounding : "expected" or "none"
        With ``expected`` the loop runs on rounded readings and the mean of what can be foreseen of
        it is given, with ``none`` it runs on exact ones.

    Raises
    ------
    ConfigError
        The model is of another axis, or the command is sampled too coarsely.
    CaptureError
        The command cannot be read, or samples of it are marked as lost.
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
    """What a command file or a capture gives to a prediction."""
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
        self._given_s = time_s - time_s[0]
        self._period_s = period_s
        self._step_s = float(self._given_s[-1] / (time_s.size - 1))
        self.same = abs(self._step_s / period_s - 1.0) <= PERIOD_TOLERANCE
        n = math.ceil(self._given_s[-1] / period_s - 1e-6) + 1
        if self._step_s > _COARSEST * period_s:
            raise ConfigError(
                f"The command has a step of {self._step_s * MS_PER_S:.3g} ms, the servo period is "
                f"{period_s * US_PER_S:.2f} us: what happens in between is not in it.",
                code="PC-IDF-002",
                hint="Sample the command at the servo period, or at least every "
                f"{_COARSEST * period_s * MS_PER_S:.1f} ms; time_s is in seconds.",
            )
        self._servo_s = self._given_s if self.same else period_s * np.arange(max(n, 2))

    def onto(self, values: FloatArray) -> FloatArray:
        """Values at the servo's times; the last one is held."""
        if self.same:
            return values
        from scipy.interpolate import make_interp_spline

        degree = min(3, values.size - 1)
        inside = np.minimum(self._servo_s, self._given_s[-1])
        return np.asarray(make_interp_spline(self._given_s, values, k=degree)(inside))

    def onto_optional(self, values: FloatArray | None) -> FloatArray | None:
        """``onto``, of nothing nothing."""
        return None if values is None else self.onto(values)

    def back(self, values: FloatArray) -> FloatArray:
        """Values at the times of the command."""
        return values if self.same else np.interp(self._given_s, self._servo_s, values)

    def note(self) -> str:
        """What was done to the grid, empty where nothing was."""
        if self.same:
            return ""
        return (
            f"the command's step of {self._step_s * US_PER_S:.2f} us was brought onto the servo "
            f"period, {self._period_s * US_PER_S:.2f} us; between servo cycles the prediction is "
            "interpolated"
        )
