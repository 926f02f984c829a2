"""A verification writes over no earlier one: runs of two sessions are never mixed."""

from pathlib import Path

import pytest

from pmac_comp.base.errors import ConfigError
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.workflow import verify
from pmac_comp.workflow.compensation_file import Compensation, write_compensation


@pytest.mark.parametrize("left", ["before_01.h5", "static_after_02.h5", "verification.json"])
def test_an_earlier_verification_is_not_written_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left: str
) -> None:
    law = tmp_path / "c.json"
    write_compensation(law, Compensation("law", CompensationLaw()))
    folder = tmp_path / "verified"
    folder.mkdir()
    (folder / left).write_bytes(b"of last week")
    monkeypatch.setattr(verify, "open_axis", lambda *a: pytest.fail("the card was touched"))
    with pytest.raises(ConfigError, match=left) as refused:
        verify.verify_on_controller("sim://", "paper", law=law, out=folder)
    assert "--out" in refused.value.hint
    assert (folder / left).read_bytes() == b"of last week"
