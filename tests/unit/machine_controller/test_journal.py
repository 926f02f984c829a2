"""What the lines of a journal say after damage: nothing that is half-changed looks settled."""

import os
from pathlib import Path
from types import ModuleType

import pytest

from pmac_comp.base import atomic
from pmac_comp.machine.controller.change import journal as journal_file
from pmac_comp.machine.controller.change.journal import Journal
from pmac_comp.machine.controller.change.journals import is_torn
from pmac_comp.machine.controller.gather import capture_log

STEPS = ("begin", "intent", "written", "done")


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    journal = Journal(tmp_path / "a.journal")
    for step in STEPS:
        journal.write(step, {"kind": "tables"})
    return journal


def test_a_closed_journal_is_neither_open_nor_torn(journal: Journal) -> None:
    assert not journal.is_open
    assert not is_torn(journal)


def test_a_missing_journal_is_not_open(tmp_path: Path) -> None:
    assert not Journal(tmp_path / "none.journal").is_open


@pytest.mark.parametrize("kept", range(1, len(STEPS)))
def test_a_journal_is_open_up_to_its_closing_line(journal: Journal, kept: int) -> None:
    lines = journal.path.read_bytes().splitlines(keepends=True)
    journal.path.write_bytes(b"".join(lines[:kept]))
    assert journal.is_open
    assert is_torn(journal) is (kept > 1)  # without an intent nothing was changed


def test_a_damaged_byte_before_the_closing_line_leaves_it_open(journal: Journal) -> None:
    whole = journal.path.read_bytes()
    first = whole.index(b"\n") + 1
    for place in range(first, len(whole) - 1):
        journal.path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        assert journal.is_open, place


@pytest.mark.parametrize(
    "tail",
    [b"5f3a9c11 {", b"\0" * 40, b"0 {}\n5f3a", b""],
    ids=["half a line", "never filled", "damaged and half a line", "no end"],
)
def test_what_is_written_behind_a_torn_line_is_read(journal: Journal, tail: bytes) -> None:
    """A power failure of the host leaves half a line, or room that was never filled."""
    closing = journal.path.read_bytes().splitlines(keepends=True)[-1]
    whole = journal.path.read_bytes().removesuffix(closing)
    for cut in (0, len(closing) // 2, len(closing) - 1):
        journal.path.write_bytes(whole + closing[:cut] + tail)
        assert is_torn(journal)
        with journal.kept_open():
            journal.write("rolled back")
            journal.write("kept")
        assert [entry.step for entry in journal.entries()] == [*STEPS[:3], "rolled back", "kept"]
        assert not is_torn(journal)


@pytest.mark.parametrize("module", [atomic, journal_file, capture_log])
def test_bytes_reach_the_disk_as_they_are_on_windows_too(
    module: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Stands for the flag that only Windows has, where LF would become CR LF without it.
    binary, seen, plain = os.O_NOCTTY, [], os.open
    monkeypatch.setattr(module, "BINARY", binary)

    def noted(path: Path, flags: int, *rest: int) -> int:
        if flags & (os.O_WRONLY | os.O_RDWR):
            seen.append(flags & binary)
        return plain(path, flags, *rest)

    monkeypatch.setattr(os, "open", noted)
    if module is atomic:
        atomic.atomic_write_text(tmp_path / "a.json", "{}\n")
    elif module is journal_file:
        Journal(tmp_path / "b.journal").write("begin")
    else:
        capture_log.CaptureLog.create(tmp_path / "c.log", {}).close()
    assert seen == [binary]
