"""What `status` says of a controller, and of what this host left open on it."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest

from pmac_comp.base.errors import SafetyRefusal
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journal import Journal
from pmac_comp.machine.controller.change.manifest import CLOCK_PER_s, Lease
from pmac_comp.machine.controller.law import law_goal
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of, context_to_look
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller import inspect
from pmac_comp.workflow.controller.deploy import deploy
from pmac_comp.workflow.controller.removal import remove_from, standing_on
from tests.compensations import lead_map


def test_a_torn_upload_is_told_although_the_tables_are_old(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names: list[str] = []
    as_it_is = context_to_look

    def noted(axis: Axis, store: Path) -> Context:
        context = as_it_is(axis, store)
        names.append(context.controller)
        return context

    monkeypatch.setattr(inspect, "context_to_look", noted)
    before = inspect.controller_status("sim://", "paper", tmp_path)["compensation"]
    assert (before["verdict"], before["left_open"], before["lease"]) == ("OLD", "nothing", "free")
    assert before["law"] == "none"
    journal = Journal(tmp_path / f"{names[0]}-000001-0000000007.journal")
    journal.write("begin", {"kind": "group", "group": 7, "name": "law"})
    torn = inspect.controller_status("sim://", "paper", tmp_path)["compensation"]
    assert torn["left_open"] == "an upload (law) was interrupted: run `pmac-comp recover`"
    refused = SafetyRefusal("The flash is damaged.", hint="Restore.")
    monkeypatch.setattr(inspect, "flash_refusals", lambda _head: [refused])
    both = inspect.controller_status("sim://", "paper", tmp_path)["compensation"]
    assert both["left_open"] == f"{torn['left_open']}; the flash is damaged. Restore."
    monkeypatch.setattr(inspect, "flash_refusals", lambda _head: [])
    journal.write("rolled back")
    after = inspect.controller_status("sim://", "paper", tmp_path)["compensation"]
    assert after["left_open"] == "nothing"


def test_an_open_servo_without_a_law_is_not_called_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(law_goal, "running_form", lambda *_: law_goal.LawForm.SERVO)
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
        "guard",
        "lease",
        "law",
        "law_bank",
        "law_gain",
        "law_correction_ct",
        "law_torque_dac",
        "clamped_passes",
    ]


def test_tables_of_other_axes_are_no_compensation_of_this_one(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Taken off from another folder, the axis was shown as NEW by the tables that still act."""

    @contextmanager
    def opened(*_: object) -> Iterator[Axis]:
        yield axis

    monkeypatch.setattr(inspect, "open_axis", opened)
    here, elsewhere = (context_of(axis, tmp_path / name) for name in ("here", "elsewhere"))
    axis.link.write_buffer(["#3DEFINE COMP 4,#3,#3,64000", "0", "16", "16", "0", "I51=1"])
    deploy(axis, Compensation("table", CompensationLaw(), lead_map()), here)
    found = inspect.controller_status("", "", here.store)["compensation"]
    assert found["why"].startswith("tables: the new tables act; law")
    assert found["last_change"] == "table: done"
    remove_from(axis, elsewhere, standing_on(axis))
    found = inspect.controller_status("", "", here.store)["compensation"]
    assert found["tables"] == "COMP #3, 4 entries"
    assert found["why"].startswith("tables: the new tables act, none of them of motor #1; law")
    since = "another folder or host has changed the controller since"
    assert found["last_change"] == f"table: done; {since}"
    nowhere = inspect.controller_status("", "", tmp_path / "nowhere")["compensation"]
    assert nowhere["last_change"] == f"none from this folder; {since}"


def test_a_guard_that_stopped_is_told(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inspect, "open_axis", lambda *_: nullcontext(axis))
    deploy(axis, Compensation("table", CompensationLaw(), lead_map()), context_of(axis, tmp_path))
    told = [inspect.controller_status("", "", tmp_path)["compensation"]["guard"]]
    axis.link.command("DISABLE PLC 1")
    told.append(inspect.controller_status("", "", tmp_path)["compensation"]["guard"])
    assert told == ["runs (PLC 1)", "does not run; the next upload of tables puts it there"]
