"""Bench files: bundled ones load, bad ones say which key."""

import math

import pytest

from pmac_comp.base.errors import ConfigError
from pmac_comp.files.bench import bundled_benches, load_bench, parse_bench
from pmac_comp.files.kinds import kind_to_keep
from pmac_comp.files.resources import data_folder
from pmac_comp.workflow.bench.remarks import remarks


@pytest.mark.parametrize("name", bundled_benches())
def test_every_bundled_bench_loads(name):
    bench = load_bench(name)
    assert bench.servo_period_s > 0.0
    assert bench.travel.min_mm < bench.mid_travel_m * 1e3 < bench.travel.max_mm


def test_a_byte_order_mark_is_no_statement(tmp_path):
    file = tmp_path / "bench.toml"
    file.write_text(load_bench("paper").text, encoding="utf-8-sig")
    assert load_bench(str(file)) == load_bench("paper")
    file.write_text("config_version = 1\n", encoding="utf-8-sig")
    assert kind_to_keep(file) == "bench file"


def test_the_servo_period_follows_from_the_clock_not_from_2262_Hz():
    bench = load_bench("paper")
    i = bench.controller.ivariables
    # Software Reference Manual p. 42 and I7m00-I7m02: I10 = (640/9)(2 I7000+3)(I7001+1)(I7002+1)
    i10 = 640 / 9 * (2 * i["I7000"] + 3) * (i["I7001"] + 1) * (i["I7002"] + 1)
    assert i["I10"] == pytest.approx(i10, abs=1.0)
    assert bench.servo_period_s == pytest.approx(441.996e-6, rel=1e-5)


@pytest.mark.parametrize("name", ["paper", "paper_x4"])
def test_the_gains_are_those_of_the_28_7_Hz_loop(name):
    """PID law of the manual (4.5 of the fact sheet) turned back into N m per rad."""
    bench = load_bench(name)
    i = bench.controller.ivariables
    dac, period_s = bench.drive.torque_per_dac_Nm, bench.servo_period_s
    per_rad = bench.encoder.counts_per_rev / (2.0 * math.pi)
    proportional = i["I130"] * 96 / 2**19 * dac * per_rad
    derivative = i["I130"] * 96 * i["I131"] / 2**26 * dac * per_rad * period_s
    integral = i["I130"] * 96 * i["I133"] / 2**42 * dac * per_rad / period_s
    acceleration = i["I130"] * 96 * i["I135"] / 2**26 * dac * per_rad * period_s**2
    assert proportional == pytest.approx(23.7, rel=1e-3)
    assert derivative == pytest.approx(0.227, rel=1e-3)
    assert integral == pytest.approx(298.0, rel=1e-3)
    assert acceleration == pytest.approx(1.112e-3, rel=1e-3)


def test_rigidity_of_the_screw_follows_from_its_core():
    bench = load_bench("paper")
    assert bench.torsional_rigidity_Nm2 == pytest.approx(1826.0, rel=1e-3)
    text = bench.text.replace("screw_rigidity_N = 7.83e7\n", "")
    assert parse_bench(text).screw_rigidity_N == pytest.approx(7.83e7, rel=1e-3)


def _changed(old: str, new: str) -> str:
    text = (data_folder("configs") / "paper.toml").read_text()
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("pitch_mm", "pich_mm", "nearest known key is 'pitch_mm'"),
        ("[scale]", "[scala]", "nearest known key is 'scale'"),
        ("resolution_um = 0.125", "resolution_um = nan", "scale.resolution_um"),
        ("resolution_um = 0.125", 'resolution_um = "fine"', "scale.resolution_um"),
        ("min_mm = -300.0", "min_mm = 300.0", "max_mm must be above min_mm"),
        ("I130 =", "Ixx30 =", "is not an I-variable"),
        ("config_version = 1", "config_version = 2", "config_version"),
        ("[screw]", "[screw", "not valid TOML"),
        ('kind = "pmac"', 'kind = "si"', "needs the table"),
    ],
)
def test_a_wrong_key_or_value_is_named(old, new, expected):
    with pytest.raises(ConfigError) as caught:
        parse_bench(_changed(old, new))
    assert expected in str(caught.value)


def test_a_missing_file_names_the_bundled_benches():
    with pytest.raises(ConfigError, match="paper"):
        load_bench("no_such_bench")


def test_a_screw_whose_bearing_is_not_placed_has_the_travel_in_its_middle() -> None:
    # A nut on the bearing itself would leave half of the travel on the wrong side of it.
    text = load_bench("paper").text.replace("bearing_to_table_zero_mm = 450.0", "#")
    bench = parse_bench(text.replace("min_mm = -300.0", "min_mm = -100.0"))
    assert bench.screw_position_m(0.0) == pytest.approx(0.4)
    assert bench.screw_position_m(bench.mid_travel_m) == pytest.approx(0.5)


def test_what_does_not_fit_together_is_said_without_the_whole_table():
    text = load_bench("paper").text.replace("I131 = 2774", "I9999 = 2774")
    with pytest.raises(ConfigError) as caught:
        parse_bench(text, name="b.toml")
    assert caught.value.message == (
        "b.toml has a problem:\n"
        "  - 'controller': 'I9999' in [controller.ivariables] is not an I-variable"
    )


def test_a_missing_file_is_said_in_words(tmp_path):
    with pytest.raises(ConfigError, match=r"There is no bench file .*b\.toml"):
        load_bench(tmp_path / "b.toml")


def test_a_bench_with_its_clock_needs_no_rounded_servo_period() -> None:
    whole = load_bench("paper")
    text = whole.text.replace("servo_period_us = 442.0\n", "")
    assert text != whole.text
    bench = parse_bench(text)
    assert bench.controller.servo_period_us is None
    assert bench.servo_period_s == whole.servo_period_s
    assert remarks(bench) == remarks(whole)
    with pytest.raises(ConfigError, match="servo_period_us is missing, and no I10"):
        parse_bench(text.replace("I10 = 3707733\n", ""))
