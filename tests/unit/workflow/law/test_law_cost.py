"""The cost of the law is stated, and what cheaper laws lose is predicted and small."""

from dataclasses import replace
from functools import partial

import pytest

from pmac_comp.base.errors import SafetyRefusal
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.controller.card.processor_load import ProcessorLoad
from pmac_comp.physics.compensate.design import design_law
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import model_loop
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.compensation import computing
from pmac_comp.workflow.law import law_cost
from pmac_comp.workflow.law.dynamic_law import law_remarks
from pmac_comp.workflow.law.law_cost import (
    cheaper_laws,
    cost_refusals,
    cost_remarks,
    fitting_cycles,
    servo_cost_refusals,
    share_frac,
)

BENCH = load_bench("paper_x4")
GAP = CompensationLaw(coulomb_m=1e-6, gap_half_m=1e-6, gap_width_m=1e-7)


def test_offers_run_less_often_and_say_what_they_lose() -> None:
    model = DriveModel.base(BENCH)
    law = design_law(BENCH, model_loop(model))
    assert law.torque_constant_Nm == 0.0  # the same both ways: nothing for a constant to fit
    offers = cheaper_laws(BENCH, model, law)
    assert [offer.every_cycles for offer in offers][:2] == [1, 2]
    assert offers[-1].share_frac <= 0.26
    # A slower law is worse, but far from none: the error without it is 4-8 um.
    assert all(offer.e_r_um < 2.0 * offers[0].e_r_um + 0.1 for offer in offers)
    (text,) = cost_remarks(BENCH, "law", law, offers)
    assert "--every 2" in text
    assert f"{offers[1].e_r_um:.2f} um" in text


def test_a_law_below_a_quarter_only_says_what_it_costs() -> None:
    plain = CompensationLaw(inertia_s2=2e-6)
    seldom = replace(plain, every_cycles=4)
    assert share_frac(BENCH, seldom) == pytest.approx(share_frac(BENCH, plain) / 4)
    (text,) = cost_remarks(BENCH, "law", seldom)
    assert "more than a quarter" not in text
    assert cost_remarks(BENCH, "table", plain) == []


def test_the_open_servo_says_what_its_own_source_takes() -> None:
    plain = CompensationLaw(inertia_s2=2e-6)
    (text,) = cost_remarks(BENCH, "servo", plain)
    assert "52 % of the processor's time at 80 MHz" in text
    assert "more than a quarter. Cheaper: --route law with --every 2 (34 %)" in text
    assert "in each servo cycle" in text
    # Interpreted it is offered with the same figure.
    assert "takes about 52 %" in cost_remarks(BENCH, "law", plain)[0]
    # Beside a slower law that takes less it is no cheaper way.
    (text,) = cost_remarks(BENCH, "law", replace(plain, every_cycles=2))
    assert "--route servo" not in text
    gap = CompensationLaw(coulomb_m=1e-6, gap_half_m=1e-6, gap_width_m=1e-7)
    (text,) = cost_remarks(BENCH, "servo", gap)
    assert "57 %" in text


def test_an_open_servo_without_time_for_the_law_is_told_before_it_is_loaded() -> None:
    whole = replace(GAP, bed_share=0.1, stribeck_m=1e-7)
    with_loop = load_of(servo=0.19)  # two motors, one of them in the open servo
    assert servo_cost_refusals(BENCH, whole, with_loop) == []
    (refusal,) = servo_cost_refusals(BENCH, whole, load_of(servo=0.4))
    assert "busy 46 %" in refusal.message
    assert "--every 4" in refusal.hint
    assert servo_cost_refusals(BENCH, CompensationLaw(), load_of(servo=0.36)) == []
    assert servo_cost_refusals(BENCH, whole, None) == []


def test_a_law_of_every_second_cycle_is_not_offered_itself() -> None:
    (text,) = cost_remarks(BENCH, "law", CompensationLaw(inertia_s2=2e-6, every_cycles=2))
    assert "--every 2`" not in text
    assert "--every 4`" in text


def test_a_law_that_leaves_the_card_no_time_is_refused() -> None:
    plain = CompensationLaw(inertia_s2=2e-6)
    assert cost_refusals(BENCH, plain) == []
    slow = BENCH.controller.model_copy(update={"cpu_clock_MHz": 40.0})
    bench = BENCH.model_copy(update={"controller": slow})
    (refusal,) = cost_refusals(bench, plain)
    assert "134 %" in refusal.message
    assert "--every 2" in refusal.hint
    assert "servo" in refusal.hint
    assert cost_refusals(bench, replace(plain, every_cycles=2)) == []
    (text,) = cost_remarks(bench, "law", plain)
    assert "`upload` refuses it" in text
    # What a drive has beside the plain law fits; not with cogging beside it, which takes 90 % of
    # the time: it would fit, and leave nothing for what else the card does.
    for has in (GAP, replace(plain, drag_m=1e-7), replace(plain, stribeck_m=1e-7)):
        assert cost_refusals(BENCH, has) == []
    cogging = replace(GAP, ripple_Nm=0.05)
    assert "--every 2" in cost_refusals(BENCH, cogging)[0].hint
    assert cost_refusals(BENCH, replace(cogging, bed_share=0.1, every_cycles=2)) == []


def load_of(*, phase: float = 0.04, servo: float = 0.07, clock_MHz: float = 80.0) -> ProcessorLoad:
    half_cycles = 0.5e6 * clock_MHz * BENCH.servo_period_s
    return ProcessorLoad(half_cycles, phase, servo, 0.02, 1e-3, 1.0)


def test_the_card_s_own_task_times_decide_where_they_are_known() -> None:
    plain = CompensationLaw(inertia_s2=2e-6)  # 66 % of the time at 80 MHz
    assert cost_refusals(BENCH, plain, load_of()) == []
    # Eight motors, or a card of half the frequency that the bench file states.
    for found in (load_of(servo=0.32), load_of(clock_MHz=40.0)):
        (refusal,) = cost_refusals(BENCH, plain, found)
        assert "servo tasks" in refusal.message
        assert "--every 2" in refusal.hint
        assert cost_refusals(BENCH, replace(plain, every_cycles=2), found) == []
    # A faster one takes what the bench file's clock would not.
    both = replace(GAP, bed_share=0.1)
    assert cost_refusals(BENCH, both) != []
    assert cost_refusals(BENCH, both, load_of(clock_MHz=160.0)) == []
    # Servo tasks alone that leave no room: the slowest rhythm is named.
    (refusal,) = cost_refusals(BENCH, plain, load_of(servo=0.95))
    assert "--every 4" in refusal.hint


def test_an_open_servo_that_leaves_no_time_is_not_sent_to_itself(
    axis: Axis, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(law_cost, "read_load", lambda *_: load_of(servo=0.95))
    for route, hint in (("law", "--every 2"), ("servo", "take other load off")):
        with pytest.raises(SafetyRefusal, match="too little is left") as refused:
            law_cost.require_time_left(axis.link, BENCH, route)
        assert hint in refused.value.hint
        assert ("--route servo" in refused.value.hint) == (route == "law")


def test_a_law_that_was_counted_to_fit_is_not_taken_back_for_the_scatter_of_looks(
    axis: Axis, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Torque that ripples and Stribeck friction: 83.5 % of the time, at the edge."""
    law = CompensationLaw(inertia_s2=2e-6, turn_share=0.05, stribeck_m=1e-7)
    assert cost_refusals(BENCH, law, load_of()) == []
    running = replace(load_of(), rti_frac=share_frac(BENCH, law) + 0.008)
    monkeypatch.setattr(law_cost, "read_load", lambda *_: running)
    law_cost.require_time_left(axis.link, BENCH, "law")


def test_what_a_law_lacks_is_said() -> None:
    model = DriveModel.base(BENCH)
    (text,) = law_remarks(model, "law", has_captures=False)
    assert "--captures" in text
    assert "cogging, friction per turn and how friction grips are not in the law" in text
    (text,) = law_remarks(model, "law", has_captures=False, has_slow=True)
    assert "cogging and friction per turn are those of the slow runs" in text
    assert law_remarks(model, "law", has_captures=True) == []
    (text,) = law_remarks(model.with_effect("backlash"), "law", has_captures=True)
    assert "takes 3.0 um up as the force" in text
    assert law_remarks(model, "table", has_captures=False) == []


def test_a_law_is_computed_for_the_time_that_a_busy_card_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With more active motors `improve` computed a law for minutes that its upload then refused."""

    def designed(*_: object, every_cycles: int, provenance: dict[str, int], **__: object) -> object:
        return CompensationLaw(2e-6, every_cycles=every_cycles, provenance=provenance)

    monkeypatch.setattr(computing, "dynamic_law", designed)
    model = DriveModel.base(BENCH)
    for load, every in ((None, 1), (load_of(), 1), (load_of(servo=0.32), 2)):
        cycles_of = partial(fitting_cycles, BENCH, load=load)
        law = computing._law_that_fits(
            BENCH, model, "law", (), (), cycles_of, every_cycles=1, provenance={}, progress=None
        )
        assert law.every_cycles == every
        assert cost_refusals(BENCH, law, load) == []
