"""The law corrected by captures of a drive that its model does not fit."""

from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.design import model_loop
from pmac_comp.physics.compensate.law import CompensationLaw, friction_state
from pmac_comp.physics.compensate.trim import shows_reversal, trimmed_law
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.signals.trajectory import Trajectory, sinusoid
from tests.compensations import lead_map

BENCH = load_bench("paper")
MODEL = DriveModel.base(BENCH)
LAW = CompensationLaw(inertia_s2=2.2e-6, viscous_s=3.8e-6, coulomb_m=0.9e-6)
MOTIONS = [
    sinusoid(
        period_s=BENCH.servo_period_s, amplitude_m=0.01, frequency_Hz=f, cycles=4.0, centre_m=x
    )
    for f, x in ((3.0, -0.2), (4.0, 0.0), (3.0, 0.2), (1.0, 0.1))
]


def capture_of(model: DriveModel, motion: Trajectory, *, extra: float = 0.0) -> Capture:
    """A run of a drive; ``extra`` is an elastic error per acceleration that the model lacks."""
    run = simulate(model, motion)
    a = np.gradient(np.gradient(run.motor_position_m, BENCH.servo_period_s), BENCH.servo_period_s)
    return Capture(
        run.time_s,
        run.commanded_position_m,
        run.motor_position_m,
        table_position_m=run.table_position_m - extra * a + 3e-6,
    )


def test_missing_compliance_is_taken_over_by_the_law() -> None:
    captures = [capture_of(MODEL, m, extra=0.5e-6) for m in MOTIONS]
    law, explained = trimmed_law(LAW, model_loop(MODEL), captures)
    assert law.inertia_s2 == pytest.approx(2.7e-6, rel=0.01)
    assert law.viscous_s == pytest.approx(LAW.viscous_s, abs=0.2e-6)
    assert explained > 0.9


def test_friction_that_grips_late_at_the_table_is_taken_over() -> None:
    distance_m, level_m = 16e-6, LAW.coulomb_m
    sharp = replace(LAW, breakaway_m=1.2e-6)
    captures = []
    for motion in MOTIONS:
        run = simulate(MODEL, motion)
        v = np.gradient(run.motor_position_m, BENCH.servo_period_s)
        states = [
            friction_state(v, b, BENCH.servo_period_s) for b in (sharp.breakaway_m, distance_m)
        ]
        table = run.table_position_m + level_m * (states[0] - states[1])
        captures.append(
            Capture(
                run.time_s, run.commanded_position_m, run.motor_position_m, table_position_m=table
            )
        )
    law, explained = trimmed_law(sharp, model_loop(MODEL), captures)
    assert law.breakaway_m == pytest.approx(distance_m, rel=0.3)
    assert law.coulomb_m == pytest.approx(LAW.coulomb_m, rel=0.05)
    assert explained > 0.5


def test_law_of_a_model_that_fits_stays_as_it_is() -> None:
    captures = [capture_of(MODEL, m) for m in MOTIONS]
    law, explained = trimmed_law(LAW, model_loop(MODEL), captures)
    assert law is LAW
    assert explained == 0.0


def test_captures_without_a_table_change_nothing() -> None:
    full = capture_of(MODEL, MOTIONS[0])
    bare = Capture(full.time_s, full.commanded_position_m, full.motor_position_m)
    assert trimmed_law(LAW, model_loop(MODEL), [bare]) == (LAW, 0.0)


def lost_on_the_way(model: DriveModel, motion: Trajectory, lost_m: float) -> Capture:
    """A run of a drive whose table lags by half of what is lost whichever way it goes."""
    run = capture_of(model, motion)
    v = np.gradient(run.motor_position_m, BENCH.servo_period_s)
    side = friction_state(v, LAW.breakaway_m, BENCH.servo_period_s)
    table = run.table_position_m
    assert table is not None
    return replace(run, table_position_m=table + 0.5 * lost_m * side)


def test_a_difference_of_the_directions_counts_where_fast_runs_show_it_too() -> None:
    lead, loop = lead_map(0.0, reversal_um=-2.0), model_loop(MODEL)
    lost = [lost_on_the_way(MODEL, m, -2e-6) for m in MOTIONS]
    assert shows_reversal(LAW, loop, lost, lead)
    # A slow run on another flank of the nut than the model's leaves as much, and fast runs nothing.
    assert not shows_reversal(LAW, loop, [capture_of(MODEL, m) for m in MOTIONS], lead)
    assert not shows_reversal(LAW, loop, [lost_on_the_way(MODEL, m, 2e-6) for m in MOTIONS], lead)


def test_what_the_captures_moved_into_the_law_is_no_difference_of_the_directions_any_more() -> None:
    lead, loop = lead_map(0.0, reversal_um=-2.0), model_loop(MODEL)
    lost = [lost_on_the_way(MODEL, m, -2e-6) for m in MOTIONS]
    law, _ = trimmed_law(LAW, loop, lost)
    moved = {"coulomb_m": law.coulomb_m - LAW.coulomb_m}
    assert moved["coulomb_m"] == pytest.approx(1e-6, rel=0.05)
    law = replace(law, provenance={"trim": moved})
    assert not shows_reversal(law, loop, lost, lead)


def test_without_runs_at_the_table_nothing_speaks_against_a_difference_of_the_directions() -> None:
    assert shows_reversal(LAW, model_loop(MODEL), [], lead_map(0.0, reversal_um=-2.0))
