"""The direction-dependent part: worth a table or not, on the card, through the servo, and back."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import (
    ChangeInterrupted,
    ControllerState,
    NotIdentifiable,
    SafetyRefusal,
)
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.card.variables import read_many
from pmac_comp.machine.controller.contents.comp_table import CompTable, TableKind
from pmac_comp.machine.controller.contents.table_set import read_tables
from pmac_comp.machine.controller.law.law_state import read_law_head
from pmac_comp.machine.controller.motors import motors
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.compensation.file import (
    Compensation,
    read_compensation,
    write_compensation,
)
from pmac_comp.workflow.compensation.text import table_remarks
from pmac_comp.workflow.controller import sign_test, upload_flow
from pmac_comp.workflow.controller.deploy import deploy, double_corrections
from pmac_comp.workflow.controller.sign_test import check_table_sign
from pmac_comp.workflow.law.backlash import backlash_table, forward_part, has_backlash
from pmac_comp.workflow.law.static_map import Limit, covered_m, static_map
from pmac_comp.workflow.motion.motions import parse_motion
from pmac_comp.workflow.verification.verify import measured_before_arming
from tests.compensations import TRAVEL_m, friction_law, lead_map

BENCH = load_bench("paper")
LEAD = lead_map(reversal_um=-6.0, reversal_um_per_m=-10.0, noise_um=0.05)
COMPENSATION = Compensation("table", CompensationLaw(), LEAD, backlash=True)


def test_only_a_difference_above_noise_and_size_is_worth_a_table() -> None:
    assert has_backlash(LEAD, "table")
    assert not has_backlash(replace(LEAD, noise_m=3e-6), "table")
    assert not has_backlash(replace(LEAD, reversal_m=0.01 * LEAD.reversal_m), "table")


def test_a_difference_that_other_runs_do_not_show_is_told_from_one_that_is_small() -> None:
    left_out = replace(COMPENSATION, route="law", backlash=False)
    assert "the other runs do not show it" in table_remarks(BENCH, left_out)[0]
    small = replace(left_out, lead=replace(LEAD, reversal_m=0.01 * LEAD.reversal_m))
    assert "not worth a backlash table" in table_remarks(BENCH, small)[0]


def test_the_tables_together_take_both_directions_away() -> None:
    table = COMPENSATION.table(BENCH)
    back = COMPENSATION.backlash_table(BENCH)
    assert table is not None
    assert back is not None
    assert back.quantisation_um <= 0.5 / 16 + 1e-9
    counts = TRAVEL_m[10:-10] / BENCH.motor_resolution_m
    up = table.table.correction_ct(counts)
    down = up - back.table.backlash_ct(counts)
    to_um = BENCH.motor_resolution_m * 1e6
    inside = slice(10, -10)
    forward = (LEAD.error_m + 0.5 * LEAD.reversal_m)[inside] * 1e6
    backward = (LEAD.error_m - 0.5 * LEAD.reversal_m)[inside] * 1e6
    left_up, left_down = forward + up * to_um, backward + down * to_um
    # One constant is free: the correction at position zero is zero by the card's rule.
    assert np.ptp(left_up) < 0.15
    assert np.ptp(left_down) < 0.15
    assert np.max(np.abs(left_up - left_down)) < 0.15
    mean = COMPENSATION.table_correction(BENCH)
    assert mean is not None
    assert np.ptp(LEAD.error_m[inside] + mean(TRAVEL_m[inside])) < 0.15e-6


def test_forward_part_and_file_keep_what_was_measured(tmp_path: Path) -> None:
    write_compensation(tmp_path / "c.json", COMPENSATION)
    assert read_compensation(tmp_path / "c.json").backlash
    np.testing.assert_allclose(
        forward_part(LEAD).error_m - LEAD.error_m, 0.5 * LEAD.reversal_m, rtol=1e-9, atol=0.0
    )
    assert backlash_table(LEAD, BENCH).table.wrap


def test_the_servo_gets_both_directions_and_rollback_takes_all_away(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = read_many(axis.link, ["I185", "I186", "I187"])
    notes = deploy(axis, COMPENSATION, context_of(axis, tmp_path)).notes
    assert any("sign of the tables measured" in note for note in notes), notes
    kinds = [table.kind for table in read_tables(axis.link)]
    assert kinds == [TableKind.COMP, TableKind.BLCOMP]
    assert read_many(axis.link, ["I185"])["I185"] > 0.0
    capture = axis.run(parse_motion("triangle:amplitude_mm=10,speed_mm_per_s=40", BENCH))
    correction = (capture.desired_m - capture.commanded_position_m) * 1e6
    speed = np.gradient(capture.commanded_position_m, capture.sample_period_s)
    near = np.abs(capture.commanded_position_m) < 2e-3
    up = float(np.mean(correction[near & (speed > 0.03)]))
    down = float(np.mean(correction[near & (speed < -0.03)]))
    # The backward direction gets the difference of both errors more: 6 um at zero, sign kept.
    assert down - up == pytest.approx(-6.0, abs=0.2)

    monkeypatch.setattr(upload_flow, "open_axis", lambda _url, _bench: nullcontext(axis))
    assert upload_flow.rollback_upload("sim://", "paper", tmp_path)["verdict"] == "OLD"
    assert len(read_tables(axis.link)) == 0
    assert read_many(axis.link, list(before)) == before


def test_tables_that_act_the_wrong_way_are_switched_off(axis: Axis, tmp_path: Path) -> None:
    deploy(axis, Compensation("table", CompensationLaw(), LEAD), context_of(axis, tmp_path))
    (table,) = read_tables(axis.link)
    assert isinstance(table, CompTable)
    meant = replace(table, entries=tuple(-entry for entry in table.entries))
    with pytest.raises(SafetyRefusal) as refused:
        check_table_sign(axis, [meant], context_of(axis, tmp_path))
    assert refused.value.code == "PC-DEP-041"
    assert refused.value.left is ControllerState.DISABLED
    assert read_many(axis.link, ["I51"])["I51"] == 0.0


def test_ctrl_c_on_the_way_to_a_sign_test_stops_the_axis_and_takes_all_back(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = read_many(axis.link, ["I51"])

    def interrupted(link: Commander, motor: int, position_ct: float, **_: object) -> None:
        motors.jog_to(link, motor, position_ct)
        link.clock.sleep_s(0.2)
        raise KeyboardInterrupt

    monkeypatch.setattr(sign_test.motors, "move_to", interrupted)
    with pytest.raises(ChangeInterrupted) as stopped:
        deploy(axis, Compensation("table", CompensationLaw(), LEAD), context_of(axis, tmp_path))
    assert stopped.value.left is ControllerState.OLD
    assert motors.read_motor(axis.link, axis.motor).status.is_commanded_still
    assert len(read_tables(axis.link)) == 0
    assert read_many(axis.link, ["I51"]) == before


def test_a_law_loaded_with_the_loop_open_waits_for_its_sign_and_load(
    axis: Axis, tmp_path: Path
) -> None:
    context = context_of(axis, tmp_path)
    law = friction_law(ripple_Nm=0.01, turn_friction_Nm=0.01)
    axis.kill()
    notes = deploy(axis, Compensation("law", law), context).notes
    assert not any("sign measured" in note for note in notes)
    assert any("loaded and not armed" in note for note in notes)
    sign, load = measured_before_arming(axis, context, Compensation("law", law))
    assert "sign measured" in sign
    assert "with the law the processor is busy" in load
    for motor in range(3, 8):
        axis.link.command(f"I{motor}00=1")
    with pytest.raises(SafetyRefusal, match="too little is left"):
        measured_before_arming(axis, context, Compensation("law", law))
    assert not read_law_head(axis.link, context.block).is_armed


def test_a_law_that_acts_forbids_what_would_correct_friction_twice(
    axis: Axis, tmp_path: Path
) -> None:
    context = context_of(axis, tmp_path)
    law = friction_law()
    deploy(axis, Compensation("law", law), context)
    (refusal,) = double_corrections(axis, context, COMPENSATION)
    assert refusal.code == "PC-DEP-060"
    with pytest.raises(SafetyRefusal):
        deploy(axis, COMPENSATION, context)
    assert len(read_tables(axis.link)) == 0


def slow_run(reach_m: float) -> Capture:
    """Triangle over plus and minus a reach, with the lead error of LEAD and 3 um of backlash."""
    period = BENCH.servo_period_s
    n = int(4.0 * reach_m / 0.02 / period)
    position = reach_m * (2.0 / np.pi) * np.arcsin(np.sin(2.0 * np.pi * np.arange(n) / n))
    side = np.sign(np.gradient(position))
    table = position + 35e-6 * position - 1.5e-6 * side
    return Capture(
        time_s=period * np.arange(n),
        commanded_position_m=position,
        motor_position_m=position.copy(),
        table_position_m=table,
    )


def test_slow_runs_of_a_part_of_the_travel_are_refused_or_said() -> None:
    law, run = CompensationLaw(), slow_run(2e-3)
    with pytest.raises(NotIdentifiable, match="cover -1"):
        static_map(BENCH, "table", [run], law, Limit.REFUSE)
    lead = static_map(BENCH, "table", [run], law, Limit.CLIP)
    covered = covered_m(BENCH, lead)
    assert covered is not None
    assert covered[1] < 0.02
    # Beyond what was measured the correction is gone after the fade.
    assert np.max(np.abs(lead.at(np.array([-0.2, 0.05, 0.29])))) < 1e-12
    assert (
        covered_m(BENCH, static_map(BENCH, "table", [slow_run(0.2995)], law, Limit.REFUSE)) is None
    )


@pytest.mark.parametrize("route", ["law", "servo", "cam", "program"])
def test_only_the_route_table_leaves_friction_to_the_backlash_table(route: str) -> None:
    law = CompensationLaw(coulomb_m=1.5e-6, breakaway_m=1e-6)
    run = slow_run(0.2995)
    assert has_backlash(static_map(BENCH, "table", [run], law, Limit.REFUSE), "table")
    # The law takes 1.5 um on each side away: the 3 um of the run are all friction.
    assert not has_backlash(static_map(BENCH, route, [run], law, Limit.REFUSE), route)


def test_a_table_is_not_said_to_reach_what_differs_at_rest() -> None:
    """`verify` explains a reversal value that grew; `compensate` says it beforehand."""
    table, law = (
        table_remarks(BENCH, Compensation(route, CompensationLaw(), LEAD, backlash=True))[0]
        for route in ("table", "law")
    )
    assert "all of it" not in table
    assert "while the axis moves" in table
    assert "the reversal value of a positioning test grows" in table
    assert "what friction leaves of it" in law
