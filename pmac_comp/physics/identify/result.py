"""What identification gives back: estimates with intervals, what they leave, what they cannot say.

What lives here: frozen values only. What may not: any fitting. Imports ``physics.model`` (types)
and ``base``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

Z95 = 1.959963984540054  # two-sided 95 % point of the normal distribution


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter in SI with its interval.

    Parameters
    ----------
    name : str
        Name in the model (``effect.parameter`` for effects).
    value, std, lower95, upper95 : float
        Estimate, standard deviation and 95 % interval, SI.
    unit : str
        SI unit.
    fixed : bool
        True when it was not estimated.
    nominal, tolerance_frac : float or None
        Value of the bench file and its tolerance as a fraction.
    informed_frac : float
        Share of the interval that the captures, not the bench file, decide (0..1).
    """

    name: str
    value: float
    std: float
    lower95: float
    upper95: float
    unit: str
    fixed: bool = False
    nominal: float | None = None
    tolerance_frac: float | None = None
    informed_frac: float = 1.0


def estimate(name: str, value: float, std: float, unit: str) -> ParameterEstimate:
    """Estimate with the normal 95 % interval, SI."""
    half = Z95 * std
    return ParameterEstimate(name, value, std, value - half, value + half, unit)


@dataclass(frozen=True)
class CaptureResiduals:
    """What the fitted model leaves of one capture, measured minus simulated, shape (n,) each.

    Invalid samples hold NaN. Channels that the capture lacks are None. ``table_m`` is that of table
    minus motor, the mechanical error, without the capture's scale offset and the static map.
    """

    motor_m: FloatArray | None
    table_m: FloatArray | None
    torque_Nm: FloatArray | None
    scale_offset_m: float = 0.0


@dataclass(frozen=True)
class NoiseLevels:
    """Standard deviation of what the model leaves, pooled over the captures."""

    motor_m: float | None
    table_m: float | None
    torque_Nm: float | None


@dataclass(frozen=True)
class StaticMap:
    """Static lead error estimated beside the dynamics: piecewise linear plus screw harmonics.

    Parameters
    ----------
    knots_m, values_m : ndarray, shape (k,)
        Table positions and static error there.
    orders_per_rev, cosine_m, sine_m : ndarray, shape (h,)
        Harmonics of the screw angle ``2 pi x / pitch``.
    pitch_m : float
        Screw pitch.
    """

    knots_m: FloatArray
    values_m: FloatArray
    orders_per_rev: FloatArray
    cosine_m: FloatArray
    sine_m: FloatArray
    pitch_m: float

    def error_m(self, table_position_m: FloatArray) -> FloatArray:
        """Static lead error in m at table positions in m, shape (n,).

        Beyond the knots it goes on with the mean slope of the map.
        """
        low, high = self.knots_m[0], self.knots_m[-1]
        slope = (self.values_m[-1] - self.values_m[0]) / (high - low)
        beyond = table_position_m - np.clip(table_position_m, low, high)
        smooth = np.interp(table_position_m, self.knots_m, self.values_m) + slope * beyond
        phase = 2.0 * np.pi * np.multiply.outer(table_position_m, self.orders_per_rev)
        phase = phase / self.pitch_m
        wobble = np.cos(phase) @ self.cosine_m + np.sin(phase) @ self.sine_m
        return np.asarray(smooth + wobble, dtype=np.float64)

    def covers(self, table_position_m: FloatArray) -> BoolArray:
        """Whether table positions in m, shape (n,), lie where the map was fitted."""
        low, high = self.knots_m[0], self.knots_m[-1]
        inside: BoolArray = (table_position_m >= low) & (table_position_m <= high)
        return inside


@dataclass(frozen=True)
class Identification:
    """Fitted model with everything a reader needs to trust or distrust it.

    Parameters
    ----------
    model : DriveModel
        The fitted model, ready for ``simulate``.
    parameters : Mapping of str to ParameterEstimate
        Estimates by name, SI.
    correlation_names, correlation : tuple of str, ndarray, shape (p, p)
        Correlation of the estimated parameters.
    noise : NoiseLevels
        What the model leaves per channel.
    residuals : tuple of CaptureResiduals
        Per capture.
    statements : tuple of str
        Identifiability in words.
    method : str
        How the estimates were found.
    figures : Mapping of str to float
        Further figures of merit (relative force error and the like).
    static_map : StaticMap or None
        Static lead error estimated beside the dynamics.
    """

    model: "DriveModel"
    parameters: Mapping[str, ParameterEstimate]
    correlation_names: tuple[str, ...]
    correlation: FloatArray
    noise: NoiseLevels
    residuals: tuple[CaptureResiduals, ...]
    statements: tuple[str, ...]
    method: str
    figures: Mapping[str, float] = field(default_factory=dict)
    static_map: StaticMap | None = None


def correlation_of(covariance: FloatArray) -> FloatArray:
    """Correlation matrix of a covariance matrix, shape (p, p); 0 for fixed parameters."""
    std = np.sqrt(np.diag(covariance))
    safe = np.where(std > 0.0, std, 1.0)
    correlation = covariance / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    return np.asarray(correlation, dtype=np.float64)
