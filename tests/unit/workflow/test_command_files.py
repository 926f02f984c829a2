"""Command files as people export them."""

from pathlib import Path

import pytest

from pmac_comp.base.errors import CaptureError
from pmac_comp.workflow.commands import read_command


def test_other_separators_are_told_and_not_that_columns_are_missing(tmp_path: Path) -> None:
    file = tmp_path / "café axis.csv"
    file.write_text("\ufefftime_s;commanded_position_mm\n0,0;0,0\n0,1;1,5\n", encoding="utf-8")
    with pytest.raises(CaptureError, match="not separated by commas") as told:
        read_command(file)
    assert told.value.code == "PC-CMD-007"  # that columns are missing is PC-CMD-001
    file.write_text("\ufefftime_s,commanded_position_mm\n0,0\n0.1,1.5\n", encoding="utf-8")
    assert read_command(file)[1][1] == pytest.approx(1.5e-3)
