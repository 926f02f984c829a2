"""Captures that do not belong to the bench, or not together, are refused before any computing."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.base.errors import CaptureError, ConfigError
from pmac_comp.files.bench import Travel, load_bench, parse_bench
from pmac_comp.files.capture import Capture, write_capture
from pmac_comp.files.model_file import ModelFile, written_for
from pmac_comp.workflow.bench.same_axis import (
    captures_of,
    check_channels,
    check_no_copies,
    check_not_twice,
    check_one_motion,
    check_same_axis,
    check_same_drive,
    check_same_loop,
    check_scales,
)

BENCH = load_bench("paper")


def capture(text: str = "") -> Capture:
    time = BENCH.servo_period_s * np.arange(100)
    attributes = {"bench_text": text} if text else {}
    return Capture(
        time, np.zeros(100), np.zeros(100), table_position_m=np.zeros(100), attributes=attributes
    )


def test_a_capture_of_this_axis_and_one_without_a_text_pass():
    check_same_axis(capture(BENCH.text), BENCH, "a.h5")
    check_same_axis(capture(), BENCH, "a.h5")
    check_same_axis(capture("no bench file"), BENCH, "a.h5")


def test_refined_inertias_and_stiffnesses_are_no_other_axis():
    text = BENCH.text.replace("table_mass_kg = 122.86", "table_mass_kg = 130.0")
    assert text != BENCH.text
    check_same_axis(capture(text), BENCH, "a.h5")


def test_another_encoder_is_named_with_both_values():
    with pytest.raises(ConfigError, match=r"encoder\.counts_per_rev 40000 .* 10000") as caught:
        check_same_axis(capture(load_bench("paper_x4").text), BENCH, "a.h5")
    assert "pmac-comp convert a.h5" in str(caught.value.hint)


@pytest.mark.parametrize(("table", "number"), [("encoder", 1), ("scale", 2)])
def test_another_motor_of_like_hardware_is_another_axis(table, number):
    """The lead error of axis 1 went into the compensation of axis 2, of the same make."""
    head, tail = BENCH.text.split(f"[{table}]")
    line = f"motor_number = {number}"
    assert line in tail
    text = f"{head}[{table}]{tail.replace(line, 'motor_number = 7', 1)}"
    with pytest.raises(ConfigError, match=rf"{table}\.motor_number 7 in the capture, {number} in"):
        check_same_axis(capture(text), BENCH, "a.h5")


def test_other_gains_are_refused_where_the_loop_is_simulated():
    text = BENCH.text.replace("I130 = 139449", "I130 = 100000")
    check_same_axis(capture(text), BENCH, "a.h5")
    check_same_loop(capture(BENCH.text), BENCH, "a.h5")
    with pytest.raises(ConfigError, match="I130"):
        check_same_loop(capture(text), BENCH, "a.h5")


def test_files_of_another_axis_are_refused_when_they_are_read(tmp_path):
    write_capture(tmp_path / "a.h5", capture(load_bench("paper_x4").text))
    write_capture(tmp_path / "b.h5", capture(BENCH.text))
    assert len(captures_of([tmp_path / "b.h5"], BENCH)) == 1
    with pytest.raises(ConfigError, match=r"a\.h5 was captured on another axis"):
        captures_of([tmp_path / "b.h5", tmp_path / "a.h5"], BENCH)


def moving(stroke_m: float, centre_m: float, n: int = 1000) -> Capture:
    time = BENCH.servo_period_s * np.arange(n)
    r = centre_m + 0.5 * stroke_m * np.sin(2 * np.pi * 5.0 * time)
    return Capture(time, r, r)


@pytest.mark.parametrize(
    "other", [moving(0.03, 0.1), moving(0.02, 0.13), moving(0.02, 0.1, 800), moving(0.0, 0.1)]
)
def test_runs_of_two_motions_are_not_compared(other):
    first = moving(0.02, 0.1)
    check_one_motion("run 1", [first, moving(0.02, 0.1), first.slice(2, 990)])
    with pytest.raises(ConfigError, match=r"90\.0 to 110\.0 mm"):
        check_one_motion("run 1", [first, other])


def test_a_table_channel_missing_in_some_captures_is_refused_and_in_all_said():
    whole = capture()
    blind = replace(whole, table_position_m=None)
    assert check_channels({"a": whole, "b": whole}, BENCH) == ""
    with pytest.raises(CaptureError, match=r"table_position_mm is missing in b\.h5"):
        check_channels({"a.h5": whole, "b.h5": blind}, BENCH)
    assert "only what the motor shows" in check_channels({"a": blind}, BENCH)
    assert check_channels({"a": blind}, load_bench("emps")) == ""


def test_a_capture_cannot_fit_and_judge():
    check_not_twice({"a.h5": "1"}, {"b.h5": "2"})
    with pytest.raises(CaptureError, match=r"copy\.h5 \(a\.h5\)"):
        check_not_twice({"a.h5": "1"}, {"copy.h5": "1"})


@pytest.mark.parametrize("copy", ["a.h5", "copy.h5", "a.csv", "short.csv"])
def test_a_run_counts_once_also_as_a_copy_or_in_another_format(tmp_path, copy):
    """A pair given four times had an interval of half the width."""
    noise = np.random.default_rng(1).normal(0.0, 1e-6, (2, 1000))
    run = moving(0.02, 0.1)
    first, second = (
        replace(run, motor_position_m=run.motor_position_m + n, attributes={"start_utc": start})
        for n, start in zip(noise, ("2026-03-01T10:00:00Z", "2026-03-01T10:01:00Z"), strict=True)
    )
    write_capture(tmp_path / "a.h5", replace(first, table_position_m=first.motor_position_m))
    write_capture(tmp_path / "b.h5", second)
    assert len(captures_of([tmp_path / "a.h5", tmp_path / "b.h5"], BENCH)) == 2
    if copy != "a.h5":
        write_capture(tmp_path / copy, first)
    given = [tmp_path / name for name in ("a.h5", "b.h5", copy)]
    with pytest.raises(ConfigError, match=rf"given twice: \S*{copy} is \S*a\.h5\.") as refused:
        captures_of(given, BENCH)
    assert refused.value.code == "PC-WRK-008"


def test_a_simulated_drive_that_does_the_same_again_is_no_copy():
    run = moving(0.02, 0.1)
    starts = ("2026-03-01T10:00:00Z", "2026-03-01T10:01:00Z")
    again = [replace(run, attributes={"start_utc": start}) for start in starts]
    check_no_copies(["a.h5", "b.h5"], again)
    untold = [replace(run, commanded_position_m=run.commanded_position_m + 0.0) for _ in starts]
    check_no_copies(["a.h5", "b.h5"], untold)
    with pytest.raises(ConfigError, match="given twice"):
        check_no_copies(["a.h5", "a.h5"], untold)


def test_runs_at_rest_are_no_copies_of_each_other():
    check_no_copies(["a.h5", "b.h5"], [capture(), capture()])


def test_a_model_of_another_axis_is_refused_with_both_names_and_values():
    stored = ModelFile(parameters={}, **written_for(load_bench("paper_x4")))
    with pytest.raises(ConfigError, match=r"encoder\.counts_per_rev 40000 .* 10000") as caught:
        check_same_drive(stored, BENCH, "m.json")
    assert BENCH.name in str(caught.value)
    assert load_bench("paper_x4").name in str(caught.value)


def test_a_model_stays_valid_under_other_gains_limits_and_nominal_values():
    stored = ModelFile(parameters={}, **written_for(BENCH))
    text = BENCH.text.replace("I130 = 139449", "I130 = 100000")
    text = text.replace("table_mass_kg = 122.86", "table_mass_kg = 130.0")
    assert text != BENCH.text
    check_same_drive(stored, parse_bench(text), "m.json")


def test_a_clock_that_a_bench_file_rounds_is_the_same_and_another_is_not():
    stored = ModelFile(parameters={}, **written_for(BENCH))
    assert stored.axis is not None
    of_the_clock = float(stored.axis["controller.servo_period_us"])
    for share, is_same in ((1e-5, True), (2e-3, False)):
        axis = stored.axis | {"controller.servo_period_us": (1.0 + share) * of_the_clock}
        other = stored.model_copy(update={"axis": axis})
        with nullcontext() if is_same else pytest.raises(ConfigError, match="servo_period_us"):
            check_same_drive(other, BENCH, "m.json")


def test_a_model_that_does_not_say_where_it_is_from_passes():
    check_same_drive(ModelFile(parameters={}), BENCH, "m.json")


def scaled(time: float, length: float) -> Capture:
    run = moving(0.02, 0.1)
    r = length * run.commanded_position_m
    return Capture(time * run.time_s, r, r)


@pytest.mark.parametrize(
    ("time", "length", "said"),
    [
        (1e3, 1.0, "milliseconds"),
        (1.0, 1e3, "um or counts"),
        (2.5, 1.0, "servo rate"),
    ],
)
def test_a_capture_in_other_units_is_refused_with_the_unit_that_is_meant(time, length, said):
    check_scales(scaled(1.0, 1.0), BENCH, "a.csv")
    with pytest.raises(ConfigError) as caught:
        check_scales(scaled(time, length), BENCH, "a.csv")
    assert said in caught.value.hint


def test_a_travel_far_from_zero_is_no_other_unit():
    bench = BENCH.model_copy(update={"travel": Travel(min_mm=5000.0, max_mm=5300.0)})
    check_scales(moving(0.2, 5.15), bench, "a.csv")
