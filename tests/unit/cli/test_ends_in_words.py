"""What uploads, recoveries and rehearsals end with: a verdict, statements, what may follow."""

from pathlib import Path

import pytest

from pmac_comp.base.errors import ControllerState, SafetyRefusal
from pmac_comp.cli.compensation import _SETTLED, _ended
from pmac_comp.cli.controller import capture

MOTIONS = ["sine:amplitude_mm=10,frequency_Hz=2"]


def test_one_statement_stands_beside_the_verdict_several_below_it() -> None:
    one = {"verdict": "OLD", "said": ["no upload is under way"], "next": "Look at it"}
    assert _ended(one) == ["OLD: no upload is under way", "Look at it"]
    two = {"verdict": "DISABLED", "said": ["tables off", "law off"], "next": "Go on"}
    assert _ended(two) == [
        "DISABLED: compensation is off on the controller, or not whole",
        "  - tables off",
        "  - law off",
        "Go on",
    ]


def test_a_recovery_after_a_removal_does_not_say_that_an_upload_stands() -> None:
    said = ["everything stands as meant", "nothing was left open; the last change was remove: done"]
    first, *_ = _ended({"verdict": "NEW", "said": said, "next": "Look at it"}, _SETTLED)
    assert first == "NEW: what the last change meant stands on the controller"


def test_each_refusal_keeps_its_advice_below_it() -> None:
    first = SafetyRefusal("A law is armed.", code="PC-LAW-021", hint="Take it off.")
    second = SafetyRefusal(
        "No open servo.", code="PC-LAW-024", hint="Compile it.", left=ControllerState.OLD
    )
    said = str(SafetyRefusal("Two reasons:", refusals=(first, second))).splitlines()
    assert said[2:] == [
        "  - A law is armed. (PC-LAW-021)",
        "    Take it off.",
        "  - No open servo. (PC-LAW-024)",
        "    The controller was left: OLD.",
        "    Compile it.",
    ]


def test_a_rehearsed_capture_says_how_long_it_takes_and_that_nothing_was_changed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture("tcp://nobody:1", "paper", tmp_path / "runs", motion=MOTIONS, dry_run=True)
    said = capsys.readouterr().out
    assert "min of motion in 1 run, about" in said
    assert said.endswith("nothing was changed\n")
    assert not (tmp_path / "runs").exists()
