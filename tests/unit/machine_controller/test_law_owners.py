"""What belongs to somebody else where the law would go stays: a machine's logic must not vanish."""

from pathlib import Path

import pytest

from pmac_comp.base.errors import SafetyRefusal
from pmac_comp.machine.controller import law_install, law_state
from pmac_comp.machine.controller.law_bank import LawBlock
from pmac_comp.machine.controller.law_state import LawForm
from pmac_comp.machine.controller.settings import Settings
from tests.unit.machine_controller.card_bench import CardBench

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
    law = law_install.law_program(LawBlock(), 1)
    found = Settings({"I101": "1", "I129": "0"}, programs={law_install.LAW: ()})
    (refusal,) = law_install._output_refusals(1, found, law)
    assert "commutated by the card" in refusal.message
    assert "--route servo" in refusal.hint
    own = Settings({"I101": "0", "I129": "0"}, programs={law_install.LAW: ()})
    assert law_install._output_refusals(1, own, law) == []
