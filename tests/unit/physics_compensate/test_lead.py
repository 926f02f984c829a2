"""Lead map: the mean of both directions, the friction step left out, the table that carries it."""

import numpy as np
import pytest

from pmac_comp.base.errors import NotIdentifiable
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.machine.controller.contents.safety import check_table
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap, _smooth, lead_map
from pmac_comp.workflow.bench.scales import Scales
from pmac_comp.workflow.law.backlash import backlash_table
from pmac_comp.workflow.law.rendering import lead_spacing_m, lead_table
from pmac_comp.workflow.motion.campaigns import lead_motions

BENCH = load_bench("paper")


def lead_error_m(x: np.ndarray) -> np.ndarray:
    wobble = 2e-6 * (np.cos(2 * np.pi * x / 0.01 + 0.4) - np.cos(0.4))
    return np.asarray(35e-6 * x + wobble)


def slow_run(step_m: float = 0.9e-6, *, quantised: bool = True) -> Capture:
    r = lead_motions(BENCH)[0].position_m
    direction = np.sign(np.gradient(r))
    table = r + lead_error_m(r) - step_m * direction
    motor = r
    if quantised:
        motor = np.round(r / 1e-6) * 1e-6
        table = np.round(table / 0.125e-6) * 0.125e-6
    time_s = np.arange(r.size) * BENCH.servo_period_s
    return Capture(time_s, r, motor, table_position_m=table)


def test_map_is_the_lead_error_without_the_friction_step() -> None:
    found = lead_map([slow_run()], None)
    want = lead_error_m(found.position_m)
    assert np.max(np.abs(found.error_m - want)) < 0.15e-6
    assert np.mean(found.reversal_m) == pytest.approx(-1.8e-6, abs=0.05e-6)


def test_dynamic_law_takes_the_step_out_of_the_reversal() -> None:
    found = lead_map([slow_run()], CompensationLaw(coulomb_m=0.9e-6))
    assert abs(np.mean(found.reversal_m)) < 0.05e-6


def test_what_cogging_makes_of_a_run_is_not_taken_for_lead() -> None:
    run = slow_run()
    shaken = 0.3e-6 * np.cos(6.0 * 2.0 * np.pi * run.commanded_position_m / 0.01)
    table = np.asarray(run.table_position_m) + shaken
    other = Capture(
        run.time_s, run.commanded_position_m, run.motor_position_m, table_position_m=table
    )
    want = lead_error_m(lead_map([run], None).position_m)
    left = lead_map([other], None).error_m - want
    clean = lead_map([other], None, per_turn_m=[shaken]).error_m - want
    assert np.std(left) > 0.08e-6
    assert np.std(clean) < 0.04e-6


@pytest.mark.parametrize("pitch_mm", [5.0, 10.0])
def test_what_runs_back_beyond_the_travel_is_not_steeper_than_a_screw_may_be(
    pitch_mm: float,
) -> None:
    """A long error is no local one: what its table does where nothing goes is not told of it."""
    bench = BENCH.model_copy(
        update={"screw": BENCH.screw.model_copy(update={"pitch_mm": pitch_mm})}
    )
    n = round(0.3 / lead_spacing_m(bench))
    x = lead_spacing_m(bench) * np.arange(-n, n + 1)
    lead = LeadMap(x, 190e-6 * x, 180e-6 * x, 0.0)
    limits = Scales.of(bench).limits(bench)
    for table in (lead_table(lead, bench).table, backlash_table(lead, bench).table):
        assert check_table(table, limits) == []
    at = np.linspace(-0.3, 0.3, 1201)
    corrected = lead_table(lead, bench).table.correction_ct(at / bench.motor_resolution_m)
    assert corrected * bench.motor_resolution_m == pytest.approx(-190e-6 * at, abs=0.1e-6)


def test_table_takes_the_map_away_within_its_rounding() -> None:
    found = lead_map([slow_run()], None)
    rendered = lead_table(found, BENCH)
    assert rendered.table.entries[-1] == 0
    count_m = BENCH.motor_resolution_m
    x = np.linspace(-0.29, 0.29, 3001)
    correction = rendered.table.correction_ct(x / count_m) * count_m
    left = found.at(x) + correction
    assert np.max(np.abs(left - left.mean())) < 0.1e-6
    assert rendered.quantisation_um <= 0.5 / 16.0 + 1e-9


def test_one_direction_is_not_enough() -> None:
    run = slow_run()
    half = run.slice(0, run.n // 2)
    with pytest.raises(NotIdentifiable, match="both directions"):
        lead_map([half], None)


def test_motor_only_bench_has_no_lead_map() -> None:
    run = slow_run()
    bare = Capture(run.time_s, run.commanded_position_m, run.motor_position_m)
    with pytest.raises(NotIdentifiable, match="no table position"):
        lead_map([bare], None)


@pytest.mark.parametrize("name", ["paper", "paper_x4"])
def test_knots_follow_the_wobble_and_fit_the_table(name: str) -> None:
    bench = load_bench(name)
    spacing = lead_spacing_m(bench)
    assert spacing == pytest.approx(bench.pitch_m / 20.0)
    assert spacing / bench.motor_resolution_m == pytest.approx(
        round(spacing / bench.motor_resolution_m)
    )
    far = bench.travel.model_copy(update={"min_mm": -3000.0, "max_mm": 3000.0})
    long = bench.model_copy(update={"travel": far})
    assert 6.0 / lead_spacing_m(long) < 4000


TURN_m = 10e-3
KNOTS = 0.5e-3 * np.arange(600)


def wave_m(order: float, amplitude_m: float) -> np.ndarray:
    return np.asarray(amplitude_m * np.sin(2.0 * np.pi * order * KNOTS / TURN_m + 0.3))


@pytest.mark.parametrize("order", [1.0, 2.0])
def test_a_wobble_of_low_order_is_the_screws(order: float) -> None:
    wobble = wave_m(order, 3e-6) + 1e-4 * KNOTS
    assert np.max(np.abs(_smooth(wobble, 20.0) - wobble)) < 0.01e-6


def test_a_wobble_of_high_order_is_the_screws_where_it_stands_out() -> None:
    wobble = wave_m(5.0, 1e-6)
    assert np.max(np.abs(_smooth(wobble, 20.0) - wobble)) < 0.02e-6


@pytest.mark.parametrize("ripple", [0.2e-6 * (-1.0) ** np.arange(600), wave_m(6.0, 0.1e-6)])
def test_what_is_small_and_quick_along_the_screw_is_no_lead(ripple: np.ndarray) -> None:
    wobble = wave_m(1.0, 3e-6)
    assert np.max(np.abs(_smooth(wobble + ripple, 20.0) - wobble)[30:-30]) < 0.01e-6


def test_a_table_does_not_ring_the_first_mode_by_its_noise() -> None:
    # At 280 mm/s what has five waves to the turn passes at 140 Hz.
    noise = 20e-9 * np.random.default_rng(1).standard_normal(600)
    left = np.abs(np.fft.rfft(_smooth(wave_m(1.0, 3e-6) + noise, 20.0) * np.hanning(600)))
    per_turn = np.fft.rfftfreq(600, 0.5e-3) * TURN_m
    given = np.abs(np.fft.rfft(noise * np.hanning(600)))
    high = per_turn > 4.5
    assert np.max(left[high]) < 0.02 * np.max(given[high])


@pytest.mark.parametrize("n", [9, 30, 60, 61, 62])
def test_a_map_of_few_turns_is_smoothed_too(n: int) -> None:
    slope, ripple = 1e-4 * KNOTS[:n], 0.2e-6 * (-1.0) ** np.arange(n)
    assert np.max(np.abs(_smooth(slope, 20.0) - slope)) < 1e-12
    left = _smooth(slope + ripple, 20.0) - slope
    assert np.max(np.abs(left[2:-2])) < 0.08e-6


def test_knots_that_are_few_to_the_turn_still_follow_its_wobble() -> None:
    wobble = 3e-6 * np.sin(2.0 * np.pi * np.arange(600) / 6.0)
    assert np.max(np.abs(_smooth(wobble, 6.0) - wobble)) < 0.03e-6


def test_rounding_of_a_coarse_scale_is_no_backlash() -> None:
    # 1 um of scale and 0.6 um of encoder: single knots differ by up to a um between directions.
    position = np.concatenate([np.linspace(-0.15, 0.15, 10_000), np.linspace(0.15, -0.15, 10_000)])
    speed = np.where(np.arange(position.size) < 10_000, 1.0, -1.0)
    motor = np.round(position / 0.61e-6) * 0.61e-6
    table = np.round((position + 0.4e-6 * np.sign(speed)) / 1e-6) * 1e-6
    run = Capture(
        time_s=5e-4 * np.arange(position.size),
        commanded_position_m=position,
        motor_position_m=motor,
        table_position_m=table,
    )
    found = lead_map([run], None, spacing_m=0.25e-3)
    inside = slice(20, -20)
    assert np.max(np.abs(found.reversal_m[inside] - 0.8e-6)) < 0.3e-6
