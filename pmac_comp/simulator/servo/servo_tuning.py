"""PMAC gains that do what a bench's SI control law does.

What lives here: the conversion of ``[controller.si]`` into Ixx30-35, so that a bench which states
its law in SI can stand behind the simulated card too. What may not: any other I-variable.
Imports ``files`` only.

Source: Turbo PMAC Software Reference Manual p. 111-113 (gain units).
"""

from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench

_SCALE = 96.0  # Ixx08 and Ixx09 at their factory values
_LARGEST = 8388607


def pmac_gains(bench: Bench) -> dict[int, int]:
    """Values of Ixx30, 31, 32, 33, 34 and 35 by their last two digits.

    Empty where the bench has no SI law, or a torque scale with which no integer gain comes near it.
    The velocity filter of the SI law has no counterpart.
    """
    si = bench.controller.si
    if bench.controller.kind != "si" or si is None:
        return {}
    # DAC units per count, per count/SC, per count/SC^2 and per count*SC.
    per_count = bench.motor_resolution_m * MM_PER_M / bench.drive.torque_per_dac_Nm
    period = bench.servo_period_s
    kp = round(si.Kp_Nm_per_mm * per_count * 2**19 / _SCALE)
    if not 100 <= kp <= _LARGEST:
        return {}
    unit = kp * _SCALE / 2**19  # what Ixx30 makes of one count
    gains = {
        30: kp,
        31: si.Kd_Nm_s_per_mm * per_count / period * 128.0 / unit,
        32: si.Kvff_Nm_s_per_mm * per_count / period * 128.0 / unit,
        33: si.Ki_Nm_per_mm_s * per_count * period * 2**23 / unit,
        34: 0,
        35: si.Kaff_Nm_s2_per_mm * per_count / period**2 * 128.0 / unit,
    }
    return {k: max(-_LARGEST, min(_LARGEST, round(value))) for k, value in gains.items()}
