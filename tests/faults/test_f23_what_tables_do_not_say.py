"""F23 where the new tables alone do not tell what switching does: registers, torque, other axes."""

from collections.abc import Callable
from pathlib import Path

import pytest

from pmac_comp.base.errors import ControllerState, SafetyRefusal
from pmac_comp.machine.controller.contents.comp_table import CompTable
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.tables import upload
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.controller import deploy
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
SMALL = CompTable(1, (16, 32, 16, 0), 640000)


def stand_at(bench: CardBench, position_ct: float) -> None:
    motors.move_to(bench.link, 1, position_ct)


def worst_following_error_ct(bench: CardBench) -> list[float]:
    """Largest following error of motor 1 from here, servo cycle by servo cycle."""
    worst = [0.0]
    ask, run = bench.side_port(), bench.card.run_cycles

    def one_by_one(n: int) -> None:
        for _ in range(n):
            run(1)
            worst[0] = max(worst[0], abs(float(ask("#1F").strip(b"\r\x06"))))

    bench.card.run_cycles = one_by_one  # type: ignore[method-assign]
    return worst


def test_f23_a_register_that_was_left_behind_is_a_step(tmp_path: Path, count_runs: Count) -> None:
    """It keeps what it had where tables were switched off (I51 = 0), and the motor stands by it."""
    bench = make_plc_bench(tmp_path)
    upload.upload_tables(bench.link, bench.context, [CompTable(1, (400, 800, 400, 0), 640000)])
    stand_at(bench, 300000.0)
    bench.link.command("I51=0")
    stand_at(bench, 0.0)
    worst = worst_following_error_ct(bench)
    with pytest.raises(SafetyRefusal, match="though tables are off") as refused:
        upload.upload_tables(bench.link, bench.context, [SMALL])
    assert (refused.value.code, refused.value.left) == ("PC-SAF-040", ControllerState.OLD)
    assert refused.value.context["motor"] == 1
    assert worst[0] < bench.context.limits.max_step_ct
    bench.link.command("#1K")
    bench.clock.sleep_s(0.5)
    result = upload.upload_tables(bench.link, bench.context, [SMALL])
    assert result.verdict is ControllerState.NEW
    count_runs(2)


def test_f23_a_register_of_a_motor_without_a_table_is_a_step(
    tmp_path: Path, count_runs: Count
) -> None:
    """A program may correct a motor by it while tables are off; with tables it is cleared."""
    bench = make_plc_bench(tmp_path)
    bench.link.command("WL$90,30720")  # 10 counts
    bench.clock.sleep_s(0.3)
    with pytest.raises(SafetyRefusal, match="motor #1 holds 10 um"):
        upload.upload_tables(bench.link, bench.context, [CompTable(2, (16, 0), 640000)])
    count_runs(1)


def test_f23_a_torque_table_is_a_step(tmp_path: Path, count_runs: Count) -> None:
    bench = make_plc_bench(tmp_path)
    bench.link.write_buffer(
        ["I30=0", "#1DEFINE TCOMP 4,640000", "800000 1600000 800000 0", "I51=1"]
    )
    stand_at(bench, 160000.0)
    worst = worst_following_error_ct(bench)
    with pytest.raises(SafetyRefusal, match="gives 3125 DAC units where it stands") as refused:
        upload.upload_tables(bench.link, bench.context, [SMALL])
    assert (refused.value.code, refused.value.left) == ("PC-SAF-041", ControllerState.OLD)
    assert bench.i51
    assert worst[0] < 2 * bench.context.limits.max_step_ct
    bench.link.command("#1J=0")
    bench.clock.sleep_s(8.0)
    result = upload.upload_tables(bench.link, bench.context, [SMALL])
    assert result.verdict is ControllerState.NEW
    count_runs(2)


class OtherAxis(Axis):
    """Axis of the same card that is not motor 1; its loop is open."""

    @property
    def motor(self) -> int:
        return 4


def test_f23_a_comparison_does_not_move_other_motors(tmp_path: Path, count_runs: Count) -> None:
    """Tables are switched for the whole card (I51)."""
    bench = make_plc_bench(tmp_path)
    bench.link.write_buffer(["I30=0", "#1DEFINE COMP 4,#1,#1,640000", "400 800 400 0", "I51=1"])
    axis = OtherAxis(bench.link, bench.bench)
    deploy.switch_tables(axis, on=False)
    assert bench.i51 == 0
    stand_at(bench, 300000.0)
    with pytest.raises(SafetyRefusal, match="on would move motor #1") as refused:
        deploy.switch_tables(axis, on=True)
    assert (refused.value.left, bench.i51) == (ControllerState.DISABLED, 0)
    bench.link.command("#1J=0")
    with pytest.raises(SafetyRefusal, match="Motor #1 is executing a move"):
        deploy.switch_tables(axis, on=True)
    bench.clock.sleep_s(15.0)
    worst = worst_following_error_ct(bench)
    deploy.switch_tables(axis, on=True)
    bench.clock.sleep_s(0.2)
    assert bench.i51 == 1
    assert worst[0] < 2 * bench.context.limits.max_step_ct
    count_runs(4)
