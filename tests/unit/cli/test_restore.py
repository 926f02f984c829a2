"""``restore``, and what ``recover`` and ``status`` print, as a user calls them."""

from pathlib import Path

import pytest

from pmac_comp.base.errors import ConfigError
from pmac_comp.cli.app import main
from pmac_comp.cli.compensation import recover
from pmac_comp.cli.controller import backup, restore, status


def test_what_a_restore_replaces_is_journalled_in_the_folder_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    program = tmp_path / "dwell.pmc"
    program.write_text("OPEN PROG 77\nCLEAR\nLINEAR\nDWELL 10\nCLOSE\n", encoding="ascii")
    kept = tmp_path / "kept"
    with pytest.raises(SystemExit) as done:
        main(["restore", "sim://", str(program), "--yes", "--journal", str(kept)])
    assert not done.value.code
    assert len(list(kept.glob("*.journal"))) == 2  # the download, and its one part
    assert not (tmp_path / "pmac-comp-journal").exists()


def test_a_backup_is_never_written_over(tmp_path: Path) -> None:
    (tmp_path / "before.json").write_text("kept")
    with pytest.raises(ConfigError, match="already"):
        backup("sim://", tmp_path / "before.json")
    assert (tmp_path / "before.json").read_text() == "kept"


def test_a_rehearsed_restore_of_what_stands_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    backup("sim://", tmp_path / "before.json")
    capsys.readouterr()
    restore("sim://", tmp_path / "before.json", dry_run=True)
    assert "nothing differs" in capsys.readouterr().out


def test_a_backup_that_is_not_there_is_no_damaged_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="There is no file"):
        restore("sim://", tmp_path / "none.json", dry_run=True)


def test_a_card_without_an_upload_is_told_so_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recover("sim://", "paper", tmp_path)
    verdict, after = capsys.readouterr().out.splitlines()
    assert verdict == "OLD: no upload is under way"
    assert after.startswith("Look at it: pmac-comp status sim:// --bench paper --journal ")


def test_the_verdict_in_the_status_says_that_it_is_of_the_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status("sim://", "paper", tmp_path)
    rows = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert "verdict on tables OLD" in rows
    assert "law torque now, DAC units 0" in rows
