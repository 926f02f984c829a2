"""Torque that a drive clips is told by what the motor did, without a model of the drive."""

from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.diagnose.clipping import clipped, told_of_clipping
from pmac_comp.physics.diagnose.records import prepare
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture

BENCH = load_bench("paper_x4")
TS = BENCH.servo_period_s


def _run(amplitude_m: float, frequency_Hz: float, limit_Nm: float | None = None) -> Capture:
    effects = {} if limit_Nm is None else {"torque_saturation": {"limit_Nm": limit_Nm}}
    time_s = TS * np.arange(round(2.0 / TS))
    command = amplitude_m * np.sin(2.0 * np.pi * frequency_Hz * time_s) * np.minimum(time_s, 1.0)
    return closed_loop_capture(BENCH, make_plant(BENCH, effects=effects, seed=2), command)


def _told(*captures: Capture) -> tuple[str, ...]:
    return told_of_clipping(prepare(captures, BENCH, prefix="run"), BENCH)


def test_a_clipped_torque_is_told_with_its_level():
    captures = [_run(0.02, 1.5, 3.0), _run(0.012, 3.3, 3.0)]
    found = clipped(prepare(captures, BENCH, prefix="run"), BENCH)
    assert found is not None
    assert found.level_Nm == pytest.approx(3.0, rel=0.05)
    assert found.peak_Nm > 3.5
    (told,) = _told(*captures)
    assert f"the motor moved there as with {found.level_Nm:.3g} N m: the drive clipped" in told


@pytest.mark.parametrize("limit_Nm", [None, 15.0])
def test_a_torque_that_comes_is_not_told(limit_Nm):
    assert _told(_run(0.02, 1.5, limit_Nm), _run(0.012, 3.3, limit_Nm)) == ()


def test_runs_that_hold_no_torque_or_no_motion_tell_nothing():
    capture = _run(0.02, 1.5, 3.0)
    assert _told(replace(capture, torque_command_Nm=None)) == ()
    assert _told(_run(5e-6, 1.0)) == ()
