"""The promise is as wide as what captures show beyond the model, and no wider."""

import math
from functools import cache

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import model_loop
from pmac_comp.physics.compensate.promise import MotionPromise
from pmac_comp.physics.compensate.unmodelled import (
    Unmodelled,
    joined_um,
    model_law,
    open_at_rest_um,
    unmodelled,
    widened,
)
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.trajectory import sinusoid
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture
from tests.generators.true_values import friction_of

BENCH = load_bench("paper_x4")
LAW = CompensationLaw(turn_m=BENCH.pitch_m, torque_limit_Nm=10.0)
PROMISE = MotionPromise(3.0, 0.2, 10.0, 0.5, 12.0, 0.6)


@cache
def rest_of(amplitude_Nm: float, law: CompensationLaw = LAW) -> Unmodelled:
    effects = {"cogging": {"amplitude_Nm": amplitude_Nm, "order_per_rev": 4.0, "phase_rad": 0.0}}
    plant = make_plant(BENCH, effects=effects if amplitude_Nm else {}, spread=0.0)
    truth = plant.truth
    model = DriveModel.base(
        BENCH,
        {
            **friction_of(truth),
            "chain.axial_stiffness_N_per_m": truth.axial_stiffness_N_per_um * 1e6,
        },
    )
    runs = [
        closed_loop_capture(
            BENCH,
            plant,
            sinusoid(
                period_s=BENCH.servo_period_s, amplitude_m=0.02, frequency_Hz=f, cycles=3.0
            ).position_m,
        )
        for f in (0.7, 1.6)
    ]
    steps = (BENCH.motor_resolution_m, BENCH.scale_resolution_m or 0.0)
    found = unmodelled(
        law, model_loop(model), runs, None, motor_step_m=steps[0], table_step_m=steps[1]
    )
    assert found is not None
    return found


def test_a_fitting_model_leaves_little_and_a_hidden_effect_is_seen() -> None:
    fits, hides = rest_of(0.0), rest_of(0.1)
    assert fits.mechanical_um[1] < 0.15
    assert hides.total_um[1] > 3.0 * fits.total_um[1]
    assert fits.off_frac[0] < 0.1
    assert fits.off_frac[1] < 0.1
    assert hides.total_um[0] <= hides.total_um[1] <= hides.total_um[2]


def test_a_promise_without_captures_is_the_models_and_else_wider() -> None:
    alone = widened(PROMISE, None)
    assert alone["e_r_after_um"] == alone["model_e_r_after_um"] == pytest.approx(0.2)
    assert not any("upper" in name or "lower" in name for name in alone)
    wide = widened(PROMISE, Unmodelled((0.1, 0.2, 0.4), (0.5, 1.0, 2.0)))
    assert wide["model_e_r_after_um"] == 0.2
    assert wide["e_r_after_um"] == pytest.approx(math.sqrt(0.2 * joined_um(0.2, 0.2, 0.2, 3.0)))
    assert wide["total_after_lower_um"] < wide["total_after_um"] < wide["total_after_upper_um"]
    assert wide["total_after_upper_um"] == pytest.approx(0.6 + 2.0)
    assert wide["total_after_lower_um"] == pytest.approx(0.6)
    off = widened(PROMISE, Unmodelled((0.1, 0.2, 0.4), (0.5, 1.0, 2.0), (0.1, 0.2)))
    assert off["total_after_lower_um"] == pytest.approx(0.48)
    assert off["total_after_upper_um"] == pytest.approx(0.72 + 2.0)


def test_friction_at_rest_widens_the_upper_end_of_e_r_alone() -> None:
    law = LAW.with_values(coulomb_m=0.9e-6)
    rests = np.repeat([0.0, 0.01, 0.02], 400)  # three rests, with a step of the command between
    assert open_at_rest_um(law, rests) == pytest.approx(0.9 / math.sqrt(3.0), rel=0.01)
    half = np.concatenate([rests, np.linspace(0.02, 0.04, rests.size)])
    assert open_at_rest_um(law, half) == pytest.approx(0.9 / math.sqrt(6.0), rel=0.01)
    assert open_at_rest_um(law.with_values(coulomb_m=0.0), half) == 0.0
    found = Unmodelled((0.1, 0.2, 0.4), (0.5, 1.0, 2.0))
    firm, stuck = widened(PROMISE, found), widened(PROMISE, found, 0.3)
    assert firm["e_r_after_upper_um"] == pytest.approx(0.6)
    assert stuck["e_r_after_upper_um"] == pytest.approx(math.hypot(0.6, 0.3))
    assert {k: v for k, v in stuck.items() if firm[k] != v}.keys() == {"e_r_after_upper_um"}
    assert widened(PROMISE, None, 0.3) == widened(PROMISE, None)


def test_rest_adds_plainly_to_an_error_that_stays_and_in_squares_to_one_that_goes() -> None:
    assert joined_um(3.0, 4.0, 12.0, 12.0) == pytest.approx(7.0)
    assert joined_um(3.0, 4.0, 13.0, 12.0) == pytest.approx(7.0)
    assert joined_um(3.0, 4.0, 0.0, 12.0) == pytest.approx(5.0)
    assert joined_um(3.0, 4.0, 0.0, 0.0) == pytest.approx(7.0)
    barely = MotionPromise(3.0, 2.9, 10.0, 9.9, 12.0, 11.9)
    middle = widened(barely, Unmodelled((0.1, 0.2, 0.4), (0.5, 1.0, 2.0)))["total_after_um"]
    assert math.sqrt(11.9 * math.hypot(11.9, 1.0)) + 0.4 < middle < math.sqrt(11.9 * (11.9 + 1.0))


def test_the_models_word_is_on_its_own_law() -> None:
    law = LAW.with_values(ripple_Nm=0.1, turn_friction_Nm=0.02, inertia_s2=2.5e-6)
    law = CompensationLaw(**{**law.as_mapping(), "provenance": {"trim": {"inertia_s2": 0.3e-6}}})
    own = model_law(law)
    assert (own.ripple_Nm, own.turn_friction_Nm) == (0.0, 0.0)
    assert own.inertia_s2 == pytest.approx(2.2e-6)


def test_a_file_keeps_it() -> None:
    rest = Unmodelled((0.1, 0.2, 0.4), (0.5, 1.0, 2.0), (0.05, 0.1))
    assert Unmodelled.from_mapping(rest.as_mapping()) == rest
