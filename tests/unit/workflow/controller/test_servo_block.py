"""The open servo in another block of P-variables than the one its file is written for."""

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pmac_comp.cli.app import app
from pmac_comp.files.bench import Bench, parse_bench
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.contents.servo_source import servo_for, servo_source
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import default_servo, embedded, make_card
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller.deploy import deploy
from tests.unit.workflow.conftest import BENCH
from tests.unit.workflow.controller.test_deploy import LAW, LEAD, MOTION

MOVED = BENCH.text.replace("p_block = [7000, 7199]", "p_block = [2000, 2199]")


@pytest.fixture
def bench() -> Bench:
    found = parse_bench(MOVED)
    assert list(found.controller.p_block) == [2000, 2199]
    return found


@pytest.mark.parametrize("first", [0, 2000, 6900, 7100, 7992])
def test_the_source_moves_whole_and_once(first: int) -> None:
    text = default_servo().read_text(encoding="utf-8")
    moved = servo_source(LawBlock(first))
    assert servo_for(moved, LawBlock(first)) == moved  # moved already
    old, new = (re.findall(r"(?<![A-OQ-Z$.\d])P?\d+", t.partition("\n")[2]) for t in (text, moved))
    differences = {int(b.strip("P")) - int(a.strip("P")) for a, b in zip(old, new, strict=True)}
    assert differences - {0} == ({first - 7000} - {0})
    assert len(moved.splitlines()) == len(text.splitlines())


def test_a_source_of_somebody_else_stays_as_it_is() -> None:
    text = "; mine\nOPEN SERVO CLEAR\nP7050=7050\nRETURN(0)\nCLOSE\n"
    assert servo_for(text, LawBlock(2000)) == text


def test_a_law_runs_in_the_open_servo_of_the_block_of_its_bench(
    bench: Bench, tmp_path: Path
) -> None:
    with embedded(make_card(bench, servo=default_servo())) as link:
        axis = Axis(link, bench, "test", simulated=True)
        axis.enable()
        link.command(f"I{axis.motor}59=1")
        deploy(axis, Compensation("servo", LAW, LEAD), context_of(axis, tmp_path))
        axis.run(MOTION)
        assert link.query("P2000P2002P2003") == ["20262", "1", "1"]
        assert float(link.query("P2144")[0]) in {2010.0, 2040.0}
        assert set(link.query("P7000..7199")) == {"0"}


def test_the_source_for_a_bench_is_printed_for_the_compiler(tmp_path: Path, bench: Bench) -> None:
    path = tmp_path / "axis.toml"
    path.write_text(MOVED, encoding="utf-8")
    done = CliRunner().invoke(app, ["config", "servo", str(path)])
    assert done.exit_code == 0
    assert done.output.splitlines()[0].startswith("; feedforward_servo.txt for P2000-P2199")
    assert done.output.rstrip() == servo_source(LawBlock(bench.controller.p_block[0])).rstrip()
