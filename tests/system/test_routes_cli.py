"""Upload, diff and plan as a person runs them: what is said before, and how it ends."""

import json
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.workflow.compensation.file import Compensation, write_compensation
from tests.compensations import TRAVEL_m, friction_law, lead_map
from tests.system.command import run

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]
BENCH = load_bench("paper")
LAW = friction_law()
LEAD = lead_map(reversal_um=-4.0)
T = np.arange(2000) * BENCH.servo_period_s
MOVE = 0.02 * (T / T[-1]) ** 3 * (10.0 - 15.0 * (T / T[-1]) + 6.0 * (T / T[-1]) ** 2)
BUMP = 8e-6 * np.sin(np.pi * T / T[-1]) ** 2


def compensation(route: str) -> Compensation:
    if route in {"law", "servo", "table"}:
        return Compensation(route, LAW, LEAD, backlash=True)
    return Compensation(
        route, LAW, motion_time_s=T, motion_position_m=MOVE, motion_correction_m=BUMP
    )


@pytest.mark.parametrize("route", ["table", "law", "cam", "program"])
def test_plan_upload_and_end_of_each_route(tmp_path: Path, route: str) -> None:
    write_compensation(tmp_path / "c.json", compensation(route))
    dry = run("upload", "sim://", "c.json", "--dry-run", cwd=tmp_path)
    assert dry.returncode == 0, dry.stderr
    assert "largest change of" in dry.stdout
    assert "nothing is saved to flash" in dry.stdout
    if route in {"table", "law", "cam"}:
        assert "are off (I51 = 0) for about" in dry.stdout
    sent = "DEFINE COMP" if route != "program" else "PVT"
    assert sent in dry.stdout
    assert not (tmp_path / "pmac-comp-journal").exists()

    done = run("upload", "sim://", "c.json", "--yes", "--persist", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert "NEW: what was uploaded stands on the controller" in lines
    said = lines[lines.index("NEW: what was uploaded stands on the controller") + 1 :]
    assert any(line.startswith("  - ") and "saved to flash and read again" in line for line in said)
    assert "pmac-comp verify sim:// --bench paper --compensation c.json" in done.stdout
    assert "pmac-comp rollback sim:// --bench paper --persist" in done.stdout
    assert "largest change of" in done.stdout  # the plan comes first


def test_old_against_new_of_a_law_is_numbers_in_um_and_a_plot(tmp_path: Path) -> None:
    write_compensation(tmp_path / "c.json", compensation("law"))
    done = run("diff", "sim://", "c.json", "--plot", "d.svg", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    named = {curve["name"]: curve for curve in found["curves"]}
    law = named["the law's correction on a reference move"]
    # 2.2 um per m/s2 at 5 m/s2 and 0.9 um of friction, on a card that has no law yet.
    assert law["largest_change"] == pytest.approx(2.2 * 5.0 + 0.9, rel=0.1)
    tables = named["the tables' correction, downwards"]["largest_change"]
    assert found["largest_change_um"] == pytest.approx(max(law["largest_change"], tables))
    assert tables == pytest.approx(35.0 * 0.3 + 4.0, rel=0.05)
    rows = {row["quantity"]: row for row in found["rows"]}
    assert rows["law, friction (each side)"]["new"] == pytest.approx(0.9, rel=1e-3)
    assert rows["law, friction (each side)"]["old"] is None
    assert rows["law, told for the axis at"]["old"] is None
    assert rows["backlash table, highest"]["new"] == pytest.approx(4.0, abs=0.1)
    # 35 um per m, to the rounding of two entries; beyond the travel the table runs back steeply.
    assert rows["lead table, steepest"]["new"] == pytest.approx(0.035, abs=2 * 0.0625 / 0.5)
    assert rows["lead table, steepest"]["unit"] == "um/mm"
    assert (tmp_path / "d.svg").read_text().count("<svg") == 1


def test_a_forbidden_upload_names_every_reason_before_it_asks(tmp_path: Path) -> None:
    x = TRAVEL_m
    steep = LeadMap(x, 90e-6 * np.sin(2 * np.pi * x / 4e-3), 0.0 * x, 0.0)
    write_compensation(tmp_path / "c.json", Compensation("table", LAW, steep))
    done = run("upload", "sim://", "c.json", cwd=tmp_path)
    assert done.returncode == 6
    # Each reason once, with its advice; the plan above them does not tell them as well.
    assert done.stderr.count("\n  - ") == 2
    assert "refused:" not in done.stdout
    assert "PC-SAF-001" in done.stderr or "corrects by" in done.stderr
    assert "--yes" not in done.stderr
    assert not (tmp_path / "pmac-comp-journal").exists()


def test_what_the_simulated_card_supports_is_printed(tmp_path: Path) -> None:
    done = run("sim", "--supported", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) > 20


def test_info_and_doctor_say_that_the_card_is_simulated(tmp_path: Path) -> None:
    assert json.loads(run("info", "sim://", "--json", cwd=tmp_path).stdout)["simulated"] is True
    found = json.loads(run("doctor", "sim://", "--json", cwd=tmp_path).stdout)["findings"]
    said = {finding["check"]: finding for finding in found}
    assert said["flash"]["state"] == "ok"
    assert "simulated" in said["controller"]["found"]
