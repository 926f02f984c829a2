"""Motions: specifications, limits, and PVT programs that draw what was meant."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest

from pmac_comp.base.errors import ConfigError, SafetyRefusal
from pmac_comp.files.bench import load_bench
from pmac_comp.physics.signals.trajectory import Trajectory, trapezoid
from pmac_comp.workflow.motion.campaigns import (
    calibration_motions,
    lead_motions,
    positioning_motion,
    ringing_motion,
    verification_motions,
)
from pmac_comp.workflow.motion.motions import (
    Motion,
    check_motion,
    parse_motion,
    relaxing,
    short_motion,
)
from pmac_comp.workflow.motion.pvt import pvt_program

BENCH = load_bench("paper")


def drawn(lines: tuple[str, ...], start_ct: float, period_s: float) -> tuple[np.ndarray, float]:
    """Position at each servo cycle that a card draws from PVT lines, and the total time."""
    time_s, here, speed = 0.0, start_ct, 0.0
    points: list[np.ndarray] = []
    done = 0
    step_s = 0.0
    for line in lines:
        if line.startswith("PVT"):
            step_s = float(line[3:]) / 1e3
        elif line.startswith("X"):
            target, end = (float(part) for part in line[1:].split(":"))
            n = math.ceil((time_s + step_s) / period_s - 1e-6) - done
            u = (np.arange(n) * period_s + done * period_s - time_s) / step_s
            points.append(
                (2 * u**3 - 3 * u**2 + 1) * here
                + (u**3 - 2 * u**2 + u) * speed * step_s
                + (3 * u**2 - 2 * u**3) * target
                + (u**3 - u**2) * end * step_s
            )
            done += n
            time_s += step_s
            here, speed = target, end
    return np.concatenate(points), time_s


@pytest.mark.parametrize(
    "motion",
    [*calibration_motions(BENCH)[:4], *verification_motions(BENCH, 5)],
    ids=lambda m: m.name,
)
def test_program_draws_the_trajectory(motion: Motion) -> None:
    program = pvt_program(motion, BENCH)
    got, total_s = drawn(program.lines, program.start_ct, BENCH.servo_period_s)
    want = motion.position_m / BENCH.motor_resolution_m
    assert total_s == pytest.approx(motion.duration_s, abs=1e-6)
    n = min(got.size, want.size)
    # Counts of 1 um: the stated departure, the decimals, and times rounded to a nanosecond.
    assert np.max(np.abs(got[:n] - want[:n])) < program.shape_error_m / 1e-6 + 0.06
    assert program.shape_error_m < 0.3e-6


@pytest.mark.parametrize(
    "motion",
    [
        *(m for m in verification_motions(BENCH, 5) if m.name.startswith("move")),
        ringing_motion(BENCH),
    ],
    ids=lambda m: m.name,
)
def test_steps_of_jerk_and_acceleration_are_ends_of_segments(motion: Motion) -> None:
    # Between two samples as well: a cubic across a corner overshoots what it should reach.
    program = pvt_program(motion, BENCH)
    assert program.shape_error_m < 1e-9
    assert len(program.segments) <= 20
    got, _ = drawn(program.lines, program.start_ct, BENCH.servo_period_s)
    scale = BENCH.motor_resolution_m / BENCH.servo_period_s**2
    acceleration = np.diff(got, 2) * scale
    largest = np.max(np.abs(motion.trajectory.acceleration_m_per_s2))
    assert np.max(np.abs(acceleration)) < 1.001 * largest + 0.01
    speed = np.diff(got)
    before_rest = np.flatnonzero(np.abs(speed) > 1e-6)[-1]
    assert acceleration[before_rest - 2] * speed[before_rest] < 0.0  # it brakes to the end


def segment_cycles(lines: Sequence[str]) -> list[float]:
    """Servo cycles of each segment of a program."""
    cycles, found = 0.0, []
    for line in lines:
        if line.startswith("PVT"):
            cycles = float(line[3:]) / 1e3 / BENCH.servo_period_s
        elif line.startswith("X"):
            found.append(cycles)
    return found


@pytest.mark.parametrize("plateau_ms", [0.1, 0.4, 1.0, 2.0, 3.0, 3.3, 4.0, 5.0])
def test_a_short_plateau_of_the_acceleration_makes_it_step_nowhere(plateau_ms: float) -> None:
    # Its corners are too close for segments of the usual length. Once the acceleration stepped by
    # a tenth within a cycle, the law's followed that too late, and the motor was off by 12 um.
    motion = trapezoid(
        period_s=BENCH.servo_period_s,
        distance_m=0.09,
        speed_m_per_s=5.0 * (15.0 + plateau_ms) * 1e-3,
        acceleration_m_per_s2=5.0,
        s_curve_s=0.015,
    )
    program = pvt_program(Motion("move", motion), BENCH)
    got, _ = drawn(program.lines, program.start_ct, BENCH.servo_period_s)
    period_s = BENCH.servo_period_s
    jerk = np.diff(got, 3) * BENCH.motor_resolution_m / period_s**3
    # Counts of 1 um are listed with four decimals: 0.1 nm are up to 5 m/s3.
    assert np.max(np.abs(jerk)) < 1.45 * 5.0 / 0.015
    assert program.shape_error_m < 0.5e-6


@pytest.mark.parametrize("s_curve_s", [0.0, 0.003, 0.005, 0.006, 0.015, 0.04])
@pytest.mark.parametrize("distance_m", [2e-5, 1e-3, 0.05])
def test_no_segment_is_too_short_for_the_card(s_curve_s: float, distance_m: float) -> None:
    trajectory = trapezoid(
        period_s=BENCH.servo_period_s,
        distance_m=distance_m,
        speed_m_per_s=0.3,
        acceleration_m_per_s2=4.3,
        s_curve_s=s_curve_s,
        dwell_s=0.1,
    )
    program = pvt_program(Motion("move", trajectory), BENCH)
    times = segment_cycles(program.lines)
    assert min(times) > 6.99
    assert all(max(pair) > 10.99 for pair in pairwise(times))  # none of two in a row
    _, total_s = drawn(program.lines, program.start_ct, BENCH.servo_period_s)
    assert total_s == pytest.approx(trajectory.time_s[-1] - trajectory.time_s[0], abs=1e-6)
    if s_curve_s >= 0.005 and distance_m == 0.05:
        assert program.shape_error_m < 1e-9


def test_two_samples_are_a_motion_too() -> None:
    time_s = np.linspace(0.0, BENCH.servo_period_s, 2)
    program = pvt_program(Motion("step", Trajectory(time_s, np.zeros(2))), BENCH)
    assert len(program.segments) == 1


def test_a_trajectory_that_scatters_has_no_corners() -> None:
    time_s = np.linspace(0.0, 0.4, 905)
    noise_m = np.random.default_rng(1).normal(0.0, 1e-8, time_s.size)
    trajectory = Trajectory(time_s, 0.01 * np.cos(5.0 * np.pi * time_s) + noise_m)
    program = pvt_program(Motion("noisy", trajectory), BENCH)
    assert all(line.startswith(("ABS", "PVT", "X")) for line in program.lines)
    assert program.shape_error_m < 0.2e-6


def test_no_line_is_longer_than_the_card_takes() -> None:
    for motion in verification_motions(BENCH, 2):
        assert max(map(len, pvt_program(motion, BENCH).lines)) < 80


def test_verification_motions_follow_the_seed_and_stay_within_limits() -> None:
    for seed in range(20):
        for motion in verification_motions(BENCH, seed):
            check_motion(motion, BENCH)
    first = [m.name for m in verification_motions(BENCH, 1)]
    assert first == [m.name for m in verification_motions(BENCH, 1)]
    assert first != [m.name for m in verification_motions(BENCH, 2)]


@pytest.mark.parametrize("seed", range(30))
def test_no_campaign_is_refused_on_a_bench_of_any_travel_and_limits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    half_mm, speed, acceleration = np.exp(rng.uniform(np.log([8, 5, 0.1]), np.log([2e3, 3e3, 30])))
    middle_mm = float(rng.uniform(-1, 1)) * half_mm
    limits = {"max_speed_mm_per_s": speed, "max_acceleration_m_per_s2": acceleration}
    travel = {"min_mm": middle_mm - half_mm, "max_mm": middle_mm + half_mm}
    bench = BENCH.model_copy(
        update={
            "travel": BENCH.travel.model_copy(update=travel),
            "safety": BENCH.safety.model_copy(update=limits),
        }
    )
    for motion in [
        *calibration_motions(bench),
        *lead_motions(bench),
        *verification_motions(bench, seed, n_sine=6),
        positioning_motion(bench),
        ringing_motion(bench),
    ]:
        check_motion(motion, bench)


def test_campaigns_fit_every_bundled_bench() -> None:
    for name in ("paper", "paper_x4", "emps"):
        bench = load_bench(name)
        for motion in [*calibration_motions(bench), *lead_motions(bench)]:
            check_motion(motion, bench)


def test_micrometres_beyond_the_travel_are_told_as_such() -> None:
    """It was told that a motion to 300.0 mm leaves a travel to 300 mm: a correction did that."""
    at_end = parse_motion("sine:amplitude_mm=50,frequency_Hz=0.5,centre_mm=250", BENCH)
    shifted = Trajectory(at_end.trajectory.time_s, at_end.position_m + 4e-6)
    with pytest.raises(SafetyRefusal) as refused:
        check_motion(Motion("at the end", shifted), BENCH)
    assert "to 300.0 mm, 0.004 mm beyond the travel of -300 to 300 mm" in str(refused.value)


def test_motion_outside_travel_and_limits_is_refused_with_all_reasons() -> None:
    with pytest.raises(SafetyRefusal) as caught:
        parse_motion("sine:amplitude_mm=280,frequency_Hz=2,centre_mm=100", BENCH)
    assert len(caught.value.refusals) == 3
    assert "travel" in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "sine",
        "triangle",
        "trapezoid:speed_mm_per_s=100",
        "trapezoid:speed_mm_per_s=100,distance_mm=-30",
    ],
)
@pytest.mark.parametrize("name", ["paper", "emps"])
def test_a_motion_without_a_place_lies_about_the_middle_of_the_travel(name: str, text: str) -> None:
    bench = load_bench(name)
    position_m = parse_motion(text, bench).position_m
    middle_m = 0.5 * (position_m.min() + position_m.max())
    assert middle_m == pytest.approx(bench.mid_travel_m, abs=1e-5)


def test_a_place_that_is_given_is_taken() -> None:
    bench = load_bench("emps")
    assert parse_motion("triangle:centre_mm=30", bench).position_m.min() == pytest.approx(0.020)
    assert parse_motion("sine:centre_mm=20", bench).position_m[0] == pytest.approx(0.020)


@pytest.mark.parametrize(
    ("text", "said", "known"),
    [
        ("wiggle:amplitude_mm=1", "not a kind", "sine, trapezoid, triangle"),
        ("sine:amplitude=1", "no amplitude", "amplitude_mm, frequency_Hz, cycles, centre_mm"),
        ("trapezoid:length_mm=3", "no length_mm", "distance_mm"),
        ("sine:amplitude_mm=much", "key=number", "amplitude_mm=10"),
    ],
)
def test_bad_specification_is_told_with_what_is_known(text: str, said: str, known: str) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        parse_motion(text, BENCH)
    assert known in caught.value.hint


def test_relaxing_wiggle_fades_and_ends_where_the_motion_starts() -> None:
    motion = calibration_motions(BENCH)[1]
    whole, first = relaxing(motion)
    assert np.array_equal(whole.position_m[first:], motion.position_m)
    before = whole.position_m[:first] - motion.position_m[0]
    assert 50e-6 < np.max(np.abs(before)) < 150e-6
    assert np.max(np.abs(before[-400:])) < 5e-6
    check_motion(whole, BENCH)


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "fast", ""])
def test_a_key_wants_a_finite_number(value: str) -> None:
    with pytest.raises(ConfigError, match="is not key=number") as refused:
        parse_motion(f"sine:amplitude_mm=10,frequency_Hz={value}", load_bench("paper"))
    assert refused.value.code == "PC-MOV-005"


@pytest.mark.parametrize(
    ("name", "short"),
    [
        ("sine:amplitude_mm=10,frequency_Hz=0.5", "sine 10 mm, 0.5 Hz"),
        (
            "trapezoid:distance_mm=50,speed_mm_per_s=100,acceleration_m_per_s2=1,s_curve_ms=15",
            "trapezoid 50 mm, 100 mm/s, 1 m/s2, s curve 15 ms",
        ),
        ("sine:amplitude_mm=10,cycles=3", "sine 10 mm, cycles 3"),
        ("sine 10 mm 2 Hz", "sine 10 mm 2 Hz"),
        ("of a file:x=3", "of a file:x=3"),
    ],
)
def test_a_motion_has_a_short_name_for_figures(name: str, short: str) -> None:
    assert short_motion(name) == short
