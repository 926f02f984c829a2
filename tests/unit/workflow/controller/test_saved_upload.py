"""An upload that was saved to flash, and its way back."""

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from pmac_comp.base.errors import ChangeInterrupted, ControllerState
from pmac_comp.files.bench import load_bench
from pmac_comp.files.resources import firmware_path
from pmac_comp.machine.controller.contents.table_set import read_tables
from pmac_comp.machine.controller.whole.rollback import rollback_last
from pmac_comp.machine.controller.whole.taking_back import RESET_NOTE
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.simulator.card.card import Card
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import embedded
from pmac_comp.workflow.compensation.file import Compensation, write_compensation
from pmac_comp.workflow.controller import safekeeping, upload_flow
from pmac_comp.workflow.controller.deploy import deploy
from pmac_comp.workflow.controller.upload_plan import preview
from tests.compensations import friction_law, lead_map

BENCH = load_bench("paper")


def after_reset(axis: Axis, card: Card) -> int:
    """Number of tables that the flash holds."""
    card.reset()
    with embedded(card) as link:
        found = len(read_tables(link))
    axis.link.write_buffer(["I3=2", "I6=1"])
    return found


def test_rollback_reaches_the_flash_on_demand_only(
    axis: Axis, card: Card, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(upload_flow, "open_axis", lambda _url, _bench: nullcontext(axis))
    new, store = tmp_path / "c.json", tmp_path / "journal"
    write_compensation(new, Compensation("table", CompensationLaw(), lead_map(20.0)))

    upload_flow.upload_file("sim://", "paper", new, store, persist=True)
    told = upload_flow.rollback_upload("sim://", "paper", store)
    assert "the flash was not touched" in told["summary"]
    assert len(read_tables(axis.link)) == 0
    assert after_reset(axis, card) == 1

    axis.link.command("I51=0")
    axis.link.command("#1DELETE COMP")
    upload_flow.upload_file("sim://", "paper", new, store / "third", persist=True)
    told = upload_flow.rollback_upload("sim://", "paper", store / "third", persist=True)
    assert (told["verdict"], told["saved"]) == ("OLD", True)
    assert after_reset(axis, card) == 0


@pytest.mark.parametrize("again", [False, True], ids=["one upload", "loaded, then armed"])
@pytest.mark.parametrize("reset", [False, True], ids=["no reset", "reset"])
def test_a_rollback_after_a_reset_says_what_did_not_come_back(
    card: Card, tmp_path: Path, *, again: bool, reset: bool
) -> None:
    """PLC 0 and guard came with the first upload: tables acted alone, called what stood before."""
    change = Compensation("law", friction_law(), lead_map(20.0))
    with embedded(card) as link:
        axis = Axis(link, BENCH, "test", simulated=True)
        if again:
            deploy(axis, change, context_of(axis, tmp_path))
        axis.enable()
        deploy(axis, change, context_of(axis, tmp_path))
        axis.kill()
    if reset:
        card.reset()
    with embedded(card) as link:
        axis = Axis(link, BENCH, "test", simulated=True)
        notes = rollback_last(link, context_of(axis, tmp_path)).notes
        assert len(read_tables(link)) == int(again)
    assert (RESET_NOTE in notes) is reset
    assert any("nothing evaluates them" in note for note in notes) is (reset and again)


@pytest.mark.parametrize("ended", [True, False])
def test_an_upload_stopped_in_its_save_was_saved_if_that_ended(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, ended: bool
) -> None:
    """It was told as lost in a reset that never was."""
    monkeypatch.setattr(upload_flow, "open_axis", lambda _url, _bench: nullcontext(axis))
    new = tmp_path / "c.json"
    write_compensation(new, Compensation("table", CompensationLaw(), lead_map(20.0)))
    saved = upload_flow.save_checked

    def stopped(*given: Any) -> None:
        if ended:
            saved(*given)
        raise ChangeInterrupted("Stopped.", left=ControllerState.NEW if ended else None)

    monkeypatch.setattr(upload_flow, "save_checked", stopped)
    with pytest.raises(ChangeInterrupted) as left:
        upload_flow.upload_file("sim://", "paper", new, tmp_path / "journal", persist=True)
    assert (left.value.left, left.value.context["confirmed"]) == (ControllerState.NEW, True)
    assert any("was saved" in note for note in left.value.__notes__) is ended
    assert not any("reset:" in note for note in left.value.__notes__)


HOMED, NOT_STARTED = "2", "4"


@pytest.mark.parametrize("saved_while", ["homed", "searching"])
def test_a_saved_homing_plc_moves_nothing_at_power_up(
    axis: Axis, card: Card, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, saved_while: str
) -> None:
    monkeypatch.setattr(safekeeping, "open_axis", lambda _url, _bench: nullcontext(axis))
    safekeeping.restore_from_file("sim://", "paper", firmware_path("homing.plc"), journal=tmp_path)
    axis.kill()
    # as a run of motion_sine.pmc leaves its parameters and its last sine
    axis.link.write_buffer(["I5=3", "I123=10", "I7012=1", "I126=0", "P7191=20000", "P7197=1"])
    axis.link.write_buffer(["P7199=20000", "ENABLE PLC 2"])
    if saved_while == "homed":
        axis.link.clock.sleep_s(8.0)
        assert axis.link.query("P7190") == [HOMED]
    else:
        axis.link.clock.sleep_s(0.6)
        assert axis.link.query("P7190") == ["1"]
    axis.kill()
    card.save()
    card.reset()
    with embedded(card) as link:
        link.write_buffer(["I3=2", "I6=1"])
        assert link.query("LIST PLC 2,0,1")
        link.clock.sleep_s(2.0)
        assert link.query("P7190P7199I5") == [NOT_STARTED, "0", "3"]
        assert link.query("M7003") == ["1"]  # open loop
        # and it still homes where somebody asks for it
        link.write_buffer(["P7199=20000", "ENABLE PLC 2"])
        link.clock.sleep_s(8.0)
        assert link.query("P7190M7003") == [HOMED, "0"]
    axis.link.write_buffer(["I3=2", "I6=1"])


def test_a_plan_to_save_names_what_runs_at_power_up(
    axis: Axis, card: Card, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(safekeeping, "open_axis", lambda _url, _bench: nullcontext(axis))
    context = context_of(axis, tmp_path)
    new = Compensation("table", CompensationLaw(), lead_map(20.0))

    def kept() -> list[str]:
        text = preview(axis, context, new, "sim://", persist=True).text
        return [line for line in text if "at power-up" in line]

    axis.link.command("I5=3")
    safekeeping.restore_from_file("sim://", "paper", firmware_path("homing.plc"), journal=tmp_path)
    assert kept() == []
    axis.link.command("P7199=20000")  # and PLC 2 not enabled yet
    (line,) = kept()
    assert "set P7199 = 0 before" in line
    axis.link.command("P7199=1")
    axis.link.write_buffer(["OPEN PLC 7 CLEAR", 'COMMAND"#1J/"', "CLOSE"])
    (line,) = kept()
    assert "SAVE keeps PLC 7 as well" in line
    card.programs.password, card.programs.unlocked = "Geheim", False
    (line,) = kept()
    assert "a password hides PLCs" in line
    axis.link.command("I5=1")
    assert kept() == []
