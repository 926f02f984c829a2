"""How the command line ends: full disks are no bugs, interruptions say what was kept."""

import errno
import json
from pathlib import Path
from typing import Any

import pytest

from pmac_comp.cli import app


def ended(monkeypatch: pytest.MonkeyPatch, error: BaseException, command: str) -> int:
    """Exit code of a command that ends so."""

    def run(**_: Any) -> None:
        raise error

    monkeypatch.setattr(app, "app", run)
    with pytest.raises(SystemExit) as left:
        app.main([command])
    return int(left.value.code or 0)


@pytest.mark.parametrize(
    ("number", "code", "exit_code"),
    [
        (errno.ENOSPC, "PC-CLI-013", 8),
        (errno.EDQUOT, "PC-CLI-013", 8),
        (errno.EROFS, "PC-CLI-003", 2),
        (errno.ENAMETOOLONG, "PC-CLI-003", 2),
        (errno.ENOENT, "PC-CLI-003", 2),
        (errno.EEXIST, "PC-CLI-003", 2),
        (errno.EBADF, "PC-BUG-001", 70),
    ],
)
def test_a_full_disk_is_no_bug(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    number: int,
    code: str,
    exit_code: int,
) -> None:
    error = OSError(number, "said so", "page.html")
    assert ended(monkeypatch, error, "report") == exit_code
    assert code in capsys.readouterr().err


def test_wrong_usage_is_a_document_where_json_was_asked_for(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as left:
        app.main(["upload", "tcp://card", "--json"])
    assert left.value.code == 2
    error = json.loads(capsys.readouterr().out)["error"]
    assert (error["code"], error["exit_code"]) == ("PC-CLI-005", 2)
    assert "new" in error["message"]


def test_a_failed_command_leaves_no_earlier_result_in_the_file_of_json(tmp_path: Path) -> None:
    """A script that read the file took the upload of yesterday for that of today."""
    kept = tmp_path / "result.json"
    kept.write_text('{"verdict": "NEW"}')
    with pytest.raises(SystemExit) as left:
        app.main(["upload", "sim://", str(tmp_path / "none.json"), "--json", str(kept)])
    assert left.value.code == 2
    assert json.loads(kept.read_text())["error"]["code"] == "PC-DEP-002"
    # An input that is named as the result by mistake is not written over.
    with pytest.raises(SystemExit):
        app.main(["upload", "sim://", str(kept), "--json", str(kept)])
    assert json.loads(kept.read_text())["error"]["code"] == "PC-DEP-002"


@pytest.mark.parametrize(
    "wrong", [["info"], ["status", "sim://", "--benhc", "x"], ["upload", "sim://"]]
)
def test_wrong_usage_leaves_no_earlier_result_in_the_file_of_json(
    tmp_path: Path, wrong: list[str]
) -> None:
    kept = tmp_path / "result.json"
    kept.write_text('{"kind": "status"}')
    with pytest.raises(SystemExit) as left:
        app.main([*wrong, "--json", str(kept)])
    assert left.value.code == 2
    assert json.loads(kept.read_text())["error"]["code"] == "PC-CLI-005"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"compensation_version": 1}', []),
        ('{"model_version": 1}', []),
        ('{"kind": "x"}', ["--effects={}"]),
    ],
)
def test_wrong_usage_writes_over_no_file_that_others_build_on(
    tmp_path: Path, text: str, words: list[str]
) -> None:
    kept = tmp_path / "kept.json"
    kept.write_text(text)
    given = [word.format(kept) for word in words]
    with pytest.raises(SystemExit):
        app.main(["identify", "--benhc", *given, "--json", str(kept)])
    assert kept.read_text() == text


def test_a_bug_is_told_in_the_file_of_json_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = tmp_path / "result.json"
    kept.write_text('{"kind": "status"}')

    def run(**_: Any) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(app, "app", run)
    with pytest.raises(SystemExit):
        app.main(["status", f"--json={kept}"])
    assert json.loads(kept.read_text())["error"]["code"] == "PC-BUG-001"


@pytest.mark.parametrize("command", ["capture", "verify", "improve"])
@pytest.mark.parametrize("taken_by", ["nobody", "typer"])
def test_an_interruption_tells_what_was_kept_and_that_the_axis_was_stopped(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    taken_by: str,
    command: str,
) -> None:
    error: BaseException = KeyboardInterrupt()
    error.add_note("3 runs are kept")
    if taken_by == "typer":
        taken = SystemExit(130)
        taken.__context__ = error
        error = taken
    assert ended(monkeypatch, error, command) == 130
    shown = capsys.readouterr().err
    assert "interrupted; the axis was stopped" in shown
    assert shown.count("3 runs are kept") == 1


def test_typer_keeps_the_interruption_behind_its_exit(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        error = KeyboardInterrupt()
        error.add_note("3 runs are kept")
        raise error

    monkeypatch.setattr("pmac_comp.report.stored.report_from_file", interrupted)
    with pytest.raises(SystemExit) as left:
        app.main(["report", str(tmp_path / "x.json")])
    assert left.value.code == 130
    assert "3 runs are kept" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["upload", "status"])
def test_an_interruption_takes_the_place_of_an_earlier_result(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: str,
) -> None:
    """A script that reads the file would take the state of last week for this one's."""
    kept = tmp_path / "result.json"
    kept.write_text('{"kind": "status", "left": "NEW"}')

    def run(**_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(app, "app", run)
    with pytest.raises(SystemExit) as left:
        app.main([command, f"--json={kept}"])
    error = json.loads(kept.read_text())["error"]
    assert (left.value.code, error["exit_code"], error["left"]) == (130, 130, None)
    assert ("recover" in error["message"] + error["hint"]) == (command == "upload")
    assert error["message"] in capsys.readouterr().err


@pytest.mark.parametrize("command", ["upload", "remove", "capture", "verify"])
def test_a_rehearsal_that_is_interrupted_left_nothing_to_be_settled(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    def run(**_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(app, "app", run)
    with pytest.raises(SystemExit) as left:
        app.main([command, "--dry-run"])
    assert left.value.code == 130
    told = capsys.readouterr().err
    assert "interrupted; a rehearsal changes nothing" in told
    assert "recover" not in told
