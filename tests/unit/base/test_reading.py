"""A file that cannot be used is spoken of in words, not in the system's."""

import errno
import json
from pathlib import Path

import pytest

from pmac_comp.base.reading import why


def said(path: Path) -> str:
    """What is said of a file that should hold JSON."""
    with pytest.raises((OSError, ValueError)) as caught:
        json.loads(path.read_text(encoding="utf-8"))
    return why(caught.value)


def test_each_wrong_file_has_its_words(tmp_path: Path) -> None:
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "text").write_text("{\n  no")
    assert said(tmp_path / "missing") == "there is no such file or folder"
    assert said(tmp_path) == "it is a folder, not a file"
    assert said(tmp_path / "empty") == "it is empty"
    assert said(tmp_path / "binary") == "it is not a text file in UTF-8"
    assert said(tmp_path / "text") == "it is no JSON (line 2, column 3)"
    assert said(tmp_path / "text" / "x") == "a part of its path is a file, not a folder"


def test_a_right_that_is_missing_and_a_full_disk_are_named() -> None:
    assert why(PermissionError(errno.EACCES, "Permission denied")) == (
        "Permission denied for this user"
    )
    assert why(OSError(errno.ENOSPC, "No space left on device")) == "No space left on the disk"
    assert why(OSError(errno.ENETDOWN, "as the system says")) == "as the system says"
    assert why(ValueError("two of them")) == "two of them"
