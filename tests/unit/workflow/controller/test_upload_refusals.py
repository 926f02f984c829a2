"""Everything that forbids an upload is told at once, before anything on the card is changed."""

import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import ControllerState, SafetyRefusal
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.controller.card.variables import read_many
from pmac_comp.machine.controller.contents.table_set import TableSet, read_tables
from pmac_comp.machine.controller.law.law_checks import no_servo
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.simulator.card.card import Card
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import default_servo, embedded
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller.deploy import Deployment, deploy, switch
from pmac_comp.workflow.controller.upload_flow import next_steps
from pmac_comp.workflow.controller.upload_plan import preview
from tests.compensations import friction_law, lead_map

BENCH = load_bench("paper")
LEAD = lead_map()
LAW = friction_law(provenance={"model": "model.json"})
URL = "tcp://127.0.0.1:1"


def standing(axis: Axis) -> tuple[TableSet, dict[str, float]]:
    return read_tables(axis.link), read_many(axis.link, ["I51", "I106", "P7001", "P7007"])


def refused(axis: Axis, folder: Path, compensation: Compensation) -> set[str]:
    """Codes that the plan and the upload itself name; nothing may have changed."""
    context = context_of(axis, folder)
    before = standing(axis)
    planned = {r.code for r in preview(axis, context, compensation, URL).refusals}
    with pytest.raises(SafetyRefusal) as stopped:
        deploy(axis, compensation, context)
    assert stopped.value.left is ControllerState.OLD
    assert standing(axis) == before
    told = {r.code for r in stopped.value.refusals} or {stopped.value.code}
    assert told == planned
    return told


def test_a_missing_open_servo_is_told_before_tables_are_touched(axis: Axis, tmp_path: Path) -> None:
    deploy(axis, Compensation("table", CompensationLaw(), LEAD), context_of(axis, tmp_path))
    steeper = replace(LEAD, error_m=1.1 * LEAD.error_m)
    servo = Compensation("servo", LAW, steeper)
    assert refused(axis, tmp_path, servo) == {"PC-LAW-024"}
    told = no_servo(context_of(axis, tmp_path), axis.motor, 0).hint
    assert "source for P7000-P7199, which `pmac-comp config servo BENCH`" in told
    # The switch alone, without an algorithm behind it, proves nothing either.
    axis.link.write_buffer(["I159=1", "P7007=1"])
    assert refused(axis, tmp_path, servo) == {"PC-LAW-024"}


@pytest.mark.parametrize("ran", [False, True], ids=["never closed", "ran before"])
def test_an_open_servo_that_rests_is_told_before_tables_are_touched(
    tmp_path: Path, *, ran: bool
) -> None:
    """Killed, no open servo proves that it runs: the upload began and was taken back."""
    source = default_servo().read_text(encoding="utf-8")
    with embedded(Card(BENCH, servo_source=source)) as link:
        axis = Axis(link, BENCH, "test", simulated=True)
        link.command("I159=1")
        servo = Compensation("servo", LAW, LEAD)
        if ran:
            axis.enable()
            deploy(axis, servo, context_of(axis, tmp_path))
            link.command("#1K")
        signature = read_many(link, ["P7000"])
        assert refused(
            axis, tmp_path, replace(servo, lead=replace(LEAD, error_m=1.1 * LEAD.error_m))
        ) == {"PC-LAW-057"}
        assert read_many(link, ["P7000"]) == signature


def test_all_that_forbids_a_law_is_told_at_once(axis: Axis, tmp_path: Path) -> None:
    axis.link.write_buffer(["CLOSE", "OPEN PLC 0 CLEAR", "P1=P1+1", "CLOSE", "I15=1", "I159=1"])
    found = refused(axis, tmp_path, Compensation("law", LAW, LEAD))
    assert found == {"PC-LAW-032", "PC-LAW-037", "PC-LAW-041"}


@pytest.mark.parametrize("lead", [LEAD, None], ids=["with tables", "without"])
def test_somebody_s_gathering_is_not_ended_and_an_idle_buffer_leaves_room(
    axis: Axis, tmp_path: Path, lead: LeadMap | None
) -> None:
    """A gather buffer, as other tools leave it, takes all memory that PLC 0 would need."""
    law = Compensation("law", LAW, lead)
    axis.link.write_buffer(["I5001=$400000", "I5050=1", "DEFINE GATHER", "GATHER"])
    before = standing(axis)
    with pytest.raises(SafetyRefusal, match="gathering is running"):
        deploy(axis, law, context_of(axis, tmp_path))
    assert standing(axis) == before
    axis.link.command("ENDGATHER")
    assert deploy(axis, law, context_of(axis, tmp_path)).verdict is ControllerState.NEW


def test_an_armed_law_forbids_another_clamp_and_the_open_servo(axis: Axis, tmp_path: Path) -> None:
    deploy(axis, Compensation("law", LAW), context_of(axis, tmp_path))
    lower = replace(LAW, amplitude_limit_m=30e-6)
    assert refused(axis, tmp_path, Compensation("law", lower, LEAD)) == {"PC-LAW-025"}
    found = refused(axis, tmp_path, Compensation("servo", LAW, LEAD))
    assert found == {"PC-LAW-021", "PC-LAW-024"}


@pytest.mark.parametrize(
    ("lines", "codes"),
    [
        (["I130=I130/2"], {"PC-COM-001"}),
        (["I168=300"], {"PC-COM-008"}),
        (["I100=0", "I133=0"], {"PC-COM-001", "PC-COM-002"}),
    ],
    ids=["another gain", "friction feedforward", "not activated"],
)
@pytest.mark.parametrize("route", ["law", "table", "program"])
def test_a_card_that_the_law_was_not_computed_for_is_refused(
    axis: Axis, tmp_path: Path, route: str, lines: list[str], codes: set[str]
) -> None:
    """Gains, units and motors that somebody changed between the runs and the upload."""
    axis.kill()
    axis.link.write_buffer(lines)
    motion_s = None if route != "program" else np.arange(4000) * BENCH.servo_period_s
    place_m = None if motion_s is None else 1e-3 * np.sin(2.0 * motion_s) ** 3
    extra = None if place_m is None else 1e-4 * place_m
    compensation = Compensation(
        route,
        LAW if route == "law" else CompensationLaw(),
        LEAD,
        motion_time_s=motion_s,
        motion_position_m=place_m,
        motion_correction_m=extra,
    )
    assert codes <= refused(axis, tmp_path, compensation)


@pytest.mark.parametrize("route", ["law", "table"])
def test_variables_that_the_machine_uses_are_not_written(
    axis: Axis, tmp_path: Path, route: str
) -> None:
    compensation = Compensation(route, LAW if route == "law" else CompensationLaw(), LEAD)
    # Homing's, and the end of a capture's lease.
    axis.link.write_buffer(["P7190=2", "P7199=1", "P7079=122997"])
    axis.link.write_buffer(["P7012=3.5", "P7090=-1"])
    assert refused(axis, tmp_path, compensation) == {"PC-COM-010"}
    assert axis.link.query("P7012 P7090") == ["3.5", "-1"]
    # What a change of ours leaves behind marks the block as ours.
    axis.link.command("P7083=-1234567")
    assert deploy(axis, compensation, context_of(axis, tmp_path)).verdict is ControllerState.NEW


@pytest.mark.parametrize("acts", [True, False])
def test_what_to_do_next_can_be_run_as_it_stands(*, tmp_path: Path, acts: bool) -> None:
    folder = tmp_path / "two words"
    folder.mkdir()
    (folder / "model.json").write_text("{}")
    new = folder / "compensation.json"
    done = Deployment(ControllerState.NEW, (), motor=4, acts=acts)
    steps = list(next_steps(URL, "my.toml", new, Path("kept"), Compensation("law", LAW), done))
    assert len(steps) == 2 + (not acts)
    words = {line.split(":", 1)[0]: shlex.split(line.split(": ", 1)[1]) for line in steps}
    check = words["Check it"]
    assert check[check.index("--model") + 1] == str(folder / "model.json")
    assert check[check.index("--compensation") + 1] == str(new)
    assert words["Take it back"][-2:] == ["--journal", "kept"]
    if not acts:
        assert "#4J/" in " ".join(words["Arm it"])


def test_an_axis_that_somebody_moves_is_not_sent_to_its_zero(axis: Axis, tmp_path: Path) -> None:
    context = context_of(axis, tmp_path)
    deploy(axis, Compensation("table", CompensationLaw(), LEAD), context)
    axis.link.command("#1J+")
    axis.link.clock.sleep_s(0.1)
    before = standing(axis)
    for act in (
        lambda: switch(axis, context, Compensation("table", CompensationLaw(), LEAD), on=False),
        lambda: deploy(axis, Compensation("law", LAW, LEAD), context),
        lambda: deploy(axis, Compensation("table", CompensationLaw(), lead_map(30.0)), context),
    ):
        with pytest.raises(SafetyRefusal, match="executing a move"):
            act()
        assert standing(axis) == before
    axis.link.clock.sleep_s(0.2)
    assert abs(float(axis.link.query("#1V")[0])) > 0.0
