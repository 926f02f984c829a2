"""Laws of two axes on one card: PLC 0 and the master word belong to one of them at a time."""

from pathlib import Path

import pytest

from pmac_comp.base.errors import SafetyRefusal
from pmac_comp.files.bench import Bench
from pmac_comp.machine.controller.law import law_goal, law_state
from pmac_comp.machine.controller.law.law_state import LawForm
from pmac_comp.machine.controller.whole.rollback import rollback_last
from pmac_comp.simulator.card.card import Card
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller.deploy import deploy
from pmac_comp.workflow.controller.removal import remove_from, standing_on
from tests.unit.workflow.conftest import BENCH
from tests.unit.workflow.controller.test_deploy import LAW


def bench_of_another() -> Bench:
    """A second axis like the first, motors #3 and #4, with a block of its own."""
    controller = BENCH.controller.model_copy(
        update={
            "p_block": (7200, 7399),
            "ivariables": {
                f"I{int(name[1]) + 2}{name[2:]}" if name[1] in "12" and len(name) == 4 else name: v
                for name, v in BENCH.controller.ivariables.items()
            },
        }
    )
    assert BENCH.scale is not None
    return BENCH.model_copy(
        update={
            "controller": controller,
            "encoder": BENCH.encoder.model_copy(update={"motor_number": 3}),
            "scale": BENCH.scale.model_copy(update={"motor_number": 4}),
        }
    )


@pytest.fixture
def other(axis: Axis) -> Axis:
    """The second axis, killed, on the card of the first."""
    bench = bench_of_another()
    values = bench.controller.ivariables.items()
    axis.link.write_buffer(["I8002=$C78010", "I8003=$C78018", *(f"{k}={v}" for k, v in values)])
    return Axis(axis.link, bench, "test", simulated=True)


def put_law(axis: Axis, folder: Path) -> None:
    deploy(axis, Compensation("law", LAW), context_of(axis, folder))


def test_what_a_law_left_behind_is_not_taken_for_that_of_another_axis(
    axis: Axis, other: Axis, card: Card, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A removal took the other law's correction out of the master word, and its motor jumped."""
    context = context_of(other, tmp_path / "other")
    put_law(other, tmp_path / "other")
    remove_from(other, context, standing_on(other))
    put_law(axis, tmp_path / "first")
    axis.move_to(3000.0)
    axis.link.clock.sleep_s(0.5)
    word = card.memory.x[0x10F8]
    assert word != 0

    head = law_state.read_law_head(axis.link, context.block)
    assert head.form is LawForm.PLC  # of the law that is gone
    assert law_goal.running_form(axis.link, context, head) is LawForm.NONE
    assert standing_on(other).is_empty

    axis.link.write_buffer(["I305=$10F8", "I306=3"])  # somebody has: it is taken off
    sent: list[str] = []
    command = axis.link.command

    def recorded(text: str) -> list[str]:
        sent.append(text)
        return command(text)

    monkeypatch.setattr(axis.link, "command", recorded)
    remove_from(other, context_of(other, tmp_path / "elsewhere"), standing_on(other))
    assert axis.link.query("I306") == ["0"]
    assert not [text for text in sent if text.startswith("WX$10F8")]
    assert card.memory.x[0x10F8] == word
    assert law_state.read_law_head(axis.link, context_of(axis, tmp_path / "first").block).is_armed


def test_a_rollback_makes_no_motor_follow_the_law_of_another_axis(
    axis: Axis, other: Axis, tmp_path: Path
) -> None:
    """It brought the following back, and each correction of the first moved the second as well."""
    context = context_of(other, tmp_path / "other")
    put_law(other, tmp_path / "other")
    remove_from(other, context, standing_on(other))
    put_law(axis, tmp_path / "first")
    before = axis.link.query("I305I306P7202P7207")
    with pytest.raises(SafetyRefusal, match="p_block begins at P7000") as stopped:
        rollback_last(axis.link, context)
    assert stopped.value.code == "PC-LAW-055"
    assert axis.link.query("I305I306P7202P7207") == before
    first = context_of(axis, tmp_path / "first")
    remove_from(axis, first, standing_on(axis))
    rollback_last(axis.link, context)
    assert axis.link.query("I306") == ["3"]
    assert law_goal.law_stands(axis.link, context.block)


def test_a_law_is_refused_while_another_motor_follows_its_word(
    axis: Axis, other: Axis, tmp_path: Path
) -> None:
    """As where PLC 0 was emptied by hand: the sign test would move both."""
    put_law(other, tmp_path / "other")
    axis.link.write_buffer(["OPEN PLC 0 CLEAR", "CLOSE"])
    with pytest.raises(SafetyRefusal, match="#3 follows") as stopped:
        put_law(axis, tmp_path / "first")
    assert stopped.value.code == "PC-LAW-056"
    remove_from(other, context_of(other, tmp_path / "other"), standing_on(other))
    put_law(axis, tmp_path / "first")


def test_the_master_word_of_an_armed_law_is_no_reason_to_clear_it(
    axis: Axis, other: Axis, card: Card, tmp_path: Path
) -> None:
    """The refusal of a second law advised to write zero under the first, whose motor follows."""
    put_law(axis, tmp_path / "first")
    axis.move_to(3000.0)
    axis.link.clock.sleep_s(0.5)
    assert card.memory.x[0x10F8] != 0
    with pytest.raises(SafetyRefusal) as told:
        put_law(other, tmp_path / "other")
    assert told.value.code == "PC-LAW-054"
