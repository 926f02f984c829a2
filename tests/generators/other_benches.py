"""Bench files of drives unlike the paper's, each with a loop that suits it."""

import math
from dataclasses import dataclass

from pmac_comp.files.bench import (
    SHEAR_OVER_YOUNG,
    Bench,
    STEEL_DENSITY_kg_per_m3,
    STEEL_YOUNG_Pa,
    parse_bench,
)

_DAMPING_RATIO = 0.7
_RESONANCE_OVER_BANDWIDTH = 5.5
_LAG_PHASE_rad = 0.56  # that delay and current loop may take at the bandwidth
_DAC_UNITS = 32768


@dataclass(frozen=True)
class Drive:
    """What distinguishes a drive."""

    pitch_mm: float
    diameter_mm: float
    length_mm: float
    mass_kg: float
    motor_kgm2: float
    torsional_Nm_per_rad: float
    axial_N_per_um: float
    counts_per_rev: float
    scale_um: float
    servo_period_us: float
    travel_mm: float
    torque_limit_Nm: float
    speed_mm_per_s: float
    acceleration_m_per_s2: float


COARSE = Drive(16.0, 20.0, 1000.0, 30.0, 2e-4, 2500.0, 80.0, 4000.0, 1.0, 442.0, 600.0, 8.0, 500.0,
               8.0)  # fmt: skip
SLENDER = Drive(10.0, 12.0, 2000.0, 300.0, 6e-4, 400.0, 40.0, 10000.0, 0.5, 442.0, 1500.0, 10.0,
                400.0, 5.0)  # fmt: skip
LIGHT = Drive(5.0, 16.0, 600.0, 22.0, 9e-5, 700.0, 60.0, 10000.0, 0.1, 500.0, 200.0, 4.0, 200.0,
              8.0)  # fmt: skip


def bench_of(drive: Drive, name: str) -> Bench:
    """Bench file of a drive, nominal."""
    root_m = 0.88e-3 * drive.diameter_mm
    length_m = 1e-3 * drive.length_mm
    rigidity_N = STEEL_YOUNG_Pa * math.pi / 4.0 * root_m**2
    screw_kgm2 = (
        STEEL_DENSITY_kg_per_m3 * math.pi / 32.0 * (0.96e-3 * drive.diameter_mm) ** 4 * length_m
    )
    lead = 1e-3 * drive.pitch_mm / (2.0 * math.pi)
    rotary_kgm2 = drive.motor_kgm2 + screw_kgm2
    inertia_kgm2 = rotary_kgm2 + drive.mass_kg * lead**2
    middle_m = 0.5 * length_m
    torsion = 1.0 / drive.torsional_Nm_per_rad + middle_m / (
        rigidity_N * SHEAR_OVER_YOUNG * root_m**2 / 8.0
    )
    compliance = 1e-6 / drive.axial_N_per_um + middle_m / rigidity_N + lead**2 * torsion
    mode = math.sqrt((1.0 / drive.mass_kg + lead**2 / rotary_kgm2) / compliance)
    lag_s = 2.5e-6 * drive.servo_period_us + 1.0 / (2.0 * math.pi * 300.0)
    omega = min(mode / _RESONANCE_OVER_BANDWIDTH, _LAG_PHASE_rad / lag_s, 2.0 * math.pi * 25.0)
    kp = 1e-3 / lead * inertia_kgm2 * omega**2
    kd = 1e-3 / lead * 2.0 * _DAMPING_RATIO * inertia_kgm2 * omega
    return parse_bench(f"""
config_version = 1
name = "{name}"
[screw]
pitch_mm = {drive.pitch_mm}
diameter_mm = {drive.diameter_mm}
root_diameter_mm = {1e3 * root_m}
length_mm = {drive.length_mm}
[encoder]
counts_per_rev = {drive.counts_per_rev}
[scale]
resolution_um = {drive.scale_um}
[nominal]
motor_inertia_kgm2 = {drive.motor_kgm2}
screw_inertia_kgm2 = {screw_kgm2}
table_mass_kg = {drive.mass_kg}
torsional_stiffness_Nm_per_rad = {drive.torsional_Nm_per_rad}
axial_stiffness_N_per_um = {drive.axial_N_per_um}
screw_rigidity_N = {rigidity_N}
efficiency = 0.95
current_bandwidth_Hz = 300.0
actuator_delay_us = {drive.servo_period_us}
[drive]
torque_limit_Nm = {drive.torque_limit_Nm}
torque_per_dac_Nm = {drive.torque_limit_Nm / _DAC_UNITS}
[known]
rated_speed_rpm = 3000.0
[controller]
kind = "si"
servo_period_us = {drive.servo_period_us}
[controller.si]
Kp_Nm_per_mm = {kp}
Ki_Nm_per_mm_s = {kp * omega / 11.0}
Kd_Nm_s_per_mm = {kd}
Kvff_Nm_s_per_mm = {kd}
Kaff_Nm_s2_per_mm = {1e-3 / lead * inertia_kgm2}
[travel]
min_mm = {-0.5 * drive.travel_mm}
max_mm = {0.5 * drive.travel_mm}
[safety]
max_speed_mm_per_s = {drive.speed_mm_per_s}
max_acceleration_m_per_s2 = {drive.acceleration_m_per_s2}
""")
