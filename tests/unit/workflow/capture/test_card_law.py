"""A card whose law or units are not those of the bench file is refused before anything moves."""

import pytest

from pmac_comp.base.errors import MotorNotSafe, SafetyRefusal
from pmac_comp.files.bench import Bench, load_bench, parse_bench
from pmac_comp.machine.controller.motors import motors
from pmac_comp.simulator.card.card import Card
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.capturing import prepare
from pmac_comp.workflow.capture.card_law import limit_remarks
from pmac_comp.workflow.capture.simulated import embedded, make_card
from pmac_comp.workflow.controller.doctor import _law
from tests.generators.control_laws import PAPER, SI, other_law

EMPS = load_bench("emps")
CASCADE = """
[controller.cascade]
kp_per_s = 160.18
kv_V_per_m_per_s = 243.45
gain_N_per_V = 35.1507
"""


def refusal(card: Card, bench: Bench, *lines: str) -> str:
    """What is said to a bench file whose axis must not be started."""
    with embedded(card) as link:
        axis = Axis(link, bench)
        link.write_buffer(list(lines))
        with pytest.raises(SafetyRefusal) as caught:
            prepare(axis)
        assert motors.read_motor(link, 1).status.is_killed
        assert any(finding.state == "bad" for finding in _law(axis, bench))
    return str(caught.value)


def started(card: Card, bench: Bench, *lines: str) -> None:
    """Close the loop of an axis that must not be refused."""
    with embedded(card) as link:
        link.write_buffer(list(lines))
        prepare(Axis(link, bench))


def test_the_cards_own_law_in_si_units_is_no_contradiction() -> None:
    bench = other_law("si", SI)
    started(make_card(PAPER), bench)
    started(make_card(bench), bench)


@pytest.mark.parametrize(
    "name",
    ["Kp_Nm_per_mm", "Ki_Nm_per_mm_s", "Kd_Nm_s_per_mm", "Kvff_Nm_s_per_mm", "Kaff_Nm_s2_per_mm"],
)
def test_a_gain_in_si_units_that_the_card_does_not_have_is_named(name: str) -> None:
    said = refusal(make_card(PAPER), other_law("si", SI.replace(f"{name} = ", f"{name} = 1")))
    assert "PC-COM-009" in said
    assert f"{name} " in said
    assert "counts_per_rev" in said


def test_a_cascade_with_the_right_clock_is_refused() -> None:
    said = refusal(make_card(PAPER), other_law("cascade", CASCADE))
    assert "kind = 'cascade'" in said
    assert "PC-COM-009" in said


def test_a_law_in_si_units_tells_wrong_counts() -> None:
    text = other_law("si", SI).text.replace("counts_per_rev = 10000.0", "counts_per_rev = 40000.0")
    assert "Kp_Nm_per_mm" in refusal(make_card(PAPER), parse_bench(text))


def test_a_servo_of_the_users_own_may_run_any_law() -> None:
    started(make_card(PAPER), other_law("cascade", CASCADE), "I159=1")


def test_what_the_file_leaves_out_must_be_at_its_factory_value() -> None:
    said = refusal(make_card(PAPER), PAPER, "I108=64", "I163=1000", "I208=32")
    for words in ("I108 = 64 (96)", "I163 = 1000 (4194304)", "I208 = 32 (96)", "PC-COM-008"):
        assert words in said


def test_a_travel_beyond_the_software_limits_is_remarked() -> None:
    text = PAPER.text.replace("counts_per_rev = 10000.0", "counts_per_rev = 20000.0")
    with embedded(make_card(PAPER)) as link:
        (said,) = limit_remarks(link, parse_bench(text))
        assert limit_remarks(link, PAPER) == ()
    assert "I113 = 305000 counts are 152.5 mm, max_mm is 300 mm" in said
    assert "I114" in said


def test_limits_that_are_off_say_nothing() -> None:
    text = PAPER.text.replace("I113 = 305000", "I113 = 0").replace("I114 = -305000", "I114 = 0")
    started(make_card(PAPER), parse_bench(text), "I113=0", "I114=0")


@pytest.mark.parametrize("counts", ["2500.0", "20000.0"])
def test_a_jog_with_wrong_counts_ends_after_a_few_millimetres(counts: str) -> None:
    text = PAPER.text.replace("I113 = 305000", "I113 = 0").replace("I114 = -305000", "I114 = 0")
    wrong = parse_bench(text.replace("counts_per_rev = 10000.0", f"counts_per_rev = {counts}"))
    with embedded(make_card(PAPER)) as link:
        axis = Axis(link, wrong)
        link.write_buffer(["I113=0", "I114=0"])
        prepare(axis)
        with pytest.raises(MotorNotSafe, match="differ in resolution") as caught:
            axis.move_to(axis.scales.counts(0.1))
        assert "resolutions in the bench file" in str(caught.value)
        link.clock.sleep_s(0.3)
        reading = motors.read_motor(link, 1)
        assert reading.status.is_closed_loop
        assert reading.status.is_commanded_still
        assert abs(reading.position_ct) < 15000.0


def test_a_jog_of_an_axis_that_is_as_described_arrives() -> None:
    with embedded(make_card(PAPER)) as link:
        axis = Axis(link, PAPER)
        prepare(axis)
        axis.move_to(axis.scales.counts(0.05))
        assert motors.read_motor(link, 1).position_ct == pytest.approx(50000.0, abs=5.0)
