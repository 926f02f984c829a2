"""What a rival model is and how it gets its best-fit parameters.

Imports ``files``, ``base`` and the filters of this package; scipy does the minimisation.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.errors import ModelError
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.derivatives import bridged, central_difference, motion_of
from pmac_comp.physics.identify.result import StaticMap
from pmac_comp.physics.identify.rigid import actuator_lag_s

_REST_m_per_s = 1e-4
_THIN_Hz = 320.0


@dataclass(frozen=True)
class Signals:
    """What a rival may look at, shapes (n,).

    Parameters
    ----------
    x_m : ndarray
        Distance from the fixed bearing to the nut.
    v_m_per_s, a_m_per_s2, direction : ndarray
        Motion of the motor, filtered without delay.
    torque_Nm : ndarray
        Torque at the motor (command, late by the actuator's lag); zeros without a torque channel.
    error_m : ndarray
        Measured table minus motor without the static map.
    usable : ndarray of bool
        Rows that count.
    period_s : float
        Sample period.
    """

    x_m: FloatArray
    v_m_per_s: FloatArray
    a_m_per_s2: FloatArray
    direction: FloatArray
    torque_Nm: FloatArray
    error_m: FloatArray
    usable: BoolArray
    period_s: float


ErrorModel = Callable[[Signals, FloatArray, Bench], FloatArray]


@dataclass(frozen=True)
class Rival:
    """One published model.

    Parameters
    ----------
    name, source : str
        For the table.
    parameters : tuple of (name, scale)
        Parameters in SI with their typical size.
    error_m : callable
        ``error_m(signals, theta, bench)``, the mechanical error in m, shape (n,).
    needs_torque : bool
        Whether the publication drives it with the torque.
    """

    name: str
    source: str
    parameters: tuple[tuple[str, float], ...]
    error_m: ErrorModel
    needs_torque: bool = False


@dataclass(frozen=True)
class FittedRival:
    """A rival with its best-fit parameters, SI."""

    rival: Rival
    parameters: Mapping[str, float]
    bench: Bench

    def predict(self, capture: Capture, static_map: StaticMap | None = None) -> FloatArray:
        """Predicted mechanical error of a capture in m, shape (n,), static error left out."""
        signals = signals_of(capture, self.bench, static_map)
        theta = np.array(list(self.parameters.values()))
        return self.rival.error_m(signals, theta, self.bench)


def signals_of(capture: Capture, bench: Bench, static_map: StaticMap | None = None) -> Signals:
    """Signals of a capture; raises ModelError where it has no table position."""
    if capture.table_position_m is None:
        raise ModelError(
            "Rival models of the mechanical error need captures with a table position.",
            code="PC-CMP-001",
            hint="Gather the scale too.",
        )
    mask, period = capture.mask, capture.sample_period_s
    motor = bridged(capture.motor_position_m, mask)
    table = bridged(capture.table_position_m, mask)
    motion = motion_of(motor, period, mask)
    error = table - motor
    if static_map is not None:
        error = error - static_map.error_m(table)
    speed = motion.velocity_m_per_s
    return Signals(
        x_m=motion.position_m + bench.screw_position_m(0.0),
        v_m_per_s=speed,
        a_m_per_s2=motion.acceleration_m_per_s2,
        direction=np.where(np.abs(speed) > _REST_m_per_s, np.sign(speed), 0.0),
        torque_Nm=_torque(capture, bench),
        error_m=error,
        usable=motion.usable,
        period_s=period,
    )


def _torque(capture: Capture, bench: Bench) -> FloatArray:
    if capture.torque_command_Nm is None:
        return np.zeros(capture.n)
    torque = bridged(capture.torque_command_Nm, capture.mask)
    late = np.interp(capture.time_s - actuator_lag_s(bench), capture.time_s, torque)
    return motion_of(late, capture.sample_period_s, capture.mask).position_m


def fit_rival(
    rival: Rival,
    captures: Sequence[Capture],
    bench: Bench,
    static_map: StaticMap | None = None,
    *,
    start: FloatArray | None = None,
) -> FittedRival:
    """Rival with the parameters that leave the least mechanical error of the captures.

    A constant per capture (the scale offset) is not part of the error. ``start`` has a value for
    each of the rival's parameters, shape (p,).
    """
    runs = [signals_of(capture, bench, static_map) for capture in captures]
    scales = np.array([scale for _, scale in rival.parameters])

    def left(theta: FloatArray) -> FloatArray:
        parts = [_centred(run, rival.error_m(run, theta * scales, bench)) for run in runs]
        return np.asarray(np.concatenate(parts) * UM_PER_M)

    first = np.ones(scales.size) if start is None else start / scales
    found = least_squares(left, first, x_scale="jac", max_nfev=60)
    names = [name for name, _ in rival.parameters]
    return FittedRival(rival, dict(zip(names, (found.x * scales).tolist(), strict=True)), bench)


def _centred(run: Signals, predicted_m: FloatArray) -> FloatArray:
    thin = max(round(1.0 / (_THIN_Hz * run.period_s)), 1)
    gap = (run.error_m - predicted_m)[run.usable][::thin]
    return gap - gap.mean() if gap.size else gap


def table_acceleration(signals: Signals, error_m: FloatArray) -> FloatArray:
    """Acceleration of the table, motor plus second derivative of an error, shape (n,)."""
    slope = central_difference(error_m, signals.period_s)
    return signals.a_m_per_s2 + central_difference(slope, signals.period_s)
