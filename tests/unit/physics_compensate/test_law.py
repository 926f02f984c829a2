"""The law as arithmetic: limits, symmetry, states, and agreement with its form in counts."""

from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ConfigError, ModelError, NonFinite
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.controller.contents.law_bank import LawParameters, evaluate
from pmac_comp.physics.compensate import evaluation, law
from pmac_comp.physics.compensate.evaluation import (
    WOUND_FADE,
    WOUND_YIELD,
    delayed,
    end_hardness,
    evaluate_law,
    friction_levels,
)
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.signals.trajectory import Trajectory, sinusoid, trapezoid
from pmac_comp.workflow.bench.scales import Scales
from pmac_comp.workflow.law.rendering import law_parameters

BENCH = load_bench("paper")
PERIOD = BENCH.servo_period_s
LAW = CompensationLaw(
    inertia_s2=2.2e-6,
    viscous_s=3.8e-6,
    coulomb_m=0.9e-6,
    compliance_slope_per_m=0.8,
    jerk_s3=1e-9,
    breakaway_m=5e-6,
    lookahead_s=1.8e-3,
    jerk_limit_m_per_s3=40.0,
    gap_half_m=2.5e-6,
    gap_width_m=0.2e-6,
    gap_lag_s=1.5e-3,
    gap_torque_Nm=-0.2,
    torque_inertia_Nm_s2_per_m=0.01,
    torque_jerk_Nm_s3_per_m=9e-4,
    torque_impulse_Nm_s3_per_m=-2e-3,
    torque_turning_Nm_s=6e-4,
    torque_turned_Nm_s=-5e-4,
    torque_viscous_Nm_s_per_m=0.1,
    torque_coulomb_Nm=0.5,
    torque_load_Nm_s2_per_m=0.005,
    turn_friction_Nm=0.1,
    turn_order=3.0,
    turn_phase_rad=0.7,
    ripple_Nm=0.04,
    ripple_order=20.0,
    ripple_phase_rad=-1.0,
    torque_constant_Nm=0.01,
    torque_place_Nm_per_m=0.3,
    stribeck_m=0.7e-6,
    torque_stribeck_Nm=0.15,
    stribeck_speed_m_per_s=0.012,
    bed_share=0.11,
    bed_damping_per_s=7.0,
    bed_stiffness_per_s2=1.6e4,
    torque_bed_Nm_s2_per_m=0.03,
    origin_m=0.02,
    torque_limit_Nm=17.0,
)
LOOSE = CompensationLaw(
    inertia_s2=2e-6, coulomb_m=1e-6, breakaway_m=1e-6, gap_half_m=2e-6, gap_width_m=0.2e-6
)
SINE = sinusoid(period_s=PERIOD, amplitude_m=0.02, frequency_Hz=2.0, cycles=3.0, centre_m=0.1)


def test_every_coefficient_is_evaluated_once_or_a_limit() -> None:
    evaluated = [name for group in evaluation._EVALUATED for name in group]
    assert len(evaluated) == len(set(evaluated))
    assert set(law.coefficient_names()) - set(evaluated) == {
        "amplitude_limit_m",
        "torque_limit_Nm",
        "valid_speed_m_per_s",
        "valid_acceleration_m_per_s2",
        "jerk_limit_m_per_s3",
    }


def test_correction_is_minus_the_quasi_static_error_where_friction_is_settled() -> None:
    law = CompensationLaw(inertia_s2=2.2e-6, viscous_s=3.8e-6, coulomb_m=0.9e-6, breakaway_m=1e-6)
    got = evaluate_law(law, SINE.position_m, PERIOD).correction_m
    v = np.gradient(SINE.position_m, PERIOD)
    a = np.gradient(v, PERIOD)
    settled = np.abs(v) > 0.05
    want = 2.2e-6 * a + 3.8e-6 * v + 0.9e-6 * np.sign(v)
    # One sample of backward differences is all that may differ.
    assert np.max(np.abs(got - want)[settled]) < 0.1e-6


@pytest.mark.parametrize("load_m", [0.0, -0.7e-6])
def test_law_in_counts_gives_the_same_correction_and_torque(load_m: float) -> None:
    agree_in_counts(LAW.with_values(gap_load_m=load_m, rest_fade_per_s=9.0, rest_unwind_per_s=14.0))


def test_friction_that_differs_by_direction_takes_the_places_of_a_gap() -> None:
    none = dict.fromkeys(("gap_half_m", "gap_width_m", "gap_torque_Nm"), 0.0)
    uneven = {"viscous_uneven_s": 1.5e-6, "torque_uneven_Nm_s_per_m": 0.4}
    agree_in_counts(LAW.with_values(**none, **uneven))
    with pytest.raises(ModelError, match="by direction"):
        LAW.with_values(**uneven)
    with pytest.raises(ConfigError, match="VU"):
        LawParameters(GH=1.0, GW=1.0, S0=1.0, VU=0.1)
    with pytest.raises(ConfigError, match="TG"):
        LawParameters(TG=3.0)
    kept = LawParameters(VU=0.1, TU=0.2, RS=0.05, RT=4.0, RV=2.0, JL=1.0)
    assert LawParameters.from_values(kept.values()) == kept


def test_torque_that_ripples_takes_the_places_of_a_gap_or_a_bed_and_of_friction_per_turn() -> None:
    gap = ("gap_half_m", "gap_width_m", "gap_torque_Nm")
    none = dict.fromkeys((*gap, "turn_friction_Nm"), 0.0)
    no_bed = dict.fromkeys(("bed_share", "turn_friction_Nm"), 0.0)
    rippling = {
        "turn_share": 0.09, "torque_loop_Nm_s2_per_m": 0.6, "torque_loop_Nm_s_per_m": 1.2,
        "turn_order": 6.0,
    }  # fmt: skip
    agree_in_counts(LAW.with_values(**none, **rippling))
    agree_in_counts(LAW.with_values(**no_bed, **rippling))
    agree_in_counts(LAW.with_values(**no_bed, **rippling).without_turn())
    with pytest.raises(ModelError, match="in proportion"):
        LAW.with_values(**rippling)
    beside_gap = LawParameters(
        GH=1.0, GW=1.0, S0=1.0, GL=0.4, TG=3.0, RS=0.05, RT=4.0, RV=2.0, JL=1.0
    )
    assert LawParameters.from_values(beside_gap.values()) == beside_gap
    with pytest.raises(ConfigError, match="no place for RS"):
        replace(beside_gap, BS=0.5)
    with pytest.raises(ConfigError, match="no place for BD"):
        replace(beside_gap, BD=0.5)
    with pytest.raises(ModelError, match="one wave"):
        LAW.with_values(**{**none, **rippling, "turn_friction_Nm": 0.1})
    with pytest.raises(ModelError, match="one wave"):
        LAW.with_values(torque_wobble_Nm_s3_per_m3=1.0)
    with pytest.raises(ConfigError, match="no place for TR"):
        LawParameters(RS=0.1, TR=5.0)
    with pytest.raises(ConfigError, match="no place for RV"):
        LawParameters(RV=0.1)
    with pytest.raises(ConfigError, match="GL"):
        LawParameters(GL=0.5)


def test_drag_over_millimetres_takes_the_places_of_a_bed() -> None:
    drags = {"bed_share": 0.0, "drag_m": 0.3e-6, "torque_drag_Nm": 0.05, "drag_distance_m": 3e-3}
    agree_in_counts(LAW.with_values(**drags))
    with pytest.raises(ModelError, match="not both"):
        LAW.with_values(drag_m=0.3e-6)
    no_turn = {"turn_friction_Nm": 0.0, "turn_share": 0.09}
    with pytest.raises(ModelError, match="what drags or"):
        LAW.with_values(**drags, **no_turn)
    kept = LawParameters(BS=-4000.0, BD=1.5, BT=20.0)
    assert kept.drags
    assert LawParameters.from_values(kept.values()) == kept
    with pytest.raises(ConfigError, match="no place for RS"):
        LawParameters(BS=-4000.0, GH=1.0, GW=1.0, S0=1.0, RS=0.05, RT=4.0, JL=1.0)


def test_drag_follows_the_way_and_stays_at_rest() -> None:
    law = CompensationLaw(drag_m=1e-6, drag_distance_m=4e-3, torque_drag_Nm=0.2, torque_limit_Nm=1)
    there = trapezoid(
        period_s=PERIOD, distance_m=0.04, speed_m_per_s=0.1, acceleration_m_per_s2=1.0,
        s_curve_s=0.015, start_m=0.0, dwell_s=0.5,
    )  # fmt: skip
    signals = evaluate_law(law, there.position_m, PERIOD)
    assert signals.torque_Nm == pytest.approx(0.2e6 * signals.correction_m)
    # 1 - exp(-x/4 mm) on the way; at rest it stays, unlike friction that unwinds.
    at_8_mm = int(np.argmax(there.position_m > 8e-3))
    assert signals.correction_m[at_8_mm] == pytest.approx(1e-6 * (1 - np.exp(-2.0)), rel=0.02)
    rests = int(np.argmax(there.position_m >= 0.04 - 1e-9))
    assert np.ptp(signals.correction_m[rests : rests + 400]) < 1e-9


def test_wave_against_the_wobble_takes_the_place_of_friction_per_turn() -> None:
    law = LAW.with_values(turn_friction_Nm=0.0, torque_wobble_Nm_s3_per_m3=60.0, turn_order=2.0)
    agree_in_counts(law)
    agree_in_counts(replace(law, bed_share=0.0))
    # What the captures' motor shows by the turn goes; the wobble is the lead's.
    assert law.without_turn() == replace(law, ripple_Nm=0.0)


def test_wave_against_the_wobble_grows_with_the_cube_of_the_speed_either_way() -> None:
    law = CompensationLaw(
        torque_wobble_Nm_s3_per_m3=60.0, turn_order=2.0, turn_phase_rad=0.3, torque_limit_Nm=9.0
    )
    # From PLC 0 it comes a cycle later; by either door it goes with the place a cycle before.
    got = evaluate_law(law, SINE.position_m, PERIOD, latency_cycles=1).torque_Nm[1:]
    same = evaluate_law(law, SINE.position_m, PERIOD).torque_Nm[1:]
    assert np.max(np.abs(got - same)) < 0.02 * np.ptp(same)
    at_m = SINE.position_m[:-1]
    v = np.gradient(at_m, PERIOD)
    phase = 0.3 + 0.25 * np.pi * np.sign(v)
    want = 60.0 * v**3 * np.sin(2.0 * 2.0 * np.pi * at_m / law.turn_m + phase)
    assert np.ptp(want) > 0.1
    assert np.max(np.abs(got - want)) < 0.02 * np.ptp(want)


def test_friction_by_direction_goes_with_the_speed_either_way() -> None:
    law = CompensationLaw(
        viscous_uneven_s=1.5e-6, torque_uneven_Nm_s_per_m=0.4, torque_limit_Nm=9.0
    )
    got = evaluate_law(law, SINE.position_m, PERIOD)
    speed = np.abs(np.gradient(SINE.position_m, PERIOD))
    assert np.max(np.abs(got.correction_m - 1.5e-6 * speed)) < 5e-9
    assert np.max(np.abs(got.torque_Nm - 0.4 * speed)) < 2e-3


def agree_in_counts(law: CompensationLaw) -> None:
    """What a controller makes of a law is what the law says."""
    scales = Scales.of(BENCH)
    here = evaluate_law(law, SINE.position_m, PERIOD)
    there = evaluate(
        law_parameters(law, scales), SINE.position_m / scales.motor_m_per_ct, clamp_ct=60.0
    )
    back_m = there.correction_ct * scales.motor_m_per_ct
    # The bank holds nine digits and ten decimals, and a gap is steep where the flank turns.
    assert np.max(np.abs(back_m - here.correction_m)) < 2e-9
    assert np.max(np.abs(there.torque_dac * scales.torque_Nm_per_dac - here.torque_Nm)) < 1e-6


def test_zero_beyond_the_screw_is_refused() -> None:
    far = LAW.with_values(origin_m=1.5)  # 0.8 of it per metre: none is left at zero
    with pytest.raises(ConfigError, match="beyond the screw"):
        law_parameters(far, Scales.of(BENCH))


def test_amplitude_is_clamped_and_marked() -> None:
    law = LAW.with_values(amplitude_limit_m=1e-6)
    got = evaluate_law(law, SINE.position_m, PERIOD)
    assert np.max(np.abs(got.correction_m)) == pytest.approx(1e-6)
    assert 0 < np.count_nonzero(got.clamped) < got.clamped.size


def slow_move(*, dwell_s: float, both_ways: bool = True) -> Trajectory:
    """Move of 10 mm with a rest behind it, there and back or one way."""
    return trapezoid(
        period_s=PERIOD,
        distance_m=0.01,
        speed_m_per_s=0.05,
        acceleration_m_per_s2=1.0,
        dwell_s=dwell_s,
        both_ways=both_ways,
    )


def test_at_rest_friction_torque_fades_and_the_table_comes_along() -> None:
    move = slow_move(dwell_s=1.5, both_ways=False)
    law = CompensationLaw(coulomb_m=1e-6, torque_coulomb_Nm=0.5, torque_limit_Nm=10.0)
    law = law.with_values(inertia_s2=2e-6)
    got = evaluate_law(law, move.position_m, PERIOD)
    # A hundred cycles at one and at 0.4 per cent each.
    stopped = np.flatnonzero(np.diff(move.position_m) > 1e-10)[-1]
    assert got.torque_Nm[stopped] == pytest.approx(0.5, rel=0.01)
    assert got.torque_Nm[-1] == pytest.approx(0.5 * 0.99**99, rel=2e-3)
    assert got.torque_Nm[stopped + 110] == got.torque_Nm[-1]
    # The two cycles in which the acceleration comes to rest apart.
    assert got.correction_m[stopped + 3] == pytest.approx(1e-6, rel=1e-2)
    unwinds = end_hardness(law, move.position_m, PERIOD)[-1]
    assert 0.2 < unwinds < 1.0
    assert got.correction_m[-1] == pytest.approx(1e-6 * (1.0 - 0.004 * unwinds) ** 99, rel=1e-3)


def test_the_table_comes_along_after_a_hard_end_and_stays_after_a_soft_one() -> None:
    law = CompensationLaw(coulomb_m=1e-6, inertia_s2=2e-6, rest_unwind_per_s=20.0)

    def left(acceleration_m_per_s2: float, s_curve_s: float) -> float:
        move = trapezoid(
            period_s=PERIOD,
            distance_m=0.05,
            speed_m_per_s=0.1,
            acceleration_m_per_s2=acceleration_m_per_s2,
            s_curve_s=s_curve_s,
            start_m=0.0,
            dwell_s=0.2,
        )
        there = move.position_m[: int(np.argmax(move.position_m >= 0.05 - 1e-12)) + 300]
        return float(evaluate_law(law, there, PERIOD).correction_m[-1] / 1e-6)

    assert left(5.0, 0.015) < 0.5
    assert left(0.2, 0.1) > 0.9


def test_motion_begins_with_the_friction_that_the_output_held() -> None:
    # The drive has slid back until it holds a fifth of its friction, by the integrator's doing.
    move = slow_move(dwell_s=0.4)
    law = CompensationLaw(torque_coulomb_Nm=0.5, torque_limit_Nm=10.0, torque_breakaway_m=1e-6)
    alone = evaluate_law(law, move.position_m, PERIOD).torque_Nm
    stopped = np.flatnonzero(np.diff(move.position_m) > 1e-10)[-1]
    back = np.flatnonzero(np.diff(move.position_m) < -1e-10)[0]
    output = np.where(np.arange(move.n) < stopped, alone, 0.1)
    got = evaluate_law(law, move.position_m, PERIOD, output_Nm=output).torque_Nm
    # Nothing jumps, and the torque turns by what friction still lacks: 0.1 + 0.5.
    assert got[back] == pytest.approx(alone[back], abs=0.01)
    assert got[back] - got[back + 60] == pytest.approx(0.6, rel=0.03)
    assert alone[back] - alone[back + 60] == pytest.approx(0.685, rel=0.03)


def test_torque_against_the_integrator_gives_way_at_rest_where_it_pushes_as_friction() -> None:
    # Two moves up; over the first rest the integrator has wound through half of the friction.
    one = slow_move(dwell_s=0.4).position_m
    up = one[: int(np.argmax(one >= one.max() - 1e-12)) + 500]
    path = np.concatenate([up, up + up[-1]])
    law = CompensationLaw(torque_coulomb_Nm=0.5, torque_limit_Nm=10.0, torque_breakaway_m=1e-6)
    alone = evaluate_law(law, path, PERIOD).torque_Nm
    ends = [int(np.flatnonzero(np.diff(part) > 1e-10)[-1]) + 1 for part in (path[: up.size], path)]
    output = np.where(np.arange(path.size) < ends[0], alone, -0.25)
    got = evaluate_law(law, path, PERIOD, output_Nm=output).torque_Nm
    held = 0.5 * (1.0 - law.rest_fade_per_s * PERIOD) ** np.arange(99)
    gone = WOUND_YIELD * 101 * held[-1]  # in the cycles after those in which friction fades
    # As the second move ends the law sends friction and what it sends against the integrator.
    against = got[ends[1]] - alone[ends[1]]
    assert against == pytest.approx((held[-1] + 0.25) * WOUND_FADE**480, rel=0.05)
    assert got[-1] - alone[-1] == pytest.approx(against - gone, abs=2e-3)
    # The other way it pushes against friction, and stays.
    back = evaluate_law(law, path, PERIOD, output_Nm=np.where(output < 0.0, 0.75, output)).torque_Nm
    against = back[ends[1]] - alone[ends[1]]
    assert against < -0.1
    assert back[-1] - alone[-1] == pytest.approx(against, abs=2e-3)


def test_move_that_ends_is_not_taken_for_one_that_turns() -> None:
    move = trapezoid(
        period_s=PERIOD,
        distance_m=0.05,
        speed_m_per_s=0.2,
        acceleration_m_per_s2=3.0,
        s_curve_s=0.015,
        dwell_s=0.2,
        both_ways=False,
    )
    law = CompensationLaw(
        torque_coulomb_Nm=0.5,
        torque_limit_Nm=10.0,
        lookahead_s=2e-3,
        breakaway_m=1e-6,
        torque_breakaway_m=1e-6,
    )
    got = evaluate_law(law, move.position_m, PERIOD).torque_Nm
    braking = np.flatnonzero(np.diff(move.position_m, 2) < -1e-8)
    assert np.min(got[braking[0] : braking[-1] + 6]) > 0.45
    assert np.min(got[braking[-1] :]) > 0.18  # at rest the torque fades, it does not turn


def test_turn_that_was_foreseen_and_did_not_come_is_taken_back() -> None:
    # Without S-curve nothing tells a stop from a turn until it comes.
    move = trapezoid(
        period_s=PERIOD,
        distance_m=0.05,
        speed_m_per_s=0.2,
        acceleration_m_per_s2=3.0,
        dwell_s=0.2,
        both_ways=False,
    )
    law = CompensationLaw(coulomb_m=1e-6, lookahead_s=2e-3, breakaway_m=1e-6)
    got = evaluate_law(law, move.position_m, PERIOD).correction_m
    stopped = np.flatnonzero(np.diff(move.position_m) > 1e-10)[-1]
    assert np.min(got[stopped - 10 : stopped + 1]) < 0.0
    assert np.min(got[stopped + 3 : stopped + 10]) > 0.8e-6


def test_gap_is_taken_up_with_the_force_and_not_with_the_velocity() -> None:
    t = np.arange(0.0, 1.0, PERIOD)
    position = 0.02 * np.cos(2.0 * np.pi * 2.0 * t)
    plain = evaluate_law(LOOSE.with_values(gap_half_m=0.0), position, PERIOD).correction_m
    with_gap = evaluate_law(LOOSE.with_values(gap_half_m=2.5e-6), position, PERIOD).correction_m
    flank = (with_gap - plain) / 2.5e-6
    # Braking with 3.1 m/s2 at most, six times the friction: the flank turns long before the end.
    clear = (np.abs(plain) > 1e-6) & (t > 0.02)  # the flank is known once the axis moves
    assert np.all(np.sign(flank[clear]) == np.sign(plain[clear]))
    assert np.all(np.abs(flank[clear]) > 0.8)
    still_forward = (np.gradient(position) > 1e-7) & (plain < -1e-6)
    assert np.all(flank[still_forward] < 0.0)
    assert np.count_nonzero(still_forward) > 0.15 * t.size


def flank_of(
    law: CompensationLaw, acceleration_m_per_s2: float, s_curve_s: float
) -> tuple[FloatArray, FloatArray]:
    """Flank from -1 to 1 and elastic correction in m along a move up."""
    motion = trapezoid(
        period_s=PERIOD,
        distance_m=0.1,
        speed_m_per_s=0.3,
        acceleration_m_per_s2=acceleration_m_per_s2,
        s_curve_s=s_curve_s,
        dwell_s=0.2,
        both_ways=False,
    )
    both = evaluate_law(law, motion.position_m, PERIOD).correction_m
    plain = evaluate_law(law.with_values(gap_half_m=0.0), motion.position_m, PERIOD).correction_m
    return (both - plain) / law.gap_half_m, plain


def test_nut_is_sent_across_the_gap_before_the_force_turns() -> None:
    law = LOOSE.with_values(lookahead_s=2e-3)
    flank, plain = flank_of(law, acceleration_m_per_s2=4.0, s_curve_s=0.015)
    turned = np.flatnonzero((flank[:-1] > 0.0) & (flank[1:] <= 0.0))
    force = np.flatnonzero((plain[:-1] > 0.0) & (plain[1:] <= 0.0))
    # The jerk falls there: less than the two milliseconds that it would be at a constant one.
    assert 1e-3 < (force[0] - turned[0]) * PERIOD < 2.5e-3


def test_flank_follows_the_force_at_once_and_stays_at_rest() -> None:
    """On a way as friction's a nut crossed too late: small slow sinusoids kept 1.7 of their aim."""
    wide = LOOSE.with_values(breakaway_m=10e-6, gap_width_m=2e-6)
    flank, plain = flank_of(wide, acceleration_m_per_s2=4.0, s_curve_s=0.015)
    at_rest = slice(-round(0.19 / PERIOD), None)
    under_way = slice(1, -round(0.21 / PERIOD))
    told = np.clip(plain / wide.gap_width_m, -1.0, 1.0)
    assert np.max(np.abs(flank - told)[under_way]) < 1e-6
    assert np.ptp(told[under_way]) > 1.9
    assert np.ptp(flank[at_rest]) < 1e-6
    assert np.ptp(told[at_rest]) > 0.05  # friction fades


def test_soft_zone_is_taken_up_in_proportion_to_the_force() -> None:
    law = CompensationLaw(inertia_s2=2e-6, coulomb_m=0.5e-6, breakaway_m=1e-6)
    soft = law.with_values(gap_half_m=1e-6, gap_width_m=3e-6)
    flank, plain = flank_of(soft, acceleration_m_per_s2=4.0, s_curve_s=0.15)
    told = np.clip(plain / 3e-6, -1.0, 1.0)
    under_way = slice(round(0.02 / PERIOD), np.flatnonzero(np.diff(plain))[-1] - 20)
    assert np.max(np.abs(flank - told)[under_way]) < 0.12
    assert np.ptp(told[under_way]) > 1.9


def test_motor_crosses_with_a_lag_and_its_torque_ends_with_the_crossing() -> None:
    slow = LOOSE.with_values(gap_lag_s=2e-3, gap_torque_Nm=-0.2, torque_limit_Nm=10.0)
    sharp, _ = flank_of(LOOSE, acceleration_m_per_s2=4.0, s_curve_s=0.015)
    lagged, _ = flank_of(slow, acceleration_m_per_s2=4.0, s_curve_s=0.015)
    turned = [np.flatnonzero((f[:-1] > 0.0) & (f[1:] <= 0.0))[0] for f in (sharp, lagged)]
    # A first-order lag is half-way, from one flank to the other, after ln 2 of it.
    assert (turned[1] - turned[0]) * PERIOD == pytest.approx(2e-3 * np.log(2.0), abs=1.5 * PERIOD)
    position = 0.02 * np.sin(2.0 * np.pi * 2.0 * np.arange(0.0, 1.0, PERIOD))
    torque = evaluate_law(slow, position, PERIOD).torque_Nm
    correction = evaluate_law(slow, position, PERIOD).correction_m
    follows = np.diff(correction) * slow.gap_torque_Nm * torque[1:]
    crossing = (np.abs(torque) > 0.02) & (np.arange(torque.size) > 50)  # it began with a jerk
    assert 0.001 < np.mean(crossing) < 0.1
    assert np.min(torque) > -0.4 - 1e-9  # of a whole gap, from -1 to 1
    assert np.all(follows[crossing[1:]] > 0.0)


def test_load_shifts_the_force_at_which_the_flank_changes() -> None:
    position = 0.02 * np.cos(2.0 * np.pi * 2.0 * np.arange(0.0, 1.0, PERIOD))
    loaded = LOOSE.with_values(gap_load_m=3e-6)
    plain = evaluate_law(LOOSE.with_values(gap_half_m=0.0), position, PERIOD).correction_m
    taken = evaluate_law(loaded, position, PERIOD).correction_m - plain
    flank = 1.0 + taken / LOOSE.gap_half_m  # the load holds the upper one, where it begins
    clear = (np.abs(plain + 3e-6) > 1e-6) & (np.arange(position.size) > 50)
    assert np.all(np.sign(flank[clear]) == np.sign(plain[clear] + 3e-6))
    # Braking alone does not lift the load: only the hardest acceleration downwards does.
    assert 0.1 < np.mean(flank[clear] < 0.0) < 0.4


def test_load_that_nothing_lifts_leaves_no_gap_to_take_up() -> None:
    position = 0.02 * np.cos(2.0 * np.pi * 2.0 * np.arange(0.0, 1.0, PERIOD))
    plain = evaluate_law(LOOSE.with_values(gap_half_m=0.0), position, PERIOD)
    heavy = evaluate_law(LOOSE.with_values(gap_load_m=-50e-6), position, PERIOD)
    assert np.allclose(heavy.correction_m, plain.correction_m, atol=1e-15)
    assert np.allclose(heavy.torque_Nm, plain.torque_Nm, atol=1e-12)


@pytest.mark.parametrize(("speed", "left"), [(1e-4, 1.0), (0.01, 0.4), (0.1, 0.0)])
def test_friction_is_higher_near_standstill(speed: float, left: float) -> None:
    plain = CompensationLaw(
        coulomb_m=1e-6,
        breakaway_m=1e-6,
        torque_coulomb_Nm=0.4,
        torque_breakaway_m=1e-6,
        torque_limit_Nm=10.0,
    )
    law = plain.with_values(stribeck_m=0.5e-6, torque_stribeck_Nm=0.2, stribeck_speed_m_per_s=0.01)
    path = speed * np.clip(np.arange(0.0, 1.0, PERIOD) - 0.01, 0.0, None)
    last = evaluate_law(law, path, PERIOD)
    moving = evaluate_law(plain, path, PERIOD)
    assert last.correction_m[-1] - moving.correction_m[-1] == pytest.approx(0.5e-6 * left, abs=2e-9)
    assert last.torque_Nm[-1] - moving.torque_Nm[-1] == pytest.approx(0.2 * left, abs=2e-3)
    friction_m, friction_Nm = friction_levels(law, np.array([speed]))
    assert friction_m[0] == pytest.approx(last.correction_m[-1], rel=0.02)
    assert friction_Nm[0] == pytest.approx(last.torque_Nm[-1], rel=0.02)
    assert law.breaks_loose_Nm == pytest.approx(0.6)


SMOOTH = CompensationLaw(
    coulomb_m=1e-6, torque_coulomb_Nm=0.4, torque_limit_Nm=10.0, breakaway_m=1e-7,
    torque_breakaway_m=1e-7,
).as_smooth(0.8e-3)  # fmt: skip


@pytest.mark.parametrize("speed", [1e-4, 0.5e-3, 2e-3, 5e-3])
def test_smooth_friction_sets_in_with_speed(speed: float) -> None:
    path = -speed * np.clip(np.arange(0.0, 1.0, PERIOD) - 0.01, 0.0, None)
    sent = evaluate_law(SMOOTH, path, PERIOD)
    assert sent.torque_Nm[-1] / -0.4 == pytest.approx(np.tanh(speed / 1e-3), abs=0.17)
    assert sent.correction_m[-1] / -1e-6 == pytest.approx(sent.torque_Nm[-1] / -0.4, rel=1e-6)


def test_smooth_friction_is_nothing_at_rest() -> None:
    path = np.concatenate([0.1 * np.arange(0.0, 0.2, PERIOD), np.full(500, 0.02)])
    sent = evaluate_law(SMOOTH, path, PERIOD)
    assert abs(sent.torque_Nm[-490]) < 1e-9
    assert sent.torque_Nm.max() == pytest.approx(0.4, rel=1e-3)
    assert SMOOTH.breaks_loose_Nm == 0.0
    assert SMOOTH.largest_correction_m == pytest.approx(1e-6)


def test_smooth_friction_stays_smooth_with_other_coefficients() -> None:
    moved = SMOOTH.with_values(coulomb_m=3e-6, torque_coulomb_Nm=0.1)
    assert (moved.stribeck_m, moved.torque_stribeck_Nm) == (-3e-6, -0.1)
    still = moved.without_torque()
    assert (still.stribeck_m, still.torque_stribeck_Nm) == (-3e-6, 0.0)


def test_law_with_less_than_no_friction_at_rest_is_refused() -> None:
    with pytest.raises(ModelError, match="torque_stribeck_Nm"):
        CompensationLaw(torque_coulomb_Nm=0.4, torque_stribeck_Nm=-0.5)


def test_table_feels_the_bed_swing_on_after_an_acceleration_and_not_at_rest() -> None:
    law = CompensationLaw(
        inertia_s2=2e-6,
        coulomb_m=2e-6,
        breakaway_m=1e-6,
        bed_share=0.1,
        bed_stiffness_per_s2=(2.0 * np.pi * 20.0) ** 2,
        torque_bed_Nm_s2_per_m=0.05,
        torque_limit_Nm=10.0,
        rest_unwind_per_s=0.004 / PERIOD,  # with it the differences below do not round
    )
    time_s = np.arange(0.0, 0.9, PERIOD)

    def felt_m_per_s2(law: CompensationLaw, ramp_s: float) -> FloatArray:
        """Along a ramp to 0.2 m/s, half a second of that, and a rest from 0.7 s on."""
        speed = np.interp(time_s, [0.1, 0.1 + ramp_s, 0.6, 0.7], [0.0, 0.2, 0.2, 0.0])
        position_m = np.cumsum(speed) * PERIOD
        with_bed = evaluate_law(law, position_m, PERIOD)
        # Next to none: without a bed less would unwind.
        without = evaluate_law(law.with_values(bed_share=1e-15), position_m, PERIOD)
        felt = (with_bed.correction_m - without.correction_m) / 2e-6
        assert with_bed.torque_Nm - without.torque_Nm == pytest.approx(0.05 * felt, abs=1e-9)
        return felt

    coasts, rests = (time_s > 0.235) & (time_s < 0.59), time_s > 0.71
    # A ramp of two whole swings leaves the bed as it was; half a swing more, and it swings on.
    assert np.max(np.abs(felt_m_per_s2(law, 0.1)[coasts])) < 0.02
    felt = felt_m_per_s2(law, 0.125)
    assert np.max(np.abs(felt[coasts])) == pytest.approx(2.0 * 0.1 * 1.6, rel=0.05)
    turns = np.flatnonzero(np.diff(np.sign(felt[coasts])) > 0)
    assert np.diff(turns).mean() * PERIOD == pytest.approx(1.0 / 20.0, rel=0.03)
    # The guide holds the table at rest, whatever the bed does, as far as its friction reaches.
    assert np.ptp(felt[rests]) == 0.0
    slippery = felt_m_per_s2(law.with_values(coulomb_m=0.1e-6), 0.125)
    free = felt_m_per_s2(law.with_values(coulomb_m=0.0), 0.125)
    assert 0.1 < np.ptp(slippery[rests]) < np.ptp(free[rests]) - 2.0 * 0.05 + 0.01


def test_elastic_error_grows_along_the_screw_by_one_slope() -> None:
    law = LAW.with_values(gap_half_m=0.0, jerk_s3=0.0, origin_m=0.1)
    here = evaluate_law(law, SINE.position_m, PERIOD).correction_m
    flat = evaluate_law(law.with_values(compliance_slope_per_m=0.0), SINE.position_m, PERIOD)
    along = 1.0 + 0.8 * (SINE.position_m - 0.1)
    np.testing.assert_allclose(here, along * flat.correction_m, atol=1e-15)


@pytest.mark.parametrize(("coulomb_m", "width_m"), [(0.0, 1e-7), (-1e-6, 1e-7), (1e-6, 0.0)])
def test_gap_without_what_tells_its_flank_is_refused(coulomb_m: float, width_m: float) -> None:
    with pytest.raises(ModelError, match="flank"):
        CompensationLaw(gap_half_m=2e-6, coulomb_m=coulomb_m, gap_width_m=width_m)


def test_motion_the_other_way_gives_the_opposite() -> None:
    law = LAW.with_values(
        origin_m=0.0, torque_constant_Nm=0.0, turn_friction_Nm=0.0, ripple_phase_rad=0.0
    )
    up = evaluate_law(law, SINE.position_m - 0.1, PERIOD)
    down = evaluate_law(
        law.with_values(
            compliance_slope_per_m=-law.compliance_slope_per_m,
        ),
        -(SINE.position_m - 0.1),
        PERIOD,
    )
    assert np.allclose(up.correction_m, -down.correction_m, atol=1e-15)
    assert np.allclose(up.torque_Nm, -down.torque_Nm, atol=1e-12)


def test_latency_shifts_what_the_servo_receives() -> None:
    at_once = evaluate_law(LAW, SINE.position_m, PERIOD)
    late = evaluate_law(LAW, SINE.position_m, PERIOD, latency_cycles=2)
    assert np.array_equal(late.correction_m[2:], at_once.correction_m[:-2])
    assert delayed(np.arange(3.0), 7).tolist() == [0.0, 0.0, 0.0]


def test_without_torque_keeps_the_offset() -> None:
    plain = evaluate_law(LAW.without_torque(), SINE.position_m, PERIOD)
    assert np.all(plain.torque_Nm == 0.0)
    assert np.array_equal(
        plain.correction_m, evaluate_law(LAW, SINE.position_m, PERIOD).correction_m
    )


def test_a_law_without_torque_has_no_term_of_it() -> None:
    """A new term is zeroed with the others; what shapes or limits them has no torque by itself."""
    named = {name for name in law.coefficient_names() if "_Nm" in name}
    shaping = {"torque_limit_Nm", "torque_loop_Nm_s2_per_m", "torque_loop_Nm_s_per_m"}
    assert set(law._WITHOUT_TORQUE) == (named - shaping) | {"turn_share"}


@pytest.mark.parametrize("name", ["breakaway_m", "torque_breakaway_m", "turn_m"])
def test_distances_and_speeds_must_be_positive(name: str) -> None:
    with pytest.raises(ModelError):
        LAW.with_values(**{name: 0.0})


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_f34_values_that_are_not_finite_are_refused(bad: float) -> None:
    with pytest.raises(NonFinite):
        LAW.with_values(inertia_s2=bad)
    position = SINE.position_m.copy()
    position[7] = bad
    with pytest.raises(NonFinite, match="index 7"):
        evaluate_law(LAW, position, PERIOD)


def test_steps_of_the_acceleration_are_followed_at_the_jerk_limit() -> None:
    step = trapezoid(
        period_s=PERIOD, distance_m=0.05, speed_m_per_s=0.2, acceleration_m_per_s2=3.0, dwell_s=0.1
    )
    law = CompensationLaw(inertia_s2=2.2e-6, jerk_limit_m_per_s3=500.0)
    got = evaluate_law(law, step.position_m, PERIOD).correction_m
    steepest = np.max(np.abs(np.diff(got))) / PERIOD
    assert steepest == pytest.approx(2.2e-6 * 500.0, rel=1e-6)
    # It arrives: the plateau of the acceleration is corrected in full.
    assert np.max(got) == pytest.approx(2.2e-6 * 3.0, rel=1e-3)
    free = evaluate_law(law.with_values(jerk_limit_m_per_s3=1e6), step.position_m, PERIOD)
    assert np.max(np.abs(np.diff(free.correction_m))) / PERIOD > 10.0 * steepest


def test_torque_answers_the_jerk_of_a_motion_and_not_that_of_a_step() -> None:
    law = CompensationLaw(
        torque_jerk_Nm_s3_per_m=1e-3, jerk_limit_m_per_s3=400.0, torque_limit_Nm=17.0
    )
    common = {"distance_m": 0.1, "speed_m_per_s": 0.3, "acceleration_m_per_s2": 3.0}
    step = trapezoid(period_s=PERIOD, **common, dwell_s=0.05)
    soft = trapezoid(period_s=PERIOD, **common, s_curve_s=0.015, dwell_s=0.05)
    # The last passes on the way to a step's end are those of less than twice the limit.
    answered = np.count_nonzero(np.abs(evaluate_law(law, step.position_m, PERIOD).torque_Nm) > 1e-6)
    assert answered < 0.2 * 8 * 3.0 / 400.0 / PERIOD  # eight corners there and back
    own = np.max(np.abs(evaluate_law(law, soft.position_m, PERIOD).torque_Nm))
    assert own == pytest.approx(1e-3 * 3.0 / 0.015, rel=0.05)


def test_motions_with_limited_jerk_never_meet_the_limit() -> None:
    move = trapezoid(
        period_s=PERIOD,
        distance_m=0.05,
        speed_m_per_s=0.2,
        acceleration_m_per_s2=4.0,
        s_curve_s=0.015,
    )
    limited = evaluate_law(LAW.with_values(jerk_limit_m_per_s3=500.0), move.position_m, PERIOD)
    free = evaluate_law(LAW.with_values(jerk_limit_m_per_s3=1e6), move.position_m, PERIOD)
    # The limited acceleration adds up what the other takes as a difference.
    assert np.max(np.abs(limited.correction_m - free.correction_m)) < 1e-12


def test_a_law_that_runs_every_second_cycle_holds_its_values() -> None:
    # The flank of a gap is a step, which half a cycle of delay does not leave small.
    law = LAW.with_values(gap_half_m=0.0)
    every = evaluate_law(law.with_values(every_cycles=2), SINE.position_m, PERIOD)
    assert np.array_equal(every.torque_Nm[0:-1:2], every.torque_Nm[1::2])
    each = evaluate_law(law, SINE.position_m, PERIOD)
    moving = np.abs(np.gradient(SINE.position_m, PERIOD)) > 0.05
    # Away from reversals it is the same law, late by half a cycle on average.
    assert np.max(np.abs(every.correction_m - each.correction_m)[moving]) < 0.3e-6
    with pytest.raises(ModelError, match="every 5"):
        LAW.with_values(every_cycles=5)
