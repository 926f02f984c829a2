"""Every rival is exact on data made by its own equation, and not on data made by another."""

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.rivals import Rival, fit_rival, rivals, signals_of
from pmac_comp.physics.identify.rivals.paper import WITH_TORQUE_TRANSMISSION
from pmac_comp.physics.identify.rivals.torsion import RIVAL as TORSION

BENCH = load_bench("paper")
PERIOD_S = BENCH.servo_period_s
TIME_S = np.arange(9000) * PERIOD_S


def motor_m(centre_m: float) -> FloatArray:
    tones = 0.02 * np.sin(2 * np.pi * 1.3 * TIME_S) + 0.004 * np.sin(2 * np.pi * 4.1 * TIME_S)
    return np.asarray(centre_m + tones)


def capture_of(rival: Rival, theta: FloatArray, centre_m: float) -> Capture:
    motor = motor_m(centre_m)
    torque = 1.2e-3 * np.gradient(np.gradient(motor, PERIOD_S), PERIOD_S) / BENCH.lead_m_per_rad
    blank = Capture(TIME_S, motor, motor, table_position_m=motor, torque_command_Nm=torque)
    error = rival.error_m(signals_of(blank, BENCH), theta, BENCH)
    return Capture(TIME_S, motor, motor, table_position_m=motor + error, torque_command_Nm=torque)


@pytest.mark.parametrize("rival", rivals(), ids=lambda rival: rival.name)
def test_exact_on_its_own_data(rival: Rival) -> None:
    theta = np.array([scale for _, scale in rival.parameters]) * 1.15
    runs = [capture_of(rival, theta, centre) for centre in (-0.25, 0.2)]
    fitted = fit_rival(rival, runs, BENCH)
    usable = signals_of(runs[0], BENCH).usable
    made = rival.error_m(signals_of(runs[0], BENCH), theta, BENCH)
    left = (made - fitted.predict(runs[0]))[usable]
    assert float(np.std(left)) < 1e-3 * float(np.std(made[usable]))


def test_a_poorer_model_leaves_what_it_lacks() -> None:
    theta = np.array([scale for _, scale in WITH_TORQUE_TRANSMISSION.parameters])
    runs = [capture_of(WITH_TORQUE_TRANSMISSION, theta, centre) for centre in (-0.25, 0.2)]
    fitted = fit_rival(TORSION, runs, BENCH)
    usable = signals_of(runs[0], BENCH).usable
    made = WITH_TORQUE_TRANSMISSION.error_m(signals_of(runs[0], BENCH), theta, BENCH)
    assert float(np.std((made - fitted.predict(runs[0]))[usable])) > 0.2e-6
