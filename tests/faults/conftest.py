"""What all fault tests share."""

import os

import pytest


@pytest.fixture(autouse=True)
def _no_wait_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Syncs return at once.

    A kill of a process loses nothing that was written, and no test cuts the power of the host; the
    lists would spend most of their time here. Tests of the order of syncs put their own in place.
    """
    monkeypatch.setattr(os, "fsync", lambda _fd: None)
