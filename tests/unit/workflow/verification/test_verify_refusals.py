"""What a verification refuses before it touches the card."""

from pathlib import Path

import pytest

from pmac_comp.base.errors import CaptureError, ConfigError, PmacCompError, VerifyMismatch
from pmac_comp.machine.controller.motors import motors
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.simulator.card.card import Card
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import embedded
from pmac_comp.workflow.compensation.file import Compensation, write_compensation
from pmac_comp.workflow.controller.deploy import deploy
from pmac_comp.workflow.motion.motions import parse_motion
from pmac_comp.workflow.verification import verify
from pmac_comp.workflow.verification.runs import left_as_found, require_on_card
from tests.compensations import lead_map
from tests.unit.workflow.conftest import BENCH


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


SHORT = "trapezoid:distance_mm=10,speed_mm_per_s=100,acceleration_m_per_s2=4"
LONG = "sine:amplitude_mm=5,frequency_Hz=1,cycles=5"


def test_in_the_cards_own_memory_what_is_asked_for_is_run_and_the_rest_left_out(
    tmp_path: Path,
) -> None:
    """On a serial line every verification ended amid its runs, at a move of its own."""
    controller = BENCH.controller.model_copy(update={"dpram": "none"})
    bench = BENCH.model_copy(update={"controller": controller})
    table = Compensation("table", CompensationLaw(), lead_map())
    with embedded(Card(bench)) as link:
        axis = Axis(link, bench, "test", simulated=True)
        axis.enable()
        context = context_of(axis, tmp_path)
        deploy(axis, table, context)
        stood_ct = motors.read_motor(link, axis.motor).position_ct
        motions = [parse_motion(text, bench) for text in (SHORT, LONG)]
        with (
            pytest.raises(CaptureError, match=r"sine.* lasts") as refused,
            left_as_found(axis, context, table),
        ):
            verify.verify_axis(axis, context, table, motions)
        # The tables act as before: nothing is to be brought back.
        assert not getattr(refused.value, "__notes__", [])
        assert abs(motors.read_motor(link, axis.motor).position_ct - stood_ct) < 20.0
        found = verify.verify_axis(axis, context, table, motions[:1], static_runs=2)
    assert len(found.motions) == 1
    assert found.ringing is None
    assert found.static is None
    left_out = [text for text in found.remarks if text.startswith("not measured: ")]
    assert len(left_out) == 2
    assert all("long words needed" in text for text in left_out)
