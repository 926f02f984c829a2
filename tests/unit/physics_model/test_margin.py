"""The peak of the sensitivity is what a sinusoid of that frequency meets in the loop."""

import math

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench, parse_bench
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.model.margin import sensitivity_peak

BENCH = load_bench("paper_x4")


def without_friction() -> DriveModel:
    model = DriveModel.base(BENCH)
    friction = [n for n in model.parameters if n.startswith(("coulomb.", "viscous."))]
    return model.with_parameters(dict.fromkeys(friction, 0.0))


def amplified(frequency_Hz: float, position_m: float) -> float:
    """How much a sinusoid of torque is amplified, once it is steady."""
    n = 6000
    time_s = np.arange(n) * BENCH.servo_period_s
    torque = 0.01 * np.sin(2.0 * math.pi * frequency_Hz * time_s)
    answer = simulate(
        without_friction(), np.full(n, position_m), torque_feedforward_Nm=torque
    ).torque_command_Nm[n // 2 :]
    return float(np.std(answer) / np.std(torque[n // 2 :]))


@pytest.mark.parametrize("position_m", [-0.3, 0.0, 0.3])
def test_a_sinusoid_meets_the_peak(position_m: float) -> None:
    peak = sensitivity_peak(DriveModel.base(BENCH), position_m)
    assert amplified(peak.frequency_Hz, position_m) == pytest.approx(
        peak.value, rel=0.04
    )  # the nut loses by its load
    for factor in (0.8, 1.25):
        assert amplified(factor * peak.frequency_Hz, position_m) < peak.value


def test_a_loop_that_swings_up_has_no_finite_peak() -> None:
    text = BENCH.text.replace("I130 = 34862", "I130 = 278896")
    assert math.isinf(sensitivity_peak(DriveModel.base(parse_bench(text)), 0.0).value)
