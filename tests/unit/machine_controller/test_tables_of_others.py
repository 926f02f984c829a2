"""Tables that are not of this change: off they stay off, and they come back as they were."""

from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import ControllerState, SafetyRefusal
from pmac_comp.machine.controller import recovery, upload
from pmac_comp.machine.controller.comp_table import CompTable, TableKind
from pmac_comp.machine.controller.manifest import Manifest, ManifestState
from pmac_comp.machine.controller.table_status import read_head
from pmac_comp.machine.controller.upload_checks import acted
from tests.unit.machine_controller.card_bench import CardBench

NEW = CompTable(1, (16, 32, 16, 0), 640000, by_desired=True)
FOREIGN = ["I30=0", "#3DEFINE COMP 4,#3,#3,640000", "8000 16000 8000 0"]
ENTRIES = [8000, 16000, 8000, 0]


def test_an_upload_does_not_switch_on_what_was_off(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    bench.link.write_buffer([*FOREIGN, "I51=0"])
    with pytest.raises(SafetyRefusal, match="COMP of motor #3 would begin to act") as refused:
        upload.upload_tables(bench.link, bench.context, [NEW])
    assert (refused.value.code, refused.value.left) == ("PC-UPL-070", ControllerState.OLD)
    assert (bench.i51, bench.values("COMP", 1)) == (0, None)
    bench.link.command("I51=1")
    result = upload.upload_tables(bench.link, bench.context, [NEW])
    assert (result.verdict, bench.i51) == (ControllerState.NEW, 1)


@pytest.mark.parametrize("on", [0, 1])
def test_a_removal_leaves_others_on_or_off(tmp_path: Path, on: int) -> None:
    bench = CardBench(tmp_path)
    bench.link.write_buffer([*FOREIGN, *NEW.lines, f"I51={on}"])
    with recovery.grouped(bench.link, bench.context, "remove") as parts:
        upload.remove_tables(bench.link, parts, [(TableKind.COMP, 1)])
    assert (bench.i51, bench.values("COMP", 1), bench.values("COMP", 3)) == (on, None, ENTRIES)
    assert recovery.recover(bench.link, bench.context).verdict is ControllerState.NEW
    assert bench.i51 == on
    recovery.rollback_last(bench.link, bench.context)
    assert bench.i51 == on
    assert tuple(bench.values("COMP", 1) or ()) == NEW.entries


def test_what_an_interrupted_upload_switched_off_did_act(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    manifest = Manifest(ManifestState.WRITING, 4711, 4, 1, 2, enabled_old=1)
    bench.link.write_buffer(manifest.lines(bench.context.block))
    assert acted(read_head(bench.link, bench.context))
    sealed = replace(manifest, state=ManifestState.VALID)
    bench.link.write_buffer(sealed.lines(bench.context.block))
    assert not acted(read_head(bench.link, bench.context))
