"""A feed rate override at which nothing moves is told at once, not after a minute of waiting."""

from pathlib import Path

import pytest

from pmac_comp.base.errors import MotorNotSafe, SafetyRefusal
from pmac_comp.machine.controller.motors import motors
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.workflow.capture.as_described import require_as_described
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller.deploy import deploy
from pmac_comp.workflow.controller.standing import stand_to_switch
from pmac_comp.workflow.controller.upload_plan import preview
from tests.compensations import lead_map

TABLE = Compensation("table", CompensationLaw(), lead_map())
URL = "tcp://127.0.0.1:1"
AT_ONCE_s = 1.0


def stopped(axis: Axis, line: str) -> None:
    axis.link.command(line)
    axis.link.clock.sleep_s(1.5)  # the time base slews


@pytest.mark.parametrize("line", ["&1%0", "&1H"])
def test_an_upload_says_it_in_its_plan_and_before_it_begins(
    axis: Axis, tmp_path: Path, line: str
) -> None:
    stopped(axis, line)
    context = context_of(axis, tmp_path)
    begun_s = axis.link.clock.now_s()
    assert "PC-MOT-005" in {r.code for r in preview(axis, context, TABLE, URL).refusals}
    with pytest.raises(MotorNotSafe, match="override of coordinate system 1 is 0 %") as refusal:
        deploy(axis, TABLE, context)
    assert "&1%100" in str(refusal.value.hint)
    assert "&1R" in str(refusal.value.hint)
    assert axis.link.clock.now_s() - begun_s < AT_ONCE_s


def test_it_is_that_of_the_motor_s_own_coordinate_system(axis: Axis) -> None:
    axis.move_to(2000.0)
    axis.link.command("&3#1->X")
    stopped(axis, "&1%0")
    stand_to_switch(axis)
    axis.move_to(2000.0)
    stopped(axis, "&3%0")
    with pytest.raises(MotorNotSafe, match="coordinate system 3"):
        stand_to_switch(axis)


def test_a_killed_motor_waits_for_no_override(axis: Axis, tmp_path: Path) -> None:
    axis.kill()
    stopped(axis, "&1%0")
    assert deploy(axis, TABLE, context_of(axis, tmp_path)).parts


@pytest.mark.parametrize("percent", [0, 40, 120])
def test_runs_want_the_whole_of_it(axis: Axis, percent: int) -> None:
    require_as_described(axis)
    stopped(axis, f"&1%{percent}")
    with pytest.raises(SafetyRefusal, match=f"is {percent} %"):
        require_as_described(axis)


def test_one_that_falls_during_a_move_is_named_with_it(axis: Axis) -> None:
    axis.link.command("I122=1")
    sent = []

    def stop_the_time_base() -> None:
        if not sent:
            sent.append(axis.link.command("&1%0"))

    with pytest.raises(MotorNotSafe) as late:
        motors.move_to(axis.link, 1, 5000.0, timeout_s=3.0, during=stop_the_time_base)
    assert "override" in str(late.value.hint)
