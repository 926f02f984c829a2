"""Every command that reads a file says in words what is wrong with it, whatever is wrong."""

from pathlib import Path

import numpy as np
import pytest

from pmac_comp.cli import app
from pmac_comp.files.capture import Capture, write_capture

BENCH = ["--bench", "paper"]
AS_RESULT = ["--out", "out.json"]
COMMANDS = [
    ["identify", "FILE.h5", *BENCH],
    ["identify", "FILE.csv", *BENCH],
    ["identify", "FILE.mat", *BENCH],
    ["identify", "good.h5", *BENCH, "--effects", "FILE.py"],
    ["identify", "good.h5", *BENCH, "--model", "FILE.json"],
    ["predict", *BENCH, "--model", "FILE.json", "--command", "good.h5", *AS_RESULT],
    ["diagnose", "good.h5", *BENCH, "--validate", "FILE.h5"],
    ["compare", "FILE.h5", *BENCH],
    ["compensate", *BENCH, "--model", "FILE.json", *AS_RESULT],
    ["diff", "sim://", "FILE.json", *BENCH],
    ["upload", "sim://", "FILE.json", *BENCH, "--yes"],
    ["verify", *BENCH, "--before", "FILE.h5", "--after", "good.h5"],
    ["verify", "sim://", *BENCH, "--compensation", "FILE.json", "--yes"],
    ["restore", "sim://", "FILE.json", *BENCH, "--dry-run"],
    ["restore", "sim://", "FILE.plc", *BENCH, "--dry-run"],
    ["capture", "sim://", *BENCH, "--motion", "FILE.csv", "--yes"],
    ["capture", "sim://", *BENCH, "--recover", "FILE.log", "--out", "recovered"],
    ["convert", "FILE.h5", "out.csv"],
    ["report", "FILE.json", "--out", "out.html"],
    ["config", "check", "FILE.toml"],
    ["sim", "--tcp", "0", "--servo", "FILE.txt"],
    ["sim", "--tcp", "0", "--force", "FILE.csv"],
    ["sim", "--tcp", "0", "--plant", "FILE.py"],
    ["sim", "--tcp", "0", "--flash", "FILE.bin"],
    ["sim", "--tcp", "0", "--bench", "FILE.toml"],
]
SYSTEM_WORDS = (
    "Errno",
    "codec",
    "Traceback",
    "Warning",
    "No such file",
    "Is a directory",
    "char 0",
)


@pytest.fixture(autouse=True)
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder with a good capture in it."""
    monkeypatch.chdir(tmp_path)
    grid = 1e-3 * np.arange(5.0)
    write_capture(Path("good.h5"), Capture(grid, grid, grid))


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["identify", "good.h5", *BENCH, "--out", "there"], "PC-CLI-002"),
        (["identify", "good.h5", *BENCH, "--report", "good.h5/page.html"], "PC-CLI-001"),
        (["diagnose", "good.h5", *BENCH, "--json", "there/x.json"], "PC-CLI-002"),
        (["convert", "good.h5", "there"], "PC-CLI-002"),
    ],
)
def test_a_result_that_cannot_be_written_is_refused_before_the_work(
    words: list[str], code: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("there/x.json").mkdir(parents=True)
    for work in ("model.identification.identify_files", "model.diagnosis.diagnose_files"):
        monkeypatch.setattr(f"pmac_comp.workflow.{work}", lambda *_, **__: pytest.fail("worked"))
    with pytest.raises(SystemExit) as left:
        app.main(words)
    assert left.value.code == 2
    assert code in capsys.readouterr().err


def make(path: Path, kind: str) -> None:
    """A file that is wrong in some way."""
    if kind == "folder":
        path.mkdir()
    elif kind != "missing":
        path.write_bytes({"empty": b"", "binary": bytes(range(256)), "other": b'{"a": 1}\n'}[kind])


@pytest.mark.parametrize("kind", ["missing", "folder", "empty", "binary", "other"])
@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_a_wrong_file_is_refused_in_words(
    words: list[str], kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if "FILE.bin" in words and kind in {"missing", "empty"}:
        pytest.skip("a flash image that is made by the first SAVE")
    if "FILE.plc" in words and kind == "other":
        pytest.skip("any text may be meant for the card; the dry run shows it")
    for word in words:
        if word.startswith("FILE"):
            make(Path(word), kind)
    with pytest.raises(SystemExit) as left:
        app.main(words)
    shown = capsys.readouterr()
    assert left.value.code in {2, 8, 9}
    assert "error: " in shown.err
    assert "(PC-" in shown.err
    assert not [text for text in SYSTEM_WORDS if text in shown.err + shown.out]
    assert "starting" not in shown.err
    assert not list(Path().glob("out*"))


def test_a_journal_that_is_a_file_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "notes.txt").write_text("a file", encoding="utf-8")
    with pytest.raises(SystemExit) as ended:
        app.main(["status", "sim://", "--journal", str(tmp_path / "notes.txt")])
    assert ended.value.code == 2
    assert "'--journal'" in capsys.readouterr().err
