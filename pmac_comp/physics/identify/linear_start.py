"""Linear start: two regressions on the same runs give friction and stiffness together.

(R1) ``e_m = -(alpha0 + alpha1 x) a - (beta0 + beta1 x) v - (gamma0 + gamma1 x) s`` beside the
static map, (R2) ``T = J a / rho + B v / rho + T_c s``. What may not live here: the closed loop.
Imports ``physics.model`` and this package.

Source: the elastic chain without its own inertia (R1) and Newton's law at the motor (R2); derived
here, ``model.quasi_static`` has the closed forms.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import NotIdentifiable
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.derivatives import (
    BORDER_SAMPLES,
    CUTOFF_Hz,
    bridged,
    decimated,
    motion_of,
)
from pmac_comp.physics.identify.regression import Regression, regress
from pmac_comp.physics.identify.rigid import actuator_lag_s
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.quasi_static import compliance_m_per_N

SKEW_TIME = "channel_skew.time_s"
SIX = ("alpha0", "alpha1", "beta0", "beta1", "gamma0", "gamma1")
_BLOCK_s = 0.25
_BLOCK_ROWS = max(round(_BLOCK_s * CUTOFF_Hz), 1)
_LEAST_SPEED_m_per_s = 2e-3  # below it the direction of the friction force is not known
_ADVICE = {
    "alpha0": "a sinusoid of 10 mm at 3 Hz",
    "alpha1": "the same sinusoid at both ends of the travel",
    "beta0": "constant speeds up to the highest, both ways",
    "beta1": "constant speeds near both ends of the travel",
    "gamma0": "slow runs in both directions",
    "gamma1": "slow runs in both directions near both ends of the travel",
    "acceleration": "a sinusoid of 10 mm at 3 Hz (the moving inertia)",
    "speed": "runs at several constant speeds up to the highest, in both directions (viscous "
    "friction)",
    "direction": "slow runs in both directions (Coulomb friction)",
}


@dataclass(frozen=True)
class _Rows:
    x_m: FloatArray
    a: FloatArray
    v: FloatArray
    s: FloatArray
    e_m: FloatArray
    torque_Nm: FloatArray | None
    capture: FloatArray


def six_coefficients(captures: Sequence[Capture], bench: Bench) -> Regression:
    """The six numbers of (R1) in SI; the offsets and the lead slope are estimated beside them.

    Raises
    ------
    NotIdentifiable
        Not enough motion, direction or travel; names the run that would help.
    """
    rows = _gathered(captures, bench)
    x = rows.x_m
    own = [rows.a, rows.a * x, rows.v, rows.v * x, rows.s, rows.s * x]
    static = _static_columns(rows, bench)
    columns = np.column_stack([*(-column for column in own), *static])
    names = (*SIX, *(f"static{i}" for i in range(len(static))))
    return regress(names, columns, rows.e_m, block=_block(captures[0]), advice=_ADVICE)


def starting_model(captures: Sequence[Capture], bench: Bench, model: DriveModel) -> DriveModel:
    """Model with friction from the two regressions, known values as they are.

    Raises
    ------
    NotIdentifiable
        The captures hold no motion, one direction or one speed only.
    """
    rows = _gathered(captures, bench)
    guide, compliance = _guide(rows, bench, model)
    speed = guide["viscous.guide_Ns_per_m"]
    shaft = None if rows.torque_Nm is None else _shaft(rows, rows.torque_Nm, bench)
    values = {name: max(value, 0.0) for name, value in guide.items()}
    if shaft is not None and SKEW_TIME in model.parameters:
        values["viscous.guide_Ns_per_m"] = _paid_for(speed, shaft, bench) * _guides_share(model)
        values[SKEW_TIME] = compliance * (speed - values["viscous.guide_Ns_per_m"])
    if shaft is not None:
        values |= _rotary(shaft, bench, model, values)
    known = {spec.name for spec in model.specs}
    return model.with_parameters({k: v for k, v in values.items() if k in known})


def lag_by_speed_s(captures: Sequence[Capture], bench: Bench, model: DriveModel) -> float:
    """Time by which the table lags in proportion to speed, s; viscous friction, or a late scale.

    Raises
    ------
    NotIdentifiable
        As ``starting_model``.

    Source
    ------
    Position read by dt earlier lags by v dt, as a table does that friction B v holds back: derived
    here.
    """
    guide, compliance = _guide(_gathered(captures, bench), bench, model)
    return compliance * guide["viscous.guide_Ns_per_m"]


def _guide(rows: _Rows, bench: Bench, model: DriveModel) -> tuple[dict[str, float], float]:
    """Friction at the guide by (R1), which may come out negative, and the mean compliance."""
    mass = model.parameters["chain.table_mass_kg"]
    table_m = rows.x_m - bench.screw_position_m(0.0)
    c = compliance_m_per_N(model, table_m)
    static = _static_columns(rows, bench)
    fit = regress(
        ("acceleration", "speed", "direction", *(f"static{i}" for i in range(len(static)))),
        np.column_stack([-c * rows.a, -c * rows.v, -c * rows.s, *static]),
        rows.e_m,
        block=_BLOCK_ROWS,
        advice=_ADVICE,
    )
    # C M comes out with the error of C: friction is scaled to the stated mass.
    scale = mass / max(fit.value("acceleration"), 0.1 * mass)
    friction = {
        "viscous.guide_Ns_per_m": scale * fit.value("speed"),
        "coulomb.guide_N": scale * fit.value("direction"),
    }
    return friction, float(np.mean(c)) / scale


def _shaft(rows: _Rows, torque_Nm: FloatArray, bench: Bench) -> Regression:
    """(R2), all of the drive as the motor feels it."""
    rho = bench.lead_m_per_rad
    return regress(
        ("acceleration", "speed", "direction", "bias"),
        np.column_stack([rows.a / rho, rows.v / rho, rows.s, np.ones_like(rows.a)]),
        torque_Nm,
        block=_BLOCK_ROWS,
        advice=_ADVICE,
    )


def _paid_for(speed_Ns_per_m: float, shaft: Regression, bench: Bench) -> float:
    """What of a viscous friction at the guide the torque pays for, at most all of the torque's."""
    most = max(shaft.value("speed"), 0.0) / bench.lead_m_per_rad**2
    return float(np.clip(speed_Ns_per_m, 0.0, most))


def _guides_share(model: DriveModel) -> float:
    """The guide's share of all viscous friction that the torque pays for, in the present values."""
    own, lead = model.parameters, model.bench.lead_m_per_rad
    guide = own["viscous.guide_Ns_per_m"] * lead**2
    turning = own["viscous.nut_Nms_per_rad"] + own["viscous.motor_Nms_per_rad"]
    return guide / (guide + turning) if guide > 0.0 else 0.0


def _rotary(
    shaft: Regression, bench: Bench, model: DriveModel, guide: dict[str, float]
) -> dict[str, float]:
    rho = bench.lead_m_per_rad
    # What both directions share: gravity on a tilted axis is far beyond what a fit finds from none.
    load_N = shaft.value("bias") / rho
    level = max(shaft.value("direction") - rho * guide["coulomb.guide_N"], 0.0)
    slope = max(shaft.value("speed") - rho**2 * guide["viscous.guide_Ns_per_m"], 0.0)
    return {
        "bias_force.force_N": load_N,
        **_shared(model, "coulomb.nut_Nm", "coulomb.motor_Nm", level),
        **_shared(model, "viscous.nut_Nms_per_rad", "viscous.motor_Nms_per_rad", slope),
    }


def _shared(model: DriveModel, nut: str, motor: str, total: float) -> dict[str, float]:
    """A sum shared as the present values are: the runs cannot tell."""
    a, b = model.parameters.get(nut, 1.0), model.parameters.get(motor, 1.0)
    share = a / (a + b) if a + b > 0.0 else 0.5
    return {nut: share * total, motor: (1.0 - share) * total}


def _static_columns(rows: _Rows, bench: Bench) -> list[FloatArray]:
    names = np.unique(rows.capture)
    offsets = [(rows.capture == name).astype(np.float64) for name in names]
    if float(np.ptp(rows.x_m)) < 2.0 * bench.pitch_m:
        return offsets
    phase = 2.0 * np.pi * rows.x_m / bench.pitch_m
    return [*offsets, rows.x_m - float(rows.x_m.mean()), np.cos(phase), np.sin(phase)]


def _gathered(captures: Sequence[Capture], bench: Bench) -> _Rows:
    parts = [
        _capture_rows(capture, capture.table_position_m, bench, float(i))
        for i, capture in enumerate(captures)
        if capture.table_position_m is not None and capture.n > 4 * BORDER_SAMPLES
    ]
    parts = [part for part in parts if part.x_m.size]
    if not parts:
        raise NotIdentifiable(
            "Nothing moves in these captures: friction and stiffness do not show at standstill.",
            code="PC-IDN-005",
            hint="Capture sinusoids of 10 mm at 1-3 Hz at three places of the travel and slow "
            "runs in both directions.",
            context={"parameters": list(SIX)},
        )
    has_torque = all(part.torque_Nm is not None for part in parts)
    joined = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("x_m", "a", "v", "s", "e_m", "capture")
    }
    torque = np.concatenate([part.torque_Nm for part in parts]) if has_torque else None
    return _Rows(torque_Nm=torque, **joined)


def _capture_rows(
    capture: Capture, table_position_m: FloatArray, bench: Bench, number: float
) -> _Rows:
    mask, period = capture.mask, capture.sample_period_s
    if int(mask.sum()) < 4 * BORDER_SAMPLES:
        empty = np.empty(0)
        return _Rows(empty, empty, empty, empty, empty, empty, empty)
    table = bridged(table_position_m, mask)
    motion = motion_of(table, period, mask)
    error = table - bridged(capture.motor_position_m, mask)
    columns = [motion.position_m, motion.velocity_m_per_s, motion.acceleration_m_per_s2, error]
    if capture.torque_command_Nm is not None:
        torque = bridged(capture.torque_command_Nm, mask)
        late = capture.time_s - actuator_lag_s(bench)
        columns.append(np.interp(late, capture.time_s, torque))
    factor = max(round(1.0 / (CUTOFF_Hz * period)), 1)
    thin, usable = decimated(np.column_stack(columns), motion.usable, factor)
    keep = usable & (np.abs(thin[:, 1]) > _LEAST_SPEED_m_per_s)
    thin = thin[keep]
    return _Rows(
        x_m=np.asarray(bench.screw_position_m(0.0) + thin[:, 0]),
        a=thin[:, 2],
        v=thin[:, 1],
        s=np.sign(thin[:, 1]),
        e_m=thin[:, 3],
        torque_Nm=thin[:, 4] if thin.shape[1] > 4 else None,
        capture=np.full(thin.shape[0], number),
    )


def _block(capture: Capture) -> int:
    factor = max(round(1.0 / (CUTOFF_Hz * capture.sample_period_s)), 1)
    return max(round(_BLOCK_s / (factor * capture.sample_period_s)), 1)
