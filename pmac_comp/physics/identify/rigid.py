"""Rigid one-mass drive from motor position and drive force: inverse dynamics, least squares.

The path for benches without a scale at the table (EMPS): ``F = M a + F_v v + F_c sign(v) + F_0``.
What may not live here: elasticity. Imports ``files``, ``base`` and this package.
"""

from collections.abc import Sequence

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
from pmac_comp.physics.model.drive import DriveModel

SYMMETRIC = ("mass_kg", "viscous_N_s_per_m", "coulomb_N", "bias_force_N")
IN_MODEL = {
    "mass_kg": "chain.mass_kg",
    "viscous_N_s_per_m": "viscous.guide_Ns_per_m",
    "coulomb_N": "coulomb.guide_N",
    "bias_force_N": "bias_force.force_N",
}
"""Parameters of a rigid model by the names that they have here."""
ASYMMETRIC = (
    "mass_kg",
    "viscous_positive_N_s_per_m",
    "coulomb_positive_N",
    "viscous_negative_N_s_per_m",
    "coulomb_negative_N",
)
_BLOCK_s = 0.25  # residuals of a drive are repeatable over a reversal, not beyond
_MAX_MASS_STD = 0.2  # of the mass: a worse estimate is noise that looks like a mass
_ADVICE = {
    "mass_kg": "a sinusoid or trapezoid with clearly changing acceleration, e.g. 10 mm at 2-3 Hz",
    "viscous_N_s_per_m": "runs at several constant speeds up to the highest, in both directions",
    "viscous_positive_N_s_per_m": "runs at several constant speeds in the positive direction",
    "viscous_negative_N_s_per_m": "runs at several constant speeds in the negative direction",
    "coulomb_N": "slow runs in both directions",
    "coulomb_positive_N": "slow runs in the positive direction",
    "coulomb_negative_N": "slow runs in the negative direction",
    "bias_force_N": "the same motion in both directions",
}


def rigid_regression(
    captures: Sequence[Capture], bench: Bench, *, friction: str = "symmetric"
) -> Regression:
    """Mass, friction and bias of a rigid drive, in kg, N s/m and N at the table.

    Parameters
    ----------
    captures : sequence of Capture
        Motor position and torque command.
    bench : Bench
        Lead, servo period; current loop and delay where stated.
    friction : "symmetric" or "asymmetric"
        One viscous and Coulomb pair with a bias, or one pair for each direction.

    Raises
    ------
    NotIdentifiable
        No torque, no motion, one direction only, or one constant speed only.

    Assumes
    -------
    The drive is stiff up to 100 Hz; derivatives come from the 100 Hz zero-phase filter.

    Source
    ------
    IDIM-LS of Janot, Gautier, Brunot, "Data Set and Reference Models of EMPS", 2019.
    """
    names = SYMMETRIC if friction == "symmetric" else ASYMMETRIC
    parts = [_rows(capture, bench, friction) for capture in captures]
    columns = np.concatenate([part[0] for part in parts])
    force_N = np.concatenate([part[1] for part in parts])
    rate_Hz = 1.0 / (captures[0].sample_period_s * _decimation(captures[0]))
    fit = regress(names, columns, force_N, block=round(_BLOCK_s * rate_Hz), advice=_ADVICE)
    _check_mass(fit)
    return fit


def rigid_start(captures: Sequence[Capture], bench: Bench, start: DriveModel) -> DriveModel:
    """A rigid model at mass and friction of inverse dynamics, where nobody stated a mass.

    A loop that is tuned for the mass of the axis need not be stable with another one, and from an
    unstable loop no step leads anywhere. Without torque, or with runs that do not tell, the model
    stays as it is.

    Parameters
    ----------
    captures : sequence of Capture
        Runs that are going to be fitted.
    bench : Bench
        Lead, servo period; current loop and delay where stated.
    start : DriveModel
        Model to begin with; one that is not rigid, or has a mass already, is returned as it is.
    """
    told = [c for c in captures if c.torque_command_Nm is not None]
    if not (start.is_rigid and told):
        return start
    mass = start.spec("chain.mass_kg")
    if mass.kind != "free" or start.parameters[mass.name] != mass.nominal:
        return start
    try:
        fit = rigid_regression(told, bench)
    except NotIdentifiable:
        return start
    values = in_model(fit)
    return start.with_parameters({k: v for k, v in values.items() if k in start.parameters})


def in_model(fit: Regression) -> dict[str, float]:
    """Values of a symmetric fit by the names of a rigid model; only a bias may be negative."""
    values = {name: fit.value(own) for own, name in IN_MODEL.items()}
    return {k: v if k == "bias_force.force_N" else max(v, 0.0) for k, v in values.items()}


def _check_mass(fit: Regression) -> None:
    mass_kg, std_kg = fit.value("mass_kg"), fit.std("mass_kg")
    if mass_kg <= 0.0 or std_kg > _MAX_MASS_STD * mass_kg:
        raise NotIdentifiable(
            f"Not identifiable: mass_kg comes out as {mass_kg:.3g} +- {std_kg:.2g} kg; the "
            "acceleration in these captures is too small against their noise.",
            code="PC-IDN-004",
            hint=f"Capture {_ADVICE['mass_kg']}.",
            context={"parameters": ["mass_kg"]},
        )


def force_of(capture: Capture, bench: Bench) -> FloatArray:
    """Drive force at the table in N, shape (n,), late by the actuator's delay."""
    if capture.torque_command_Nm is None:
        raise NotIdentifiable(
            "The capture has no torque command: without a scale at the table it alone can tell "
            "mass and friction.",
            code="PC-IDN-003",
            hint="Gather the torque command too (it is in the default gather set-up).",
            context={"parameters": list(SYMMETRIC)},
        )
    force_N = bridged(capture.torque_command_Nm, capture.mask) / bench.lead_m_per_rad
    late = capture.time_s - actuator_lag_s(bench)
    return np.interp(late, capture.time_s, force_N)


def actuator_lag_s(bench: Bench) -> float:
    """Lag in s between torque command and torque: stated delay and current loop."""
    nominal = bench.nominal
    lag_s = 1e-6 * (nominal.actuator_delay_us or 0.0)
    if nominal.current_bandwidth_Hz is not None:
        lag_s += 1.0 / (2.0 * np.pi * nominal.current_bandwidth_Hz)
    return float(lag_s)


def _rows(capture: Capture, bench: Bench, friction: str) -> tuple[FloatArray, FloatArray]:
    force_N = force_of(capture, bench)
    if capture.n <= 4 * BORDER_SAMPLES or int(capture.mask.sum()) < 2:
        return np.empty((0, len(SYMMETRIC if friction == "symmetric" else ASYMMETRIC))), force_N[:0]
    motion = motion_of(capture.motor_position_m, capture.sample_period_s, capture.mask)
    v, direction = motion.velocity_m_per_s, _direction(motion.velocity_m_per_s, bench)
    columns = _columns(motion.acceleration_m_per_s2, v, direction, friction)
    inner = slice(BORDER_SAMPLES, capture.n - BORDER_SAMPLES)
    both = np.column_stack([columns, force_N])[inner]
    # At rest friction takes up any force below its level: that row says nothing of the drive, and
    # what a controller without an integrator holds there, mostly one way, would pass for a bias.
    tells = motion.usable & (direction != 0.0) if np.any(direction) else motion.usable
    thin, usable = decimated(both, tells[inner], _decimation(capture))
    return thin[usable, :-1], thin[usable, -1]


def _decimation(capture: Capture) -> int:
    return max(round(1.0 / (CUTOFF_Hz * capture.sample_period_s)), 1)


def _direction(velocity_m_per_s: FloatArray, bench: Bench) -> FloatArray:
    # Below one count per 50 ms the sign is that of the quantisation.
    floor = bench.motor_resolution_m / 0.05
    still = np.abs(velocity_m_per_s) < floor
    return np.where(still, 0.0, np.sign(velocity_m_per_s))


def _columns(a: FloatArray, v: FloatArray, s: FloatArray, friction: str) -> FloatArray:
    if friction == "symmetric":
        return np.column_stack([a, v, s, np.ones_like(v)])
    forward, backward = s > 0.0, s < 0.0
    return np.column_stack([a, v * forward, 1.0 * forward, v * backward, -1.0 * backward])
