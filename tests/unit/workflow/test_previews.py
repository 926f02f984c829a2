"""Dry runs: they say what would be done, and nothing is."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import ConfigError, ForeignChange
from pmac_comp.cli.compensation import _told
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.controller.contents.table_set import read_tables
from pmac_comp.machine.controller.whole import grouping, rollback
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.capturing import plan_capture
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller.deploy import deploy
from pmac_comp.workflow.controller.removal import remove_from, standing_on
from pmac_comp.workflow.controller.upload_plan import preview
from pmac_comp.workflow.demo import run_demo
from pmac_comp.workflow.improve import improve_on_controller
from pmac_comp.workflow.motion.motions import parse_motion
from pmac_comp.workflow.previews import (
    preview_improvement,
    preview_verification,
    what_is_open,
    what_was_uploaded,
)
from tests.compensations import friction_law, lead_map

BENCH = load_bench("paper")
TABLE = Compensation("table", CompensationLaw(), lead_map())


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_rollback_and_recovery_are_told_from_what_stands(axis: Axis, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no upload"):
        what_was_uploaded(axis, tmp_path)
    context = context_of(axis, tmp_path)
    deploy(axis, TABLE, context)
    stands, kept = read_tables(axis.link), files_of(tmp_path)
    told = what_was_uploaded(axis, tmp_path)
    assert told["would_take_back"] == ["tables", "settings"]  # the last one first
    assert "tables" in told["summary"]
    assert what_is_open(axis, tmp_path)["would_settle"] == []
    assert read_tables(axis.link) == stands
    assert files_of(tmp_path) == kept
    rollback.rollback_last(axis.link, context)
    with pytest.raises(ConfigError, match="taken back already"):
        what_was_uploaded(axis, tmp_path)


def test_recovery_names_an_upload_that_was_interrupted(axis: Axis, tmp_path: Path) -> None:
    context = context_of(axis, tmp_path)
    with pytest.raises(RuntimeError), grouping.grouped(axis.link, context, "law"):
        raise RuntimeError
    assert what_is_open(axis, tmp_path)["would_settle"] == ["an upload (law) was interrupted"]


def test_a_rehearsal_names_what_the_command_is_refused_for(axis: Axis, tmp_path: Path) -> None:
    """Somebody has taken the compensation off from another folder: nothing is written over that."""
    here, elsewhere = (context_of(axis, tmp_path / name) for name in ("here", "elsewhere"))
    deploy(axis, TABLE, here)
    assert what_was_uploaded(axis, here.store)["refusals"] == []
    remove_from(axis, elsewhere, standing_on(axis))
    (told,) = what_was_uploaded(axis, here.store)["refusals"]
    with pytest.raises(ForeignChange) as refused:
        rollback.rollback_last(axis.link, here)
    assert refused.value.message == told
    assert any("refused: Another folder" in line
               for line in _told("take back", what_was_uploaded(axis, here.store)))  # fmt: skip


def test_an_armed_law_is_told_to_be_replaced_where_it_is(axis: Axis, tmp_path: Path) -> None:
    """Its sign was measured and its gain stands: the axis does not move, and bank 0 is idle now."""
    law, context = Compensation("law", friction_law()), context_of(axis, tmp_path)
    first = preview(axis, context, law, "tcp://127.0.0.1:1")
    assert any("to measure the sign" in line for line in first.text)
    assert any(line.startswith("P7040=") for line in first.lines)
    deploy(axis, law, context)
    again = preview(axis, context, law, "tcp://127.0.0.1:1")
    assert any("takes its place at the same gain" in line for line in again.text)
    assert not any("to measure the sign" in line for line in again.text)
    assert any(line.startswith("P7010=") for line in again.lines)


@pytest.mark.parametrize(("static_runs", "more"), [(0, 1), (5, 2)])
def test_verification_tells_each_motion_and_how_often_it_runs(static_runs: int, more: int) -> None:
    told = preview_verification(
        "paper",
        TABLE,
        motions=("sine:amplitude_mm=8,frequency_Hz=3", "triangle:amplitude_mm=2"),
        repeats=3,
        static_runs=static_runs,
        seed=0,
    )
    assert [row[1] for row in told.rows()[:2]] == [6, 6]
    assert len(told.rows()) == 2 + more
    runs = sum(row[1] for row in told.rows())
    assert f"min of motion in {runs} runs, about" in told.lines()[0]


def test_a_compensation_of_one_motion_is_verified_on_that_motion_only() -> None:
    motion = parse_motion("sine:amplitude_mm=8,frequency_Hz=3", BENCH)
    cam = Compensation(
        "cam",
        CompensationLaw(),
        motion_time_s=motion.trajectory.time_s,
        motion_position_m=motion.position_m,
        motion_correction_m=np.zeros(motion.position_m.size),
    )
    told = preview_verification("paper", cam, repeats=2, static_runs=5, seed=0)
    assert [row[:2] for row in told.rows()] == [("verification", 4)]


def test_no_other_motion_is_asked_of_a_compensation_of_one() -> None:
    known = parse_motion("sine:amplitude_mm=8,frequency_Hz=3", BENCH)
    cam = Compensation(
        "cam",
        CompensationLaw(),
        None,
        known.trajectory.time_s,
        known.position_m,
        0 * known.position_m,
    )
    asked = ("sine:amplitude_mm=5,frequency_Hz=1",)
    with pytest.raises(ConfigError, match="one known motion") as refused:
        preview_verification("paper", cam, motions=asked, repeats=2, static_runs=0, seed=0)
    assert "--route cam --command" in refused.value.hint


def test_improvement_tells_its_runs_and_refuses_what_it_would_refuse() -> None:
    told = preview_improvement("paper", route="law", seed=0)
    assert {row[0] for row in told.rows()} == {
        "calibration", "lead error", "verification of both models",
    }  # fmt: skip
    with pytest.raises(ConfigError, match="one known motion"):
        preview_improvement("paper", route="cam", seed=0)


@pytest.mark.parametrize("route", ["table", "law", "servo"])
def test_the_guard_is_told_wherever_tables_come(axis: Axis, tmp_path: Path, route: str) -> None:
    """Its PLC 1 is written beside tables, whatever else the route brings, and not without them."""
    context = context_of(axis, tmp_path)
    law = CompensationLaw() if route == "table" else friction_law()
    with_tables = preview(axis, context, Compensation(route, law, lead_map()), "tcp://a:1")
    assert sum("guard: PLC 1 comes" in line for line in with_tables.text) == 1
    assert with_tables.lines.count("OPEN PLC 1 CLEAR") == 1
    assert with_tables.lines.count("OPEN PLC 0 CLEAR") == (route == "law")
    if route != "table":
        without = preview(axis, context, Compensation(route, law), "tcp://a:1")
        assert not any("guard:" in line for line in without.text)
        assert "OPEN PLC 1 CLEAR" not in without.lines


def test_the_plan_names_the_other_motors_whose_tables_are_off_meanwhile(
    axis: Axis, tmp_path: Path
) -> None:
    """Their tables stay, and all act or none."""
    context = context_of(axis, tmp_path)
    alone = preview(axis, context, TABLE, "tcp://127.0.0.1:1")
    assert not any("that concerns" in line for line in alone.text)
    axis.link.write_buffer(["#3DEFINE COMP 4,#3,#3,64000", "0", "16", "16", "0", "I51=1"])
    beside = preview(axis, context, TABLE, "tcp://127.0.0.1:1")
    assert any("that concerns #3 as well" in line for line in beside.text)


@pytest.mark.parametrize("command", ["improve", "improve --dry-run", "demo", "capture"])
def test_what_needs_a_scale_is_refused_before_anything_moves(tmp_path: Path, command: str) -> None:
    text = re.sub(r"\[scale\][^\[]*", "", load_bench("paper").text)
    bench = tmp_path / "no_scale.toml"
    bench.write_text(text)
    acts: dict[str, Callable[[], object]] = {
        "improve": lambda: improve_on_controller("sim://", str(bench), tmp_path / "out"),
        "improve --dry-run": lambda: preview_improvement(str(bench), route="law", seed=0),
        "demo": lambda: run_demo(tmp_path / "out", bench=str(bench)),
        "capture": lambda: plan_capture(str(bench), campaign="lead", motions=()),
    }
    with pytest.raises(ConfigError, match=r"no \[scale\]") as refused:
        acts[command]()
    assert refused.value.code == "PC-WRK-005"
    assert not (tmp_path / "out").exists()
    assert plan_capture(str(bench), campaign="calibration", motions=()).motions
