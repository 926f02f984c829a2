"""Friction models of a one-mass drive side by side, judged lap by lap where they were not fitted.

Without a scale at the table there is no mechanical error to predict; what a model can be judged on
is the motor: in the closed loop from the command alone, and one step ahead from the measured past.
Imports this package and ``physics.model``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pmac_comp.base.errors import DidNotConverge, ModelError, NotIdentifiable
from pmac_comp.base.progress import Progress, untold
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.joint import identify
from pmac_comp.physics.identify.records import prepare, response_of
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.quasi_static import table_force_N
from pmac_comp.physics.signals.metrics import rms_um

# Effects beside Coulomb and viscous friction, from the published symmetric model upwards.
GROWTH: tuple[tuple[str, ...], ...] = (
    ("bias_force",),
    ("bias_force", "friction_asymmetry"),
    ("bias_force", "viscous_nonlinear"),
    ("bias_force", "friction_asymmetry", "viscous_nonlinear"),
    ("bias_force", "friction_asymmetry", "stribeck"),
    ("bias_force", "friction_asymmetry", "viscous_nonlinear", "presliding"),
)
_SAME_m = 1e-6  # a command that repeats does so to its resolution
_SHORTEST_s = 0.5
_NM_PER_M = 1e9


@dataclass(frozen=True)
class RigidRow:
    """One model: position error per lap (fitted ones first) and one step ahead.

    ``left_rms_um`` is that of the laps that were not used for fitting.
    """

    name: str
    source: str
    n_parameters: int
    left_rms_um: float
    error_rms_um: float
    laps_um: tuple[float, ...]
    one_step_nm: float


@dataclass(frozen=True)
class RigidComparison:
    """Rows of the table.

    Parameters
    ----------
    rows : tuple of RigidRow
        Models that could be fitted, the simplest first.
    refused : Mapping of str to str
        Models that could not, and why.
    fitted_laps, n_laps : int
        Laps used for fitting (the first ones) and all.
    floor_um : float or None
        Repeatability of the laps, see ``repeatability_um``; None where the command does not repeat.
    lattice_nm : float
        Resolution of the encoder: the floor of one step ahead is of its size.
    """

    rows: tuple[RigidRow, ...]
    refused: dict[str, str]
    fitted_laps: int
    n_laps: int
    floor_um: float | None
    lattice_nm: float


def compare_rigid(
    capture: Capture,
    bench: Bench,
    *,
    growth: Sequence[tuple[str, ...]] = GROWTH,
    progress: Progress | None = None,
) -> RigidComparison:
    """Fit each model to the first half of a record and judge it on every lap.

    Parameters
    ----------
    capture : Capture
        One record with torque, best of a command that repeats itself.
    bench : Bench
        A one-mass bench.
    growth : sequence of tuples of str
        Effects of each model beside Coulomb and viscous friction.
    progress : callable or None
        ``progress(text, fraction)``.

    Raises
    ------
    ModelError
        The capture holds no torque.

    Source
    ------
    EMPS: Janot, Gautier, Brunot 2019.
    """
    tell = progress or untold
    if capture.torque_command_Nm is None:
        raise ModelError(
            "Friction of a drive without a scale shows in the torque, which this capture lacks.",
            code="PC-CMP-005",
            hint="Capture the torque command too.",
        )
    lap = lap_samples(capture)
    n_laps = round(capture.n / lap)
    fitted_laps = max(n_laps // 2, 1) if n_laps > 1 else 0
    border = fitted_laps * lap if n_laps > 1 else capture.n // 2
    rows, refused = [], {}
    for i, effects in enumerate(growth):
        name = " + ".join(effects)
        tell(name, i / len(growth))
        try:
            rows.append(_row(capture, bench, effects, lap, border))
        except (DidNotConverge, NotIdentifiable) as error:
            refused[name] = error.message
    tell("compared", 1.0)
    return RigidComparison(
        tuple(rows),
        refused,
        fitted_laps,
        n_laps,
        repeatability_um(capture, lap) if n_laps > 2 else None,
        bench.motor_resolution_m * _NM_PER_M,
    )


def lap_samples(capture: Capture) -> int:
    """Samples after which the command repeats itself; all of them where it does not."""
    command = capture.commanded_position_m
    shortest = round(_SHORTEST_s / capture.sample_period_s)
    moving = float(np.ptp(command))
    if moving < _SAME_m:
        return capture.n
    centred = command - command.mean()
    n = capture.n
    likeness = np.fft.irfft(np.abs(np.fft.rfft(centred, 2 * n)) ** 2)[:n]
    power = np.concatenate(([0.0], np.cumsum(centred**2)))
    lags = np.arange(n)
    unlike = (power[n - lags] + power[n] - power[lags] - 2.0 * likeness) / (n - lags)
    for lag in np.flatnonzero(unlike < (1e-2 * moving) ** 2):
        # Only the bottom of each valley can be a repetition.
        if shortest <= lag < 2 * n // 3 and unlike[lag] <= unlike[lag - 1 : lag + 2].min():
            gap = command[lag:] - command[:-lag]
            if float(np.abs(gap).max()) < max(_SAME_m, 1e-4 * moving):
                return int(lag)
    return capture.n


def repeatability_um(capture: Capture, lap: int) -> float:
    """What the tracking errors of the last two whole laps differ by, rms in um."""
    error = capture.motor_position_m - capture.desired_m
    laps = [error[k * lap : (k + 1) * lap] for k in range(capture.n // lap)]
    return UM_PER_M * float(np.std(laps[-1] - laps[-2]))


def _row(
    capture: Capture, bench: Bench, effects: tuple[str, ...], lap: int, border: int
) -> RigidRow:
    model = _fitted(capture, bench, effects, border)
    stride = prepare(capture, bench).stride
    response = response_of(prepare(capture, bench), model)
    gap = capture.motor_position_m - response.motor_position_m[::stride][: capture.n]
    laps = [gap[start : start + lap] for start in range(0, capture.n, lap)]
    return RigidRow(
        name=" + ".join(effects),
        source="coulomb + viscous as published, with effects of this project",
        n_parameters=sum(not spec.discrete for spec in model.specs),
        left_rms_um=rms_um(gap[border:]),
        error_rms_um=rms_um(capture.motor_position_m[border:] - capture.desired_m[border:]),
        laps_um=tuple(rms_um(part) for part in laps if part.size > lap // 2),
        one_step_nm=_one_step_nm(capture, model, border),
    )


def _fitted(capture: Capture, bench: Bench, effects: tuple[str, ...], border: int) -> DriveModel:
    valid = capture.mask & (np.arange(capture.n) < border)
    part = replace(capture, valid=valid)
    start = identify([part], bench).model
    model = DriveModel.base(bench) if start is None else start
    for effect in effects:
        if effect not in model.effects:
            model = model.with_effect(effect)
    found = identify([part], bench, model=model).model
    if found is None:
        raise ModelError("The fit gave no model.", code="PC-CMP-006")
    return found


def _one_step_nm(capture: Capture, model: DriveModel, border: int) -> float:
    """Error of the next position from the measured past on the judged part, rms in nm.

    Models differ here only below the lattice of the encoder, whose own share is of its size.
    """
    torque = capture.torque_command_Nm
    if torque is None:
        raise ModelError("The record has no torque.", code="PC-CMP-005")
    q, period = capture.motor_position_m, capture.sample_period_s
    speed = np.gradient(q, period)
    friction = table_force_N(model, q, speed, np.zeros_like(q), np.sign(speed))
    force = torque / model.bench.lead_m_per_rad - friction
    ahead = 2.0 * q[1:-1] - q[:-2] + period**2 * force[1:-1] / model.parameters["chain.mass_kg"]
    return _NM_PER_M * float(np.sqrt(np.mean((q[2:] - ahead)[border:] ** 2)))
