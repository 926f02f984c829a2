"""Cams and compensated motions of two axes on one card: none is taken for that of the other."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import ControllerState, SafetyRefusal
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.settings import read_axes
from pmac_comp.machine.controller.contents.table_set import TableSet, read_tables
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.compensation.cam import CAM_PROGRAM, time_motor_variables
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.compensation.program import COMPENSATED_PROGRAM
from pmac_comp.workflow.controller import inspect, upload_flow
from pmac_comp.workflow.controller.deploy import deploy
from pmac_comp.workflow.controller.difference import difference_on
from pmac_comp.workflow.controller.removal import remove_from, standing_on
from pmac_comp.workflow.controller.upload_plan import preview
from tests.unit.workflow.compensation.test_cam import BUMP, cam_of
from tests.unit.workflow.controller.test_removal import put_on

URL = "tcp://127.0.0.1:1"
OTHER_CAM = ("#8DEFINE COMP 4,#8D,#3,64000", "0", "16", "16", "0", "I51=1")
MOVES = ("ABS(X)", "X100")


def motion_of_another(axis: Axis, number: int) -> programs.Program:
    """A motion of motor #3, as its bench file puts it on the card."""
    program = programs.sealed_motion(number, MOVES, motor=3)
    programs.download(axis.link, program)
    return program


def standing(axis: Axis) -> tuple[TableSet, object, list[list[str] | None]]:
    numbers = (CAM_PROGRAM, COMPENSATED_PROGRAM)
    listed = [programs.listing(axis.link, programs.ProgramKind.PROG, n) for n in numbers]
    return read_tables(axis.link), read_axes(axis.link), listed


def refused(axis: Axis, folder: Path, compensation: Compensation) -> dict[str, SafetyRefusal]:
    """What plan and upload refuse, by code; nothing may have changed."""
    context, before = context_of(axis, folder), standing(axis)
    planned = {r.code for r in preview(axis, context, compensation, URL).refusals}
    with pytest.raises(SafetyRefusal) as stopped:
        deploy(axis, compensation, context)
    assert stopped.value.left is ControllerState.OLD
    assert standing(axis) == before
    told = {r.code: r for r in stopped.value.refusals or (stopped.value,)}
    assert told.keys() == planned
    return told


def test_a_cam_of_another_axis_is_not_replaced(axis: Axis, tmp_path: Path) -> None:
    axis.link.write_buffer(list(OTHER_CAM))
    motion_of_another(axis, CAM_PROGRAM)
    told = refused(axis, tmp_path, cam_of(BUMP))
    assert told.keys() == {"PC-DEP-063", "PC-DEP-064"}
    assert "corrects motor #3" in told["PC-DEP-063"].message
    assert all("bench file of motor #3" in refusal.hint for refusal in told.values())


@pytest.mark.parametrize("route", ["cam", "program"])
@pytest.mark.parametrize("number", [CAM_PROGRAM, COMPENSATED_PROGRAM])
def test_a_motion_of_another_axis_keeps_its_program_and_its_axis(
    axis: Axis, tmp_path: Path, route: str, number: int
) -> None:
    motion_of_another(axis, number)
    told = refused(axis, tmp_path, replace(cam_of(BUMP), route=route))
    assert told.keys() == {"PC-DEP-064"}
    assert f"PROG {number} is the compensated motion of motor #3" in told["PC-DEP-064"].message


def test_a_cam_of_an_earlier_version_belongs_to_axis_x(axis: Axis, tmp_path: Path) -> None:
    lines = ["GOTO2", "N1", *MOVES, "RETURN", "N2", "GOTO1"]
    axis.link.write_buffer(["OPEN PROG 705 CLEAR", *lines, "CLOSE", "&1#3->X"])
    assert refused(axis, tmp_path, cam_of(BUMP)).keys() == {"PC-DEP-064"}
    assert standing_on(axis).is_empty
    axis.link.write_buffer(["UNDEFINE ALL", "&1#1->X"])
    assert standing_on(axis).lines() == ["PROG 705"]
    assert deploy(axis, cam_of(BUMP), context_of(axis, tmp_path)).verdict is ControllerState.NEW


def test_a_removal_leaves_the_cam_of_another_axis(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The journal of this axis knows the time motor as its own, of an earlier cam."""
    put_on(axis, "cam", tmp_path)
    remove_from(axis, context_of(axis, tmp_path), standing_on(axis))
    counting = [f"{name}={value}" for name, value in time_motor_variables(axis.bench).items()]
    axis.link.write_buffer([*counting, "I5190=1000", *OTHER_CAM, "&1#3->X", "&1#8->Y", "I800=1"])
    program = motion_of_another(axis, CAM_PROGRAM)
    put_on(axis, "table", tmp_path)
    found = standing_on(axis)
    assert not any("#8" in line or "PROG" in line for line in found.lines())
    remove_from(axis, context_of(axis, tmp_path), found)
    (table,) = read_tables(axis.link)
    assert table.motor == 8
    assert programs.is_present(axis.link, program)
    assert axis.link.query("I800I5190") == ["1", "1000"]
    assert read_axes(axis.link) == ((1, 3, "X"), (1, 8, "Y"))
    assert standing_on(axis).is_empty
    monkeypatch.setattr(inspect, "open_axis", lambda *_: nullcontext(axis))
    why = inspect.controller_status("", "", tmp_path)["compensation"]["why"]
    assert "none of them of motor #1" in why


def test_the_plan_tells_whose_tables_and_axes_it_touches(axis: Axis, tmp_path: Path) -> None:
    axis.link.write_buffer([*OTHER_CAM, "&1#3->X"])
    text = "\n".join(preview(axis, context_of(axis, tmp_path), cam_of(BUMP), URL).text)
    assert "that concerns #3 as well" in text
    assert "takes the place of the axis definitions &1#3->X" in text


@pytest.mark.parametrize("route", ["cam", "program"])
def test_a_rollback_does_not_bring_a_motion_back_over_that_of_another_axis(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, route: str
) -> None:
    """It said that PROG 705 stood, and took table, axes and time motor of the other cam away."""
    monkeypatch.setattr(upload_flow, "open_axis", lambda *_: nullcontext(axis))
    put_on(axis, route, tmp_path)
    remove_from(axis, context_of(axis, tmp_path), standing_on(axis))
    axis.link.write_buffer([*OTHER_CAM, "&1#3->X", "&1#8->Y"])
    motion_of_another(axis, CAM_PROGRAM)
    before = standing(axis)
    with pytest.raises(SafetyRefusal) as stopped:
        upload_flow.rollback_upload(URL, "paper", tmp_path)
    codes = {refusal.code for refusal in stopped.value.refusals or (stopped.value,)}
    assert codes == {"PC-DEP-064"} | ({"PC-DEP-063"} if route == "cam" else set())
    assert standing(axis) == before
    axis.link.write_buffer(["I51=0", "#8DELETE COMP", "OPEN PROG 705 CLEAR", "CLOSE"])
    axis.link.write_buffer(["UNDEFINE ALL"])
    assert upload_flow.rollback_upload(URL, "paper", tmp_path)["verdict"] == "OLD"


@pytest.mark.parametrize("route", ["cam", "program"])
def test_a_known_motion_that_stands_already_changes_nothing(
    axis: Axis, tmp_path: Path, route: str
) -> None:
    """The plan told its whole correction as the largest change."""
    motion = replace(cam_of(BUMP), route=route)
    context = context_of(axis, tmp_path)
    assert difference_on(axis, context, motion).largest_change_um > 1.0
    deploy(axis, motion, context)
    assert difference_on(axis, context, motion).largest_change_um == 0.0
