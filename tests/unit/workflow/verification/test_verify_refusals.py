"""What a verification refuses before it touches the card."""

from pathlib import Path

import pytest

from pmac_comp.base.errors import ConfigError, PmacCompError, VerifyMismatch
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.compensation.file import Compensation, write_compensation
from pmac_comp.workflow.motion.motions import parse_motion
from pmac_comp.workflow.verification import verify
from pmac_comp.workflow.verification.runs import require_on_card
from tests.compensations import lead_map


@pytest.fixture
def law(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A compensation file; a card that must not be opened."""
    monkeypatch.setattr(verify, "open_axis", lambda *a: pytest.fail("the card was touched"))
    write_compensation(tmp_path / "c.json", Compensation("law", CompensationLaw()))
    return tmp_path / "c.json"


@pytest.mark.parametrize("left", ["before_01.h5", "static_after_02.h5", "verification.json"])
def test_an_earlier_verification_is_not_written_over(tmp_path: Path, law: Path, left: str) -> None:
    """Runs of two sessions are never mixed."""
    folder = tmp_path / "verified"
    folder.mkdir()
    (folder / left).write_bytes(b"of last week")
    with pytest.raises(ConfigError, match=left) as refused:
        verify.verify_on_controller("sim://", "paper", law=law, out=folder)
    assert "--out" in refused.value.hint
    assert (folder / left).read_bytes() == b"of last week"


def test_a_wrong_motion_or_model_is_refused_before_the_card_is_spoken_to(
    tmp_path: Path, law: Path
) -> None:
    with pytest.raises(ConfigError, match="not a kind of motion"):
        verify.verify_on_controller("sim://", "paper", law=law, motions=("stroll:distance_mm=1",))
    with pytest.raises(PmacCompError, match=r"lost\.json"):
        verify.verify_on_controller("sim://", "paper", law=law, model=tmp_path / "lost.json")


def test_a_cam_that_the_card_lacks_is_called_one(axis: Axis, tmp_path: Path) -> None:
    motion = parse_motion("sine:amplitude_mm=8,frequency_Hz=3", axis.bench)
    cam = Compensation(
        "cam",
        CompensationLaw(),
        lead_map(),
        motion.trajectory.time_s,
        motion.position_m,
        0.0 * motion.position_m,
    )
    lacks = r"does not hold its COMP table and its cam \(the COMP table of motor #8\):"
    with pytest.raises(VerifyMismatch, match=lacks):
        require_on_card(axis, context_of(axis, tmp_path), cam)
