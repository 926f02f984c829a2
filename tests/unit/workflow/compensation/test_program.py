"""The route ``program``: what was uploaded draws the motion with its correction, and is checked."""

import re
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ConfigError, VerifyMismatch
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.programs import Program, ProgramKind
from pmac_comp.machine.controller.contents.safety import check_sums
from pmac_comp.machine.controller.motors import motors
from pmac_comp.physics.compensate.exact import Aim
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.rests import rests_of
from pmac_comp.workflow.accuracy.outcome import Spread
from pmac_comp.workflow.bench.scales import Scales
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import acting, context_of
from pmac_comp.workflow.capture.run_cut import LEAD_IN_s
from pmac_comp.workflow.compensation import compensate, computing
from pmac_comp.workflow.compensation.computing import compute_compensation
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.compensation.program import COMPENSATED_PROGRAM, draw_motion, motion_of
from pmac_comp.workflow.compensation.promises import Promiser
from pmac_comp.workflow.compensation.tables import tables_of
from pmac_comp.workflow.compensation.text import limits_report
from pmac_comp.workflow.controller import upload_flow
from pmac_comp.workflow.controller.deploy import deploy
from pmac_comp.workflow.motion.motions import parse_motion
from pmac_comp.workflow.verification.learning import refine_motion
from pmac_comp.workflow.verification.runs import left_as_found, require_on_card, runs_of
from pmac_comp.workflow.verification.verify import verify_axis
from tests.compensations import friction_law, lead_map

BENCH = load_bench("paper")
MOTION = parse_motion("sine:amplitude_mm=8,frequency_Hz=3,cycles=3,centre_mm=40", BENCH)
N = MOTION.position_m.size
BUMP = 12e-6 * np.sin(np.pi * np.arange(N) / N) ** 2
COMPENSATION = Compensation(
    "program",
    CompensationLaw(),
    motion_time_s=MOTION.trajectory.time_s,
    motion_position_m=MOTION.position_m,
    motion_correction_m=BUMP,
)


def test_the_program_states_its_errors() -> None:
    drawn = draw_motion(COMPENSATION, BENCH)
    assert drawn.largest_um == pytest.approx(12.0, rel=1e-3)
    assert drawn.shape_error_um < 0.1
    assert drawn.rounding_um < 0.001


def test_without_a_motion_there_is_no_program() -> None:
    with pytest.raises(ConfigError) as refused:
        motion_of(Compensation("program", CompensationLaw()), BENCH)
    assert refused.value.code == "PC-DEP-051"
    assert "--command" in refused.value.hint


def test_verify_runs_what_was_uploaded_against_the_plain_motion(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = context_of(axis, tmp_path)
    deploy(axis, COMPENSATION, context)
    verification = verify_axis(axis, context, COMPENSATION, (), repeats=1, static_runs=2)
    assert verification.simulated
    assert verification.route == "program"
    assert verification.static is None
    assert verification.ringing is None
    assert any("one known motion" in remark for remark in verification.remarks)
    (before,), (after,) = verification.before, verification.after
    assert after.attributes.items() >= COMPENSATION.marks.items()
    assert not before.attributes.keys() & COMPENSATION.marks.keys()
    assert np.max(np.abs(before.desired_m - before.commanded_position_m)) < 1e-9
    correction = after.desired_m - after.commanded_position_m
    assert float(np.max(correction)) == pytest.approx(12e-6, rel=0.01)
    # The command of both sides is the motion itself.
    span = np.ptp(MOTION.position_m)
    assert np.ptp(after.commanded_position_m) == pytest.approx(span, abs=0.2e-6)

    monkeypatch.setattr(upload_flow, "open_axis", lambda _url, _bench: nullcontext(axis))
    assert upload_flow.rollback_upload("sim://", "paper", tmp_path)["verdict"] == "OLD"
    runs = runs_of(axis, context, COMPENSATION, ())
    with pytest.raises(VerifyMismatch):
        runs.run(runs.motions[0], on=True)


def test_another_program_on_the_card_is_not_run(axis: Axis, tmp_path: Path) -> None:
    context = context_of(axis, tmp_path)
    deploy(axis, COMPENSATION, context)
    require_on_card(axis, context, COMPENSATION)
    other = Program(ProgramKind.PROG, COMPENSATED_PROGRAM, ("ABS", "LINEAR", "TM100", "X5"))
    programs.download(axis.link, other)
    runs = runs_of(axis, context, COMPENSATION, ())
    with pytest.raises(VerifyMismatch, match="differs"):
        runs.run(runs.motions[0], on=True)
    # A verification does not begin with it: half of its motions would run for nothing.
    with pytest.raises(VerifyMismatch, match="does not hold its PROG 704"):
        require_on_card(axis, context, COMPENSATION)


def test_a_comparison_leaves_motor_and_compensation_as_found(axis: Axis, tmp_path: Path) -> None:
    law = Compensation(
        "law",
        friction_law(),
    )
    context = context_of(axis, tmp_path)
    deploy(axis, law, context)
    with left_as_found(axis, context, law):
        runs_of(axis, context, law, (MOTION,)).run(MOTION, on=False)
    assert float(axis.link.query(f"P{context.block.first + 2}")[0]) == 1.0  # armed again
    axis.kill()
    with left_as_found(axis, context, law):
        axis.enable()
    assert motors.read_motor(axis.link, axis.motor).status.is_killed


def test_a_comparison_that_is_interrupted_leaves_a_killed_motor_killed(
    axis: Axis, tmp_path: Path
) -> None:
    context = context_of(axis, tmp_path)
    axis.kill()

    def compare() -> None:
        with left_as_found(axis, context, COMPENSATION):
            axis.enable()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compare()
    assert motors.read_motor(axis.link, axis.motor).status.is_killed


def test_learning_that_is_interrupted_stops_the_axis_with_its_compensation_on(
    axis: Axis, tmp_path: Path
) -> None:
    """What was learned is kept, the law stands as the runs had it, what was borrowed goes back."""
    law = Compensation("law", friction_law())
    context = context_of(axis, tmp_path)
    deploy(axis, law, context)
    as_found = acting(axis, context)
    begun: list[float] = []

    def press(_step: str, fraction: float) -> None:
        begun.append(fraction)
        runs = sum(later < earlier for earlier, later in pairwise(begun))
        if runs == 3 and fraction > 0.5:  # bare, before learning, first pass; amid the second
            raise KeyboardInterrupt

    with left_as_found(axis, context, law):
        found = refine_motion(axis, context, law, MOTION, 4, press)
        assert found.learning.ended == "it was interrupted after 1 pass"
    axis.link.clock.sleep_s(0.5)
    assert motors.read_motor(axis.link, axis.motor).status.is_commanded_still
    assert motors.read_motor(axis.link, axis.motor).status.is_closed_loop
    assert as_found == acting(axis, context)
    assert as_found[0]


def test_the_correction_is_computed_for_the_start_that_a_run_has() -> None:
    # Begun relaxed it would leave twice this: friction and integrator are not where a jog
    # leaves them.
    drive = DriveModel.base(BENCH)
    found = compute_compensation(BENCH, drive, route="program", motion=MOTION)
    promiser = Promiser.of(BENCH, found, drive)
    assert promiser is not None
    run = promiser.of_known()
    assert run is not None
    told_um = min(found.law.provenance["exact"]["error_um"])
    assert run["model_total_after_um"] < 1.5 * told_um


def test_a_cam_that_is_cut_leaves_room_for_the_lead_table_beside_it() -> None:
    """Cut to the whole limit it could not be uploaded: both together were beyond it."""
    lead = lead_map(20.0)
    drive = DriveModel.base(BENCH)
    found = compute_compensation(BENCH, drive, route="cam", motion=MOTION)
    assert found.motion_correction_m is not None
    needed_um = 1e6 * float(np.max(np.abs(found.motion_correction_m)))
    table_um = 1e6 * float(np.max(np.abs(lead.error_m)))
    safety = BENCH.safety.model_copy(update={"max_correction_um": 0.8 * needed_um + table_um})
    bench = BENCH.model_copy(update={"safety": safety})
    cut = computing._for_motion(
        bench, drive, "cam", found.law, lead, MOTION, Aim.TOTAL, backlash=False
    )
    (said,) = limits_report(bench, cut)
    assert "of which the lead table beside it takes" in said
    tables = tables_of(cut, bench)
    assert check_sums(tables, tables, Scales.of(bench).limits(bench)) == []


def test_a_correction_that_is_cut_tells_what_it_would_take() -> None:
    """Three limits were tried, each a minute, before one was large enough."""
    drive = DriveModel.base(BENCH)

    def limited(most_um: float) -> tuple[float, list[str]]:
        safety = BENCH.safety.model_copy(update={"max_correction_um": most_um})
        bench = BENCH.model_copy(update={"safety": safety})
        found = compute_compensation(bench, drive, route="program", motion=MOTION)
        assert found.motion_correction_m is not None
        return 1e6 * float(np.max(np.abs(found.motion_correction_m))), limits_report(bench, found)

    needed_um, nothing = limited(200.0)
    assert nothing == []
    cut_um, (said,) = limited(0.8 * needed_um)
    assert cut_um == pytest.approx(0.8 * needed_um)
    assert f"uncut all of it would take up to {needed_um:.3g} um" in said


MOVE = parse_motion("trapezoid:distance_mm=60,speed_mm_per_s=150,acceleration_m_per_s2=3", BENCH)


@pytest.mark.parametrize("route", ["program", "cam"])
def test_the_table_stays_at_its_target_while_a_known_motion_rests(
    axis: Axis, tmp_path: Path, route: str
) -> None:
    """The offset stayed at the lag of the stop, which the integrator takes away within 0.1 s."""
    drive = DriveModel.base(BENCH)
    compensation = compute_compensation(BENCH, drive, route=route, motion=MOVE)
    context = context_of(axis, tmp_path)
    deploy(axis, compensation, context)
    found = verify_axis(axis, context, compensation, (), drive=drive)
    (before,), (after,) = found.before, found.after
    assert after.table_position_m is not None
    error_m = after.table_position_m - after.commanded_position_m
    begins = round(LEAD_IN_s / BENCH.servo_period_s)
    rests = rests_of(MOVE.position_m, BENCH.servo_period_s)
    left_m = [float(error_m[begins + rest.stop - 100 :][:80].mean()) for rest in rests]
    assert np.ptp(left_m) < 5e-6, left_m  # it was 10 um between one end of the way and the other
    # Both sides are judged over the motion with all of its rests, and promised alike.
    whole_s = MOVE.duration_s + 0.2
    assert [c.n * BENCH.servo_period_s for c in (before, after)] == pytest.approx(
        [whole_s, whole_s], abs=0.02
    )
    (outcome,) = found.motions
    promiser = Promiser.of(BENCH, compensation, drive)
    assert promiser is not None
    assert outcome.promise is not None
    told = promiser.of_known()
    assert told is not None
    for name in ("total_before_um", "total_after_um"):
        assert outcome.promise[name] == pytest.approx(told[name], rel=0.1)
        measured: Spread = getattr(outcome, name.removesuffix("_um"))
        assert measured.value == pytest.approx(told[name], rel=0.3)


def test_a_promise_of_a_known_motion_holds_the_lead_error_and_its_table() -> None:
    """The table's correction was in it and the lead error was not: that was told as an error."""
    drive = DriveModel.base(BENCH)

    def promised(lead: LeadMap | None) -> Mapping[str, float]:
        promiser = Promiser.of(BENCH, replace(COMPENSATION, lead=lead), drive)
        assert promiser is not None
        told = promiser.of_known()
        assert told is not None
        return told

    bare, with_lead = promised(None), promised(lead_map(2000.0))
    assert with_lead["total_after_um"] == pytest.approx(bare["total_after_um"], rel=0.05)
    assert abs(with_lead["total_before_um"] - bare["total_before_um"]) > 0.1


@pytest.mark.parametrize("route", ["program", "cam"])
def test_a_known_motion_that_gets_worse_is_named(route: str) -> None:
    drive = DriveModel.base(BENCH)

    def remarks(offset_m: FloatArray, aim: Aim) -> list[str]:
        law = CompensationLaw(provenance={"exact": {"aim": aim.value}})
        known = replace(COMPENSATION, route=route, law=law, motion_correction_m=offset_m)
        return compensate._expected_worse(BENCH, known, drive)

    found = compute_compensation(BENCH, drive, route=route, motion=MOTION)
    assert found.motion_correction_m is not None
    assert remarks(found.motion_correction_m, Aim.TOTAL) == []
    (said,) = remarks(-found.motion_correction_m, Aim.TOTAL)
    assert re.search(r"to get worse, .* total error [\d.]+ -> [\d.]+ um \(\+\d+ %\)", said)
    assert "e_r" not in said  # with this aim it holds the lag by its definition
    (said,) = remarks(-found.motion_correction_m, Aim.MECHANICAL)
    assert "e_r" in said
