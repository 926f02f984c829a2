"""``verify --refine``: what lies in the folder, however the learning ends."""

import json
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmac_comp.files.capture import Capture, write_capture
from pmac_comp.physics.compensate.exact import Learning
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.workflow.compensation.file import Compensation, read_compensation, write_compensation
from pmac_comp.workflow.verification import kept_runs, verify
from pmac_comp.workflow.verification.learning import Refinement
from pmac_comp.workflow.verification.result import Verification
from tests.unit.workflow.verification.test_verify import run


class Desk:
    """``verify --refine`` with a card that gives one run on each side."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.out, self.law = folder / "out", folder / "law.json"
        write_compensation(self.law, Compensation("law", CompensationLaw(inertia_s2=2e-6)))
        self.patch = monkeypatch
        self.axis = SimpleNamespace(motor=1, bench=None)
        for name in ("open_axis", "measuring", "left_as_found"):
            monkeypatch.setattr(verify, name, lambda *_: nullcontext(self.axis))
        for name in (
            "borrowing_in", "context_to_look", "require_on_card", "measured_before_arming",
        ):  # fmt: skip
            monkeypatch.setattr(verify, name, lambda *_, **__: [])
        monkeypatch.setattr(verify, "verify_axis", self.verified)
        monkeypatch.setattr(verify, "motion_of", lambda *_: None)

    @staticmethod
    def verified(*_: object, keep: Callable[[Capture], None], **__: object) -> Verification:
        before = run(correction_um=0.0, e_um=3.0, control_um=10.0)
        after = run(correction_um=-3.0, e_um=3.3, control_um=1.0)
        runs = [
            before.with_attributes(compensation="off"),
            after.with_attributes(compensation="on"),
        ]
        for one in runs:
            keep(one)
        return Verification((), 0.1, simulated=True, before=(runs[0],), after=(runs[1],))

    def verify(self, learned: Callable[..., Refinement]) -> Verification:
        self.patch.setattr(verify, "refine_motion", learned)
        return verify.verify_on_controller(
            "tcp://card", "paper", law=self.law, refine=3, out=self.out
        )

    def result(self) -> dict[str, Any]:
        return dict(json.loads((self.out / "verification.json").read_text("utf-8")))


def interrupted(*_: object) -> Refinement:
    raise KeyboardInterrupt


def test_what_was_verified_is_kept_where_learning_behind_it_is_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(tmp_path, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        desk.verify(interrupted)
    assert desk.result()["files"] == {"before": ["before_01.h5"], "after": ["after_01.h5"]}


MODEL = Compensation(
    "program",
    CompensationLaw(),
    None,
    1e-3 * np.arange(50),
    np.linspace(0.0, 0.01, 50),
    np.zeros(50),
)


@pytest.mark.parametrize(("best_um", "is_kept"), [(0.6, True), (2.1, False)])
def test_what_was_learned_before_an_interruption_is_kept_and_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, best_um: float, *, is_kept: bool
) -> None:
    history_um = (2.0, best_um)
    learning = Learning(
        np.full(50, 1e-6), history_um, converged=False, learnable_um=history_um,
        ended="it was interrupted after 1 pass", interrupted=True,
    )  # fmt: skip
    desk = Desk(tmp_path, monkeypatch)
    write_compensation(desk.law, MODEL)
    with pytest.raises(KeyboardInterrupt) as stop:
        desk.verify(lambda *_: Refinement("sine", 9.0, 2.0, learning))
    told = "\n".join(stop.value.__notes__)
    assert "it ended because it was interrupted after 1 pass" in told
    assert f"The result so far is in {desk.out / 'verification.json'}" in told
    assert desk.result()["learning"]["ended"] == learning.ended
    path = desk.out / "learned.json"
    assert path.exists() is is_kept
    if is_kept:
        assert "0.60 um with what was learned (in its best pass, which no fresh run" in told
        assert f"what was learned is in {path}" in told
        assert read_compensation(path).motion_correction_m == pytest.approx(learning.correction_m)
    else:
        assert "none of its passes was better than with the model alone" in told


def test_each_run_of_a_verification_is_written_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With learning behind it three times: as it was made, before learning and at the end."""
    written: list[str] = []

    def write(path: Path, capture: Capture) -> None:
        written.append(path.name)
        write_capture(path, capture)

    monkeypatch.setattr(kept_runs, "write_capture", write)
    learning = Learning(np.zeros(50), (2.0, 0.6), converged=True, confirmed_um=(0.6,))
    desk = Desk(tmp_path, monkeypatch)
    desk.verify(lambda *_: Refinement("sine", 9.0, 2.0, learning))
    assert written == ["before_01.h5", "after_01.h5"]
    assert desk.result()["learning"]["learned_um"] == 0.6
