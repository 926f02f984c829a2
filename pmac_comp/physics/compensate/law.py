"""The dynamic compensation law: one set of coefficients, evaluated on a commanded trajectory.

What lives here: the law as data in SI with its validity and provenance, and its arithmetic. What
may not: counts and registers (``workflow`` renders the law for a controller), the fit of the
coefficients (``design``). Imports ``base`` only.

With ``r`` the commanded position, ``v a j`` its backward differences at the servo period and ``x``
the distance from the law's origin::

    s' = |v| (sgn v - s) / break-away distance         friction state, follows distance
    c  = (A0 + A1 x) a + (V0 + V1 x) v + (S0 + S1 x) s + J0 j
    correction = c + D1 c' + D2 c''                     is added to the command
    q  = TJ a + TK j + TB v + (TC + TE |a| + TS / (1 + |v|/v_half)) t + T0
    torque = q + TL q'                                  is added to the controller's output

``t`` is a second friction state with the break-away distance of the motor's friction; it fades at
rest within 0.2 s.
"""

from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np
from numba import njit

from pmac_comp.base.arrays import FloatArray, finite_array
from pmac_comp.base.errors import ModelError


@dataclass(frozen=True)
class CompensationLaw:
    """Coefficients of the law in SI; zero means that the term is absent.

    Parameters
    ----------
    inertia_s2, inertia_per_m_s2_per_m : float
        A0 (m per m/s2) at the origin and A1 (the same per m of travel).
    viscous_s, viscous_per_m_s_per_m : float
        V0 (m per m/s) and V1.
    coulomb_m, coulomb_per_m : float
        S0 (m) and S1 (m per m).
    jerk_s3 : float
        J0 (m per m/s3), damping of the chain.
    breakaway_m, torque_breakaway_m : float
        Distances over which the friction states follow a reversal.
    lead_s, lead2_s2 : float
        D1 and D2, which undo latency and loop lag.
    torque_inertia_Nm_s2_per_m, torque_jerk_Nm_s3_per_m, torque_viscous_Nm_s_per_m : float
        TJ, TK, TB.
    torque_coulomb_Nm, torque_load_Nm_s2_per_m, torque_excess_Nm, torque_constant_Nm : float
        TC, TE, TS, T0.
    excess_speed_m_per_s : float
        Speed at which the excess TS is halved.
    torque_lead_s : float
        TL.
    origin_m : float
        Table position at which ``x`` is zero.
    amplitude_limit_m, torque_limit_Nm : float
        Clamps that the running law applies.
    valid_speed_m_per_s, valid_acceleration_m_per_s2 : float
        Range of motions that the coefficients were fitted on.
    provenance : dict
        Model digest, bench digest, effects, time of the fit.
    """

    inertia_s2: float = 0.0
    inertia_per_m_s2_per_m: float = 0.0
    viscous_s: float = 0.0
    viscous_per_m_s_per_m: float = 0.0
    coulomb_m: float = 0.0
    coulomb_per_m: float = 0.0
    jerk_s3: float = 0.0
    breakaway_m: float = 10e-6
    lead_s: float = 0.0
    lead2_s2: float = 0.0
    torque_inertia_Nm_s2_per_m: float = 0.0
    torque_jerk_Nm_s3_per_m: float = 0.0
    torque_viscous_Nm_s_per_m: float = 0.0
    torque_coulomb_Nm: float = 0.0
    torque_load_Nm_s2_per_m: float = 0.0
    torque_excess_Nm: float = 0.0
    torque_constant_Nm: float = 0.0
    excess_speed_m_per_s: float = 5e-3
    torque_breakaway_m: float = 10e-6
    torque_lead_s: float = 0.0
    origin_m: float = 0.0
    amplitude_limit_m: float = 60e-6
    torque_limit_Nm: float = 0.0
    valid_speed_m_per_s: float = 0.0
    valid_acceleration_m_per_s2: float = 0.0
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        finite_array("law coefficients", [getattr(self, name) for name in coefficient_names()])
        small = [
            name
            for name in ("breakaway_m", "torque_breakaway_m", "excess_speed_m_per_s")
            if getattr(self, name) <= 0.0
        ]
        if small or self.amplitude_limit_m < 0.0 or self.torque_limit_Nm < 0.0:
            raise ModelError(
                f"{', '.join(small) or 'a limit'} of the compensation law is not positive.",
                code="PC-LAW-020",
                hint="Compute the compensation again from a model.",
            )

    def as_mapping(self) -> dict[str, Any]:
        """All fields, for a file."""
        return asdict(self)

    def with_values(self, **values: float) -> "CompensationLaw":
        """Copy with some coefficients replaced."""
        return replace(self, **values)  # type: ignore[arg-type]

    def without_torque(self) -> "CompensationLaw":
        """The same command offset with no torque feed-forward."""
        zero = dict.fromkeys(TORQUE_NAMES, 0.0)
        return replace(self, **zero, torque_limit_Nm=0.0)  # type: ignore[arg-type]


# Share of the torque's friction state that is lost per servo period: at rest friction holds the
# axis, and a torque that stays on would be wound up against by the controller's integrator.
_FADE = 0.002

TORQUE_NAMES = (
    "torque_inertia_Nm_s2_per_m",
    "torque_jerk_Nm_s3_per_m",
    "torque_viscous_Nm_s_per_m",
    "torque_coulomb_Nm",
    "torque_load_Nm_s2_per_m",
    "torque_excess_Nm",
    "torque_constant_Nm",
)


def coefficient_names() -> tuple[str, ...]:
    """Names of all numeric fields in order."""
    return tuple(f.name for f in fields(CompensationLaw) if f.name != "provenance")


@dataclass(frozen=True)
class LawSignals:
    """What a law sends along a trajectory.

    Parameters
    ----------
    correction_m, torque_Nm : ndarray, shape (n,)
        Added to the command (m) and to the controller's output (N m).
    clamped : ndarray of bool, shape (n,)
        Samples at which the amplitude clamp acted.
    """

    correction_m: FloatArray
    torque_Nm: FloatArray
    clamped: FloatArray


def evaluate_law(
    law: CompensationLaw, position_m: FloatArray, period_s: float, *, latency_cycles: int = 0
) -> LawSignals:
    """Correction in m and torque in N m along a commanded position.

    Parameters
    ----------
    law : CompensationLaw
        Coefficients.
    position_m : FloatArray, shape (n,)
        Commanded position in m at the servo period, starting at rest.
    period_s : float
        Servo period in s.
    latency_cycles : int
        Cycles by which the servo receives the values late (1 from PLC 0, 0 in the open servo).

    Returns
    -------
    LawSignals
        What the servo receives in each cycle, clamped to the law's limits.
    """
    position = finite_array("position_m", position_m)
    values = np.array([float(getattr(law, name)) for name in coefficient_names()])
    correction, torque = _evaluate(values, position, period_s)
    clamped = np.abs(correction) > law.amplitude_limit_m
    correction = np.clip(correction, -law.amplitude_limit_m, law.amplitude_limit_m)
    torque = np.clip(torque, -law.torque_limit_Nm, law.torque_limit_Nm)
    return LawSignals(
        correction_m=delayed(correction, latency_cycles),
        torque_Nm=delayed(torque, latency_cycles),
        clamped=clamped,
    )


def delayed(values: FloatArray, cycles: int) -> FloatArray:
    """Array shifted to later samples; the first value fills the front."""
    if cycles <= 0:
        return values
    head = np.full(min(cycles, values.size), values[0])
    return np.concatenate([head, values[: values.size - cycles]])


@njit(cache=True, nogil=True)
def _evaluate(p: FloatArray, r: FloatArray, period: float) -> tuple[FloatArray, FloatArray]:
    n = r.size
    correction = np.empty(n)
    torque = np.empty(n)
    v = a = s = t = 0.0
    c1 = dc1 = q1 = 0.0
    for k in range(n):
        step = r[k] - r[k - 1] if k > 0 else 0.0
        v1, a1 = v, a
        v = step / period
        a = (v - v1) / period
        j = (a - a1) / period
        # Implicit Euler of the friction state: holds at standstill, never overshoots.
        u = step / p[7]
        s = (s + u) / (1.0 + abs(u))
        w = step / p[18]
        t = (t + w) / (1.0 + _FADE + abs(w))
        x = r[k] - p[20]
        c = (p[0] + p[1] * x) * a + (p[2] + p[3] * x) * v + (p[4] + p[5] * x) * s + p[6] * j
        level = p[13] + p[14] * abs(a) + p[15] / (1.0 + abs(v) / p[17])
        q = p[10] * a + p[11] * j + p[12] * v + level * t + p[16]
        if k == 0:
            c1, q1 = c, q
        dc = (c - c1) / period
        correction[k] = c + p[8] * dc + p[9] * (dc - dc1) / period
        torque[k] = q + p[19] * (q - q1) / period
        c1, dc1, q1 = c, dc, q
    return correction, torque
