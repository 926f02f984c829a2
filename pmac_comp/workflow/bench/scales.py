"""Counts to metres and back for one bench: the one place where the two meet."""

from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.base.units import UM_PER_M, UM_PER_MM
from pmac_comp.files.bench import Bench
from pmac_comp.machine.controller.contents.safety import Limits

_DAC_PER_WORD = 256.0  # the output register holds 1/256 of a 16-bit DAC unit


@dataclass(frozen=True)
class Scales:
    """Units of a bench's registers.

    Parameters
    ----------
    motor_m_per_ct, scale_m_per_ct : float
        One count of the encoder and of the scale (0 without a scale) in m of table travel.
    period_s : float
        Servo period.
    torque_Nm_per_dac : float
        One 16-bit DAC unit.
    ixx08, scale_ixx08 : float
        Position scale factors of both motors.
    """

    motor_m_per_ct: float
    scale_m_per_ct: float
    period_s: float
    torque_Nm_per_dac: float
    ixx08: float
    scale_ixx08: float

    @classmethod
    def of(cls, bench: Bench) -> "Scales":
        """Units that follow from a bench file."""
        values = bench.controller.ivariables
        motor = bench.encoder.motor_number
        scale = bench.scale.motor_number if bench.scale else motor
        return cls(
            motor_m_per_ct=bench.motor_resolution_m,
            scale_m_per_ct=bench.scale_resolution_m or 0.0,
            period_s=bench.servo_period_s,
            torque_Nm_per_dac=bench.drive.torque_per_dac_Nm,
            ixx08=values.get(f"I{motor * 100 + 8}", 96.0),
            scale_ixx08=values.get(f"I{scale * 100 + 8}", 96.0),
        )

    def motor_m(self, raw: IntArray) -> FloatArray:
        """Positions in m of 48-bit registers of the motor."""
        return np.asarray(raw, dtype=np.float64) * (self.motor_m_per_ct / (32.0 * self.ixx08))

    def table_m(self, raw: IntArray) -> FloatArray:
        """Positions in m of the 48-bit register of the scale motor, on the scale's lattice."""
        counts = np.asarray(raw, dtype=np.float64) / (32.0 * self.scale_ixx08)
        return counts * self.scale_m_per_ct

    def torque_Nm(self, raw: IntArray) -> FloatArray:
        """Torque in N m of the 24-bit output word."""
        return np.asarray(raw, dtype=np.float64) * (self.torque_Nm_per_dac / _DAC_PER_WORD)

    def counts(self, position_m: float) -> float:
        """Motor counts of a length in m."""
        return position_m / self.motor_m_per_ct

    def limits(self, bench: Bench) -> Limits:
        """Safety limits of a bench in counts."""
        um_per_ct = self.motor_m_per_ct * UM_PER_M
        safety, (low_m, high_m) = bench.safety, bench.travel_m
        return Limits(
            max_correction_ct=safety.max_correction_um / um_per_ct,
            max_slope=safety.max_slope_um_per_mm / UM_PER_MM,
            max_step_ct=safety.max_enable_step_um / um_per_ct,
            min_position_ct=self.counts(low_m),
            max_position_ct=self.counts(high_m),
            um_per_ct=um_per_ct,
            hardest_ct_per_s2=self.counts(safety.max_acceleration_m_per_s2),
        )
