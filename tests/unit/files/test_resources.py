"""Folders that commands share, on accounts with and without a home."""

import os
import sys
from pathlib import Path

import pytest

from pmac_comp.files.resources import locks_folder


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    if sys.platform == "win32":
        pytest.skip("Windows has LOCALAPPDATA instead")
    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def test_locks_lie_in_the_home_of_the_account(home: Path) -> None:
    assert locks_folder() == home / ".local" / "state" / "pmac-comp" / "locks"


def test_an_account_that_may_not_write_to_its_home_has_locks_all_the_same(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: not Path(path).is_relative_to(home))
    assert not locks_folder().is_relative_to(home)
    monkeypatch.delenv("HOME")
    assert locks_folder().is_absolute()
    assert str(os.getuid()) in str(locks_folder())
