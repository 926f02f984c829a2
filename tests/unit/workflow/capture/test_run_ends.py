"""A run whose program outlasts its time is refused, and the axis is left at rest."""

import pytest

from pmac_comp.base.errors import CaptureError
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.motors.motion import program_status
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.motion.motions import parse_motion

BENCH = load_bench("paper")


def test_a_feed_override_is_named_instead_of_half_a_run(axis: Axis) -> None:
    motion = parse_motion("trapezoid:distance_mm=80", BENCH)
    axis.link.command("&1%40")
    with pytest.raises(CaptureError, match="was not over") as refused:
        axis.run(motion)
    assert "&1%100" in str(refused.value.hint)
    axis.link.clock.sleep_s(0.5)
    assert not program_status(axis.link).running
    assert motors.read_motor(axis.link, axis.motor).status.is_commanded_still
    axis.link.command("&1%100")
    assert axis.run(motion).n > 100
