"""The order of an improvement: what is uploaded when, what is put back, what people are told."""

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pmac_comp.base.errors import ConfigError, LinkLost, NotIdentifiable
from pmac_comp.files.capture import Capture, write_capture
from pmac_comp.workflow import improve
from pmac_comp.workflow.improve import Improvement, improve_axis, improve_on_controller, is_better
from pmac_comp.workflow.verification.result import Verification


def verification(mechanical: float, total: float, *, kept: bool = True) -> Verification:
    motion = SimpleNamespace(
        name="sine",
        e_before=SimpleNamespace(value=5.0),
        e_r_after=SimpleNamespace(value=mechanical),
        total_before=SimpleNamespace(value=20.0),
        total_after=SimpleNamespace(value=total),
        promise_kept=lambda floor_um: kept,
        as_result=lambda: {"motion": "sine"},
    )
    return Verification((motion,), 0.05, simulated=False, before=("run without compensation",))


class Bench:
    """Everything that improve_axis calls, as a list of what was called."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, named: tuple[str, ...]) -> None:
        self.done: list[str] = []
        self.models: list[tuple[str, str]] = []
        self.provenance: list[dict[str, str]] = []
        self.answers = [verification(1.0, 2.0)]
        self.validated: Any = None
        self.load, self.loads = object(), list[object]()
        self.hopeless = False
        self.gap: float | None = None
        self.diagnosis = SimpleNamespace(
            diagnosis=SimpleNamespace(named=named, model="grown"),
            model="file",
            sources=(),
            lines=lambda: ["verdict: named"],
            as_result=lambda: {},
        )
        for name, fake in {
            "run_to_files": lambda axis, motions, paths, progress: ["run"],
            "calibration_motions": lambda *a: [],
            "lead_motions": lambda *a: [],
            "verification_motions": lambda *a: [],
            "write_model": lambda path, model: self.models.append((path.name, model)),
            "write_compensation": lambda *a: None,
            "KeptRuns": lambda folder: SimpleNamespace(keep=None, write_result=lambda found: None),
            "context_of": lambda *a: "context",
            "identify_captures": self.identified,
            "base_friction": lambda captures, bench: "coulomb",
            "read_load": lambda link, period_s: self.load,
            "nut_gap": lambda model: None if self.gap is None else (self.gap, None),
            "compute_compensation": self.computed,
            "deploy": lambda axis, compensation, context: self.done.append(f"up {compensation}"),
            "switch": lambda axis, context, what, on: self.done.append(f"off {what}"),
            "verify_axis": lambda *a, **k: self.answers.pop(0),
            "diagnose_captures": self.diagnosed,
        }.items():
            monkeypatch.setattr(improve, name, fake)

    def identified(self, captures: Any, bench: Any, *, model: Any = None, **rest: Any) -> Any:
        if self.hopeless and model is not None:
            raise NotIdentifiable("nothing to stand on", code="PC-TST-001")
        name = "first" if model is None else f"{model} again"
        return SimpleNamespace(
            identification=SimpleNamespace(model=name), model_file=f"file of {name}"
        )

    def computed(
        self, bench: Any, drive: str, *, provenance: dict[str, str], load: object, **rest: Any
    ) -> str:
        self.provenance.append(provenance)
        self.loads.append(load)
        return f"compensation of {drive}"

    def diagnosed(self, *args: Any, validate: Any, **rest: Any) -> Any:
        self.validated = validate
        return self.diagnosis

    def run(self, tmp_path: Path) -> Improvement:
        loaded = SimpleNamespace(digest="d1", servo_period_s=442e-6)
        return improve_axis(SimpleNamespace(bench=loaded, link=None), tmp_path)


def test_the_first_compensation_is_off_before_the_grown_one_comes(monkeypatch, tmp_path) -> None:
    bench = Bench(monkeypatch, ("backlash",))
    bench.answers.append(verification(0.4, 1.5))
    found = bench.run(tmp_path)
    first, grown = "compensation of first", "compensation of grown again"
    assert bench.done == [f"up {first}", f"off {first}", f"up {grown}"]
    assert found.kept == "grown"
    assert bench.validated == ("run without compensation",)
    assert bench.loads == [bench.load, bench.load]  # laws fit beside what the card does already
    assert any("mechanical error, quadratic mean: 1.000 -> 0.400 um" in x for x in found.lines())


def test_where_the_effect_cannot_be_estimated_again_the_diagnosis_values_stay(
    monkeypatch, tmp_path
) -> None:
    bench = Bench(monkeypatch, ("cogging",))
    bench.hopeless = True
    bench.answers.append(verification(0.4, 1.5))
    bench.run(tmp_path)
    assert bench.done[-1] == "up compensation of grown"
    assert bench.models[-1] == ("grown_model.json", "file")


def test_the_models_that_were_used_are_left_and_each_compensation_knows_bench_and_model(
    monkeypatch, tmp_path
) -> None:
    bench = Bench(monkeypatch, ("backlash",))
    bench.answers.append(verification(0.4, 1.5))
    bench.run(tmp_path)
    assert dict(bench.models) == {
        "first_model.json": "file of first",
        "grown_model.json": "file of grown again",
    }
    assert bench.provenance == [
        {"bench_digest": "d1", "model": "first_model.json"},
        {"bench_digest": "d1", "model": "grown_model.json"},
    ]


def test_a_gap_that_torque_does_not_show_stays_as_the_diagnosis_found_it(
    monkeypatch, tmp_path
) -> None:
    bench = Bench(monkeypatch, ("backlash",))
    bench.gap = 2.5e-6
    bench.answers.append(verification(0.4, 1.5))
    assert bench.run(tmp_path).kept == "grown"
    assert bench.done[-1] == "up compensation of grown"


def test_a_grown_model_that_is_worse_is_taken_back(monkeypatch, tmp_path) -> None:
    bench = Bench(monkeypatch, ("payload",))
    bench.answers.append(verification(1.6, 2.4))
    found = bench.run(tmp_path)
    first, grown = "compensation of first", "compensation of grown again"
    assert bench.done[-2:] == [f"off {grown}", f"up {first}"]
    assert found.kept == "first"
    assert "not better" in found.lines()[-1]


def test_nothing_named_uploads_nothing_a_second_time(monkeypatch, tmp_path) -> None:
    bench = Bench(monkeypatch, ())
    found = bench.run(tmp_path)
    assert bench.done == ["up compensation of first"]
    assert found.after_growth is None
    assert found.as_result()["grown_model"] is None
    assert found.rows() == [("sine", 5.0, 1.0, None)]
    assert "added nothing" in found.lines()[-1]


@pytest.mark.parametrize("route", ["cam", "program"])
def test_a_route_for_one_motion_is_refused_before_anything_moves(
    monkeypatch, tmp_path, route: str
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(improve, "open_axis", lambda *a: opened.append("axis"))
    with pytest.raises(ConfigError, match="one known motion"):
        improve_on_controller("sim://", "paper", tmp_path / "out", route=route)
    assert opened == []
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("mechanical", "total"), [(0.5, 2.0), (1.0, 1.0), (1.01, 2.0), (1.05, 1.0)]
)
def test_one_error_falls_or_nothing_changes(mechanical: float, total: float) -> None:
    assert is_better(verification(1.0, 2.0), verification(mechanical, total))


@pytest.mark.parametrize(("mechanical", "total"), [(1.1, 2.0), (1.0, 2.2), (0.95, 3.0)])
def test_one_error_rises_by_more_than_the_other_falls(mechanical: float, total: float) -> None:
    assert not is_better(verification(1.0, 2.0), verification(mechanical, total))


@pytest.mark.parametrize(
    ("first", "grown"),
    [((0.2, 2.0), (0.1, 2.8)), ((0.5, 0.2), (0.7, 0.1))],
)
def test_half_of_a_small_error_does_not_pay_for_more_um_of_the_other(first, grown) -> None:
    """0.1 um of mechanical error less were taken for 0.8 um of total error more."""
    assert not is_better(verification(*first), verification(*grown))


def test_where_the_errors_are_the_same_the_model_whose_promise_is_kept_stays() -> None:
    first = verification(1.0, 2.0)
    assert not is_better(first, verification(1.0, 2.0, kept=False))
    assert is_better(first, verification(0.5, 2.0, kept=False))
    assert is_better(verification(1.0, 2.0, kept=False), verification(1.0, 2.0, kept=False))


def test_what_decided_is_said_where_the_errors_are_the_same(monkeypatch, tmp_path) -> None:
    """0.255 and 0.467 um became 0.239 and 0.500 um on a drive whose missing effect was found."""
    bench = Bench(monkeypatch, ("preload_loss",))
    bench.answers = [verification(0.255, 0.467), verification(0.239, 0.500)]
    found = bench.run(tmp_path)
    assert found.kept == "grown"
    assert "within what two verifications differ by (3 %), and the grown" in found.lines()[-1]
    again = Bench(monkeypatch, ("preload_loss",))
    again.answers = [verification(0.255, 0.467), verification(0.239, 0.500, kept=False)]
    found = again.run(tmp_path)
    assert found.kept == "first"
    assert "its promise was kept on fewer motions" in found.lines()[-1]


def test_the_total_error_is_shown_motion_by_motion_as_well(monkeypatch, tmp_path) -> None:
    bench = Bench(monkeypatch, ("backlash",))
    bench.answers.append(verification(0.4, 1.5))
    said = bench.run(tmp_path).lines()
    at = said.index("total error, table to command, um rms (measured)")
    assert "none   20.00   first  2.000   grown  1.500" in said[at + 1]
    assert "  motions on which the model's promise was kept: 1 -> 1 of 1" in said


def opened(monkeypatch: pytest.MonkeyPatch, axis: Any) -> None:
    """Let ``improve_on_controller`` find this axis behind its URL."""
    monkeypatch.setattr(improve, "open_axis", lambda *a: nullcontext(axis))
    monkeypatch.setattr(improve, "motor_as_found", lambda axis: nullcontext())
    monkeypatch.setattr(improve, "prepare", lambda axis: None)


def test_an_earlier_improvement_is_not_written_over(monkeypatch, tmp_path) -> None:
    (tmp_path / "calibration_03.h5").write_bytes(b"measured last week")
    monkeypatch.setattr(improve, "open_axis", lambda *a: pytest.fail("the card was touched"))
    with pytest.raises(ConfigError, match=r"calibration_03\.h5") as refused:
        improve_on_controller("sim://", "paper", tmp_path)
    assert "--out" in refused.value.hint
    assert (tmp_path / "calibration_03.h5").read_bytes() == b"measured last week"


@pytest.mark.parametrize("ended_by", [LinkLost, KeyboardInterrupt])
def test_an_end_in_the_middle_says_what_was_kept_and_how_to_settle(
    monkeypatch, tmp_path, ended_by: type[BaseException]
) -> None:
    opened(monkeypatch, SimpleNamespace(setup=SimpleNamespace(store=None)))

    def cut(axis: Any, out: Path, **rest: Any) -> None:
        axis.setup.store.mkdir()
        raise ended_by("gone")

    monkeypatch.setattr(improve, "improve_axis", cut)
    with pytest.raises(ended_by) as left:
        improve_on_controller("sim://", "paper", tmp_path / "out")
    said = " ".join(left.value.__notes__)
    assert f"so far is in {tmp_path / 'out'}" in said
    assert f"--journal {tmp_path / 'out' / 'journal'}" in said


@dataclass(frozen=True)
class _Outcome:
    """Of a diagnosis what an improvement adds to it."""

    url: str = ""
    bench_name: str = ""
    removal: str = ""

    def as_result(self) -> dict[str, str]:
        return {}


def test_runs_that_the_diagnosis_asks_for_begin_with_the_compensation_off(
    monkeypatch, tmp_path
) -> None:
    """One stays on the controller: in runs made beside it, it would look like the drive."""
    opened(monkeypatch, SimpleNamespace(setup=SimpleNamespace(store=None)))
    monkeypatch.setattr(improve, "measuring", lambda *a: nullcontext())
    left = Improvement(_Outcome(), verification(1.0, 2.0), None, "first")
    monkeypatch.setattr(improve, "improve_axis", lambda *a, **k: left)
    (tmp_path / "out").mkdir()
    result = improve_on_controller("tcp://card:1", "paper", tmp_path / "out")
    assert result.diagnosis.removal == (
        f"pmac-comp remove tcp://card:1 --bench paper --journal {tmp_path / 'out' / 'journal'}"
    )


@pytest.mark.parametrize(
    "left", ["before_01.h5", "calibration_01.h5", "verification_first/static_after_02.h5"]
)
def test_a_folder_with_runs_of_any_command_is_refused(tmp_path: Path, left: str) -> None:
    """A `verify` folder was accepted: its runs lay among those of the improvement."""
    (tmp_path / left).parent.mkdir(exist_ok=True)
    still = np.zeros(100)
    write_capture(tmp_path / left, Capture(1e-3 * np.arange(100), still, still))
    with pytest.raises(ConfigError, match=rf"holds {Path(left).name}") as refused:
        improve_on_controller("sim://", "paper", tmp_path)
    assert refused.value.code == "PC-CAL-004"
