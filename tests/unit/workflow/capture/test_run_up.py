"""A run begins in the same state wherever the axis comes from."""

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.motion.motions import parse_motion

BENCH = load_bench("paper")


def error_m(run: Capture) -> np.ndarray:
    table_m = run.table_position_m
    assert table_m is not None
    return np.asarray(table_m - run.commanded_position_m)


@pytest.mark.parametrize("from_mm", [0.0, -35.0])
def test_error_of_a_first_move_does_not_tell_where_the_axis_came_from(
    axis: Axis, from_mm: float
) -> None:
    # Integrator and friction at rest remember a long jog: the first move differed by 14 um.
    motion = parse_motion("trapezoid:distance_mm=15,start_mm=20", BENCH)
    axis.run(motion)
    near = error_m(axis.run(motion))
    axis.move_to(from_mm * 1e-3 / axis.scales.motor_m_per_ct)
    afar = error_m(axis.run(motion))
    n = min(near.size, afar.size)
    assert np.ptp(near) > 20e-6
    assert np.max(np.abs(near[:n] - afar[:n])) < 3e-6
