"""What a fit holds at a usual value widens its intervals."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.physics.identify.considered import considered_scores, one_deviation_off
from pmac_comp.physics.identify.normal_equations import white_filters
from pmac_comp.physics.identify.problem import Problem, jacobian, problem_of
from pmac_comp.physics.identify.records import nuisances, prepare
from pmac_comp.physics.model import slots
from pmac_comp.physics.model.chain import USUAL_SHARES
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.trajectory import sinusoid
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture
from tests.generators.other_benches import SLENDER, bench_of

PAPER = load_bench("paper")


def problem_on(bench: Bench, workers: ThreadPoolExecutor) -> Problem:
    """One sine of a bench, its stated values."""
    run = sinusoid(period_s=bench.servo_period_s, amplitude_m=0.005, frequency_Hz=3.0, cycles=3)
    capture = closed_loop_capture(bench, make_plant(bench, effects={}, seed=1), run.position_m)
    records = [prepare(capture, bench)]
    columns, _ = nuisances(records, bench, static_map=False)
    model = DriveModel.base(bench)
    return problem_of(records, columns, model, bench, None, workers, None, 1)


def score_over_prior(bench: Bench, name: str) -> float:
    """What is held pulls at a parameter, over what its prior does a standard deviation away."""
    with ThreadPoolExecutor(1) as workers:
        problem = problem_on(bench, workers)
        theta = problem.theta_of([problem.model.parameters[s.name] for s in problem.specs])
        left, slopes = jacobian(problem, theta)
        filters = white_filters(problem, left)
        scores = considered_scores(problem, theta, filters, slopes)
    i = [s.name for s in problem.specs].index(name)
    return float(np.sqrt(scores[i, i] / problem.weight[i]))


def test_torsion_of_a_slender_core_moves_its_rigidity_more_than_of_a_stout_one() -> None:
    stout = score_over_prior(PAPER, "chain.screw_rigidity_N")
    slender = score_over_prior(bench_of(SLENDER, "slender"), "chain.screw_rigidity_N")
    assert slender > 1.0
    assert slender > 2.0 * stout


def test_the_core_is_known_to_the_tolerance_of_its_rigidity() -> None:
    *_, torsion = one_deviation_off(USUAL_SHARES, PAPER)
    assert torsion.torsion_of_core == pytest.approx(1.0 + 0.5 * PAPER.tolerance.screw_rigidity_N)


def test_a_diameter_that_is_not_stated_is_known_less() -> None:
    bare = PAPER.model_copy(
        update={"screw": PAPER.screw.model_copy(update={"root_diameter_mm": None})}
    )
    *_, torsion = one_deviation_off(USUAL_SHARES, bare)
    assert torsion.torsion_of_core > 1.07


def test_each_share_moves_its_own_part_of_the_chain() -> None:
    usual = DriveModel.base(PAPER)
    own = {
        slots.J_COUPLING: (slots.J_MOTOR, slots.J_COUPLING),
        slots.K_NUT: (slots.K_NUT, slots.K_BEARING),
        slots.GJ: (slots.GJ,),
    }
    for shares, places in zip(one_deviation_off(USUAL_SHARES, PAPER), own.values(), strict=True):
        other = replace(usual, shares=shares)
        changed = np.flatnonzero(other.kernel_vector() != usual.kernel_vector())
        assert set(changed) == set(places)
        again = other.with_effect("bias_force").without_effect("bias_force")
        np.testing.assert_array_equal(again.kernel_vector(), other.kernel_vector())


def test_shares_keep_sums_and_series() -> None:
    def sums(vector: np.ndarray) -> tuple[float, float]:
        inertia = vector[slots.J_MOTOR] + vector[slots.J_COUPLING]
        return inertia, 1.0 / vector[slots.K_NUT] + 1.0 / vector[slots.K_BEARING]

    usual = DriveModel.base(PAPER)
    for shares in one_deviation_off(USUAL_SHARES, PAPER):
        off = replace(usual, shares=shares)
        assert sums(off.kernel_vector()) == pytest.approx(sums(usual.kernel_vector()))
