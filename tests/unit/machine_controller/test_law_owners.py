"""What belongs to somebody else where the law would go stays: a machine's logic must not vanish."""

from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import MotorNotSafe, SafetyRefusal
from pmac_comp.files.bench import load_bench
from pmac_comp.files.resources import firmware_path
from pmac_comp.machine.controller.contents.law_bank import LawBlock, LawParameters
from pmac_comp.machine.controller.contents.settings import Settings
from pmac_comp.machine.controller.law import (
    block_use,
    law_arming,
    law_checks,
    law_goal,
    law_install,
    law_state,
    law_upload,
)
from pmac_comp.machine.controller.law.law_state import LawForm
from pmac_comp.machine.controller.motors import open_servos
from pmac_comp.machine.controller.whole import grouping, rollback
from pmac_comp.simulator.card.card import Card
from tests.unit.machine_controller.card_bench import LIMITS, CardBench, make_plc_bench

OTHER_PLC_0 = ["CLOSE", "OPEN PLC 0 CLEAR", "P1=P1+1", "CLOSE"]
OTHER_PLC_1 = ["CLOSE", "OPEN PLC 1 CLEAR", "P2=P2+1", "CLOSE"]


@pytest.mark.parametrize(
    ("standing", "said"),
    [
        (OTHER_PLC_0, "PLC 0 holds a program that is not ours"),
        (["M7003->Y:$78003,8,16,S"], "M7003 is Y:\\$78003"),
        (["I105=$78C01", "I106=1"], "follows the master at \\$78C01"),
        (["I129=-40"], "I129 = -40: the output of motor #1 has an offset"),
    ],
)
def test_a_law_is_refused_where_something_stands(
    tmp_path: Path, standing: list[str], said: str
) -> None:
    bench = CardBench(tmp_path)
    bench.link.write_buffer(standing)
    asked = ["M7003->I105I106I107I8I129", "P7000..7009"]
    before = [bench.link.query(line) for line in asked]
    with pytest.raises(SafetyRefusal, match=said):
        law_install.install_law(bench.link, bench.context, 1)
    assert [bench.link.query(line) for line in asked] == before
    if standing is OTHER_PLC_0:
        assert bench.link.query("LIST PLC 0") == ["P1=P1+1", "RET"]


def test_a_program_in_the_place_of_the_guard_stays_and_the_law_goes_on(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    bench.link.write_buffer([*OTHER_PLC_1, "ENABLE PLC 1"])
    done = law_install.install_law(bench.link, bench.context, 1)
    assert any("PLC 1 holds another program" in line for line in done)
    assert "P2=P2+1" in bench.link.query("LIST PLC 1")
    bench.clock.sleep_s(0.1)
    assert bench.p(2) > 0
    running = law_state.is_running(bench.link, bench.context.block, bench.context.servo_period_s)
    assert running is LawForm.PLC


def test_a_law_moves_to_another_motor_over_what_it_left_behind(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    law_install.install_law(bench.link, bench.context, 1)
    law_install.remove_law(bench.link, bench.context)
    law_install.install_law(bench.link, bench.context, 2)
    assert bench.link.query("M7001->") == ["D:$108"]


def test_a_motor_that_the_card_commutates_has_no_torque_in_its_offset() -> None:
    # The simulated card commutates none, so what stands there is written down.
    law = law_goal.law_program(LawBlock(), 1)
    found = Settings({"I101": "1", "I129": "0"}, programs={law_goal.LAW: ()})
    (refusal,) = law_checks._output_refusals(1, found, law)
    assert "commutated by the card" in refusal.message
    assert "--route servo" in refusal.hint
    own = Settings({"I101": "0", "I129": "0"}, programs={law_goal.LAW: ()})
    assert law_checks._output_refusals(1, own, law) == []


def servo_bench(folder: Path) -> CardBench:
    """A bench whose motor 1 is in closed loop by the open servo."""
    source = firmware_path("feedforward_servo.txt").read_text(encoding="utf-8")
    bench = CardBench(folder, card=Card(load_bench("paper"), servo_source=source))
    bench.link.write_buffer(["I159=1", "#1J/"])
    bench.clock.sleep_s(0.1)
    return bench


def test_the_open_servo_leaves_a_plc_0_of_somebody_else(tmp_path: Path) -> None:
    bench = servo_bench(tmp_path)
    bench.link.write_buffer([*OTHER_PLC_0, "ENABLE PLC 0"])
    law_install.require_open_servo(bench.link, bench.context, 1)
    assert bench.link.query("LIST PLC 0") == ["P1=P1+1", "RET"]


def test_both_forms_on_one_block_are_refused(tmp_path: Path) -> None:
    """Each writes what the other works with: what one leaves, the other sends as torque."""
    bench = servo_bench(tmp_path)
    bench.link.write_buffer(["#1K", "I159=0"])
    law_install.install_law(bench.link, bench.context, 1)
    bench.link.write_buffer(["I159=1", "#1J/"])
    bench.clock.sleep_s(0.1)
    with pytest.raises(MotorNotSafe, match="PLC 0 evaluates the law"):
        law_install.require_open_servo(bench.link, bench.context, 1)
    bench.link.write_buffer(["#1K", "I159=0"])
    with grouping.grouped(bench.link, bench.context, "remove") as inner:
        law_install.remove_law(bench.link, inner)
    bench.link.write_buffer(["I159=1", "#1J/"])
    bench.clock.sleep_s(0.1)
    with pytest.raises(MotorNotSafe, match="come back beside the open servo"):
        rollback.rollback_last(bench.link, bench.context)
    law_install.require_open_servo(bench.link, bench.context, 1)


@pytest.mark.parametrize("has_marks", [False, True], ids=["block free", "law stood before"])
def test_plc_0_and_the_open_servo_of_another_motor_are_not_put_on_one_block(
    tmp_path: Path, *, has_marks: bool
) -> None:
    """Every motor of the open servo writes its scratch, in what PLC 0 works with."""
    paper = load_bench("paper")
    servo = firmware_path("feedforward_servo.txt").read_text(encoding="utf-8")
    bench = CardBench(tmp_path, card=Card(paper, servo_source=servo))
    if has_marks:
        law_install.install_law(bench.link, bench.context, 1)
        law_install.remove_law(bench.link, bench.context)
    bench.link.write_buffer(["I300=1", "I359=1"])
    block = bench.context.block
    assert "motor #3 will run" in open_servos.scratch_remarks(bench.link, block, 1)[0]
    assert open_servos.scratch_remarks(bench.link, block, 3) == ()
    bench.link.command("#3J/")
    bench.clock.sleep_s(0.01)
    assert open_servos.scratch_remarks(bench.link, block, 1) == ()
    assert block_use.block_refusals(bench.link, block) == []
    before = [bench.link.query(text) for text in ("I106I8", "P7000..7009")]
    told = law_checks.law_refusals(bench.link, bench.context, 1)
    assert [r.code for r in told] == ["PC-LAW-052"]
    with pytest.raises(MotorNotSafe, match="open servo runs for motor #3"):
        law_install.install_law(bench.link, bench.context, 1)
    assert [bench.link.query(text) for text in ("I106I8", "P7000..7009")] == before
    # Another block has none of it, nor has this one once that motor is out and it is cleared.
    elsewhere = replace(bench.context, block=LawBlock(7200))
    assert law_checks.law_refusals(bench.link, elsewhere, 1) == []
    bench.link.write_buffer(["I359=0", "P7150=0"])
    law_install.install_law(bench.link, bench.context, 1)
    bench.link.command("I359=1")
    bench.clock.sleep_s(0.01)
    told = law_checks.law_refusals(bench.link, bench.context, 1)
    assert [r.code for r in told] == ["PC-LAW-052"]


def test_a_law_of_another_motor_is_not_replaced(tmp_path: Path) -> None:
    """Both motors would follow one master word: what one needs would move the other."""
    bench = CardBench(tmp_path)
    law_install.install_law(bench.link, bench.context, 1)
    (refusal,) = law_checks.law_refusals(bench.link, bench.context, 2)
    assert "holds the law of motor #1" in refusal.message
    with pytest.raises(SafetyRefusal, match="holds the law of motor #1"):
        law_install.install_law(bench.link, bench.context, 2)
    assert bench.link.query("P7007I206") == ["1", "0"]


@pytest.mark.parametrize(("servo", "step"), [(False, 7152), (True, 7114)], ids=["PLC 0", "servo"])
def test_the_largest_acceleration_of_a_bench_file_that_changed_is_written_anew(
    tmp_path: Path, *, servo: bool, step: int
) -> None:
    """With one that is too small the law takes motions up late."""
    bench = servo_bench(tmp_path) if servo else CardBench(tmp_path)
    put = law_install.require_open_servo if servo else law_install.install_law
    slow = replace(LIMITS, hardest_ct_per_s2=0.1 * LIMITS.hardest_ct_per_s2)
    put(bench.link, replace(bench.context, limits=slow), 1)
    law_upload.upload_law(bench.link, bench.context, LawParameters(V0=0.1))
    before = bench.p(step)
    put(bench.link, bench.context, 1)
    assert bench.p(step) == pytest.approx(10.0 * before)
    head = law_state.read_law_head(bench.link, LawBlock())
    assert law_state.read_bank(bench.link, LawBlock(), head.bank) == LawParameters(V0=0.1)


def test_a_law_that_a_reset_took_away_is_not_called_armed(tmp_path: Path) -> None:
    """Its variables stay: an upload asked for a removal, which found nothing to remove."""
    bench = make_plc_bench(tmp_path)
    law_install.install_law(bench.link, bench.context, 1)
    law_upload.upload_law(bench.link, bench.context, LawParameters(V0=0.1))
    law_arming.arm(bench.link, bench.context)
    side = bench.side_port()
    side("$$$***")
    bench.card.run_cycles(5000)
    bench.reconnect()
    assert bench.link.query("P7000P7003") == ["20261", "1"]
    bench.link.write_buffer(["I5=3", "I8=0", "I106=0"])
    assert law_checks.law_refusals(bench.link, bench.context, 1) == []
    law_install.install_law(bench.link, bench.context, 1)
    assert not law_state.read_law_head(bench.link, bench.context.block).is_armed
