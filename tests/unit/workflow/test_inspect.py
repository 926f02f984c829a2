"""What `status` says of a controller, and of what this host left open on it."""

from pathlib import Path

import pytest

from pmac_comp.machine.controller import law_state
from pmac_comp.machine.controller.context import Context
from pmac_comp.machine.controller.journal import Journal
from pmac_comp.machine.controller.manifest import CLOCK_PER_s, Lease
from pmac_comp.workflow import inspect
from pmac_comp.workflow.axis import Axis


def test_a_torn_upload_is_told_although_the_tables_are_old(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names: list[str] = []
    as_it_is = inspect.context_of

    def noted(axis: Axis) -> Context:
        context = as_it_is(axis)
        names.append(context.controller)
        return context

    monkeypatch.setattr(inspect, "context_of", noted)
    before = inspect.controller_status("sim://", "paper", tmp_path)["compensation"]
    assert (before["verdict"], before["left_open"], before["lease"]) == ("OLD", "nothing", "free")
    assert before["law"] == "none"
    journal = Journal(tmp_path / f"{names[0]}-000001-0000000007.journal")
    journal.write("begin", {"kind": "group", "group": 7, "name": "law"})
    torn = inspect.controller_status("sim://", "paper", tmp_path)["compensation"]
    assert torn["left_open"] == "an upload (law) was interrupted: run `pmac-comp recover`"
    journal.write("rolled back")
    after = inspect.controller_status("sim://", "paper", tmp_path)["compensation"]
    assert after["left_open"] == "nothing"


def test_an_open_servo_without_a_law_is_not_called_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(law_state, "running_form", lambda *_: law_state.LawForm.SERVO)
    found = inspect.controller_status("sim://", "paper", tmp_path)["compensation"]
    assert found["law"] == "servo"
    assert found["why"].endswith("law: its program runs, and no law is loaded")


@pytest.mark.parametrize(
    ("lease", "said"),
    [
        (Lease(0, 0), "free"),
        (Lease(77, int(30 * CLOCK_PER_s)), "held by owner 77 for 20 s more"),
        (Lease(77, int(5 * CLOCK_PER_s)), "left behind by owner 77, expired"),
    ],
)
def test_the_lease_in_words(lease: Lease, said: str) -> None:
    assert inspect.lease_text(lease, int(10 * CLOCK_PER_s)) == said


def test_status_has_stable_names_without_blanks(tmp_path: Path) -> None:
    """Scripts read them: names change with a note in the README only."""
    found = inspect.controller_status("sim://", "paper", tmp_path)
    assert list(found) == ["motors", "compensation", "processor"]
    assert list(found["processor"]) == [
        "summary",
        "foreground_frac",
        "phase_frac",
        "servo_frac",
        "rti_frac",
        "background_cycle_ms",
        "watchdog_lowest_frac",
    ]
    assert set(found["motors"][0]) == {
        "number",
        "position_ct",
        "following_error_ct",
        "state",
        "bits",
    }
    assert list(found["compensation"]) == [
        "tables",
        "tables_act",
        "verdict",
        "why",
        "left_open",
        "last_change",
        "lease",
        "law",
        "law_bank",
        "law_gain",
        "law_correction_ct",
        "law_torque_dac",
        "clamped_passes",
    ]
