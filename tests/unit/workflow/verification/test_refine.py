"""``--refine`` on the simulated card: learning on top of the law, against errors no model holds."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.design import design_law
from pmac_comp.physics.compensate.exact import Aim, Learning
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import model_loop
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.trajectory import sinusoid
from pmac_comp.report.repeated import learning_section
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.plant import make_plant
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import embedded
from pmac_comp.workflow.compensation.file import (
    Compensation,
    read_compensation,
    write_compensation,
)
from pmac_comp.workflow.compensation.repeated import delay_samples
from pmac_comp.workflow.controller.deploy import deploy
from pmac_comp.workflow.motion.motions import Motion
from pmac_comp.workflow.verification.learning import Refinement, learned_remarks, refine_motion
from pmac_comp.workflow.verification.verify import keep_learned
from tests.generators.true_values import friction_of

BENCH = load_bench("paper_x4")
HIDDEN = {
    "lead_cyclic": {"amplitude_um": 3.0, "order_per_rev": 1.0, "phase_rad": 0.4},
    "friction_per_rev": {"amplitude_Nm": 0.05, "order_per_rev": 1.0, "phase_rad": 0.7},
}


@pytest.fixture(scope="module")
def refined(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Refinement]:
    folder: Path = tmp_path_factory.mktemp("refine")
    plant = make_plant(BENCH, effects=HIDDEN, spread=0.0)
    model = DriveModel.base(
        BENCH,
        friction_of(plant.truth),
    )
    law = design_law(BENCH, model_loop(model), latency_cycles=1)
    motion = Motion(
        "sine",
        sinusoid(period_s=BENCH.servo_period_s, amplitude_m=0.02, frequency_Hz=1.0, cycles=2.0),
    )
    with embedded(Card(BENCH, plant=plant)) as link:
        axis = Axis(link, BENCH, "card")
        axis.enable()
        context = context_of(axis, folder)
        compensation = Compensation("law", law)
        deploy(axis, compensation, context)
        yield refine_motion(axis, context, compensation, motion, passes=6)


def test_learning_takes_away_what_the_model_does_not_hold(refined: Refinement) -> None:
    # The law takes friction and elasticity away, the cyclic lead error stays: 3 / sqrt(2) um.
    assert refined.start_um < 0.5 * refined.without_um
    assert refined.start_um > 1.5
    assert refined.confirmed_um < 0.25 * refined.start_um
    assert refined.start_share > 0.5
    assert 0.05 < refined.learning_share < 1.0 - refined.start_share


def test_convergence_is_shown_by_the_fall_of_what_can_be_learned(refined: Refinement) -> None:
    learning = refined.learning
    assert learning.converged
    assert learning.contraction < 0.7
    assert learning.learnable_um[1] < 0.5 * learning.learnable_um[0]
    assert len(learning.confirmed_um) == 2
    assert learning.scatter_um < refined.confirmed_um


def test_a_person_reads_both_shares(refined: Refinement) -> None:
    text = " ".join(refined.lines())
    assert f"the model takes {100 * refined.start_share:.0f} %" in text
    assert "it converges" in text
    assert "ended because the last pass changed the error by less than" in text


@pytest.mark.parametrize(("fresh_um", "is_kept"), [(0.6, True), (2.5, False)])
def test_what_was_learned_becomes_a_compensation_to_upload(
    tmp_path: Path, fresh_um: float, *, is_kept: bool
) -> None:
    known = np.linspace(0.0, 0.01, 50)
    model = Compensation(
        "program", CompensationLaw(), None, 1e-3 * np.arange(50), known, np.zeros(50)
    )
    learning = Learning(
        2e-6 * np.sin(known * 300.0), (2.0, 0.6), converged=True, confirmed_um=(fresh_um,)
    )
    learned = Refinement("sine", 9.0, 2.0, learning)
    folder = tmp_path / "my runs"
    folder.mkdir()
    said = keep_learned(learned, model, folder, "sim://", "paper")
    path = folder / "learned.json"
    assert path.exists() is is_kept
    assert (f"pmac-comp upload sim:// '{path}' --bench paper" in said) is is_kept
    if is_kept:
        assert "the model's own stands as before" in said
        stored = read_compensation(path)
        assert stored.motion_correction_m == pytest.approx(learning.correction_m)
        assert stored.motion_position_m == pytest.approx(known)
        assert "--out FOLDER" in keep_learned(learned, model, None, "sim://", "paper")
    law = Compensation("law", CompensationLaw())
    assert "has no place" in keep_learned(learned, law, tmp_path, "sim://", "paper")


MODEL = Compensation(
    "program",
    CompensationLaw(provenance={"exact": {"aim": "mechanical"}}),
    None,
    1e-3 * np.arange(50),
    np.linspace(0.0, 0.01, 50),
    np.zeros(50),
)


def learned(without_um: float, *history_um: float, began_learned: bool = False) -> Refinement:
    """Learning whose fresh runs are as good as its best."""
    best_um = min(history_um)
    found = Learning(
        np.zeros(50),
        history_um,
        converged=True,
        learnable_um=history_um,
        confirmed_um=(best_um, best_um),
    )
    return Refinement("sine", without_um, history_um[0], found, began_learned)


def test_what_is_worse_than_no_compensation_is_not_kept_though_learning_gained(
    tmp_path: Path,
) -> None:
    """'learning takes 25 % more' was said of a motion whose total error had grown by 29 %."""
    found = learned(7.1, 9.1, 8.4)
    assert found.as_compensation(MODEL) is None
    said = keep_learned(found, MODEL, tmp_path, "sim://", "paper")
    assert "no better than without compensation" in said
    assert not list(tmp_path.iterdir())
    shares = found.lines()[1]
    assert shares == "the model makes it 28 % larger, learning takes 10 % of it away"


def test_a_learned_file_tells_where_it_comes_from(tmp_path: Path) -> None:
    """'with the model alone' and 'the model's own stands' were said of a learned correction."""
    first = learned(9.0, 2.0, 0.6).as_compensation(MODEL)
    assert first is not None
    write_compensation(tmp_path / "learned.json", first)
    stored = read_compensation(tmp_path / "learned.json")
    assert [one["from"] for one in stored.learned] == ["the model alone"]
    assert stored.aim is Aim.TOTAL  # that is what the scale taught
    assert stored.digest == first.digest
    (told,) = learned_remarks(stored)
    assert "9.00 um without it and 0.60 um with it" in told
    assert learned_remarks(MODEL) == []

    again = learned(9.0, 0.6, 0.4, began_learned=True)
    said = keep_learned(again, stored, tmp_path, "sim://", "paper")
    assert "what was learned before stands as before" in said
    text = " ".join([*again.lines(), *learning_section(again).tables[0].rows[1]])
    assert "0.60 um with what was learned before" in text
    assert "the model" not in text
    nothing = learned(9.0, 0.6, began_learned=True)
    assert nothing.lines()[1] == "what was learned before takes 93 % of it away, learning 0 % more"
    twice = read_compensation(tmp_path / "learned.json").learned
    assert [one["from"] for one in twice] == ["the model alone", "what was learned before"]


def test_a_rest_that_bows_by_nanometres_is_not_the_beginning_of_the_motion() -> None:
    # Cubics through a learned offset leave the rest before it by 2 nm, long before it begins.
    planned = np.concatenate([np.zeros(240), 0.02 * (1.0 - np.cos(np.linspace(0.0, 12.0, 4000)))])
    late = 38
    gathered = np.concatenate([np.zeros(late), planned, np.full(300, planned[-1])])
    bow = np.zeros(gathered.size)
    bow[90:278] = -5e-9 * np.sin(np.linspace(0.0, np.pi, 188))
    assert delay_samples(planned, gathered + bow) == late
