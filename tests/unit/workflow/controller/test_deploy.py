"""The bridge on the embedded card: what was meant is what the servo receives, and can be undone."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import (
    ChangeInterrupted,
    ConfigError,
    ControllerState,
    LocalProtocolError,
    MotorNotSafe,
    SafetyRefusal,
    TableStateError,
    VerifyMismatch,
)
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.controller.contents.law_bank import LawBlock, LawParameters, evaluate
from pmac_comp.machine.controller.contents.programs import Program
from pmac_comp.machine.controller.contents.settings import plc_runs
from pmac_comp.machine.controller.contents.table_set import read_tables
from pmac_comp.machine.controller.law import law_goal, law_state
from pmac_comp.machine.controller.motors import sign_check
from pmac_comp.machine.controller.whole import recovery, rollback, waiting
from pmac_comp.physics.compensate.evaluation import evaluate_law
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.simulator.card.card import Card
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import TruthRecorder
from pmac_comp.workflow.compensation.file import (
    Compensation,
    edited_remarks,
    read_compensation,
    write_compensation,
)
from pmac_comp.workflow.compensation.repeated import run_with_offset
from pmac_comp.workflow.controller.deploy import bank_in_use, deploy, switch
from pmac_comp.workflow.controller.removal import remove_from, standing_on
from pmac_comp.workflow.law import law_cost
from pmac_comp.workflow.law.law_cost import cost_remarks
from pmac_comp.workflow.motion.motions import Motion, parse_motion
from pmac_comp.workflow.verification.runs import require_on_card
from tests.compensations import friction_law, lead_map

BENCH = load_bench("paper")
LAW = friction_law(
    viscous_s=3.7e-6,
    compliance_slope_per_m=0.8,
    lookahead_s=1.8e-3,
    torque_jerk_Nm_s3_per_m=9e-4,
    torque_coulomb_Nm=0.45,
)
LEAD = lead_map()
MOTION = parse_motion("sine:amplitude_mm=8,frequency_Hz=3,cycles=3,centre_mm=40", BENCH)


def test_capture_is_the_motion_in_si(axis: Axis, recorder: TruthRecorder) -> None:
    capture = axis.run(MOTION)
    assert capture.sample_period_s == pytest.approx(BENCH.servo_period_s)
    span = np.ptp(capture.commanded_position_m)
    assert span == pytest.approx(np.ptp(MOTION.position_m), abs=0.1e-6)
    # Compensation is off: desired is the command, the sensors lie on their lattices.
    assert np.max(np.abs(capture.desired_m - capture.commanded_position_m)) < 1e-9
    counts = capture.motor_position_m / 1e-6
    assert np.max(np.abs(counts - np.round(counts))) < 1e-6
    assert capture.table_position_m is not None
    steps = capture.table_position_m / 0.125e-6
    assert np.max(np.abs(steps - np.round(steps))) < 1e-6
    true = recorder.truth().of(capture)
    assert np.max(np.abs(true[0] - capture.motor_position_m)) < 0.51e-6


def test_servo_receives_what_the_law_says_and_rollback_takes_it_away(
    axis: Axis, tmp_path: Path
) -> None:
    compensation = Compensation("law", LAW, LEAD)
    told: list[tuple[str, float]] = []
    context = context_of(axis, tmp_path, lambda step, share: told.append((step, share)))
    deployment = deploy(axis, compensation, context)
    assert deployment.verdict is ControllerState.NEW
    # Whoever looks on knows why the axis moves for a minute.
    moving = [step for step, share in told if share < 0.0]
    assert [step.split(":")[0] for step in moving] == [
        "standing where tables may be switched",
        "measuring the sign of the tables",
        "measuring the sign of the law",
        "arming the law",
    ]
    bank = bank_in_use(axis, context, compensation)
    assert bank is not None
    clamp = compensation.law.amplitude_limit_m / axis.scales.motor_m_per_ct
    there = evaluate(bank, MOTION.position_m / axis.scales.motor_m_per_ct, clamp_ct=clamp)
    here = evaluate_law(compensation.law, MOTION.position_m, axis.scales.period_s)
    gap_m = there.correction_ct * axis.scales.motor_m_per_ct - here.correction_m
    assert np.max(np.abs(gap_m)) < 1e-9
    require_on_card(axis, context, compensation)
    with pytest.raises(VerifyMismatch, match="does not hold its law: "):
        require_on_card(axis, context, replace(compensation, law=friction_law()))
    with pytest.raises(VerifyMismatch, match="does not hold its COMP table: "):
        require_on_card(axis, context, replace(compensation, lead=lead_map(3.0)))
    capture = axis.run(MOTION)
    got = capture.desired_m - capture.commanded_position_m
    command = capture.commanded_position_m
    law = evaluate_law(LAW, command, BENCH.servo_period_s, latency_cycles=1).correction_m
    correction = compensation.table_correction(BENCH)
    assert correction is not None
    want = law + correction(command)
    moving = np.abs(np.gradient(command, BENCH.servo_period_s)) > 5e-3
    # Half a table step (1/32 count) and the master word (1/1024 count).
    assert np.max(np.abs(got - want)[moving]) < 0.06e-6
    switch(axis, context, compensation, on=False)
    off = axis.run(MOTION)
    assert np.max(np.abs(off.desired_m - off.commanded_position_m)) < 1e-9
    rollback.rollback_last(axis.link, context)
    assert len(read_tables(axis.link)) == 0


def test_offset_in_the_program_reaches_the_motor(axis: Axis) -> None:
    n = MOTION.position_m.size
    bump = 20e-6 * np.sin(np.pi * np.arange(n) / n) ** 2
    capture = run_with_offset(axis, MOTION, bump)
    correction = capture.desired_m - capture.commanded_position_m
    assert np.max(correction) == pytest.approx(20e-6, rel=0.02)
    plain = axis.run(MOTION)
    m = min(capture.n, plain.n)
    k = np.argmax(capture.commanded_position_m[:m])
    assert capture.commanded_position_m[k] == pytest.approx(
        np.max(plain.commanded_position_m), abs=0.3e-6
    )


def test_compensation_file_comes_back_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    write_compensation(path, Compensation("law", LAW, LEAD))
    found = read_compensation(path)
    assert found.law == LAW
    assert found.lead is not None
    assert np.array_equal(found.lead.error_m, LEAD.error_m)


@pytest.mark.parametrize(
    "text",
    ["{}", "[]", "nonsense", '{"compensation_version": 1, "route": "law", "law": {"x": 1}}',
     '{"compensation_version": 1, "route": "magic", "law": {}}',
     '{"compensation_version": 1, "route": "law", "law": {"inertia_s2": NaN}}'],
)  # fmt: skip
def test_bad_compensation_files_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "c.json"
    path.write_text(text)
    with pytest.raises(ConfigError):
        read_compensation(path)


def test_a_file_that_was_changed_by_hand_is_told(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    write_compensation(path, Compensation("law", LAW, LEAD))
    written = json.loads(path.read_text())
    assert not edited_remarks(read_compensation(path))
    path.write_text(json.dumps(written))  # another layout is no change
    assert not edited_remarks(read_compensation(path))
    written["law"]["provenance"]["note"] = "does not act"
    path.write_text(json.dumps(written))
    assert not edited_remarks(read_compensation(path))
    doubled = {**written["law"], "inertia_s2": 2.0 * written["law"]["inertia_s2"]}
    left_out = {name: v for name, v in written["law"].items() if name != "inertia_s2"}
    for law in (doubled, left_out):
        path.write_text(json.dumps({**written, "law": law}))
        told = edited_remarks(read_compensation(path))
        assert "was changed after" in told[0]
        write_compensation(path, read_compensation(path))  # its own again
        assert not edited_remarks(read_compensation(path))


@pytest.mark.parametrize(
    ("part", "value"),
    [("law", {"provenance": []}), ("law", {"provenance": None}), ("lead", {"noise_m": 10**400})],
)
def test_values_of_another_kind_make_no_compensation(
    tmp_path: Path, part: str, value: dict[str, object]
) -> None:
    """An origin that is no object ended the upload as a bug of the program."""
    path = tmp_path / "c.json"
    write_compensation(path, Compensation("law", LAW, LEAD))
    written = json.loads(path.read_text())
    path.write_text(json.dumps({**written, part: {**written[part], **value}}))
    with pytest.raises(ConfigError, match="is not a compensation file"):
        read_compensation(path)


@pytest.mark.parametrize("nested", ["[" * 100_000, '{"a":' * 100_000])
def test_a_file_that_is_nested_without_end_is_none(tmp_path: Path, nested: str) -> None:
    path = tmp_path / "c.json"
    path.write_text(nested)
    with pytest.raises(ConfigError, match="nested without end"):
        read_compensation(path)


def test_a_compensation_whose_values_do_not_belong_together_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    time_s = np.arange(20) * BENCH.servo_period_s
    whole = Compensation("cam", LAW, LEAD, time_s, 1e-3 * time_s, 1e-6 * time_s)
    write_compensation(path, whole)
    read_compensation(path)
    for short in ("motion_time_s", "motion_position_m", "motion_correction_m"):
        write_compensation(path, replace(whole, **{short: getattr(whole, short)[:10]}))
        with pytest.raises(ConfigError, match=f"differ in number .*{short} 10"):
            read_compensation(path)
    for short in ("position_m", "error_m", "reversal_m"):
        lead = replace(LEAD, **{short: getattr(LEAD, short)[:-1]})
        write_compensation(path, Compensation("table", LAW, lead))
        with pytest.raises(ConfigError, match="differ in number"):
            read_compensation(path)
    mixed = LEAD.position_m.copy()
    mixed[5] = mixed[3]
    write_compensation(path, Compensation("table", LAW, replace(LEAD, position_m=mixed)))
    with pytest.raises(ConfigError, match="does not rise at index 5"):
        read_compensation(path)


def test_a_coefficient_that_no_register_holds_is_refused_before_anything_is_changed(
    axis: Axis, tmp_path: Path
) -> None:
    asked = "I106 I8 I129 I51 RX$10F8"
    before = axis.link.query(asked)
    huge = Compensation("law", LAW.with_values(inertia_s2=1e6), LEAD)
    with pytest.raises(SafetyRefusal, match=r"no register holds: .*A0 = ") as refused:
        deploy(axis, huge, context_of(axis, tmp_path))
    assert refused.value.left is ControllerState.OLD
    assert axis.link.query(asked) == before
    assert len(read_tables(axis.link)) == 0
    assert not plc_runs(axis.link, 0)


def test_a_law_with_more_torque_than_the_drive_may_have_is_refused(
    axis: Axis, tmp_path: Path
) -> None:
    strong = Compensation("law", LAW.with_values(torque_limit_Nm=20.0))
    with pytest.raises(SafetyRefusal, match=r"up to 20 N m; .* is 19.11") as refused:
        deploy(axis, strong, context_of(axis, tmp_path))
    assert refused.value.left is ControllerState.OLD
    assert not plc_runs(axis.link, 0)


def test_a_value_that_cannot_be_said_is_no_lost_link(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What stood before is put back at once, and said to be confirmed."""

    def unsayable(*_: object) -> None:
        raise LocalProtocolError("A value has more digits than a register holds.")

    monkeypatch.setattr("pmac_comp.machine.controller.law.law_upload.fill_bank", unsayable)
    with pytest.raises(LocalProtocolError) as refused:
        deploy(axis, Compensation("law", LAW, LEAD), context_of(axis, tmp_path))
    assert refused.value.left is ControllerState.OLD
    assert refused.value.context["confirmed"]
    assert len(read_tables(axis.link)) == 0
    assert axis.link.query("I51") == ["0"]
    assert waiting.left_open(context_of(axis, tmp_path)) == ()


def test_cost_is_stated_and_a_cheaper_way_offered() -> None:
    law = CompensationLaw(inertia_s2=2e-6)
    (text,) = cost_remarks(BENCH, "law", law)
    assert "more than a quarter" in text
    assert "every second cycle" in text
    assert cost_remarks(BENCH, "table", law) == []


def test_motion_is_a_value() -> None:
    assert Motion("a", MOTION.trajectory).duration_s == MOTION.duration_s


@pytest.mark.parametrize(
    ("room_frac", "code", "step"),
    [(1e-3, "PC-LAW-044", "measuring the sign of the law"), (-1e-3, "PC-LAW-043", "")],
    ids=["measured with the law", "foreseen"],
)
def test_a_card_too_busy_for_the_law_is_left_as_it_was(
    axis: Axis,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    room_frac: float,
    code: str,
    step: str,
) -> None:
    """Whether it shows beforehand, or only by the task times with the law running."""
    monkeypatch.setattr(law_cost, "_SCATTER_FRAC", 0.0)  # the interrupt itself takes it over
    law = replace(LAW, turn_friction_Nm=0.1)
    load = law_cost.read_load(axis.link, BENCH.servo_period_s)
    taken_frac = load.phase_frac + load.servo_frac + law_cost.share_frac(BENCH, law)
    monkeypatch.setattr(law_cost, "BUSIEST_FRAC", taken_frac + room_frac)
    told: list[str] = []
    context = context_of(axis, tmp_path, lambda text, _: told.append(text))
    asked = "I106 I8 I129 RX$10F8"
    before = axis.link.query(asked)
    with pytest.raises(SafetyRefusal, match="too little") as refused:
        deploy(axis, Compensation("law", law), context)
    assert refused.value.code == code
    assert refused.value.left is ControllerState.OLD
    assert refused.value.context["confirmed"]
    assert "--every 2" in refused.value.hint
    assert any(text.startswith(step) for text in told) == bool(step)
    assert "arming the law" not in told
    assert axis.link.query(asked) == before
    assert not plc_runs(axis.link, 0)
    # Every second cycle leaves time enough.
    deployment = deploy(axis, Compensation("law", replace(law, every_cycles=2)), context)
    assert any("background cycle" in note for note in deployment.notes)


class Killed(BaseException):
    """This program ended where it was: nothing is put back."""


def test_an_upload_killed_in_its_sign_test_is_taken_back_and_may_be_made_again(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = context_of(axis, tmp_path)
    stood, looks = sign_check._position_ct(axis.link, axis.motor), iter(range(10))

    def killed_at_the_second_look(*_: object) -> float:
        if next(looks) == 0:
            return 0.0
        for name in ("command", "query", "write_buffer"):
            meanwhile.setattr(axis.link, name, killed_at_the_second_look)
        raise Killed

    with monkeypatch.context() as meanwhile:
        meanwhile.setattr(sign_check, "_position_ct", killed_at_the_second_look)
        with pytest.raises(Killed):
            deploy(axis, Compensation("law", LAW), context)
    assert axis.link.query("RX$10F8") != ["0"]  # the offset that the motor follows
    axis.link.clock.sleep_s(0.5)
    assert recovery.recover(axis.link, context).verdict is ControllerState.OLD
    assert axis.link.query("I106 RX$10F8") == ["0", "0"]
    axis.link.clock.sleep_s(0.5)
    # The offset went out while the motor followed it: otherwise it would stand there for good.
    assert sign_check._position_ct(axis.link, axis.motor) == pytest.approx(stood, abs=3.0)
    assert deploy(axis, Compensation("law", LAW), context).verdict is ControllerState.NEW


def bank_on(axis: Axis, folder: Path) -> LawParameters | None:
    block = context_of(axis, folder).block
    return law_state.read_bank(axis.link, block, law_state.read_law_head(axis.link, block).bank)


@pytest.mark.parametrize("uploads", [1, 2])
def test_rollback_brings_the_law_of_an_earlier_version_back_whole(
    axis: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, uploads: int
) -> None:
    """Its PLC 0 takes any sealed bank: one that holds other values must not be left to it."""
    context = context_of(axis, tmp_path)
    whole = law_goal.law_program

    def earlier(block: LawBlock, motor: int) -> Program:
        ours = whole(block, motor)
        return replace(ours, lines=(ours.lines[0], "P7119=0", *ours.lines[1:]))

    with monkeypatch.context() as before:
        before.setattr(law_goal, "law_program", earlier)
        for k in range(uploads):
            law = replace(LAW, coulomb_m=(1.0 + k) * LAW.coulomb_m)
            deploy(axis, Compensation("law", law), context)
    axis.kill()
    stood = bank_on(axis, tmp_path)
    deploy(axis, Compensation("law", friction_law()), context)
    rollback.rollback_last(axis.link, context)
    assert stood is not None
    assert bank_on(axis, tmp_path) == stood


def test_a_killed_motor_does_not_keep_a_law_from_coming_back(axis: Axis, tmp_path: Path) -> None:
    context = context_of(axis, tmp_path)
    deploy(axis, Compensation("law", LAW, LEAD), context)
    stood = bank_on(axis, tmp_path)
    deploy(axis, Compensation("law", friction_law(), LEAD), context)
    axis.kill()
    rollback.rollback_last(axis.link, context)
    assert bank_on(axis, tmp_path) == stood
    assert axis.link.query("P7002P7003") == ["1", "0"]
    axis.enable()
    axis.link.clock.sleep_s(1.0)
    assert axis.link.query("P7003") == ["1"]  # armed, as it was


def test_a_law_that_is_loaded_in_place_of_an_armed_one_waits(axis: Axis, tmp_path: Path) -> None:
    context = context_of(axis, tmp_path)
    deploy(axis, Compensation("law", LAW), context)
    axis.kill()
    deployment = deploy(axis, Compensation("law", friction_law()), context)
    assert not deployment.acts
    axis.enable()
    axis.link.clock.sleep_s(1.0)
    assert axis.link.query("P7002P7003RX$10F8") == ["0", "0", "0"]


def seen(axis: Axis, card: Card, words: list[tuple[int, float]]) -> Callable[[float], None]:
    """A sleep of the axis' clock that notes master word and torque before it."""
    sleep = axis.link.clock.sleep_s

    def noted(duration_s: float) -> None:
        word = int(card.memory.x[0x10F8])
        words.append(((word + 0x800000) % 0x1000000 - 0x800000, float(card.variables.read_i(129))))
        sleep(duration_s)

    return noted


def test_a_sign_test_that_is_stopped_takes_its_offset_out_slowly(
    axis: Axis, card: Card, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = context_of(axis, tmp_path)
    looks = iter(range(10))

    def stopped_at_the_second_look(*_: object) -> float:
        if next(looks):
            raise KeyboardInterrupt
        return 0.0

    words: list[tuple[int, float]] = []
    with monkeypatch.context() as meanwhile:
        meanwhile.setattr(sign_check, "_position_ct", stopped_at_the_second_look)
        meanwhile.setattr(axis.link.clock, "sleep_s", seen(axis, card, words))
        with pytest.raises(ChangeInterrupted) as stopped:
            deploy(axis, Compensation("law", LAW), context)
    assert stopped.value.left is ControllerState.OLD
    steps = np.abs(np.diff([word for word, _ in words]))
    assert max(word for word, _ in words) >= 20 * 1024  # 20 um, 1024 units a count
    assert np.max(steps) <= 1.1 * 20 * 1024 / sign_check.STEPS
    assert axis.link.query("I106 RX$10F8") == ["0", "0"]


def test_what_a_stopped_plc_0_left_fades(
    axis: Axis, card: Card, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = context_of(axis, tmp_path)
    deploy(axis, Compensation("law", replace(LAW, torque_constant_Nm=0.3)), context)
    axis.move_to(20_000.0)
    axis.link.command("DISABLE PLC 0")
    axis.link.clock.sleep_s(0.5)
    words: list[tuple[int, float]] = []
    monkeypatch.setattr(axis.link.clock, "sleep_s", seen(axis, card, words))
    rollback.rollback_last(axis.link, context)
    torque = [value for _, value in words]
    assert abs(torque[0]) > 100.0
    assert np.max(np.abs(np.diff(torque))) <= 0.03 * abs(torque[0])
    assert axis.link.query("I129 RX$10F8 I106") == ["0", "0", "0"]


def test_a_law_that_something_else_holds_disarmed_is_taken_back(axis: Axis, tmp_path: Path) -> None:
    """The link lives: nothing is left unconfirmed, and no part of the upload stands."""
    axis.link.write_buffer(["OPEN PLC 5 CLEAR", "P7002=0", "CLOSE", "ENABLE PLC 5"])
    with pytest.raises(TableStateError, match="gain of the law is 0 instead of 1") as refused:
        deploy(axis, Compensation("law", LAW, LEAD), context_of(axis, tmp_path))
    assert refused.value.left is ControllerState.OLD
    assert refused.value.context["confirmed"]
    assert len(read_tables(axis.link)) == 0
    assert not plc_runs(axis.link, 0)


def test_what_a_killed_verification_left_in_the_master_word_is_taken_out_slowly(
    axis: Axis, card: Card, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its sign test stands in no journal: PLC 0 is off, the motor 20 counts beside its place."""
    context, law = context_of(axis, tmp_path), Compensation("law", LAW)
    axis.kill()
    deploy(axis, law, context)
    axis.enable()
    axis.link.command("DISABLE PLC 0")
    for k in range(21):
        axis.link.command(f"WX$10F8,{1024 * k}")
        axis.link.clock.sleep_s(0.01)
    axis.link.clock.sleep_s(0.5)
    with pytest.raises(MotorNotSafe, match="master word is 20480"):
        deploy(axis, law, context)
    words: list[tuple[int, float]] = []
    with monkeypatch.context() as meanwhile:
        meanwhile.setattr(axis.link.clock, "sleep_s", seen(axis, card, words))
        remove_from(axis, context, standing_on(axis))
    assert np.max(np.abs(np.diff([word for word, _ in words]))) <= 1024
    assert deploy(axis, law, context).verdict is ControllerState.NEW
