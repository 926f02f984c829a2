"""A measurement writes no settings: it refuses a card that is not as the bench file says."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import MotorNotSafe, SafetyRefusal
from pmac_comp.files.bench import Bench, load_bench, parse_bench
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.whole.rollback import rollback_last
from pmac_comp.physics.signals.trajectory import sinusoid
from pmac_comp.simulator.card.card import Card
from pmac_comp.workflow.bench.remarks import remarks
from pmac_comp.workflow.capture.as_described import place_remarks
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.capturing import offset_remarks, prepare
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import embedded, make_card
from pmac_comp.workflow.controller.commissioning import set_up_axis, settable_variables
from pmac_comp.workflow.motion.motions import Motion

OTHER = """
config_version = 1
name = "motor 3, scale read by motor 5, another position scale"
[screw]
pitch_mm = 5.0
[encoder]
counts_per_rev = 20000.0
motor_number = 3
[scale]
resolution_um = 0.1
motor_number = 5
[nominal]
motor_inertia_kgm2 = 5.0e-4
table_mass_kg = 60.0
torsional_stiffness_Nm_per_rad = 5000.0
axial_stiffness_N_per_um = 90.0
[drive]
torque_limit_Nm = 19.11
torque_per_dac_Nm = 5.8319e-4
[controller]
kind = "pmac"
servo_period_us = 442.0
p_block = [3000, 3299]
[controller.ivariables]
I308 = 64
I309 = 64
I330 = 104587
I331 = 2774
I332 = 2804
I333 = 46621
I334 = 0
I335 = 30742
[travel]
min_mm = -100.0
max_mm = 100.0
"""
PAPER = load_bench("paper")
SLOW = Motion("slow", sinusoid(period_s=442e-6, amplitude_m=2e-3, frequency_Hz=2.0, cycles=2.0))
TIMERS = {29, 30, 35, 36}  # and servo counts


@contextmanager
def axis_of(card: Card, bench: Bench) -> Iterator[Axis]:
    with embedded(card) as link:
        yield Axis(link, bench, "test", simulated=True)


@pytest.fixture
def other(tmp_path: Path) -> Bench:
    path = tmp_path / "other.toml"
    path.write_text(OTHER, encoding="utf-8")
    return load_bench(str(path))


def settings_of(axis: Axis) -> dict[str, list[str]]:
    """I-, P- and M-variables' texts, definitions and PLC programs that a run must leave alone."""
    asked = {
        "I": ["I0..99", "I100..199", "I300..399", "I500..599", "I8000..8009"],
        "P": ["P3000..3299", "P6990..7209"],
        "M": [f"M{n}->" for n in range(6990, 7020)],
    }
    found = {kind: [x for line in lines for x in axis.link.query(line)]
             for kind, lines in asked.items()}  # fmt: skip
    # The lease and the number of the last change are ours to write.
    found["P"] = [v for k, v in enumerate(found["P"]) if k not in range(78, 84)]
    found["I"] = [v for k, v in enumerate(found["I"]) if k not in TIMERS]
    found["PLC"] = [*axis.link.query("LIST PLC 0"), *axis.link.query("LIST PLC 1")]
    return found


def test_a_run_of_another_motor_writes_no_settings_and_leaves_others_programs(
    other: Bench,
) -> None:
    with axis_of(make_card(other), other) as axis:
        axis.link.write_buffer(
            ["CLOSE", "OPEN PLC 0 CLEAR", "P1=P1+1", "CLOSE", "OPEN PLC 1 CLEAR", "P2=P2+1",
             "CLOSE", "ENABLE PLC 0", "P3050=7", "P7050=8", "M7003->Y:$78003,8,16,S"]
        )  # fmt: skip
        before = settings_of(axis)
        prepare(axis)
        capture = axis.run(SLOW)
        assert settings_of(axis) == before
        assert float(axis.link.query("P1")[0]) > 1000
    motor, table = capture.motor_position_m, capture.table_position_m
    assert table is not None
    assert np.ptp(capture.commanded_position_m) == pytest.approx(4e-3, rel=0.01)
    assert np.max(np.abs(motor - capture.commanded_position_m)) < 3e-4
    assert np.max(np.abs(table - motor)) < 5e-5


def test_what_differs_from_the_bench_file_is_named_and_nothing_moves() -> None:
    with axis_of(make_card(PAPER), PAPER) as axis:
        axis.link.write_buffer(["I116=400", "I200=0", "I8000=$78000"])
        with pytest.raises(SafetyRefusal) as caught:
            prepare(axis)
        said = str(caught.value)
        for words in ("I116 = 400 (500)", "I200 = 0 (1)", "Motor #2", "I8000 = $078000"):
            assert words in said
        assert axis.link.query("I116I200") == ["400", "0"]
        assert motors.read_motor(axis.link, 1).status.is_killed


def test_a_bench_file_with_another_servo_period_is_refused_and_nothing_moves() -> None:
    with axis_of(make_card(PAPER), load_bench("emps")) as axis:
        with pytest.raises(SafetyRefusal, match=r"442\.0 us \(I10\), in the bench file"):
            prepare(axis)
        assert motors.read_motor(axis.link, 1).status.is_killed


def test_a_program_of_somebody_else_in_our_place_is_not_replaced() -> None:
    with axis_of(make_card(PAPER), PAPER) as axis:
        axis.link.write_buffer(["CLOSE", "OPEN PROG 703 CLEAR", "LINEAR", "X10", "CLOSE"])
        with pytest.raises(SafetyRefusal, match="PROG 703"):
            prepare(axis)


def test_what_a_compensation_sets_itself_is_no_difference() -> None:
    with axis_of(make_card(PAPER), PAPER) as axis:
        axis.link.write_buffer(["I8=1", "I129=12", "I105=$10F8", "I106=3"])
        prepare(axis)


def test_set_up_puts_the_bench_file_on_and_rollback_takes_it_back(tmp_path: Path) -> None:
    with axis_of(make_card(PAPER), PAPER) as axis:
        axis.link.write_buffer(["I116=400", "I130=1000"])
        context = context_of(axis, tmp_path / "journal")
        set_up_axis(axis, context, settable_variables(axis))
        assert axis.link.query("I116I130") == ["500", "139449"]
        prepare(axis)
        with pytest.raises(MotorNotSafe, match="enabled"):
            set_up_axis(axis, context, settable_variables(axis))
        axis.kill()
        rollback_last(axis.link, context)
        assert axis.link.query("I116I130") == ["400", "1000"]


def test_a_zero_that_nobody_looked_for_is_said_until_the_axis_is_homed() -> None:
    with axis_of(make_card(PAPER), PAPER) as axis:
        (said,) = place_remarks(axis.link, PAPER)
        assert "motor #1 has not been homed" in said
        axis.enable()
        axis.link.write_buffer(["I123=10", "I7012=1", "I126=0", "#1HM"])
        axis.link.clock.sleep_s(3.0)
        assert place_remarks(axis.link, PAPER) == ()


def test_encoder_and_scale_swapped_in_the_bench_file_enable_nothing() -> None:
    text = PAPER.text.replace('extension = "none"\nmotor_number = 1', "motor_number = 2")
    swapped = parse_bench(text.replace("0.125\nmotor_number = 2", "0.125\nmotor_number = 1"))
    assert any("swapped" in remark for remark in remarks(swapped))
    with axis_of(make_card(PAPER), swapped) as axis:
        with pytest.raises(SafetyRefusal, match="motor #2 would be enabled"):
            prepare(axis)
        assert motors.read_motor(axis.link, 2).status.is_killed


def test_an_offset_of_the_output_is_told_before_runs_for_a_law(axis: Axis) -> None:
    assert offset_remarks(axis) == ()
    axis.link.command("I129=25")
    (said,) = offset_remarks(axis)
    assert "I129 = 25" in said
    assert "route law" in said


def test_gains_are_not_put_back_under_a_closed_loop(tmp_path: Path) -> None:
    """The set-up wants the motor killed, and so does taking it back."""
    bench = load_bench("paper")
    with embedded(make_card(bench)) as link:
        axis = Axis(link, bench, "test", simulated=True)
        context = context_of(axis, tmp_path)
        link.command("I130=1000")
        set_up_axis(axis, context, settable_variables(axis))
        axis.enable()
        with pytest.raises(MotorNotSafe, match="Motor #1 is enabled"):
            rollback_last(link, context)
        assert link.query("I130") == ["139449"]
        axis.kill()
        rollback_last(link, context)
        assert link.query("I130") == ["1000"]


def test_gains_of_a_motor_that_the_set_up_activated_go_back_with_it_killed(
    tmp_path: Path,
) -> None:
    """An axis that nobody has used yet: Ixx00 is among what the set-up changes."""
    bench = load_bench("paper")
    with embedded(make_card(bench)) as link:
        axis = Axis(link, bench, "test", simulated=True)
        context = context_of(axis, tmp_path)
        link.command("I100=0I130=1000")
        set_up_axis(axis, context, settable_variables(axis))
        axis.enable()
        with pytest.raises(MotorNotSafe, match="Motor #1 is enabled"):
            rollback_last(link, context)
        assert link.query("I100I130") == ["1", "139449"]
        axis.kill()
        rollback_last(link, context)
        assert link.query("I100I130") == ["0", "1000"]
