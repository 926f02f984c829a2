"""Results are for everybody who works at the bench: the umask decides who may read them."""

import os
import stat
from pathlib import Path

import pytest

from pmac_comp.base.atomic import atomic_write_text


@pytest.mark.skipif(os.name != "posix", reason="only POSIX has modes and a umask")
@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o644), (0o077, 0o600)])
def test_the_umask_decides_who_may_read(tmp_path: Path, mask: int, mode: int) -> None:
    before = os.umask(mask)
    try:
        atomic_write_text(tmp_path / "model.json", "{}")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "model.json").stat().st_mode) == mode
