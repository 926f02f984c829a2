"""Two terminals at one axis: whoever comes second is refused, and nothing is sent."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from pmac_comp.base.errors import ControllerState, LeaseHeld
from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.workflow.capture import capturing
from pmac_comp.workflow.capture.at_work import at_work
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.capturing import CapturePlan
from pmac_comp.workflow.compensation.file import Compensation, write_compensation
from pmac_comp.workflow.controller import commissioning, removal, safekeeping, upload_flow
from pmac_comp.workflow.verification import verify

URL = "tcp://card"
PLAN = CapturePlan(load_bench("paper"), ())
_MODULES = (capturing, commissioning, removal, safekeeping, upload_flow, verify)
Second = Callable[[Path], Any]

SECONDS: dict[str, Second] = {
    "capture": lambda at: capturing.capture_to_folder(URL, "paper", PLAN, at / "runs"),
    "verify": lambda at: verify.verify_on_controller(URL, "paper", law=at / "c.json"),
    "upload": lambda at: upload_flow.upload_file(URL, "paper", at / "c.json", at / "journal"),
    "rollback": lambda at: upload_flow.rollback_upload(URL, "paper", at / "journal"),
    "recover": lambda at: upload_flow.recover_upload(URL, "paper", at / "journal"),
    "remove": lambda at: removal.remove_compensation(URL, "paper", at / "journal"),
    "setup": lambda at: commissioning.set_up(URL, "paper", at / "journal"),
    "restore": lambda at: safekeeping.restore_from_file(
        URL, "paper", at / "program.pmc", journal=at / "journal"
    ),
}


@pytest.fixture
def folder(axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Files of a session, and every command of this process at the one card."""
    for module in _MODULES:
        monkeypatch.setattr(module, "open_axis", lambda _url, _bench: nullcontext(axis))
    axis.setup.store = tmp_path / "journal"
    write_compensation(tmp_path / "c.json", Compensation("law", CompensationLaw(inertia_s2=1e-6)))
    (tmp_path / "program.pmc").write_text("P7190=7\n")
    return tmp_path


@pytest.mark.parametrize("second", SECONDS)
def test_a_second_terminal_is_refused_while_the_first_is_at_work(
    axis: Axis, folder: Path, second: str
) -> None:
    with at_work(axis, URL):
        axis.link.command("P7190=0")
        with pytest.raises(LeaseHeld, match="measures or changes") as refused:
            SECONDS[second](folder)
    assert refused.value.left is ControllerState.OLD
    assert axis.link.query("P7190") == ["0"]
    with at_work(axis, URL):
        pass  # the lock is free again


def test_a_card_in_this_process_is_nobody_elses(axis: Axis) -> None:
    with at_work(axis, "sim://"), at_work(axis, "sim://"):
        pass
