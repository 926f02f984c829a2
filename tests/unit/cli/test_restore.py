"""``restore`` as a user calls it."""

from pathlib import Path

import pytest

from pmac_comp.cli.app import main


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
