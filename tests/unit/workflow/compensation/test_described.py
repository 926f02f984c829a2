"""What is said of a compensation: its figures by route, and the way out where it passes limits."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmac_comp.base.errors import AmplitudeExceeded, SafetyRefusal
from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.exact import Aim
from pmac_comp.workflow.bench.scales import Scales
from pmac_comp.workflow.compensation import compensate
from pmac_comp.workflow.compensation.compensate import compensate_files
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.compensation.text import describe
from pmac_comp.workflow.controller.law_rows import law_rows
from pmac_comp.workflow.law.rendering import law_parameters
from pmac_comp.workflow.motion.motions import parse_motion
from tests.compensations import friction_law, lead_map

BENCH = load_bench("paper")

MOTION = "sine:amplitude_mm=12,frequency_Hz=3.5"


@pytest.mark.parametrize(
    ("route", "aim", "offers_less"),
    [
        ("cam", Aim.TOTAL, True),
        ("program", Aim.TOTAL, True),
        ("cam", Aim.MECHANICAL, False),
        ("law", Aim.TOTAL, False),
    ],
)
def test_a_motion_cut_by_the_limit_offers_the_smaller_aim(
    monkeypatch, tmp_path, route: str, aim: Aim, offers_less: object
) -> None:
    drive = SimpleNamespace(effects=())
    monkeypatch.setattr("pmac_comp.workflow.model.identification.load_model", lambda *a, **k: drive)
    monkeypatch.setattr(compensate, "check_amplitude", lambda *a: None)
    monkeypatch.setattr(compensate, "compute_compensation", lambda *a, **k: "cut")
    monkeypatch.setattr(compensate, "limits_report", lambda *a: ["26.0 % of the motion is cut"])
    out = tmp_path / "c.json"
    with pytest.raises(AmplitudeExceeded, match=r"26\.0 %") as refused:
        compensate_files("paper", Path("m.json"), out, route=route, command=MOTION, aim=aim)
    assert ("--aim mechanical" in refused.value.hint) is offers_less
    assert not out.exists()


def test_a_motion_that_its_correction_makes_too_hard_is_refused_before_it_is_written(
    monkeypatch, tmp_path
) -> None:
    """Drawing it refused only when the file lay there, to be uploaded."""
    motion = parse_motion(MOTION, BENCH)
    bends = np.zeros(motion.position_m.size)
    bends[motion.position_m.size // 2] = 20e-6
    bent = Compensation(
        "program",
        friction_law(),
        motion_time_s=motion.trajectory.time_s,
        motion_position_m=motion.position_m,
        motion_correction_m=bends,
    )
    drive = SimpleNamespace(effects=())
    monkeypatch.setattr("pmac_comp.workflow.model.identification.load_model", lambda *a, **k: drive)
    monkeypatch.setattr(compensate, "check_amplitude", lambda *a: None)
    monkeypatch.setattr(compensate, "compute_compensation", lambda *a, **k: bent)
    out = tmp_path / "c.json"
    with pytest.raises(SafetyRefusal, match="acceleration"):
        compensate_files("paper", Path("m.json"), out, route="program", command=MOTION)
    assert not out.exists()


def test_a_table_is_described_without_a_law_that_it_does_not_carry() -> None:
    law = friction_law()
    told = describe(BENCH, Compensation("law", law, lead_map()))
    assert {"per speed um/(m/s)", "friction torque Nm", "look-ahead ms"} <= set(told)
    table = describe(BENCH, Compensation("table", law, lead_map()))
    assert table["route"] == "table"
    assert table["lead slope um per m"] == pytest.approx(35.0)
    static = {name for name in told if name in table}
    assert static == set(table)
    assert not any("per " in name and "lead" not in name for name in table)


def test_clearance_that_a_law_takes_up_is_told() -> None:
    law = friction_law()
    told = describe(BENCH, Compensation("law", law, None))
    assert "clearance of the nut um" not in told
    loose = law.with_values(gap_half_m=1.2e-6, gap_width_m=2.4e-6)
    more = describe(BENCH, Compensation("law", loose, None))
    assert more["clearance of the nut um"] == pytest.approx(2.4)
    assert more["taken up over um (each side)"] == pytest.approx(2.4)
    largest = "largest correction um"
    assert more[largest] == pytest.approx(told[largest] + 1.2)


def test_torque_per_turn_that_a_law_sends_is_told_with_its_order() -> None:
    law = friction_law()
    assert not any("a turn" in name for name in describe(BENCH, Compensation("law", law, None)))
    waves = law.with_values(ripple_Nm=0.043, ripple_order=10.0, turn_friction_Nm=0.018)
    for order, what in ((-12.0, "cogging 12"), (1.0, "friction that changes 1")):
        second = waves.with_values(turn_order=order)
        told = describe(BENCH, Compensation("servo", second, None))
        assert told["cogging 10 times a turn, amplitude Nm"] == pytest.approx(0.043)
        assert told[f"{what} times a turn, amplitude Nm"] == pytest.approx(0.018)
    wobble = law.with_values(
        torque_wobble_Nm_s3_per_m3=5.0, turn_order=2.0, valid_speed_m_per_s=0.4
    )
    told = describe(BENCH, Compensation("law", wobble, None))
    assert told["against the lead's wobble 2 times a turn, at full speed Nm"] == pytest.approx(0.32)


def test_only_what_either_law_has_stands_in_the_difference() -> None:
    scales = Scales.of(BENCH)
    axis: Any = SimpleNamespace(scales=scales, bench=BENCH)
    law = friction_law()
    loose = law.with_values(gap_half_m=1.2e-6, gap_width_m=2.4e-6)
    old, new = law_parameters(law, scales), law_parameters(loose, scales)
    name = "law, clearance of the nut"
    assert name not in {row[0] for row in law_rows(axis, old, old)}
    (row,) = (row for row in law_rows(axis, new, old) if row[0] == name)
    assert row[1:] == (pytest.approx(2.4, rel=1e-6), 0.0, "um")


def test_each_wave_of_the_turn_has_a_row_with_its_name_and_unit() -> None:
    """Three kinds share one place of a bank, a wobble below zero and in another unit."""
    scales = Scales.of(BENCH)
    axis: Any = SimpleNamespace(scales=scales, bench=BENCH)
    waves = {
        "torque, friction per turn": ({"turn_friction_Nm": 0.018, "turn_order": 2.0}, "Nm"),
        "torque, second cogging": ({"turn_friction_Nm": 0.018, "turn_order": -12.0}, "Nm"),
        "torque, against the lead's wobble": (
            {"torque_wobble_Nm_s3_per_m3": 5.0, "turn_order": 2.0},
            "Nm/(m/s)3",
        ),
    }
    laws = {
        name: law_parameters(friction_law().with_values(**values), scales)
        for name, (values, _) in waves.items()
    }
    for name, (values, unit) in waves.items():
        for other in waves:
            rows = {row[0]: row[1:] for row in law_rows(axis, laws[other], laws[name])}
            assert rows.keys() & waves.keys() == {name, other}
            size = pytest.approx(next(iter(values.values())), rel=1e-6)
            assert rows[name] == (size if other == name else 0.0, size, unit)
            assert other == name or rows[other][1] == 0.0


def test_what_only_some_drives_have_is_told_as_compensate_tells_it() -> None:
    scales = Scales.of(BENCH)
    axis: Any = SimpleNamespace(scales=scales, bench=BENCH)
    plain = friction_law()
    bed = {"bed_share": 0.12, "bed_damping_per_s": 8.0, "bed_stiffness_per_s2": 9e3,
           "torque_bed_Nm_s2_per_m": 0.02}  # fmt: skip
    drag = {"drag_m": 0.4e-6, "drag_distance_m": 3e-3, "torque_drag_Nm": 0.02}
    stribeck = {"stribeck_m": 0.3e-6, "torque_stribeck_Nm": 0.05, "stribeck_speed_m_per_s": 5e-3}
    place = {"torque_place_Nm_per_m": 0.5}
    cases: list[tuple[dict[str, float], dict[str, float]]] = [
        (bed, {"law, share of a bed that swings": 12.0}),
        (drag, {"law, drag (each side)": 0.4, "law, that drag turns over within": 3000.0,
                "torque, drag": 0.02}),
        (stribeck, {"law, friction at rest beyond that": 0.3,
                    "torque, friction at rest beyond that": 0.05}),
        (place, {"torque, rising along the travel": 0.5}),
    ]  # fmt: skip
    usual = {row[0] for row in law_rows(axis, None, law_parameters(plain, scales))}
    for values, told in cases:
        old = law_parameters(plain, scales)
        new = law_parameters(plain.with_values(**values), scales)
        rows = {row[0]: row[1:3] for row in law_rows(axis, old, new) if row[0] not in usual}
        assert rows == {name: (0.0, pytest.approx(size, rel=1e-5)) for name, size in told.items()}


def test_coefficients_are_told_for_the_same_place_before_and_on_the_card() -> None:
    """A bank holds them at the motor's zero; the travel of this axis lies far from it."""
    travel = BENCH.travel.model_copy(update={"min_mm": 20.0, "max_mm": 380.0})
    bench = BENCH.model_copy(update={"travel": travel})
    scales = Scales.of(bench)
    law = friction_law().with_values(
        origin_m=bench.mid_travel_m, compliance_slope_per_m=0.84, viscous_s=3e-6,
        gap_half_m=1.2e-6, gap_width_m=2.4e-6,
    )  # fmt: skip
    axis: Any = SimpleNamespace(scales=scales, bench=bench)
    there = {row[0]: row[2] for row in law_rows(axis, None, law_parameters(law, scales))}
    told = describe(bench, Compensation("law", law, None))
    pairs = {
        "law, told for the axis at": "told for the axis at mm",
        "law, per acceleration": "per acceleration um/(m/s2)",
        "law, per speed": "per speed um/(m/s)",
        "law, friction (each side)": "friction um (each side)",
        "law, taken up over (each side)": "taken up over um (each side)",
    }
    for ours, theirs in pairs.items():
        assert there[ours] == pytest.approx(told[theirs], rel=1e-5), ours
    pushed = law.with_values(torque_place_Nm_per_m=0.5, torque_constant_Nm=0.1)
    (constant,) = (r for r in law_rows(axis, None, law_parameters(pushed, scales))
                   if r[0] == "torque, constant")  # fmt: skip
    assert constant[2] == pytest.approx(0.1, rel=1e-4)
