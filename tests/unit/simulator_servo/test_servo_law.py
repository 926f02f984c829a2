"""The PID law of the card, term by term (Software Reference Manual p. 111-127)."""

import numpy as np
import pytest
from scipy.signal import lfilter

from pmac_comp.simulator.memory import registers as reg
from pmac_comp.simulator.servo import servo_law as law

UNIT = 32 * 96
ONE = 2000 * 96 / 2**19  # DAC units per count at the factory gain


def gains(**changes):
    vector = law.default_gains()
    for name in ("G_KD", "G_KVFF", "G_KI", "G_KAFF", "G_MODE"):
        vector[getattr(law, name)] = 0.0
    for name, value in changes.items():
        vector[getattr(law, name)] = value
    return vector


def outputs(vector, errors_ct, *, cv=0.0, ca=0.0, av=0.0, moving=False):
    memory = np.zeros(law.N_LAW)
    result = [
        law.pid_output(vector, memory, fe * UNIT, cv * UNIT, ca * UNIT, av * UNIT, moving) / 256
        for fe in errors_ct
    ]
    return np.array(result), memory


def test_proportional_and_derivative_and_feedforward_units():
    assert outputs(gains(), [100.0])[0][0] == pytest.approx(100 * ONE, abs=0.01)
    out = outputs(gains(G_KD=1280.0), [0.0], av=3.0)[0][0]
    assert out == pytest.approx(-(2000 * 96) / 2**26 * 1280 * 3.0, abs=0.01)
    out = outputs(gains(G_KVFF=1280.0), [0.0], cv=3.0)[0][0]
    assert out == pytest.approx((2000 * 96) / 2**26 * 1280 * 3.0, abs=0.01)
    out = outputs(gains(G_KAFF=5000.0), [0.0], ca=0.5)[0][0]
    assert out == pytest.approx((2000 * 96) / 2**26 * 5000 * 0.5, abs=0.01)


def test_integral_uses_earlier_errors_and_its_unit():
    out, _ = outputs(gains(G_KI=100_000.0), [10.0, 10.0, 10.0])
    step = 2000 * 96 / 2**42 * 100_000 * 10
    np.testing.assert_allclose(out - 10 * ONE, [0.0, step, 2 * step], atol=0.005)


def test_integration_limit_is_the_value_that_the_manual_gives():
    # Ixx63 = Ixx69 * 2^23 / (Ixx08 Ixx30) saturates the output by itself.
    limit = 5000 * 2**23 / (96 * 2000)
    out, _ = outputs(gains(G_KI=8_000_000.0, G_ILIMIT=limit), [50.0] * 2000 + [0.0])
    assert out[-1] == pytest.approx(5000, rel=1e-3)
    assert outputs(gains(G_KI=8e6, G_ILIMIT=0.0), [50.0] * 100 + [0.0])[0][-1] == 0.0


def test_integrator_freezes_in_motion_and_at_saturation():
    _, memory = outputs(gains(G_KI=1e6, G_MODE=1.0), [50.0] * 50, moving=True)
    assert memory[law.L_INTEGRAL] == 0.0
    _, memory = outputs(gains(G_KI=1e6, G_OUTLIMIT=1.0), [50.0] * 50)
    assert memory[law.L_INTEGRAL] == 0.0
    _, memory = outputs(gains(G_KI=1e6, G_MODE=1.0), [50.0] * 50)
    assert memory[law.L_INTEGRAL] > 0.0


def test_notch_is_the_stated_filter():
    n1, n2, d1, d2 = -1.8, 0.95, -1.2, 0.4
    errors = 100 * np.sin(np.arange(200) * 0.3)
    out, _ = outputs(gains(G_N1=n1, G_N2=n2, G_D1=d1, G_D2=d2), errors)
    wanted = lfilter([1, n1, n2], [1, d1, d2], errors * ONE)
    np.testing.assert_allclose(out, wanted, atol=0.02)


def test_output_and_error_limits():
    assert outputs(gains(G_OUTLIMIT=1234.0), [1e6])[0][0] == 1234.0
    assert outputs(gains(G_OUTLIMIT=1234.0), [-1e6])[0][0] == -1234.0
    # Ixx67 in 1/16 count.
    assert outputs(gains(G_FELIMIT=16 * 20.0), [500.0])[0][0] == pytest.approx(20 * ONE, abs=0.01)


@pytest.mark.parametrize(("gain", "inside", "outside"), [(-16, 0.0, 8.0), (16, 4.0, 12.0)])
def test_dead_band(gain, inside, outside):
    # Band of 2 counts; -16 kills the gain inside, 16 doubles it; the share is kept outside.
    vector = gains(G_BANDGAIN=float(gain), G_BAND=32.0)
    assert outputs(vector, [2.0])[0][0] == pytest.approx(inside * ONE, abs=0.01)
    assert outputs(vector, [10.0])[0][0] == pytest.approx(outside * ONE, abs=0.01)


@pytest.mark.parametrize(("cv", "sign"), [(0.5, 1), (-0.5, -1), (0.0, 0)])
def test_friction_feedforward_has_the_sign_of_the_command(cv, sign):
    assert outputs(gains(G_FRICTION=700.0), [0.0], cv=cv)[0][0] == pytest.approx(700.0 * sign)


def test_desired_position_filter_has_the_time_constant_of_ixx40(enabled):
    # Ixx40 = Tf / (Tf + Ts): 0.9 is nine cycles; a step of the master is smoothed by it.
    enabled.variables.write_i(140, 0.9)
    enabled.variables.write_i(105, 0x10F8)
    enabled.variables.write_i(106, 3)
    enabled.run(50)
    start = enabled._long(1, reg.M_PREVIOUS_NET)
    enabled.memory.x[0x10F8] = 32 * 10
    steps = []
    for _ in range(30):
        enabled.run(1)
        steps.append((enabled._long(1, reg.M_PREVIOUS_NET) - start) / UNIT)
    wanted = 10.0 * (1.0 - 0.9 ** np.arange(1, 31))
    np.testing.assert_allclose(steps, wanted, atol=0.01)
