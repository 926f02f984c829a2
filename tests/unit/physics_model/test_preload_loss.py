"""A nut that has lost preload, against springs in series written down apart from the kernel."""

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.model.kernel import joint_force
from pmac_comp.physics.model.quasi_static import mechanical_error_m

BENCH = load_bench("paper")
BASE = DriveModel.base(BENCH)
HALF_m, RATIO = 2e-6, 0.5
BEYOND = {"half_width_m": HALF_m, "stiffness_ratio": RATIO}


def slow_reversals() -> np.ndarray:
    time = BENCH.servo_period_s * np.arange(4000)
    return np.asarray(0.1 + 0.006 * (1.0 - np.cos(2 * np.pi * 4.0 * time)))


@pytest.mark.parametrize("place", ["centre", "beyond"])
def test_the_joint_follows_two_slopes(place):
    vector = BASE.with_effect(f"preload_loss@{place}", BEYOND).kernel_vector()
    nominal = BASE.kernel_vector()[s.K_NUT]
    inside, outside = (RATIO, 1.0) if place == "centre" else (1.0, RATIO)
    for deflection in np.linspace(-5e-6, 5e-6, 21):
        stiff = inside * np.clip(deflection, -HALF_m, HALF_m)
        rest = np.sign(deflection) * max(abs(deflection) - HALF_m, 0.0)
        force = vector[s.K_NUT] * deflection + joint_force(vector, deflection)[0]
        assert force == pytest.approx(nominal * (stiff + outside * rest), rel=1e-12)


def test_beyond_a_threshold_that_is_never_reached_nothing_is_soft():
    command = slow_reversals()
    far = BASE.with_effect("preload_loss@beyond", {**BEYOND, "half_width_m": 1e-3})
    without, with_it = simulate(BASE, command), simulate(far, command)
    assert with_it.table_position_m == pytest.approx(without.table_position_m, abs=1e-8)


@pytest.mark.parametrize("place", ["centre", "beyond"])
def test_motion_follows_the_closed_form(place):
    command = slow_reversals()
    model = BASE.with_effect(f"preload_loss@{place}", BEYOND)
    period = BENCH.servo_period_s
    speed = np.gradient(command, period)
    closed = mechanical_error_m(model, command, speed, np.gradient(speed, period))
    moved = simulate(model, command).mechanical_error_m
    settled = slice(1200, -10)
    apart = (moved - closed)[settled] - np.median((moved - closed)[settled])
    # What the loop delays and rings is the same without the effect, and larger than this bound.
    plain = simulate(BASE, command).mechanical_error_m
    other = mechanical_error_m(BASE, command, speed, np.gradient(speed, period))
    usual = (plain - other)[settled] - np.median((plain - other)[settled])
    assert np.std(apart) < 1.3 * np.std(usual)


def test_a_contact_softens_smoothly_up_to_where_one_half_is_unloaded() -> None:
    model = DriveModel.base(BENCH).with_effect("axial_stiffness_nonlinear", {"preload_N": 400.0})
    vector = model.kernel_vector()
    stiffness = vector[s.K_NUT]
    spring_N = np.linspace(0.0, 4.0 * 400.0, 801)
    force_N = np.array([f + joint_force(vector, f / stiffness)[0] for f in spring_N])
    slope = np.gradient(force_N, spring_N)
    below = force_N < np.sqrt(8.0) * 400.0
    secant_N = spring_N * (1.0 - (force_N / 400.0) ** 2 / 36.0)
    assert np.allclose(force_N[below], secant_N[below], rtol=1e-9)
    assert np.all(np.diff(slope) < 0.006)  # no corner
    assert slope.min() == pytest.approx(0.5, abs=0.006)
    assert slope[-1] == pytest.approx(0.5, abs=1e-6)
