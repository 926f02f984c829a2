"""An upload that was saved to flash, and its way back."""

from contextlib import nullcontext
from pathlib import Path

import pytest

from pmac_comp.machine.controller.table_set import read_tables
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.simulator.card import Card
from pmac_comp.workflow import upload_flow
from pmac_comp.workflow.axis import Axis
from pmac_comp.workflow.compensation_file import Compensation, write_compensation
from pmac_comp.workflow.simulated import embedded
from tests.compensations import lead_map


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
