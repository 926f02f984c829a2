"""Before and after: error terms of README, Words, intervals, verdict on the promise."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import CaptureError, ConfigError
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture, write_capture
from pmac_comp.physics.compensate.exact import Aim
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.report.verification import headline, verification_sections
from pmac_comp.workflow.accuracy.outcome import (
    Ratio,
    Spread,
    error_signals,
    outcome_of,
    sensor_floor_um,
)
from pmac_comp.workflow.compensation.file import Compensation, write_compensation
from pmac_comp.workflow.motion.commands import capture_paths
from pmac_comp.workflow.verification.kept_runs import KeptRuns
from pmac_comp.workflow.verification.result import Verification, interval_texts, verdict_remarks
from pmac_comp.workflow.verification.summing_up import summed_up
from pmac_comp.workflow.verification.verify import _compared
from pmac_comp.workflow.verification.verify_stored import verify_files
from tests.compensations import lead_map

BENCH = load_bench("paper")
PERIOD = BENCH.servo_period_s
N = 6000


def run(*, correction_um: float, e_um: float, control_um: float, motion: str = "a") -> Capture:
    """A run with known errors: sines of given rms."""
    t = np.arange(N) * PERIOD
    unit = np.sqrt(2.0) * np.sin(2 * np.pi * 3.0 * t) * 1e-6
    other = np.sqrt(2.0) * np.cos(2 * np.pi * 3.0 * t) * 1e-6
    r = 0.01 * np.sin(2 * np.pi * 1.5 * t)
    desired = r + correction_um * unit
    motor = desired + control_um * other
    table = motor + e_um * unit + 5e-6
    return Capture(
        t, r, motor, desired_position_m=desired, table_position_m=table,
        attributes={"motion": motion},
    )  # fmt: skip


def test_error_terms_are_those_of_the_readme() -> None:
    signals = error_signals(run(correction_um=-3.0, e_um=3.2, control_um=1.5))
    rms = [np.sqrt(np.mean(np.square(v))) * 1e6 for v in (
        signals.mechanical_m, signals.control_m, signals.total_m)]  # fmt: skip
    # e_r = e + c; total = e_c + e_r; the scale offset of 5 um is in none of them.
    assert rms[0] == pytest.approx(0.2, rel=0.01)
    assert rms[1] == pytest.approx(1.5, rel=0.01)
    assert rms[2] == pytest.approx(np.hypot(0.2, 1.5), rel=0.01)


def test_interval_covers_the_value_and_shrinks_with_runs() -> None:
    rng = np.random.default_rng(3)
    one = Spread.of([rng.normal(0.0, 1e-6, N)], PERIOD)
    many = Spread.of([rng.normal(0.0, 1e-6, N) for _ in range(9)], PERIOD)
    for spread in (one, many):
        assert spread.lower95 < spread.value < spread.upper95
        assert spread.value == pytest.approx(1.0, rel=0.03)
    assert many.upper95 - many.lower95 < 0.6 * (one.upper95 - one.lower95)


def test_promise_is_kept_or_missed() -> None:
    before = [run(correction_um=0.0, e_um=3.0, control_um=10.0)]
    after = [run(correction_um=-3.0, e_um=3.3, control_um=1.0)]
    promised = {"e_r_after_um": 0.28, "e_r_after_upper_um": 0.3, "total_after_upper_um": 1.4}
    kept = outcome_of("a", before, after, promise=promised)
    assert kept.mechanical.value == pytest.approx(0.1, rel=0.02)
    assert kept.promise_kept(0.05) is True
    for name, most in (("e_r_after_upper_um", 0.02), ("total_after_upper_um", 0.5)):
        missed = outcome_of("a", before, after, promise={**promised, name: most})
        assert missed.promise_kept(0.02) is False
    assert outcome_of("a", before, after).promise_kept(0.05) is None
    # The wide interval of one pair of runs is no excuse: its value is beyond the promise.
    scattered = outcome_of("a", before, after, promise={"e_r_after_upper_um": 0.9})
    wide = replace(scattered, e_r_after=Spread(1.0, 0.4, 1.6, 3.0))
    assert wide.promise_kept(0.05) is False
    assert [(j.quantity, j.is_kept) for j in wide.judged(0.05)] == [("e_r", False)]


def test_a_person_reads_what_the_sensors_make_and_whether_the_promise_was_kept() -> None:
    before = [run(correction_um=0.0, e_um=3.0, control_um=10.0)]
    after = [run(correction_um=-3.0, e_um=3.5, control_um=1.0)]
    bounds = [
        {"e_before_um": 3.0, "e_r_after_um": 0.4, "e_c_before_um": 10.0, "e_c_after_um": 1.0,
         "total_before_um": 10.4, "total_after_um": 1.1,
         "e_r_after_upper_um": upper, "total_after_upper_um": 1.4}
        for upper in (0.5, 0.1)
    ]  # fmt: skip
    motions = tuple(outcome_of("a", before, after, promise=promise) for promise in bounds)
    judged = Verification(motions, floor_um=0.3, simulated=True).judged()
    # e_r is 0.5 um and the steps make 0.3 of it: 0.4 is left.
    assert "0.300 um" in judged[0]
    assert "e_r is 0.40 um" in judged[0]
    assert "1 of 2 motions" in judged[1]
    alone = Verification((outcome_of("a", before, after),), floor_um=0.9, simulated=True)
    assert "e_r is 0.00 um" in alone.judged()[0]
    assert len(alone.judged()) == 1
    both = (
        motions[0],
        outcome_of("b", before, [run(correction_um=-3.0, e_um=4.0, control_um=1.0)]),
    )
    assert "0.40 to 0.9" in Verification(both, floor_um=0.3, simulated=True).judged()[0]
    assert Verification((), floor_um=0.3, simulated=True).judged() == []


def test_what_a_law_leaves_beyond_a_tenth_is_said_with_what_the_model_expected() -> None:
    before = [run(correction_um=0.0, e_um=3.0, control_um=10.0)]
    little, much = ([run(correction_um=-3.0, e_um=e_um, control_um=1.0)] for e_um in (3.2, 3.6))
    promise = {"e_before_um": 3.0, "e_r_after_um": 0.45}
    motions = (
        outcome_of("a", before, little, promise=promise),
        outcome_of("b", before, much, promise=promise),
        outcome_of("c", before, much),
    )
    law = Verification(motions, floor_um=0.1, simulated=True, route="law")
    (said,) = [text for text in law.judged() if "more than a tenth" in text]
    # 0.6 um are left, the steps make 0.1 of it: 0.59 of 3.0 um.
    assert "2 of 3 motions" in said
    assert "b 0.20, 0.15 expected; c 0.20." in said
    assert "pmac-comp diagnose" in said
    rigid = outcome_of("d", before, much, promise={"e_before_um": 0.0, "e_r_after_um": 0.0})
    assert "d 0.20, 0.00 um of none expected." in replace(law, motions=(rigid,)).judged()[-1]
    for other in (replace(law, motions=motions[:1]), replace(law, route="table")):
        assert not any("more than a tenth" in text for text in other.judged())


def test_what_a_law_leaves_of_the_total_error_beyond_a_fifth_is_said() -> None:
    before = [run(correction_um=0.0, e_um=3.0, control_um=10.0)]
    little, much = ([run(correction_um=-3.0, e_um=3.2, control_um=c_um)] for c_um in (2.0, 4.0))
    promise = {"total_before_um": 13.0, "total_after_um": 1.3}
    motions = (
        outcome_of("a", before, little),
        outcome_of("b", before, much, promise=promise),
    )
    law = Verification(motions, floor_um=0.1, simulated=True, route="servo")
    totals = [m.total_after.value / m.total_before.value for m in motions]
    assert totals[0] < 0.2 < totals[1]
    (said,) = [text for text in law.judged() if "more than a fifth of the total error" in text]
    assert f"1 of 2 motions: b {totals[1]:.2f}, 0.10 expected." in said
    assert "pmac-comp diagnose" in said
    for other in (replace(law, motions=motions[:1]), replace(law, route="table")):
        assert not any("more than a fifth" in text for text in other.judged())


def test_a_miss_is_said_with_its_motion_and_figures_and_points_to_diagnose() -> None:
    before = [run(correction_um=0.0, e_um=3.0, control_um=10.0)]
    after = [run(correction_um=-3.0, e_um=3.5, control_um=1.0)]
    promise = {"e_r_after_upper_um": 0.1, "total_after_upper_um": 1.4}
    (remark,) = verdict_remarks([outcome_of("a", before, after, promise=promise)], 0.3)
    assert "a: e_r 0.50 um, at most 0.32 promised" in remark
    assert "pmac-comp diagnose" in remark


def test_growth_of_the_total_error_is_said_with_its_figures() -> None:
    before = [run(correction_um=0.0, e_um=3.0, control_um=10.0)]
    after = [run(correction_um=-3.0, e_um=3.5, control_um=12.5)]
    remarks = verdict_remarks([outcome_of("a", before, after)], 0.3)
    assert any("total error grew on: a 10.42 -> 12.48 um (+20 %)" in text for text in remarks)


def test_a_promise_without_captures_has_no_interval_to_keep_and_says_so() -> None:
    before = [run(correction_um=0.0, e_um=3.0, control_um=10.0)]
    after = [run(correction_um=-3.0, e_um=3.5, control_um=1.0)]
    promise = {"e_r_after_um": 0.2, "total_after_um": 1.0, "e_r_rounding_um": 0.17}
    motion = outcome_of("a", before, after, promise=promise)
    assert motion.promise_kept(0.3) is None
    told = Verification((motion,), floor_um=0.3, simulated=True).judged()
    assert any("no interval" in text and "--captures" in text for text in told)
    assert any("0.17 um rms of e_r" in text for text in told)
    assert interval_texts(motion, 0.3) == ["of e_r 0.17 um are rounding that the loop feeds back"]


def test_floor_is_the_quantisation_of_both_sensors() -> None:
    # 1 um and 0.125 um steps: hypot/sqrt(12).
    assert sensor_floor_um(BENCH) == pytest.approx(0.2909, rel=1e-3)


def test_stored_captures_are_paired_by_motion(tmp_path: object) -> None:
    from pathlib import Path

    folder = Path(str(tmp_path))
    for name, capture in (
        ("b1", run(correction_um=0.0, e_um=3.0, control_um=9.0, motion="x")),
        ("b2", run(correction_um=0.0, e_um=1.0, control_um=9.0, motion="y")),
        ("a1", run(correction_um=-1.0, e_um=1.1, control_um=1.0, motion="y")),
        ("a2", run(correction_um=-3.0, e_um=3.3, control_um=1.0, motion="x")),
    ):
        write_capture(folder / f"{name}.h5", capture)
    found = verify_files(
        "paper", [folder / "b1.h5", folder / "b2.h5"], [folder / "a1.h5", folder / "a2.h5"]
    )
    values = {m.name: (m.e_before.value, m.e_r_after.value) for m in found.motions}
    assert values["x"] == pytest.approx((3.0, 0.3), rel=0.05)
    assert values["y"] == pytest.approx((1.0, 0.1), rel=0.05)


def test_unpaired_captures_and_missing_tables_are_refused(tmp_path: object) -> None:
    from pathlib import Path

    folder = Path(str(tmp_path))
    write_capture(folder / "b.h5", run(correction_um=0.0, e_um=1.0, control_um=1.0, motion=""))
    with pytest.raises(ConfigError, match="paired"):
        verify_files("paper", [folder / "b.h5"], [])
    bare = run(correction_um=0.0, e_um=1.0, control_um=1.0)
    with pytest.raises(CaptureError, match="no table position"):
        error_signals(Capture(bare.time_s, bare.commanded_position_m, bare.motor_position_m))


def test_runs_of_an_interrupted_verification_are_kept_and_can_be_compared(tmp_path: Path) -> None:
    kept = KeptRuns(tmp_path / "runs")
    bare = run(correction_um=0.0, e_um=3.0, control_um=10.0)
    better = run(correction_um=-3.0, e_um=3.3, control_um=1.0)
    alone = run(correction_um=0.0, e_um=3.0, control_um=11.0, motion="b")
    for capture, on in ((bare, "off"), (better, "on"), (alone, "off")):
        kept.keep(capture.with_attributes(compensation=on))
    assert kept.names == {"before": ["before_01.h5", "before_02.h5"], "after": ["after_01.h5"]}
    said = kept.left(1, _compared("my bench.toml", Path("c.json"), None))
    assert "3 runs are kept" in said
    # Without them the runs of any axis but the paper's were refused, and the lead error stayed in.
    assert f"--after {tmp_path / 'runs'} --bench 'my bench.toml' --compensation c.json`" in said
    sides = [capture_paths([tmp_path / "runs"], side=side) for side in ("before", "after")]
    (motion,) = verify_files("paper", *sides).motions
    assert motion.name == "a"
    assert motion.mechanical.value == pytest.approx(0.1, rel=0.02)


def test_stored_runs_are_held_against_the_compensation_that_acted_only(tmp_path: Path) -> None:
    """Runs of a cam were told as 'route program reached ... kept' with a program's file."""
    acted = Compensation("table", CompensationLaw(), lead_map())
    other = Compensation("table", CompensationLaw(), lead_map(40.0))
    # What the file promises and where it comes from does not act.
    renamed = replace(acted, law=CompensationLaw(provenance={"model": "m.json"}))
    files = {"acted": acted, "other": other, "renamed": renamed}
    for name, one in files.items():
        write_compensation(tmp_path / f"{name}.json", one)
    before, after, mixed = (tmp_path / f"{name}.h5" for name in ("before", "after", "mixed"))
    write_capture(before, run(correction_um=0.0, e_um=3.0, control_um=10.0))
    with_it = run(correction_um=-3.0, e_um=3.3, control_um=1.0)
    write_capture(after, with_it.with_attributes(**acted.marks))
    second = run(correction_um=-3.0, e_um=3.2, control_um=1.1)
    write_capture(mixed, second.with_attributes(**other.marks))

    def compared(*runs: Path, law: str = "") -> tuple[str, ...]:
        named = tmp_path / f"{law}.json" if law else None
        return verify_files("paper", [before], runs, law=named).remarks

    with pytest.raises(ConfigError, match=r"after\.h5: made with another .* \(route table\)"):
        compared(after, law="other")
    for law in ("acted", "renamed"):
        assert not any("compensation" in text for text in compared(after, law=law))
    (said,) = (text for text in compared(after) if "compensation" in text)
    assert "the lead error is still in the mechanical error before" in said
    assert "--compensation FILE" in said
    assert any("2 different ones" in text for text in compared(after, mixed))
    # Captures of an earlier version, or of `capture` with the compensation on.
    write_capture(after, with_it)
    assert any("1 of 1 runs with it do not tell" in text for text in compared(after, law="other"))


def test_an_interrupted_verification_that_kept_nothing_says_how_to_keep() -> None:
    kept = KeptRuns(None)
    kept.keep(run(correction_um=0.0, e_um=3.0, control_um=10.0))
    assert "--out" in kept.left(4, "")
    assert "#4" in kept.left(4, "")


@pytest.mark.parametrize(("route", "judged"), [("law", "mechanical"), ("program", "total")])
def test_the_figure_of_a_page_shows_the_error_that_is_judged(route: str, judged: str) -> None:
    before = [run(correction_um=0.0, e_um=3.0, control_um=10.0)]
    after = [run(correction_um=-9.0, e_um=3.3, control_um=1.0)]
    errors = ("e_before", "e_r_after", "e_c_before", "e_c_after", "total_before", "total_after")
    promise = {f"{error}_um": 1.0 for error in errors}
    motions = (outcome_of("a", before, after, promise=promise),)
    sections = verification_sections(Verification(motions, 0.1, simulated=True, route=route))
    image, caption = sections[0].figures[0]
    assert caption.startswith(f"{judged.capitalize()} error per motion")
    assert f"{judged} error (um rms)" in image


@pytest.mark.parametrize("route", ["cam", "law"])
def test_an_offset_against_the_lag_is_told_by_the_total_error_only(route: str) -> None:
    """'mechanical error 9.613' was told of a cam that took 93 % of the total error away."""
    before = [run(correction_um=0.0, e_um=3.0, control_um=10.0)]
    after = [run(correction_um=-9.0, e_um=3.3, control_um=1.0)]
    motions = (outcome_of("a", before, after),)
    found = Verification(
        motions, 0.1, simulated=True, route=route,
        mechanical=Ratio(9.6, 8.5, 10.8), total=Ratio(0.07, 0.06, 0.09),
    )  # fmt: skip
    held = route == "cam"
    assert found.holds_lag is held
    assert any("mechanical error 9.6" in line for line in found.reached()) is not held
    assert any("beyond them e_r" in line for line in found.judged()) is not held
    assert ("mech" in found.lines()[2]) is not held


@pytest.mark.parametrize("route", ["cam", "program"])
def test_an_offset_against_the_lag_is_judged_by_the_total_error_also_where_that_grew(
    route: str,
) -> None:
    """`program` said that the mechanical error grew, `cam` that the total error counts."""
    before = [run(correction_um=0.0, e_um=3.0, control_um=1.0)]
    after = [run(correction_um=-9.0, e_um=3.3, control_um=10.0)]
    outcomes = [outcome_of("a", before, after)]

    def told(aim: Aim) -> str:
        law = CompensationLaw(provenance={"exact": {"aim": aim.value}})
        compensation = Compensation(route, law)
        found = summed_up(outcomes, [(before, after)], BENCH, compensation, simulated=True)
        return " ".join(found.lines())

    by_total = told(Aim.TOTAL)
    assert "the total error grew on: a" in by_total
    assert "the total error is what counts" in by_total
    assert "mechanical error" not in by_total
    assert "the mechanical error grew on: a" in told(Aim.MECHANICAL)


def test_one_run_is_not_compared_with_itself(tmp_path: Path) -> None:
    before, copy = tmp_path / "before.h5", tmp_path / "after.h5"
    write_capture(before, run(correction_um=0.0, e_um=3.0, control_um=10.0))
    copy.write_bytes(before.read_bytes())
    for after in (before, copy):
        with pytest.raises(ConfigError, match="without and with compensation alike") as refused:
            verify_files("paper", [before], [after])
        assert refused.value.code == "PC-WRK-006"


def test_runs_in_which_nothing_acted_keep_no_promise(tmp_path: Path) -> None:
    law = tmp_path / "table.json"
    write_compensation(law, Compensation("table", CompensationLaw(), lead_map(400.0)))
    before, after = tmp_path / "before.h5", tmp_path / "after.h5"
    write_capture(before, run(correction_um=0.0, e_um=3.0, control_um=10.0))
    write_capture(after, run(correction_um=0.0, e_um=3.1, control_um=9.0))
    with pytest.raises(ConfigError, match=r"after\.h5: no compensation acted in it") as refused:
        verify_files("paper", [before], [after], law=law)
    assert refused.value.code == "PC-WRK-007"
    assert verify_files("paper", [before], [after]).motions
    write_capture(after, run(correction_um=-3.0, e_um=3.1, control_um=9.0))
    assert verify_files("paper", [before], [after], law=law).motions


def test_a_scale_that_counts_the_other_way_is_no_error_of_the_axis(tmp_path: Path) -> None:
    before, after = tmp_path / "before.h5", tmp_path / "after.h5"
    good = run(correction_um=0.0, e_um=3.0, control_um=10.0)
    assert good.table_position_m is not None
    write_capture(before, good)
    write_capture(after, replace(good, table_position_m=-good.table_position_m))
    with pytest.raises(CaptureError, match="counts against the motor"):
        verify_files("paper", [before], [after])


def without_desired(capture: Capture) -> Capture:
    """A run as other programs write it: the column is optional."""
    return replace(capture, desired_position_m=None)


def test_runs_that_do_not_tell_what_was_added_are_judged_by_their_total_error(
    tmp_path: Path,
) -> None:
    """The correction was taken as none: e_r of 0.3 um was told as 3.3 um, its promise as missed."""
    before, after, told = (tmp_path / f"{name}.csv" for name in ("before", "after", "told"))
    write_capture(before, without_desired(run(correction_um=0.0, e_um=3.0, control_um=10.0)))
    acted = run(correction_um=-3.0, e_um=3.3, control_um=1.0)
    write_capture(after, without_desired(acted))
    write_capture(told, acted)
    found, whole = (verify_files("paper", [before], [path]) for path in (after, told))
    (motion,) = found.motions
    assert motion.e_before.value == pytest.approx(3.0, rel=0.01)
    assert motion.total == whole.motions[0].total
    assert not motion.e_r_after.is_known
    assert found.mechanical is None
    promised = {"e_r_after_um": 0.3, "e_r_after_upper_um": 0.4, "total_after_upper_um": 2.0}
    assert [j.quantity for j in replace(motion, promise=promised).judged(0.0)] == ["total"]
    text = "\n".join(found.lines())
    assert "nan" not in text
    assert " mech, " not in text
    assert "after.csv), so what the compensation added is not known" in text
    assert "desired_position_mm" not in "\n".join(whole.lines())


def test_a_page_of_runs_that_do_not_tell_what_was_added_shows_no_figure_for_it() -> None:
    before = run(correction_um=0.0, e_um=3.0, control_um=10.0)
    after = without_desired(run(correction_um=-3.0, e_um=3.3, control_um=1.0))
    after = after.with_attributes(compensation="on")
    outcome = outcome_of("a", [before], [after])
    found = summed_up([outcome], [([before], [after])], BENCH, None, simulated=False)
    assert [name.split(" error")[0] for _, name in headline(found)] == ["total"]
    sections = verification_sections(found)
    cells = [cell for s in sections for t in s.tables for row in t.rows for cell in row]
    assert cells.count(None) == 6  # rms, ratio and peak of e_r and of e_c
    assert not any("nan" in str(cell) for cell in cells)


def test_stored_runs_on_the_wrong_side_are_refused_by_their_header(tmp_path: Path) -> None:
    off, on = tmp_path / "before.h5", tmp_path / "after.h5"
    bare = run(correction_um=0.0, e_um=3.0, control_um=10.0)
    write_capture(off, bare.with_attributes(compensation="off"))
    better = run(correction_um=-3.0, e_um=3.3, control_um=1.0)
    write_capture(on, better.with_attributes(compensation="on"))
    assert verify_files("paper", [off], [on]).motions
    with pytest.raises(ConfigError, match=r"after\.h5 says 'compensation = on'.*before\.h5") as e:
        verify_files("paper", [on], [off])
    assert e.value.code == "PC-VER-008"
