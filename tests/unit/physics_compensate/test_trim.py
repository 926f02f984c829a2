"""The law corrected by captures of a drive that its model does not fit."""

from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.evaluation import friction_state
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import model_loop
from pmac_comp.physics.compensate.trim import DRAG, shows_reversal, trimmed_law, with_drag
from pmac_comp.physics.compensate.unmodelled import model_law
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


def test_stiffness_that_does_not_change_along_the_travel_is_taken_over_beside_another() -> None:
    steep = replace(LAW, compliance_slope_per_m=0.8)
    captures = []
    for motion in MOTIONS:
        run = capture_of(MODEL, motion)
        motor = run.motor_position_m
        v = np.gradient(motor, BENCH.servo_period_s)
        a = np.gradient(v, BENCH.servo_period_s)
        s = friction_state(v, steep.breakaway_m, BENCH.servo_period_s)
        own = steep.inertia_s2 * a + steep.viscous_s * v + steep.coulomb_m * s
        # A third less at the middle, and the same everywhere.
        change = own * (1.0 + steep.compliance_slope_per_m * motor) - 2.0 / 3.0 * own
        assert run.table_position_m is not None
        captures.append(replace(run, table_position_m=run.table_position_m + change))
    law, _ = trimmed_law(steep, model_loop(MODEL), captures)
    assert law.inertia_s2 == pytest.approx(2.0 / 3.0 * LAW.inertia_s2, rel=0.01)
    assert law.compliance_slope_per_m == pytest.approx(0.0, abs=0.03)


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


def dragged(motion: Trajectory, drag_m: float, seed: int) -> Capture:
    """A run of a drive at whose table something drags that turns over within 4 mm; 0.1 um noise."""
    run = capture_of(MODEL, motion)
    v = np.gradient(run.motor_position_m, BENCH.servo_period_s)
    state = friction_state(v, 4e-3, BENCH.servo_period_s)
    noise = 0.1e-6 * np.random.default_rng(seed).standard_normal(v.size)
    table = run.table_position_m
    assert table is not None
    return replace(run, table_position_m=table - drag_m * state + noise)


WIDE = [
    sinusoid(period_s=BENCH.servo_period_s, amplitude_m=a, frequency_Hz=f, cycles=3.0, centre_m=0.0)
    for a, f in ((0.002, 2.0), (0.01, 2.0), (0.04, 1.0), (0.06, 0.5))
]
WITH_TORQUE = replace(
    LAW, torque_limit_Nm=17.0, torque_coulomb_Nm=0.4, torque_viscous_Nm_s_per_m=0.3
)


def test_drag_over_millimetres_is_told_from_friction_by_how_far_motions_go() -> None:
    captures = [dragged(m, 0.3e-6, k) for k, m in enumerate(WIDE)]
    loop = model_loop(MODEL)
    law = with_drag(WITH_TORQUE, loop, captures, None, torque_Nm_s2_per_m=0.2)
    assert law.drag_m == pytest.approx(0.3e-6, rel=0.1)
    assert law.drag_distance_m == 4e-3
    assert law.coulomb_m == pytest.approx(LAW.coulomb_m, abs=0.03e-6)
    # All of it acts at the table: its torque is to its error as that of the table's mass.
    assert law.torque_drag_Nm / law.drag_m == pytest.approx(0.2 / LAW.inertia_s2)
    moved_Nm = law.torque_coulomb_Nm - WITH_TORQUE.torque_coulomb_Nm
    assert moved_Nm == pytest.approx((law.coulomb_m - LAW.coulomb_m) * 0.2 / LAW.inertia_s2)
    assert law.provenance[DRAG] > 0.2
    own = model_law(law)
    assert own.drag_m == pytest.approx(0.0, abs=1e-15)
    assert own.coulomb_m == pytest.approx(LAW.coulomb_m)
    assert own.torque_coulomb_Nm == pytest.approx(WITH_TORQUE.torque_coulomb_Nm)
    no_torque = with_drag(LAW, loop, captures, None, torque_Nm_s2_per_m=0.2)
    assert no_torque.drag_m == law.drag_m
    assert no_torque.torque_drag_Nm == 0.0


def test_no_drag_is_read_where_none_is() -> None:
    loop = model_loop(MODEL)

    def found(sizes_m: list[float], law: CompensationLaw = LAW) -> CompensationLaw:
        runs = [dragged(m, s, k) for k, (m, s) in enumerate(zip(WIDE, sizes_m, strict=True))]
        return with_drag(law, loop, runs, None, torque_Nm_s2_per_m=0.2)

    assert found([0.0] * 4) is LAW
    assert found([-0.3e-6] * 4) is LAW  # it would push
    # In a single run: something else happened there.
    assert found([0.0, 0.0, 0.0, 0.5e-6]) is LAW
    swings = replace(LAW, bed_share=0.1, bed_stiffness_per_s2=1e4)  # its place is taken
    assert found([0.3e-6] * 4, swings) is swings
    one = with_drag(LAW, loop, [dragged(WIDE[2], 0.3e-6, 0)], None, torque_Nm_s2_per_m=0.2)
    assert one is LAW
