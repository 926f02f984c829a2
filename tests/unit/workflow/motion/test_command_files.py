"""Command files as people export them."""

from pathlib import Path

import pytest

from pmac_comp.base.errors import CaptureError, SampleGap
from pmac_comp.workflow.motion.commands import read_command


def test_other_separators_are_told_and_not_that_columns_are_missing(tmp_path: Path) -> None:
    file = tmp_path / "café axis.csv"
    file.write_text("\ufefftime_s;commanded_position_mm\n0,0;0,0\n0,1;1,5\n", encoding="utf-8")
    with pytest.raises(CaptureError, match="not separated by commas") as told:
        read_command(file)
    assert told.value.code == "PC-CMD-007"  # that columns are missing is PC-CMD-001
    file.write_text("\ufefftime_s,commanded_position_mm\n0,0\n0.1,1.5\n", encoding="utf-8")
    assert read_command(file)[1][1] == pytest.approx(1.5e-3)


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ("0 .001 .002 .0015 .0025 .0035", "row 4 .* at 0.0015 s, comes -0.0005 s .* is 0.001 s"),
        ("0 .001 .002 .005 .006 .007", "row 4 .* at 0.005 s, comes 0.003 s .* is 0.001 s"),
        ("0 .001 .0012 .0022 .0032 .0052", "row 3 .* at 0.0012 s, comes 0.0002 s .* is 0.001 s"),
        ("0 .001 .001 .002 .003", "row 3 .* at 0.001 s, comes 0 s .* is 0.001 s"),
        ("0 .001 .002 .004 .006", "row 4 .* at 0.004 s, comes 0.002 s .* is 0.001 s"),
        ("3 2 1", "row 2 .* at 2 s, comes -1 s .* is more than 0 s"),
    ],
)
def test_the_first_row_off_the_grid_is_told_with_its_step(
    tmp_path: Path, times: str, said: str
) -> None:
    file = tmp_path / "steps.csv"
    rows = "".join(f"{time},1\n" for time in times.split())
    file.write_text("time_s,commanded_position_mm\n" + rows, encoding="utf-8")
    with pytest.raises(SampleGap, match=said) as told:
        read_command(file)
    assert told.value.code == "PC-CMD-003"


def test_rounded_times_are_no_gap(tmp_path: Path) -> None:
    file = tmp_path / "rounded.csv"
    rows = "".join(f"{k * 442e-6:.4f},1\n" for k in range(50))
    file.write_text("time_s,commanded_position_mm\n" + rows, encoding="utf-8")
    assert read_command(file)[0].size == 50
