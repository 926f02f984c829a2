"""What doctor says of this installation."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.machine.controller.contents.comp_table import CompTable
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.tables.upload import upload_tables
from pmac_comp.workflow.capture import session
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.controller import doctor, inspect
from pmac_comp.workflow.controller.doctor import examine
from tests.unit.workflow.conftest import BENCH


def test_an_installed_package_says_where_its_files_lie() -> None:
    said = {finding.check: finding.found for finding in examine("", "paper")}
    for check, name in (("configs", "effect_worn_stretch.py"), ("firmware_plc", "homing.plc")):
        assert (Path(said[check].split(" files in ")[1]) / name).is_file()


def test_tables_are_judged_as_status_does(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tables of two axes were a foreign change to doctor, and NEW to status."""
    for module in (inspect, session):
        monkeypatch.setattr(module, "open_axis", lambda *_: nullcontext(axis))
    here = context_of(axis, tmp_path / "here")
    there = replace(context_of(axis, tmp_path / "there"), block=LawBlock(7200))
    upload_tables(axis.link, here, [CompTable(1, (16, 32, 16, 0), 640000, by_desired=True)])
    upload_tables(axis.link, there, [CompTable(3, (16, 32, 16, 0), 640000, by_desired=True)])
    found = {finding.check: finding for finding in examine("sim://", "paper", journal=here.store)}
    told = found["compensation"]
    assert "as an upload with the p_block at P7200 meant them" in told.found
    status = inspect.controller_status("", "", here.store)["compensation"]
    assert told.found.removeprefix("tables ").startswith(f"{status['verdict']}: ")
    assert told.found.partition(": ")[2] in status["why"]
    assert told.state == "ok"


def test_a_conversion_that_a_capture_refuses_is_told(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "open_axis", lambda *_: nullcontext(axis))
    assert "encoder conversion" not in {f.check for f in examine("x", "paper", journal=tmp_path)}
    other = "1/T" if BENCH.encoder.extension == "none" else "none"
    said = BENCH.model_copy(
        update={"encoder": BENCH.encoder.model_copy(update={"extension": other})}
    )
    monkeypatch.setattr(doctor, "load_bench", lambda _: said)
    found = {f.check: f for f in examine("x", "paper", journal=tmp_path)}
    assert found["encoder conversion"].state == "bad"
    assert "extension" in found["encoder conversion"].found
