"""Figures in another unit are remarked on; benches that exist are not."""

import pytest

from pmac_comp.files.bench import load_bench, parse_bench
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.workflow.bench.remarks import implausible, lag_remarks, loop_remarks, remarks
from tests.generators.control_laws import SI, other_law

TEXT = load_bench("paper").text


@pytest.mark.parametrize("name", ["paper", "paper_x4", "emps"])
def test_existing_benches_are_plausible(name):
    assert implausible(load_bench(name)) == []


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("pitch_mm = 10.0", "pitch_mm = 0.010", "no ball screw's"),
        ("counts_per_rev = 10000.0", "counts_per_rev = 1.0", "one encoder count is 1e+04 um"),
        ("resolution_um = 0.125", "resolution_um = 125.0", "no linear scale's"),
        ("root_diameter_mm = 22.0", "root_diameter_mm = 28.0", "larger than diameter_mm"),
        ("stiffness_N_per_um = 97.14", "stiffness_N_per_um = 9.714e-5", "first resonance"),
        ("motor_inertia_kgm2 = 5.45e-4", "motor_inertia_kgm2 = 5.45", "accelerates this axis"),
        ("screw_inertia_kgm2 = 2.557e-4", "screw_inertia_kgm2 = 2.557", "a steel screw of 25 mm"),
        ("screw_rigidity_N = 7.83e7", "screw_rigidity_N = 7.83e4", "a steel screw of 25 mm"),
        ("torque_per_dac_Nm = 5.8319e-4", "torque_per_dac_Nm = 19.11", "torque of one unit"),
        ("torque_limit_Nm = 19.11", "torque_limit_Nm = 19110", "torque_limit_Nm is 19110"),
        ("resolution_um = 0.125", "resolution_um = 0.000125", "no linear scale's"),
        ("max_correction_um = 60.0", "max_correction_um = 60000", "60000 is outside"),
        ("max_correction_um = 60.0", "max_correction_um = 0.06", "0.06 is outside"),
        ("max_enable_step_um = 5.0", "max_enable_step_um = 5000", "0.05 to 500 um"),
        ("max_speed_mm_per_s = 500.0", "max_speed_mm_per_s = 500000", "1 to 5000 mm/s"),
        ("cpu_clock_MHz = 80.0", "cpu_clock_MHz = 80e6", "10 to 1000 MHz"),
        ("actuator_delay_us = 442.0", "actuator_delay_us = 0.442", "5 to 20000 us"),
        ("I130 = 139449", "I130 = 0", "no gain the loop of motor #1"),
        ("p_block = [7000, 7199]", "p_block = [7000, 7100]", "has 101 P-variables"),
        ("cam_motor_number = 8", "cam_motor_number = 1", "is the motor of the axis"),
        ("cam_motor_number = 8", "cam_motor_number = 2", "is the motor of the scale"),
    ],
)
def test_a_value_in_another_unit_is_remarked_on(old, new, said):
    assert old in TEXT
    assert said in " ".join(remarks(parse_bench(TEXT.replace(old, new, 1))))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("screw_rigidity_N = 7.83e7", "screw_rigidity_N = 6.3e7", "(-20 %, its tolerance is 3 %)"),
        ("root_diameter_mm = 22.0", "root_diameter_mm = 20.0", "has 6.47e+07 N (+21 %"),
        ("screw_rigidity_N = 7.83e7", "screw_rigidity_N = 7.7e7", ""),  # 2 %
        ("root_diameter_mm = 22.0\n", "", ""),
        ("screw_rigidity_N = 7.83e7\n", "", ""),
    ],
)
def test_a_rigidity_that_is_not_that_of_the_stated_core_is_remarked_on(old, new, said):
    """Runs then put the right one of both outside its tolerance, and the mass beside it."""
    assert old in TEXT
    told = " ".join(implausible(parse_bench(TEXT.replace(old, new, 1))))
    assert (said in told) if said else (told == "")


def test_a_torque_limit_that_is_not_stated_is_held_against_nothing():
    text = TEXT.replace("torque_limit_Nm = 19.11", "")
    assert text != TEXT
    assert implausible(parse_bench(text)) == []


@pytest.mark.parametrize(
    ("line", "said"), [("", "I8 is not stated"), ("I8 = 3\n", "I8 = 3,"), ("I8 = 0\n", "")]
)
def test_the_pace_of_plc_0_is_told_as_the_bench_file_has_it(line, said):
    stated = "I8 = 0          # PLC 0 every servo cycle\n"
    assert stated in TEXT
    told = [text for text in remarks(parse_bench(TEXT.replace(stated, line))) if "I8" in text]
    assert bool(told) == bool(said)
    assert said in "".join(told)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("I132 = 2804", "I132 = 0", "71.3 N m at 500 mm/s, the drive has 19.11: the motor runs up"),
        ("I132 = 2804", "I132 = 0", "to 4.8 mm behind its command"),
        ("I132 = 2804", "I132 = 0", "Laws are fitted up to 100 mm/s"),
        ("I132 = 2804", "I132 = 0", "Set I132 = 2774, which makes up for I131"),
        ("I132 = 2804", "I132 = 5608", "ahead of its command"),
        ("I132 = 2804", "", "Set I132 = 2774"),  # a card without settings has 1280
        ("I132 = 2804", "I132 = 2600", ""),  # a law sends what that lacks
    ],
)
def test_a_lag_that_no_law_can_take_away_is_remarked_on(old, new, said):
    """Nobody said so, and why a law did little."""
    assert old in TEXT
    told = " ".join(lag_remarks(parse_bench(TEXT.replace(old, new, 1))))
    assert (said in told) if said else (told == "")


@pytest.mark.parametrize("name", ["paper", "paper_x4", "emps"])
def test_existing_benches_have_no_such_lag(name):
    assert lag_remarks(load_bench(name)) == []


def test_the_gain_that_a_lag_asks_for_is_one_of_the_bench_s_own_form():
    table = "".join(line for line in SI.splitlines(keepends=True) if "Kvff" not in line)
    bench = other_law("si", table)
    assert "Set Kvff_Nm_s_per_mm to Kd_Nm_s_per_mm" in " ".join(lag_remarks(bench))


@pytest.mark.parametrize("name", ["paper", "paper_x4", "emps"])
def test_gains_of_existing_benches_do_not_ring(name):
    assert loop_remarks(load_bench(name)) == []


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("I130 = 34862", "I130 = 69724", "rings"),  # twice: 4 times at 157 Hz, as a step shows
        ("I131 = 2774", "I131 = 8322", "rings"),
        ("I130 = 34862", "I130 = 139448", "unstable"),
        ("actuator_delay_us = 442.0", "actuator_delay_us = 1400.0", "unstable"),
    ],
)
def test_gains_that_ring_are_remarked_on(old, new, said):
    text = load_bench("paper_x4").text
    assert old in text
    (line,) = loop_remarks(parse_bench(text.replace(old, new, 1)))
    assert said in line
    assert "mm of the travel" in line


def test_an_identified_drive_that_rings_is_remarked_on():
    bench = load_bench("paper_x4")
    model = DriveModel.base(bench).with_effect("presliding").with_effect("backlash")
    assert loop_remarks(bench, model) == []
    late = model.with_parameters({"chain.actuator_delay_s": 884e-6})
    (line,) = loop_remarks(bench, late)
    assert "4.0 times (140 Hz, at 0 mm" in line
    assert "compensation adds no damping" in line
