"""`remove` takes off what compensates an axis, with no journal of the upload, and can be undone."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import ControllerState, LinkLost, SafetyRefusal
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.contents.settings import read_axes
from pmac_comp.machine.controller.contents.table_set import read_tables
from pmac_comp.machine.controller.law import law_goal, law_install, law_state
from pmac_comp.machine.controller.law.law_state import LawForm
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.settings.backup import Backup, compare, read_backup
from pmac_comp.machine.controller.tables.table_status import table_status
from pmac_comp.machine.controller.whole.rollback import rollback_last
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.simulator.card.card import Card
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.capturing import acting_remarks
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import default_servo, embedded
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller import commissioning, inspect, removal, safekeeping
from pmac_comp.workflow.controller.deploy import deploy
from pmac_comp.workflow.controller.removal import remove_from, standing_on
from tests.unit.workflow.conftest import BENCH
from tests.unit.workflow.controller.test_deploy import LAW, LEAD, MOTION


def test_tables_and_law_go_and_come_back_without_a_jolt(axis: Axis, tmp_path: Path) -> None:
    deploy(axis, Compensation("law", LAW, LEAD), context_of(axis, tmp_path / "upload"))
    before = read_tables(axis.link)
    (remark,) = acting_remarks(axis)
    assert remark.startswith("tables and a law of a compensation acted")
    context = context_of(axis, tmp_path / "elsewhere")  # another host, another journal
    found = standing_on(axis)
    assert found.law is LawForm.PLC
    assert len(found.tables) == len(before) >= 1

    at_zero = motors.read_motor(axis.link, axis.motor).position_ct
    remove_from(axis, context, found)
    reading = motors.read_motor(axis.link, axis.motor)
    assert abs(reading.position_ct - at_zero) < 20.0
    assert not reading.status.is_killed
    assert standing_on(axis).is_empty
    assert acting_remarks(axis) == ()
    assert table_status(axis.link, context).decision.reason == "no tables, as was meant"
    assert axis.link.query("I106I129I51") == ["0", "0", "0"]
    capture = axis.run(MOTION)
    assert np.max(np.abs(capture.desired_m - capture.commanded_position_m)) < 1e-9

    rollback_last(axis.link, context)
    assert read_tables(axis.link) == before
    assert standing_on(axis).law is LawForm.PLC


def whole(axis: Axis) -> Backup:
    """All but the block, whose marks stay, as long as nothing is enabled."""
    axis.kill()
    axis.link.clock.sleep_s(0.3)
    found = read_backup(axis.link, p_range=(0, 6999), with_q=False)
    axis.enable()
    return found


def put_on(axis: Axis, route: str, folder: Path) -> None:
    bump = 20e-6 * np.sin(np.linspace(0.0, np.pi, MOTION.position_m.size)) ** 4
    moves = (MOTION.trajectory.time_s, MOTION.position_m, bump)
    known = moves if route in {"cam", "program"} else (None, None, None)
    law = LAW if route == "law" else CompensationLaw()
    deploy(axis, Compensation(route, law, LEAD, *known), context_of(axis, folder))


@pytest.mark.parametrize("route", ["table", "law", "cam", "program"])
def test_nothing_of_a_route_is_left_behind(axis: Axis, tmp_path: Path, route: str) -> None:
    axis.link.write_buffer(["I8=3", "I186=0.5", "I819=0.7", "&1#1->500X", "&2#8->Z"])
    before = whole(axis)
    put_on(axis, route, tmp_path)
    put_on(axis, route, tmp_path)  # a second one does not make the first what stood before
    found = standing_on(axis)
    assert compare(before, whole(axis))
    context = context_of(axis, tmp_path)
    remove_from(axis, context, found)
    assert compare(before, whole(axis)) == ()
    assert standing_on(axis).is_empty
    rollback_last(axis.link, context)
    assert standing_on(axis) == found


def test_a_removal_that_could_not_begin_left_everything_as_it_was(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_on(axis, "cam", tmp_path)
    found = standing_on(axis)

    def lost(_axis: Axis) -> None:
        raise LinkLost("cut", code="X")

    monkeypatch.setattr(removal, "rest_time_motor", lost)
    with pytest.raises(LinkLost) as told:
        remove_from(axis, context_of(axis, tmp_path), found)
    assert told.value.left is ControllerState.OLD
    # What stands is NEW: OLD alone was read as the tables of before the upload.
    assert "The controller was left: OLD, as before this command." in str(told.value)
    monkeypatch.undo()
    assert standing_on(axis) == found


def test_a_removal_says_that_the_flash_was_not_touched(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_on(axis, "table", tmp_path)
    monkeypatch.setattr(removal, "open_axis", lambda *_: nullcontext(axis))
    monkeypatch.setattr(removal, "at_work", lambda *_: nullcontext())
    done = removal.remove_compensation("sim://", "paper", tmp_path)
    assert "a reset brings it back" in done["said"][0]
    assert removal.remove_compensation("sim://", "paper", tmp_path)["said"] == []


def test_what_was_set_after_an_upload_stays_set(axis: Axis, tmp_path: Path) -> None:
    put_on(axis, "law", tmp_path)
    axis.link.command("I8=2")
    remove_from(axis, context_of(axis, tmp_path), standing_on(axis))
    assert axis.link.query("I8I105") == ["2", "$35C0"]


def test_a_cam_of_another_folder_is_off_and_its_program_gone(axis: Axis, tmp_path: Path) -> None:
    put_on(axis, "cam", tmp_path / "there")
    found = standing_on(axis)
    assert {"PROG 705", "PLC 1", "motor #8, which counts time"} <= set(found.lines())
    remove_from(axis, context_of(axis, tmp_path / "here"), found)
    assert axis.link.query("I800") == ["0"]
    assert (1, 8, "Y") not in read_axes(axis.link)
    assert standing_on(axis).is_empty
    axis.run(MOTION)


def test_a_cam_whose_time_motor_somebody_switched_off_can_be_taken_off(
    axis: Axis, tmp_path: Path
) -> None:
    put_on(axis, "cam", tmp_path)
    axis.link.command("I800=0")  # as a reset does where the cam was not saved
    remove_from(axis, context_of(axis, tmp_path), standing_on(axis))
    assert not read_tables(axis.link)
    assert axis.link.query("I800") == ["0"]
    assert standing_on(axis).is_empty


def test_what_the_law_of_another_axis_needs_stays(axis: Axis, tmp_path: Path) -> None:
    put_on(axis, "table", tmp_path)
    axis.link.command("I8=1")
    other = replace(context_of(axis, tmp_path / "other"), block=LawBlock(7200))
    law_install.install_law(axis.link, other, 2)
    remove_from(axis, context_of(axis, tmp_path), standing_on(axis))
    assert axis.link.query("M7000->M7001->I8") == ["X:$0,24", "D:$108", "0"]


HOMING = ("M7003->X:$B0,18", "M7011->Y:$C0,0", "M7012->Y:$C0,10", "M7015->X:$B0,10")
OF_HOMING = "M7003->M7011->M7012->M7015->"


def load_homing(axis: Axis) -> list[str]:
    axis.link.write_buffer([*HOMING, "OPEN PLC 2 CLEAR", "P7190=M7003", "CLOSE"])
    return axis.link.query(OF_HOMING)


@pytest.mark.parametrize("route", ["table", "law"])
@pytest.mark.parametrize("homing", ["first", "second"])
def test_what_a_program_that_stays_uses_stays(
    axis: Axis, tmp_path: Path, route: str, homing: str
) -> None:
    if homing == "first":
        load_homing(axis)
    put_on(axis, route, tmp_path)
    defined = load_homing(axis)
    remove_from(axis, context_of(axis, tmp_path / "elsewhere"), standing_on(axis))
    assert axis.link.query(OF_HOMING) == defined
    put_on(axis, route, tmp_path)
    remove_from(axis, context_of(axis, tmp_path), standing_on(axis))
    assert axis.link.query(OF_HOMING) == defined
    assert standing_on(axis).is_empty


def test_definitions_that_no_law_put_there_stay(axis: Axis, tmp_path: Path) -> None:
    """A person's own names at a terminal: no law stood, or they stood before it did."""
    axis.link.write_buffer([*HOMING, "M7007->D:$17", "M7001->D:$88"])
    asked = f"M7001->M7007->{OF_HOMING}"
    defined = axis.link.query(asked)
    put_on(axis, "table", tmp_path / "there")
    remove_from(axis, context_of(axis, tmp_path / "here"), standing_on(axis))
    assert axis.link.query(asked)[:1] == defined[:1]
    assert axis.link.query(OF_HOMING) == defined[2:]
    axis.link.command("M7007->D:$17")
    put_on(axis, "law", tmp_path)
    remove_from(axis, context_of(axis, tmp_path), standing_on(axis))
    assert axis.link.query(asked) == defined


def test_a_law_that_pushes_at_rest_comes_back(axis: Axis, tmp_path: Path) -> None:
    """Its torque is an output: read back under a running law it is never the same."""
    pushing = replace(LAW, torque_constant_Nm=0.3)
    deploy(axis, Compensation("law", pushing, LEAD), context_of(axis, tmp_path / "upload"))
    axis.move_to(1000.0)
    axis.move_to(0.0)
    torque = float(axis.link.query("I129")[0])
    assert torque != 0.0
    context = context_of(axis, tmp_path / "elsewhere")
    remove_from(axis, context, standing_on(axis))
    assert axis.link.query("I106I129") == ["0", "0"]
    rollback_last(axis.link, context)
    assert standing_on(axis).law is LawForm.PLC
    axis.link.clock.sleep_s(1.0)
    assert axis.link.query("P7002P7003I106") == ["1", "1", "3"]
    assert float(axis.link.query("I129")[0]) != 0.0


def test_what_a_stopped_plc_0_left_standing_goes(axis: Axis, tmp_path: Path) -> None:
    pushing = replace(LAW, torque_constant_Nm=0.3)
    context = context_of(axis, tmp_path)
    deploy(axis, Compensation("law", pushing), context)
    axis.move_to(20_000.0)
    axis.link.command("DISABLE PLC 0")
    axis.link.clock.sleep_s(0.5)
    assert "0" not in axis.link.query("I129RX$10F8")
    head = law_state.read_law_head(axis.link, context.block)
    form = law_goal.running_form(axis.link, context, head)
    assert "its last correction stands" in inspect._law_text(axis, context, form, head)
    axis.link.command("I106=0")
    assert inspect._law_text(axis, context, form, head) == "none runs"  # as after $$$***
    axis.link.command("I106=3")
    remove_from(axis, context, standing_on(axis))
    assert axis.link.query("I106I129RX$10F8") == ["0", "0", "0"]
    assert standing_on(axis).is_empty


def test_the_law_of_an_open_servo_fades_and_comes_back_armed(tmp_path: Path) -> None:
    """The servo itself stays: what a rollback brings back is the gain that was wanted."""
    source = default_servo().read_text(encoding="utf-8")
    with embedded(Card(BENCH, servo_source=source)) as link:
        axis = Axis(link, BENCH, "test", simulated=True)
        axis.enable()
        link.command(f"I{axis.motor}59=1")
        context = context_of(axis, tmp_path)
        deploy(axis, Compensation("servo", LAW, LEAD), context)
        found = standing_on(axis)
        assert found.law is LawForm.SERVO
        assert law_state.read_law_head(link, context.block).gain == 1.0
        remove_from(axis, context, found)
        assert law_state.read_law_head(link, context.block).gain == 0.0
        rollback_last(link, context)
        link.clock.sleep_s(2.0)
        head = law_state.read_law_head(link, context.block)
        assert (head.target, head.gain) == (1.0, 1.0)
        assert standing_on(axis) == found


@pytest.mark.parametrize("look", ["remove", "restore", "setup"])
def test_a_look_is_refused_where_the_work_would_be(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, look: str
) -> None:
    """`--dry-run` told what would change, and the command itself wrote nothing."""
    law_install.install_law(axis.link, context_of(axis, tmp_path), 1)
    controller = BENCH.controller.model_copy(update={"p_block": (7100, 7299)})
    other = replace(axis, bench=BENCH.model_copy(update={"controller": controller}))
    for module in (removal, safekeeping, commissioning):
        monkeypatch.setattr(module, "open_axis", lambda *_: nullcontext(other))
    program = tmp_path / "some.pmc"
    program.write_text("P7600=1\n", encoding="utf-8")
    looks = {
        "remove": lambda: removal.plan_removal("tcp://card", "paper"),
        "restore": lambda: safekeeping.plan_restore("tcp://card", "paper", program),
        "setup": lambda: commissioning.plan_setup("tcp://card", "paper"),
    }
    with pytest.raises(SafetyRefusal) as refused:
        looks[look]()
    assert refused.value.code == "PC-COM-012"
