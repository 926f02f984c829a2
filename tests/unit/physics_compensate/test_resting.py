"""What is left of the table's lag at rest, held against moves that it was not read from."""

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.design import design_law
from pmac_comp.physics.compensate.evaluation import evaluate_law
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import load_torque_Nm, model_loop
from pmac_comp.physics.compensate.motions import design_motions, resting_moves
from pmac_comp.physics.compensate.resting import with_unwinding
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.rests import moving_of, rests_of
from pmac_comp.physics.signals.trajectory import Trajectory, sinusoid
from pmac_comp.workflow.law.dynamic_law import nut_gap
from pmac_comp.workflow.motion.campaigns import verification_motions

BENCH = load_bench("paper")


def model_of(effect: str | None) -> DriveModel:
    model = DriveModel.base(BENCH)
    if effect == "presliding@rotary":
        return model.with_effect(effect, {"distance_m": 12e-6})
    if effect == "backlash":
        model = model.with_effect("bias_force", {"force_N": 150.0})
        return model.with_effect("backlash", {"gap_m": 4e-6})
    return model


def errors_at_rest_um(
    law: CompensationLaw, model: DriveModel, moves: list[Trajectory]
) -> FloatArray:
    """Mechanical error at the end of each rest against its mean in motion."""
    loop, found = model_loop(model), []
    for move in moves:
        r = move.position_m
        sent = evaluate_law(law, r, BENCH.servo_period_s, latency_cycles=1)
        signals = loop(r, r + sent.correction_m, sent.torque_Nm)
        error = signals.table_position_m - signals.motor_position_m + sent.correction_m
        rests = rests_of(r, BENCH.servo_period_s)
        error -= error[moving_of(r.size, rests)].mean()
        found += [error[rest.stop - 1] for rest in rests[1:]]
    return 1e6 * np.array(found)


@pytest.mark.parametrize("effect", [None, "presliding@rotary", "backlash"])
def test_other_moves_rest_nearer_to_their_command(effect: str | None) -> None:
    model = model_of(effect)
    loop = model_loop(model)
    few = design_motions(BENCH)[3:9]  # on two the search would suit those
    load_Nm = load_torque_Nm(model)
    fitted = design_law(BENCH, loop, gap=nut_gap(model), load_Nm=load_Nm, motions=few)
    law = with_unwinding(fitted, loop, BENCH, 1, load_Nm)
    moves = [m.trajectory for m in verification_motions(BENCH, 11, n_sine=1, n_move=8)[1:]]

    def left_um(law: CompensationLaw) -> float:
        return float(np.sqrt(np.mean(errors_at_rest_um(law, model, moves) ** 2)))

    own_um = left_um(law)
    for other_per_s in (0.0, 3.0 * law.rest_unwind_per_s):
        assert own_um < 0.8 * left_um(law.with_values(rest_unwind_per_s=other_per_s))


@pytest.mark.parametrize("effect", [None, "presliding@rotary"])
def test_after_a_soft_end_the_table_rests_where_the_command_does(effect: str | None) -> None:
    model = model_of(effect)
    loop = model_loop(model)
    fitted = design_law(BENCH, loop, motions=design_motions(BENCH)[3:9])
    law = with_unwinding(fitted, loop, BENCH, 1)
    moves = [m.trajectory for m in verification_motions(BENCH, 11, n_sine=1, n_move=8)[1:]]
    slow = sinusoid(
        period_s=BENCH.servo_period_s,
        amplitude_m=0.01,
        frequency_Hz=0.5,
        cycles=2.0,
        centre_m=BENCH.mid_travel_m,
        dwell_s=0.2,
    )
    friction_um = 1e6 * law.coulomb_m
    # What hard ends leave on average would be wrong by a quarter of the friction here.
    hard_um = friction_um * (1.0 - (1.0 - law.rest_unwind_per_s * BENCH.servo_period_s) ** 99)
    assert hard_um > 0.2 * friction_um
    assert np.max(np.abs(errors_at_rest_um(law, model, [slow]))) < 0.6 * hard_um
    assert np.mean(np.abs(errors_at_rest_um(law, model, moves))) < hard_um


def test_a_drive_without_friction_has_no_lag_at_rest() -> None:
    law = CompensationLaw(inertia_s2=2e-6)
    loop = model_loop(DriveModel.base(BENCH))
    assert with_unwinding(law, loop, BENCH, latency_cycles=1) == law


def test_moves_stay_within_travel_and_limits() -> None:
    moves = resting_moves(BENCH, n_moves=24, dwell_cycles=250)
    assert len({m.n for m in moves}) > 10
    for move in moves:
        assert BENCH.travel.min_mm / 1e3 <= move.position_m.min()
        assert move.position_m.max() <= BENCH.travel.max_mm / 1e3
        assert np.max(np.abs(move.velocity_m_per_s)) <= BENCH.usable_speed_m_per_s
        assert np.max(np.abs(move.acceleration_m_per_s2)) < 1.01 * 5.0
        assert len(rests_of(move.position_m, BENCH.servo_period_s)) == 3
