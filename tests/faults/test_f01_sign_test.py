"""F01: a kill while the law stands aside for a sign test, of one that stood before the upload."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pmac_comp.base.errors import ControllerState, LinkLost
from pmac_comp.machine.controller.change.transaction import UploadResult
from pmac_comp.machine.controller.contents.settings import plc_runs
from pmac_comp.machine.controller.law import law_upload
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.whole import recovery
from pmac_comp.simulator.card.card import Card
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import embedded
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller.deploy import deploy
from tests.unit.workflow.conftest import BENCH
from tests.unit.workflow.controller.test_deploy import LAW

pytestmark = pytest.mark.faults
Count = Callable[[int], None]


@pytest.fixture
def loaded(tmp_path: Path) -> Iterator[Axis]:
    """A law is on the card, not armed, and the loop is closed."""
    with embedded(Card(BENCH)) as link:
        axis = Axis(link, BENCH, "card")
        deploy(axis, Compensation("law", LAW), context_of(axis, tmp_path))
        axis.enable()
        yield axis


def upload_cut(
    axis: Axis, folder: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, words: int
) -> None:
    """Upload another law; ``error`` ends it at a write of the master word."""
    command, seen = axis.link.command, []

    def cut(text: str, *, timeout_s: float | None = None) -> list[str]:
        seen.extend(["word"] if text.startswith("WX$10F8") else [])
        if len(seen) >= words:
            raise error
        return command(text, timeout_s=timeout_s)

    other = Compensation("law", LAW.with_values(coulomb_m=2.0 * LAW.coulomb_m))
    monkeypatch.setattr(axis.link, "command", cut)
    with pytest.raises(type(error)):
        deploy(axis, other, context_of(axis, folder))
    monkeypatch.undo()


@pytest.mark.parametrize("words", [1, 2, 20, 25, 40])
def test_f01_a_law_that_stood_aside_goes_on(
    loaded: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: int, count_runs: Count
) -> None:
    before_ct = motors.read_motor(loaded.link, loaded.motor).position_ct
    upload_cut(loaded, tmp_path, monkeypatch, LinkLost("cut", code="X"), words)
    assert not plc_runs(loaded.link, 0)
    result = recovery.recover(loaded.link, context_of(loaded, tmp_path))
    assert result.verdict is ControllerState.OLD
    assert plc_runs(loaded.link, 0)
    assert loaded.link.query("RX$10F8") == ["0"]
    loaded.link.clock.sleep_s(0.5)
    after_ct = motors.read_motor(loaded.link, loaded.motor).position_ct
    assert abs(after_ct - before_ct) < 3.0
    deploy(loaded, Compensation("law", LAW), context_of(loaded, tmp_path))
    count_runs(1)


def test_f01_a_law_that_somebody_stopped_since_stays_so(
    loaded: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count_runs: Count
) -> None:
    """The test ended, and the link was lost behind it: who stops PLC 0 then is obeyed."""

    def lost(*_: object, **__: object) -> UploadResult:
        raise LinkLost("cut", code="X")

    monkeypatch.setattr(law_upload, "upload_law", lost)
    with pytest.raises(LinkLost):
        deploy(loaded, Compensation("law", LAW), context_of(loaded, tmp_path))
    assert plc_runs(loaded.link, 0)
    loaded.link.command("DISABLE PLC 0")
    recovery.recover(loaded.link, context_of(loaded, tmp_path))
    assert not plc_runs(loaded.link, 0)
    count_runs(1)
