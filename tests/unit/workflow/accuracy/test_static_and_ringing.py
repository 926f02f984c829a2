"""Positioning after ISO 230-2 and ringing, from runs whose figures are known beforehand."""

from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.base.errors import CaptureError
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.report.verification import headline
from pmac_comp.workflow.accuracy.positioning_sheet import by_target, run_scheme, sheet_rows
from pmac_comp.workflow.accuracy.ringing import ringing_of
from pmac_comp.workflow.accuracy.static_check import (
    Approaches,
    StaticOutcome,
    approaches,
    is_static,
)
from pmac_comp.workflow.motion.campaigns import positioning_motion, ringing_motion
from pmac_comp.workflow.motion.motions import Motion, check_motion, parse_motion
from pmac_comp.workflow.motion.pvt import pvt_program
from pmac_comp.workflow.verification.result import Verification, static_remarks

BENCH = load_bench("paper")
STAIRS = positioning_motion(BENCH)


def run_of(motion: Motion, error_m: np.ndarray, **attributes: str) -> Capture:
    r = motion.position_m
    return Capture(
        time_s=np.arange(r.size) * BENCH.servo_period_s,
        commanded_position_m=r.copy(),
        motor_position_m=r.copy(),
        table_position_m=r + error_m,
        attributes={"motion": motion.name, **attributes},
    )


def staircase_run(offset_um: float, reversal_um: float, slope_um_per_m: float) -> Capture:
    """Table with a lead slope, half a reversal value on each side and an offset of the run."""
    r = STAIRS.position_m
    step = np.diff(r, prepend=r[0])
    side = np.where(np.abs(step) > 1e-9, np.sign(step), 0.0)
    last = np.maximum.accumulate(np.where(side != 0.0, np.arange(r.size), 0))
    error_um = slope_um_per_m * r + 0.5 * reversal_um * side[last] + offset_um
    return run_of(STAIRS, 1e-6 * error_um)


def test_the_motion_meets_the_standard_and_the_travel() -> None:
    check_motion(STAIRS, BENCH)
    found = approaches([staircase_run(0.0, 0.0, 0.0)] * 2)
    assert found.target_m.size == 7
    # Targets meet the pitch at different phases (clause 5.3.1).
    phase = np.mod(found.target_m, BENCH.pitch_m) / BENCH.pitch_m
    assert np.min(np.diff(np.sort(phase))) > 0.02
    assert pvt_program(STAIRS, BENCH).shape_error_m < 0.05e-6


def test_figures_are_those_that_were_put_in() -> None:
    offsets = [100.0, 100.5, 99.5]
    runs = [staircase_run(offset, 3.0, 20.0) for offset in offsets]
    figures = approaches(runs).figures()
    span_um = 20.0 * float(np.ptp(approaches(runs).target_m))
    assert figures.reversal_value_m * 1e6 == pytest.approx(3.0, abs=1e-3)
    assert figures.mean_bidirectional_m * 1e6 == pytest.approx(span_um, abs=1e-3)
    assert figures.systematic_m * 1e6 == pytest.approx(span_um + 3.0, abs=1e-3)
    # s = 0.5 um in each direction: R = 2 s + 2 s + |B|, A = E + 4 s.
    assert figures.repeatability_m * 1e6 == pytest.approx(4 * 0.5 + 3.0, abs=1e-3)
    assert figures.accuracy_m * 1e6 == pytest.approx(span_um + 3.0 + 4 * 0.5, abs=1e-3)


def test_before_and_after_side_by_side() -> None:
    sides = [approaches([staircase_run(o, b, 20.0) for o in (0.0, 0.1)]) for b in (3.0, 0.5)]
    found = StaticOutcome(sides[0], sides[1])
    rows = {name: (before, after) for name, before, after in found.rows()}
    assert rows["reversal value B"] == pytest.approx((3.0, 0.5), abs=1e-3)
    result = found.as_result()
    assert result["after"]["reversal_B_um"] == pytest.approx(0.5, abs=1e-3)
    assert result["before"]["runs"] == 2
    assert any("wants 5 runs" in line for line in found.lines())
    assert is_static(staircase_run(0.0, 0.0, 0.0))


def test_the_sheet_has_each_way_alone_and_the_run_scheme() -> None:
    offsets = (100.0, 100.5, 99.5)
    runs = [staircase_run(offset, 3.0, 20.0) for offset in offsets]
    told = [run.with_attributes(start_utc=f"2026-03-01T10:0{i}:00") for i, run in enumerate(runs)]
    found = StaticOutcome(approaches(runs), None, tuple(told))
    rows = {name: (before, after) for name, before, after in sheet_rows(found)}
    assert next(iter(rows)) == "accuracy A"
    span_um = 20.0 * float(np.ptp(approaches(runs).target_m))
    # s = 0.5 um in each direction: R = 4 s, A = E + 4 s; the reversal is in neither.
    for way in "↑↓":
        assert rows[f"systematic deviation E {way}"] == (pytest.approx(span_um, abs=1e-3), None)
        assert rows[f"repeatability R {way}"][0] == pytest.approx(2.0, abs=1e-3)
        assert rows[f"accuracy A {way}"][0] == pytest.approx(span_um + 2.0, abs=1e-3)
    first = by_target(approaches(runs))[0]
    assert first.figures_um[1::2][:2] == pytest.approx((0.5, 0.5), abs=1e-3)
    assert first.figures_um[4] == pytest.approx(3.0, abs=1e-3)
    scheme = dict(run_scheme(found))
    assert scheme["targets"].startswith("7, from -275.000")
    assert scheme["approaches of a target from each side"] == "3 before; the standard wants 5"
    assert scheme["overrun beyond the first and last target"] == "12.0 mm"
    assert scheme["speed between targets, at most"] == "300 mm/s"
    assert scheme["rest at a target"].startswith("0.40 s")
    assert "2026-03-01 10:00:00 and 2026-03-01 10:02:00 UTC" in scheme.values()
    result = found.as_result()["before"]
    assert result["one_way_um"]["up"]["repeatability_R"] == pytest.approx(2.0, abs=1e-3)
    assert np.shape(result["deviation_down_um"]) == (3, 7)


def test_the_report_begins_with_the_accuracy() -> None:
    sides = [approaches([staircase_run(o, b, 0.0) for o in (0.0, 0.0)]) for b in (3.0, 0.5)]
    shown = headline(Verification((), 0.0, simulated=True, static=StaticOutcome(*sides)))
    assert shown == [("3.0 → 0.5 um", "accuracy A by ISO 230-2")]


def test_what_the_motor_leaves_at_rest_is_told_from_the_mechanics() -> None:
    rng = np.random.default_rng(3)
    r = STAIRS.position_m
    still = np.abs(np.diff(r, prepend=r[0])) < 1e-10
    rest = np.cumsum(np.diff(still.astype(int), prepend=0) == 1)
    runs = []
    for _ in range(4):
        stop_m = 2e-6 * rng.standard_normal(int(rest[-1]) + 1)[rest]
        run = staircase_run(0.0, 0.4, 0.0)
        table = np.asarray(run.table_position_m) + stop_m
        runs.append(replace(run, motor_position_m=r + stop_m, table_position_m=table))
    side = approaches(runs)
    assert side.of_mechanics().repeatability_m * 1e6 == pytest.approx(0.4, abs=1e-3)
    assert side.of_mechanics().mean_reversal_m * 1e6 == pytest.approx(0.4, abs=1e-3)
    assert side.of_motor().repeatability_m > 4e-6
    found = StaticOutcome(side, side)
    names = [name for name, _, _ in found.rows()]
    assert "repeatability: mechanical" in names
    (said,) = static_remarks(found)
    assert "stops within its friction" in said
    clean = approaches([staircase_run(offset, 0.4, 0.0) for offset in (0.0, 0.3)])
    assert static_remarks(StaticOutcome(clean, clean)) == ()


def stops(servo_um: float, mechanical_um: float) -> Approaches:
    """Two runs over three targets whose stops from both sides lie so far apart."""
    own, whole = (np.full((2, 3), 0.5e-6 * d) for d in (servo_um, servo_um + mechanical_um))
    return Approaches(np.array([-0.1, 0.0, 0.1]), whole, -whole, own, -own)


@pytest.mark.parametrize(
    ("before", "after", "said", "unsaid"),
    [
        ((4.0, -3.5), (4.2, -0.2), "had cancelled the wind-up", "begins the next motion"),
        ((6.5, -2.0), (-22.2, -0.7), "22.20 um apart, 6.50 before", "wind-up"),
    ],
)
def test_a_reversal_value_that_grows_is_put_down_to_what_made_it_grow(before, after, said, unsaid):
    told = " ".join(static_remarks(StaticOutcome(stops(*before), stops(*after))))
    assert said in told
    assert unsaid not in told
    # What the law sends is no matter of the servo's gains.
    assert ("servo's gains" in told) is ("wind-up" in said)


def test_runs_without_targets_from_both_sides_are_refused() -> None:
    one_way = parse_motion("trapezoid:distance_mm=50", BENCH)
    with pytest.raises(CaptureError, match="both sides"):
        approaches([run_of(one_way, np.zeros(one_way.position_m.size))] * 2)
    bare = staircase_run(0.0, 0.0, 0.0)
    with pytest.raises(CaptureError, match="no table position"):
        approaches([Capture(bare.time_s, bare.commanded_position_m, bare.motor_position_m)] * 2)


def rings(amplitude_um: float, seed: int) -> Capture:
    """A decaying 130 Hz wave from every corner of the speed, and slow errors that do not ring."""
    motion = ringing_motion(BENCH)
    r, period = motion.position_m, BENCH.servo_period_s
    t = np.arange(r.size) * period
    acceleration = np.gradient(np.gradient(r, period), period)
    corners = np.flatnonzero(np.abs(np.diff(acceleration)) > 1.0)
    error = 5.0 * np.sin(2 * np.pi * 2.0 * t) + 0.02 * np.random.default_rng(seed).normal(
        size=t.size
    )
    starts = [c for k, c in enumerate(corners) if k == 0 or c - corners[k - 1] > 50]
    for c in starts:
        after = np.clip(t - t[c], 0.0, None)
        error += amplitude_um * np.exp(-after / 0.05) * np.sin(2 * np.pi * 130.0 * after)
    return run_of(motion, 1e-6 * error)


def test_ringing_is_measured_apart_from_slow_errors() -> None:
    found = ringing_of([rings(2.0, 1), rings(2.0, 2)], [rings(1.0, 3), rings(1.0, 4)], 130.6)
    assert found.frequency_Hz == pytest.approx(130.0, abs=8.0)
    # Rms over 0.12 s of a wave that decays with 50 ms: about 0.45 of the amplitude.
    assert found.before.value == pytest.approx(0.9, rel=0.15)
    assert found.after.value / found.before.value == pytest.approx(0.5, rel=0.05)
    assert found.says == "compensation lowers it"
    same = ringing_of([rings(2.0, 1)], [rings(2.0, 5)], None)
    assert "no difference beyond the intervals" in same.says
    assert set(found.as_result()) == {"frequency_Hz", "before_um", "after_um", "says"}
