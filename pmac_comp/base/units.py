"""Unit conversions: one constant per pair of units, used everywhere."""

import math

UM_PER_M = 1e6
MM_PER_M = 1e3
UM_PER_MM = 1e3
US_PER_S = 1e6
MS_PER_S = 1e3
CLOCK_CT_PER_MS = 8388608.0  # I10 counts 2^-23 ms (Software Reference Manual p. 42)
S_PER_MIN = 60.0
RAD_PER_REV = 2.0 * math.pi


def lead_m_per_rad(pitch_m: float) -> float:
    """Screw lead in m/rad, ``p / 2 pi`` (rho of the drive equations).

    Parameters
    ----------
    pitch_m : float
        Screw pitch per revolution in m.
    """
    return pitch_m / RAD_PER_REV


def um(value_m: float) -> float:
    """Length in um."""
    return value_m * UM_PER_M


def mm(value_m: float) -> float:
    """Length in mm."""
    return value_m * MM_PER_M
