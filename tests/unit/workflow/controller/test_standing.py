"""An axis whose zero lies outside its travel: nothing of ours moves it out of there."""

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import ControllerState, MotorNotSafe, SafetyRefusal
from pmac_comp.files.bench import load_bench, parse_bench
from pmac_comp.machine.controller.contents.table_set import read_tables
from pmac_comp.machine.controller.motors import motors
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.workflow import previews
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import embedded, make_card
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller import removal, upload_flow, upload_plan
from pmac_comp.workflow.controller.deploy import deploy, switch
from pmac_comp.workflow.controller.upload_plan import preview
from pmac_comp.workflow.motion.motions import parse_motion

BENCH = parse_bench(
    load_bench("paper").text.replace("min_mm = -300.0", "min_mm = 20.0"), name="beside its zero"
)
LOW_ct, HIGH_ct = 20e3, 300e3
HOME_ct = 200e3
URL = "tcp://127.0.0.1:1"
PLACES_m = np.arange(0.02, 0.301, 1e-3)


def lead_of(error_um: np.ndarray, *, reversal_um: float = 0.0) -> LeadMap:
    reversal_m = np.full(PLACES_m.size, 1e-6 * reversal_um)
    return LeadMap(PLACES_m, 1e-6 * error_um, reversal_m, 0.0)


WAVE = Compensation(
    "table", CompensationLaw(), lead_of(15.0 * np.sin(PLACES_m * 2.0 * np.pi / 0.14))
)


@pytest.fixture
def goals() -> list[float]:
    return []


@pytest.fixture
def axis(goals: list[float], monkeypatch: pytest.MonkeyPatch) -> Iterator[Axis]:
    """In closed loop at 200 mm; every place that it is sent to is kept. Its stops lie far off."""
    send = motors.jog_to

    def noted(link: object, motor: int, place_ct: float) -> None:
        goals.append(place_ct)
        send(link, motor, place_ct)  # type: ignore[arg-type]

    with embedded(make_card(load_bench("paper"))) as link:
        found = Axis(link, BENCH, "test", simulated=True)
        found.enable()
        motors.move_to(link, 1, HOME_ct)
        monkeypatch.setattr(motors, "jog_to", noted)
        for module in (upload_flow, removal, previews, upload_plan):
            monkeypatch.setattr(module, "open_axis", lambda _url, _bench: nullcontext(found))
        yield found


def inside(goals: list[float]) -> bool:
    return bool(goals) and all(LOW_ct <= goal <= HIGH_ct for goal in goals)


def place_ct(axis: Axis) -> float:
    return motors.read_motor(axis.link, axis.motor).position_ct


def test_a_place_outside_the_travel_is_refused_and_nothing_moves(
    axis: Axis, goals: list[float]
) -> None:
    with pytest.raises(MotorNotSafe, match="outside the travel of 20 to 300 mm") as refused:
        axis.move_to(0.0)
    assert refused.value.code == "PC-MOT-040"
    assert goals == []


def test_upload_switch_remove_and_rollback_stay_inside(
    axis: Axis, goals: list[float], tmp_path: Path
) -> None:
    context = context_of(axis, tmp_path)
    said = "\n".join(preview(axis, context, WAVE, URL).text)
    assert "the axis moves from 200.0 mm to " in said
    assert "its zero is outside [travel]" in said
    done = deploy(axis, WAVE, context)
    assert done.verdict is ControllerState.NEW
    assert any("sign of the tables measured" in note for note in done.notes)
    switch(axis, context, WAVE, on=False)
    switch(axis, context, WAVE, on=True)
    axis.run(parse_motion("sine:amplitude_mm=5,frequency_Hz=2,cycles=2,centre_mm=150", BENCH))

    moved = removal.plan_removal(URL, "paper")["motion"]
    assert any("moves from 150.0 mm to " in line for line in moved)
    removal.remove_compensation("sim://", "paper", tmp_path)
    assert not read_tables(axis.link)
    moved = previews.preview_rollback(URL, "paper", tmp_path)["motion"]
    assert any("its zero is outside" in line for line in moved)
    upload_flow.rollback_upload("sim://", "paper", tmp_path)
    assert len(read_tables(axis.link)) == 1
    assert inside(goals)


def test_a_backlash_table_is_switched_after_an_upward_motion(
    axis: Axis, goals: list[float], tmp_path: Path
) -> None:
    lead = lead_of(15.0 * np.sin(PLACES_m * 2.0 * np.pi / 0.14), reversal_um=12.0)
    both = Compensation("table", CompensationLaw(), lead, backlash=True)
    axis.move_to(HOME_ct + 5e3)
    goals.clear()
    deploy(axis, both, context_of(axis, tmp_path))
    assert goals[1] > goals[0]
    assert inside(goals)


def test_where_tables_step_everywhere_it_is_refused_before_anything_moves(
    axis: Axis, goals: list[float], tmp_path: Path
) -> None:
    context = context_of(axis, tmp_path)
    deploy(axis, WAVE, context)
    (table,) = read_tables(axis.link)
    # A table of somebody else that corrects 20 um all over the travel, and nothing at zero.
    n = len(table.entries)
    flat = replace(table, entries=(*[20 * 16] * (n - 1), 0))
    axis.kill()
    axis.link.write_buffer(["I51=0", "#1DELETE COMP", *flat.lines, "I51=1"])
    axis.enable()
    goals.clear()
    with pytest.raises(SafetyRefusal, match="step by 20 um at least") as refused:
        deploy(axis, WAVE, context)
    assert refused.value.code == "PC-MOT-041"
    assert "-c '#1K'" in str(refused.value.hint)
    assert refused.value.left is ControllerState.OLD
    assert "PC-MOT-041" in {r.code for r in preview(axis, context, WAVE, URL).refusals}
    assert goals == []
    axis.kill()
    assert deploy(axis, WAVE, context).verdict is ControllerState.NEW


def test_the_plan_says_from_where_the_axis_goes_to_its_zero(tmp_path: Path) -> None:
    bench = load_bench("paper")
    with embedded(make_card(bench)) as link:
        axis = Axis(link, bench, "test", simulated=True)
        axis.enable()
        axis.move_to(150e3)
        said = preview(axis, context_of(axis, tmp_path), WAVE, URL).text
    assert any("the axis moves from 150.0 mm to its zero first" in line for line in said)
