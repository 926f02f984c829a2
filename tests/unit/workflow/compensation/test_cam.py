"""The electronic cam on the embedded card: exact table in time, better motion, gone by rollback."""

import re
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import (
    ConfigError,
    ControllerState,
    LinkLost,
    SafetyRefusal,
    VerifyMismatch,
)
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.machine.controller.card.variables import read_many
from pmac_comp.machine.controller.contents.comp_table import TableKind
from pmac_comp.machine.controller.contents.settings import read_axes
from pmac_comp.machine.controller.contents.table_set import read_tables
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.tables.table_status import read_head
from pmac_comp.machine.controller.tables.upload import TableUpload
from pmac_comp.machine.controller.tables.upload_checks import buffer_refusals
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.workflow.capture import simulated
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import TruthRecorder
from pmac_comp.workflow.compensation import cam as cam_module
from pmac_comp.workflow.compensation.cam import (
    CAM_PROGRAM,
    cam_axis,
    render_cam,
    reset_time,
    time_motor_variables,
)
from pmac_comp.workflow.compensation.computing import compute_compensation
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.compensation.tables import refused_remarks
from pmac_comp.workflow.controller import sign_test, upload_flow
from pmac_comp.workflow.controller.deploy import deploy, switch
from pmac_comp.workflow.controller.upload_plan import preview
from pmac_comp.workflow.law.rendering import CAM_RUN_UP_CYCLES, cam_shape
from pmac_comp.workflow.motion.campaigns import verification_motions
from pmac_comp.workflow.motion.motions import Motion, parse_motion
from tests.compensations import lead_map

BENCH = load_bench("paper")
MOTION = parse_motion("sine:amplitude_mm=8,frequency_Hz=3,cycles=3,centre_mm=40", BENCH)
N = MOTION.position_m.size
BUMP = 20e-6 * np.sin(2.0 * np.pi * np.arange(N) / N) * np.sin(np.pi * np.arange(N) / N) ** 2


def cam_of(correction_m: np.ndarray, lead: LeadMap | None = None) -> Compensation:
    return Compensation(
        "cam", CompensationLaw(), lead, MOTION.trajectory.time_s, MOTION.position_m, correction_m
    )


def offset_of(capture: Capture) -> np.ndarray:
    return capture.desired_m - capture.commanded_position_m


def test_table_is_the_correction_over_time_and_zero_outside() -> None:
    cam = render_cam(cam_of(BUMP), BENCH)
    table, shape = cam.table.table, cam.shape
    assert (table.motor, table.source, table.target, table.by_desired) == (8, 8, 1, True)
    cycle = np.arange(N, dtype=np.float64) + CAM_RUN_UP_CYCLES / 2
    at = cycle * shape.ct_per_cycle
    got = table.correction_ct(at) * BENCH.motor_resolution_m
    assert np.max(np.abs(got - BUMP)) < 0.1e-6
    after = np.arange(at[-1], table.span_ct, 97.0)
    assert np.all(table.correction_ct(after) == 0.0)
    assert table.span_ct >= (BENCH.travel.max_mm - BENCH.travel.min_mm) / 1e3 / 1e-6


def cam_along(motion: Motion) -> Compensation:
    nothing = np.zeros(motion.position_m.size)
    time_s = motion.trajectory.time_s
    return Compensation("cam", CompensationLaw(), None, time_s, motion.position_m, nothing)


def times_and_counts(lines: Sequence[str]) -> list[tuple[float, int]]:
    """Servo cycles and counts of the time axis at the end of each segment, from the start."""
    cycles, time, count, found = 0.0, 0.0, 0, []
    for line in lines:
        if line.startswith("PVT"):
            cycles = float(line[3:]) / 1e3 / BENCH.servo_period_s
        elif way := re.search(r"Y(-?[0-9]+):", line):
            time, count = time + cycles, count + int(way[1])
            found.append((time, count))
    return found


@pytest.mark.parametrize("seed", [1, 5])
def test_time_goes_through_the_whole_table_where_segments_end_between_cycles(seed: int) -> None:
    for motion in verification_motions(BENCH, seed, n_sine=1):
        cam = render_cam(cam_along(motion), BENCH)
        _, *between, last = times_and_counts(cam.program.lines)
        assert last[1] == cam.table.table.span_ct, motion.name
        ramp = CAM_RUN_UP_CYCLES / 2  # at half speed: it takes twice as long
        late = [count / cam.shape.ct_per_cycle + ramp - time for time, count in between]
        assert np.max(np.abs(late)) < 0.01, motion.name  # cycles


def test_a_program_run_again_finds_its_table_from_the_beginning(axis: Axis, tmp_path: Path) -> None:
    motion = verification_motions(BENCH, 1)[4]
    compensation = cam_along(motion)
    deploy(axis, compensation, context_of(axis, tmp_path))
    runner, _ = cam_axis(axis, compensation)
    runner.prepare(motion)
    turn_ct = render_cam(compensation, BENCH).table.table.span_ct
    for turns in (1, 2):
        axis.move_to(float(motion.position_m[0]) / axis.scales.motor_m_per_ct)
        axis.link.command(f"&1B{CAM_PROGRAM}R")
        runner.finish()
        assert cam_module._time_ct(axis) == pytest.approx(turns * turn_ct, abs=0.5)


def test_too_long_a_motion_is_refused() -> None:
    with pytest.raises(ConfigError, match="too long"):
        cam_shape(200_000, BENCH)


def test_correction_runs_with_the_motion_every_time(axis: Axis, tmp_path: Path) -> None:
    compensation = cam_of(BUMP)
    deployment = deploy(axis, compensation, context_of(axis, tmp_path))
    assert deployment.verdict is ControllerState.NEW
    runner, (motion,) = cam_axis(axis, compensation)
    worst = []
    for _ in range(2):
        capture = runner.run(motion)
        moving = np.flatnonzero(np.diff(capture.commanded_position_m))
        first = int(np.flatnonzero(MOTION.position_m - MOTION.position_m[0])[0])
        index = np.arange(capture.n) - (int(moving[0]) + 1) + first
        want = np.interp(index, np.arange(N), BUMP, left=0.0, right=0.0)
        worst.append(float(np.max(np.abs(offset_of(capture) - want))))
    # Half an entry, the line between entries, and what one cycle changes.
    assert max(worst) < 0.3e-6, worst


def test_a_sum_of_tables_beyond_the_limit_is_told_before_the_upload() -> None:
    x = np.arange(-0.3, 0.3005, 1e-3)
    lead = LeadMap(x, 55e-6 * np.sin(np.pi * x / 0.3), np.zeros(x.size), 0.0)
    assert refused_remarks(cam_of(BUMP), BENCH) == []
    assert refused_remarks(cam_of(0.3 * BUMP, lead), BENCH) == []
    (told,) = refused_remarks(cam_of(BUMP, lead), BENCH)
    assert "`upload` will refuse this" in told
    assert "the limit is 60" in told
    assert "max_correction_um" in told


def test_a_cam_that_changes_too_fast_is_told_with_what_asks_for_less() -> None:
    steep = 20e-6 * np.clip(40.0 * np.sin(6.0 * np.pi * np.arange(N) / N), -1.0, 1.0)
    strict = BENCH.model_copy(
        update={"safety": BENCH.safety.model_copy(update={"max_slope_um_per_mm": 5.0})}
    )
    (told,) = refused_remarks(cam_of(steep), strict)
    assert "`upload` will refuse this" in told
    assert "um per mm; the limit is 5" in told
    assert "--route program" in told


def test_interrupted_cam_fades_and_starts_anew(axis: Axis, tmp_path: Path) -> None:
    compensation = cam_of(BUMP)
    deploy(axis, compensation, context_of(axis, tmp_path))
    runner, (motion,) = cam_axis(axis, compensation)
    before = offset_of(runner.run(motion))
    axis.link.command(f"&1B{CAM_PROGRAM}R")
    axis.link.clock.sleep_s(0.6)
    axis.link.command("&1A")
    axis.link.clock.sleep_s(0.3)
    reading = motors.read_motor(axis.link, 8)
    assert abs(reading.following_error_ct) > 1e4
    reset_time(axis)
    after = offset_of(runner.run(motion))
    m = min(before.size, after.size)
    assert np.max(np.abs(before[:m] - after[:m])) < 0.1e-6


def test_total_error_falls_and_rollback_restores(
    axis: Axis, recorder: TruthRecorder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench_lead = LeadMap(np.arange(-0.3, 0.3005, 1e-3), np.zeros(601), np.zeros(601), 0.0)
    drive = DriveModel.base(BENCH)
    compensation = compute_compensation(BENCH, drive, route="cam", motion=MOTION)
    compensation = Compensation(
        "cam",
        compensation.law,
        bench_lead,
        compensation.motion_time_s,
        compensation.motion_position_m,
        compensation.motion_correction_m,
    )
    context = context_of(axis, tmp_path)
    told = preview(axis, context, compensation, "sim://").text
    done = deploy(axis, compensation, context)
    assert [t.motor for t in read_tables(axis.link)] == [8, 1]
    # The plan says that the sign of the lead table is measured: it is, as on the other routes.
    assert any("to measure its sign" in line for line in told)
    assert any("sign was not measured" in note for note in done.notes)  # it corrects nothing
    runner, (motion,) = cam_axis(axis, compensation)
    left: dict[bool, tuple[float, float]] = {}
    for on in (False, True):
        switch(axis, context, compensation, on=on)
        capture = runner.run(motion)
        _, table = recorder.truth().of(capture)
        left[on] = (
            float(np.std(table - capture.commanded_position_m)),
            float(np.std(offset_of(capture))),
        )
    assert left[False][1] < 1e-9
    assert left[True][0] < 0.3 * left[False][0], left

    monkeypatch.setattr(upload_flow, "open_axis", lambda _url, _bench: nullcontext(axis))
    result = upload_flow.rollback_upload("sim://", "paper", tmp_path)
    assert result["verdict"] == "OLD"
    assert len(read_tables(axis.link)) == 0
    assert read_many(axis.link, ["I800"])["I800"] == 0.0
    with pytest.raises(VerifyMismatch):
        runner.run(motion)
    assert np.max(np.abs(offset_of(axis.run(MOTION)))) < 1e-9


@pytest.mark.parametrize("lead", [None, lead_map()], ids=["cam alone", "with a lead table"])
def test_the_sign_of_the_lead_table_beside_a_cam_is_measured(
    axis: Axis, tmp_path: Path, lead: LeadMap | None
) -> None:
    """The plan promised it, and a reversed table would have acted unseen."""
    compensation, context = replace(cam_of(BUMP), lead=lead), context_of(axis, tmp_path)
    axis.enable()
    told = preview(axis, context, compensation, "sim://").text
    done = deploy(axis, compensation, context)
    assert any("table corrects most, to measure" in line for line in told) is (lead is not None)
    measured = any("sign of the tables measured" in note for note in done.notes)
    assert measured is (lead is not None)


def test_the_sign_of_a_cam_is_measured_before_it_is_run(axis: Axis, tmp_path: Path) -> None:
    context = context_of(axis, tmp_path)
    told = preview(axis, context, cam_of(BUMP), "sim://").text
    assert any("its time is then run slowly" in line for line in told)
    done = deploy(axis, cam_of(BUMP), context)
    (said,) = [note for note in done.notes if "sign of the cam" in note]
    meant_um, found_um = (float(text) for text in re.findall(r"([-+][\d.]+) um", said))
    assert abs(meant_um) > 5.0
    assert found_um == pytest.approx(meant_um, abs=1.5)
    assert axis.link.query("#8P") == ["0"]
    assert abs(motors.read_motor(axis.link, 1).position_ct) < 2.0
    axis.kill()
    done = deploy(axis, cam_of(1.1 * BUMP), context)
    assert any("was not measured, as the motor's loop is open" in note for note in done.notes)


def test_a_reversed_cam_is_switched_off_and_taken_back(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    beyond = sign_test._beyond_command
    monkeypatch.setattr(sign_test, "_beyond_command", lambda axis: -beyond(axis))
    with pytest.raises(SafetyRefusal, match="sign of the tables is reversed"):
        deploy(axis, cam_of(BUMP), context_of(axis, tmp_path))
    assert len(read_tables(axis.link)) == 0
    assert axis.link.query("I51") == ["0"]


TIME_MOTOR = tuple(time_motor_variables(BENCH))


@pytest.mark.parametrize("way", [upload_flow.rollback_upload, upload_flow.recover_upload])
def test_what_stood_before_a_cam_comes_back(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: Callable[..., object]
) -> None:
    link = axis.link
    link.write_buffer(["UNDEFINE ALL", "&1#1->500X", "&2#3->7Z", "&1#8->4W", "I802=$78001"])
    link.write_buffer(["I819=0.25", "I5190=500", "OPEN PROG 705", "CLEAR", "DWELL7", "CLOSE"])
    names = [*TIME_MOTOR, "I800", "I5190", "I5113", "I42"]
    before = read_many(link, names), read_axes(link), link.query("LIST PROG 705")
    if way is upload_flow.recover_upload:

        def torn(*_ignored: object) -> None:
            raise LinkLost("cut between the parts")

        monkeypatch.setattr(TableUpload, "execute", torn)
    with suppress(LinkLost):
        deploy(axis, cam_of(BUMP), context_of(axis, tmp_path))
    assert ("W" in str(read_axes(link)), (2, 3, "7Z") in read_axes(link)) == (False, True)
    monkeypatch.undo()
    monkeypatch.setattr(upload_flow, "open_axis", lambda _url, _bench: nullcontext(axis))
    way("sim://", "paper", tmp_path)
    assert (read_many(link, names), read_axes(link), link.query("LIST PROG 705")) == before
    assert len(read_tables(link)) == 0


def test_motor_in_use_is_refused(axis: Axis, tmp_path: Path) -> None:
    axis.link.command("I800=1")
    plan = preview(axis, context_of(axis, tmp_path), cam_of(BUMP), "sim://")
    assert [refusal.code for refusal in plan.refusals] == ["PC-DEP-052"]
    with pytest.raises(SafetyRefusal, match="in use"):
        deploy(axis, cam_of(BUMP), context_of(axis, tmp_path))
    assert len(read_tables(axis.link)) == 0


@pytest.mark.parametrize("route", ["cam", "program"])
@pytest.mark.parametrize("lead", [None, lead_map()])
def test_a_backlash_table_does_not_stand_beside_the_friction_of_a_motion(
    axis: Axis, tmp_path: Path, route: str, lead: LeadMap | None
) -> None:
    context = context_of(axis, tmp_path)
    with_backlash = Compensation(
        "table", CompensationLaw(), lead_map(reversal_um=-4.0), backlash=True
    )
    deploy(axis, with_backlash, context)
    backlash = (TableKind.BLCOMP, axis.motor)
    assert read_tables(axis.link).get(*backlash) is not None
    compensation = replace(cam_of(BUMP, lead), route=route)
    meant = preview(axis, context, compensation, "sim://").text
    deploy(axis, compensation, context)
    assert read_tables(axis.link).get(*backlash) is None
    assert "BLCOMP of motor" not in " ".join(meant)


@pytest.mark.parametrize("route", ["cam", "program"])
def test_the_plan_says_what_other_motions_have(axis: Axis, tmp_path: Path, route: str) -> None:
    context = context_of(axis, tmp_path)
    bare, with_lead = (replace(cam_of(BUMP, lead), route=route) for lead in (None, lead_map()))
    said = " ".join(preview(axis, context, bare, "sim://").text)
    assert "other motions stay uncompensated" in said
    said = " ".join(preview(axis, context, with_lead, "sim://").text)
    assert "other motions have the tables only" in said
    assert "tables of the controller are off" in said
    assert "Nothing is off" not in said


def test_a_motor_that_has_just_closed_its_loop_executes_no_move(
    axis: Axis, monkeypatch: pytest.MonkeyPatch
) -> None:
    motors.kill(axis.link, axis.motor)
    axis.link.clock.sleep_s(0.1)
    # Both requests of a fast host lie within one servo cycle; the status comes with the next one.
    monkeypatch.setattr(simulated, "_REQUEST_CYCLES", 0)
    reading = motors.enable(axis.link, axis.motor)
    assert motors.executing_moves({axis.motor: reading}) == ()


def test_gathering_is_not_told_to_be_stopped_while_somebody_measures(
    axis: Axis, tmp_path: Path
) -> None:
    head = read_head(axis.link, context_of(axis, tmp_path))
    (refusal,) = buffer_refusals(replace(head, global1=head.global1 | 1 << 19))
    assert refusal.code == "PC-UPL-021"
    assert "wait for its end" in refusal.hint
