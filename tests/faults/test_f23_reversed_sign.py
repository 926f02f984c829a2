"""F23 where tables act the wrong way: they are switched off where that is no step."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from pmac_comp.base.errors import ChangeInterrupted, ControllerState, SafetyRefusal
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.card import registers as reg
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.contents.comp_table import CompTable, Table
from pmac_comp.machine.controller.contents.table_set import read_tables
from pmac_comp.machine.controller.motors import motors
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.memory.memory import read_long
from pmac_comp.simulator.memory.registers import M_STATUS1, S1_OPEN_LOOP, motor_base
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import embedded
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller import deploy, sign_test
from tests.compensations import lead_map
from tests.unit.workflow.conftest import BENCH

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
REGISTER = reg.motor_register(1, reg.COMPENSATION)
STEP_um = BENCH.safety.max_enable_step_um


@dataclass
class Rig:
    """A card of which the sign of tables is taken for the other one, and its axis."""

    card: Card
    axis: Axis

    def offset_um(self) -> float:
        """What tables add to the command, from the card's own memory."""
        memory = self.card.servo.memory
        offset_ct = read_long(memory.x, memory.y, REGISTER) / (32.0 * self.axis.scales.ixx08)
        return abs(offset_ct) * self.axis.scales.motor_m_per_ct * 1e6

    def is_closed(self) -> bool:
        status = self.card.servo.memory.x[motor_base(1) + M_STATUS1]
        return not int(status) & S1_OPEN_LOOP

    def upload(self, folder: Path, slope_um_per_m: float) -> None:
        """A table over 0.6 m of travel."""
        compensation = Compensation("table", CompensationLaw(), lead_map(slope_um_per_m))
        deploy.deploy(self.axis, compensation, context_of(self.axis, folder))

    def largest_step_um(self, monkeypatch: pytest.MonkeyPatch) -> list[float]:
        """Largest step of the closed loop from here, servo cycle by servo cycle.

        Switching off counts with what it would take away on a card that clears the register.
        """
        run, ask, link = self.card.run_cycles, self.axis.link.command, self.axis.link
        worst, last = [0.0], [self.offset_um()]

        def one_by_one(n: int) -> None:
            for _ in range(n):
                run(1)
                now = self.offset_um()
                step_um, last[0] = abs(now - last[0]), now
                worst[0] = max(worst[0], step_um if self.is_closed() else 0.0)

        def command(text: str, **options: Any) -> list[str]:
            if "I51=0" in text and self.is_closed():
                worst[0] = max(worst[0], self.offset_um())
            return ask(text, **options)

        monkeypatch.setattr(self.card, "run_cycles", one_by_one)
        monkeypatch.setattr(link, "command", command)
        return worst


def as_if_reversed(
    axis: Axis, tables: Sequence[Table], context: Context, **options: float
) -> list[str]:
    """The sign test, of what would be meant if the tables acted the other way."""
    comps = [table for table in tables if isinstance(table, CompTable)]
    meant = [replace(t, entries=tuple(-entry for entry in t.entries)) for t in comps]
    return sign_test.check_table_sign(axis, meant, context, **options)


@pytest.fixture
def rig() -> Iterator[Rig]:
    card = Card(BENCH)
    with embedded(card) as link:
        axis = Axis(link, BENCH, "card")
        axis.enable()
        yield Rig(card, axis)


@pytest.mark.parametrize("older", [False, True])
def test_f23_tables_that_act_the_wrong_way_go_without_a_step(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count_runs: Count, older: object
) -> None:
    """Their register keeps what it holds while they are off, and moves the axis for good."""
    if older:
        rig.upload(tmp_path, 20.0)
    monkeypatch.setattr(deploy, "check_table_sign", as_if_reversed)
    worst_um = rig.largest_step_um(monkeypatch)
    with pytest.raises(SafetyRefusal, match=r"means -40\..* is reversed") as refused:
        rig.upload(tmp_path, 200.0)
    assert (refused.value.code, refused.value.left) == ("PC-DEP-041", ControllerState.OLD)
    assert worst_um[0] < 0.1 * STEP_um, f"largest step {worst_um[0]:.2f} um"
    assert len(read_tables(rig.axis.link)) == (1 if older else 0)
    assert rig.axis.link.query("I51") == ["1" if older else "0"]
    assert rig.is_closed()
    rig.axis.move_to(-200000.0)
    assert rig.offset_um() == pytest.approx(4.0 if older else 0.0, abs=0.1)
    count_runs(1)


@pytest.mark.parametrize("stop", [SafetyRefusal("it hangs", code="X"), KeyboardInterrupt()])
def test_f23_an_axis_that_cannot_leave_is_killed_before_they_go(
    rig: Rig,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    count_runs: Count,
    stop: BaseException,
) -> None:
    rig.upload(tmp_path, 20.0)
    move_to, moves = motors.move_to, [0]

    def stuck(link: Commander, motor: int, place_ct: float, **options: Any) -> object:
        moves[0] += 1
        if moves[0] > 1:
            raise stop
        return move_to(link, motor, place_ct, **options)

    def stuck_after_the_test(axis: Axis, *rest: Any, **options: float) -> list[str]:
        monkeypatch.setattr(motors, "move_to", stuck)
        return as_if_reversed(axis, *rest, **options)

    monkeypatch.setattr(deploy, "check_table_sign", stuck_after_the_test)
    worst_um = rig.largest_step_um(monkeypatch)
    with pytest.raises((SafetyRefusal, ChangeInterrupted)) as refused:
        rig.upload(tmp_path, 200.0)
    assert refused.value.left is ControllerState.OLD
    is_told = "it hangs" in str(getattr(refused.value, "__notes__", ""))
    assert is_told is isinstance(stop, SafetyRefusal)
    assert worst_um[0] < 0.1 * STEP_um, f"largest step {worst_um[0]:.2f} um"
    assert not rig.is_closed()
    assert rig.axis.link.query("I51") == ["1"]
    monkeypatch.undo()
    rig.axis.enable()
    rig.axis.move_to(0.0)
    assert rig.offset_um() < 0.1
    count_runs(1)
