"""Orders are read from what varies, whatever the zeros of encoder and scale."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.diagnose.candidates import starts_of
from pmac_comp.physics.diagnose.spectra import Peaks, peaks_of
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import effect_library

BENCH = load_bench("paper_x4")
MODEL = DriveModel.base(BENCH)
TS = BENCH.servo_period_s
TURNS = 3.0
ORDER = 2.0


def _run(offset_m: float) -> tuple[Any, Any]:
    """Three seconds over three turns with a wave of the lead twice per turn; none of it missing.

    The first tenth is no evidence.
    """
    n = round(3.0 / TS)
    motor = TURNS * BENCH.pitch_m * 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, n)))
    wave = 0.9e-6 * np.cos(ORDER * 2.0 * np.pi * motor / BENCH.pitch_m)
    valid = np.arange(n) >= n // 10
    record = SimpleNamespace(
        channels=2,
        measured_m=np.column_stack([motor, motor + wave + offset_m]),
        valid=valid,
        torque_Nm=np.zeros(n),
        period_s=TS,
        capture=SimpleNamespace(time_s=TS * np.arange(n)),
        begun_s=0.0,
        number=0,
    )
    still = np.zeros(n)
    response = SimpleNamespace(
        mechanical_error_m=still,
        motor_position_m=motor,
        torque_command_Nm=1e-3 * np.sin(np.linspace(0.0, 9.0, n)),
    )
    return record, response


@pytest.mark.parametrize("offset_um", [0.0, 30.0, -30.0])
def test_the_zero_of_the_scale_hides_no_order(offset_um):
    record, response = _run(1e-6 * offset_um)
    assert peaks_of([record], [response], MODEL).reading[0] == pytest.approx(ORDER, abs=0.1)


@pytest.mark.parametrize("effect", ["lead_cyclic", "encoder_eccentricity", "friction_per_rev"])
def test_once_and_twice_per_turn_are_tried_whatever_peaks(effect):
    peaks = Peaks(torque=(19.35,), friction=(19.35,), reading=(19.35, 18.8))
    starts = starts_of(effect_library()[effect], MODEL, BENCH, peaks)
    orders = {start.values["order_per_rev"] for start in starts}
    assert {1.0, 2.0, 19.35} <= orders
