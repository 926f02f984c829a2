"""A program file that `restore` loads: told before, read back, and taken back with all it set."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest

from pmac_comp.base.errors import ConfigError
from pmac_comp.files.resources import firmware_path
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.programs import ProgramKind
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.controller import safekeeping, upload_flow

ASKED = "M7003->M7011->M7012->M7015->"


def test_homing_comes_whole_and_goes_with_its_definitions(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (safekeeping, upload_flow):
        monkeypatch.setattr(module, "open_axis", lambda _url, _bench: nullcontext(axis))
    axis.link.write_buffer(["M7011->X:$10,3"])
    before = axis.link.query(ASKED)
    source = firmware_path("homing.plc")
    told = safekeeping.plan_restore("sim://", "paper", source)["lines"]
    assert any("M7011 is X:$10,3 instead of Y:$C0,0" in line for line in told)
    assert axis.link.query(ASKED) == before
    axis.link.command("I5=1")
    done = safekeeping.restore_from_file("sim://", "paper", source, journal=tmp_path)
    assert "I5 = 1 holds background PLCs" in done["summary"]
    assert "4 definitions and 1 program written" in done["summary"]
    assert axis.link.query(ASKED) == ["X:$B0,18", "Y:$C0,0", "Y:$C0,10", "X:$B0,10"]
    axis.kill()
    axis.link.write_buffer(["I5=2", "P7199=300", "I123=0", "ENABLE PLC 2"])
    axis.link.clock.sleep_s(2.0)
    assert axis.link.query("P7190") == ["3"]  # it runs to its end: no trigger came
    axis.link.write_buffer(["#1J/"])
    axis.link.clock.sleep_s(0.5)
    upload_flow.rollback_upload("sim://", "paper", tmp_path)
    assert axis.link.query(ASKED) == before
    assert not programs.listing(axis.link, ProgramKind.PLC, 2)


def test_other_commands_are_sent_and_said_to_stay(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(safekeeping, "open_axis", lambda _url, _bench: nullcontext(axis))
    source = tmp_path / "mixed.pmc"
    source.write_text("I8=3\nP7190=$10\n&1#1->10000X\n", encoding="ascii")
    done = safekeeping.restore_from_file("sim://", "paper", source, journal=tmp_path / "kept")
    assert "2 variables" in done["summary"]
    assert "1 commands sent that no rollback undoes" in done["summary"]
    assert axis.link.query("I8P7190&1#1->") == ["3", "16", "10000X"]


def test_names_and_gather_sources_come_and_go(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (safekeeping, upload_flow):
        monkeypatch.setattr(module, "open_axis", lambda _url, _bench: nullcontext(axis))
    asked = "M7002->M7010->M7013->I5000I5001I5003I5049I5050I5051"
    axis.link.write_buffer(["M7013->Y:$78003,8,16,S", "I5003=$800090", "I5049=4"])
    before = axis.link.query(asked)
    done = safekeeping.restore_from_file(
        "sim://", "paper", firmware_path("bench_setup.pmc"), journal=tmp_path
    )
    assert "10 variables, 16 definitions and 0 programs written and read back" in done["summary"]
    assert axis.link.query(asked)[:4] == ["X:$10F8,24,S", "D:$10B", "X:$BF,8,16,S", "0"]
    upload_flow.rollback_upload("sim://", "paper", tmp_path)
    assert axis.link.query(asked) == before


@pytest.mark.parametrize("act", [safekeeping.plan_restore, safekeeping.restore_from_file])
def test_the_source_of_an_open_servo_is_for_its_compiler(act: Callable[..., object]) -> None:
    with pytest.raises(ConfigError, match="compiled only") as refused:
        act("sim://", "paper", firmware_path("feedforward_servo.txt"))
    assert "config servo" in refused.value.advice
