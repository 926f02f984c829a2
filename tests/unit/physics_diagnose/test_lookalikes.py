"""Causes that no run tells apart."""

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.diagnose.lookalikes import (
    swinging_mass,
    tilt_um_per_m_per_s2,
    unlisted_twins,
)
from pmac_comp.physics.model import slots
from pmac_comp.physics.model.drive import DriveModel, simulate

SWINGS = {"frequency_Hz": 60.0, "mass_ratio": 0.2, "damping_ratio": 0.04}
MODEL = DriveModel.base(load_bench("paper")).with_effect("base_mode", SWINGS)


def test_a_mass_on_the_table_moves_it_as_a_swinging_bed_does():
    twin = swinging_mass(MODEL)
    whole_kg = float(MODEL.kernel_vector()[slots.M_TABLE])
    s = 2j * np.pi * np.geomspace(5.0, 300.0, 200)
    bed = 2.0 * np.pi * SWINGS["frequency_Hz"]
    rates = bed**2 + 2.0 * SWINGS["damping_ratio"] * bed * s
    # Acceleration of the table relative to the bed, per force on it.
    by_bed = (1.0 + SWINGS["mass_ratio"] * s**2 / (s**2 + rates)) / whole_kg
    rest_kg = whole_kg - twin.mass_kg
    reduced_kg = twin.mass_kg * rest_kg / whole_kg
    link = reduced_kg * rates  # spring and damper, of the same rates as the bed's
    assert np.sqrt(link.real / twin.mass_kg) / (2 * np.pi) == pytest.approx(twin.frequency_Hz)
    carried = twin.mass_kg * link / (twin.mass_kg * s**2 + link)
    assert 1.0 / (rest_kg + carried) == pytest.approx(by_bed, rel=1e-9)


def test_it_is_told_where_the_bed_is_named_and_only_there():
    (told,) = unlisted_twins(MODEL, ("base_mode",))
    assert "54.8 Hz" in told
    assert "accelerometer" in told
    assert unlisted_twins(MODEL, ("backlash",)) == ()


def test_a_reading_that_tilts_with_the_acceleration_lags_as_a_coupling_that_winds_up():
    plain = DriveModel.base(load_bench("paper_x4"))
    soft = plain.with_effect("coupling_windup", {"compliance_rad_per_Nm": 5e-4})
    time_s = plain.bench.servo_period_s * np.arange(6000)
    command = 0.01 * (1.0 - np.cos(2.0 * np.pi * 4.0 * time_s))
    lag_um = 1e6 * (
        simulate(soft, command).mechanical_error_m - simulate(plain, command).mechanical_error_m
    )
    acceleration = np.gradient(np.gradient(command, time_s), time_s)
    late = slice(2000, -10)
    per_acceleration = np.polyfit(acceleration[late], lag_um[late], 1)[0]
    assert -per_acceleration == pytest.approx(tilt_um_per_m_per_s2(soft), rel=0.15)
    (told,) = unlisted_twins(soft, ("coupling_windup",))
    assert "0.31 um per m/s2" in told
    assert "second scale" in told
