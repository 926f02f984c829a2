"""What is said of captures that are not what `identify` needs: other units, a compensation on."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import ConfigError, NotIdentifiable
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture, read_capture, write_capture
from pmac_comp.physics import identify
from pmac_comp.workflow.model import diagnosis, identification

BENCH = load_bench("paper")


@dataclass(frozen=True)
class _Found:
    """Of an identification what is told."""

    statements: tuple[str, ...]


@pytest.mark.parametrize(("span_m", "n_told"), [(20e-6, 1), (20e-3, 0), (0.0, 0)])
def test_captures_that_hardly_move_are_asked_for_their_unit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, span_m: float, n_told: int
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise NotIdentifiable("no motion")

    monkeypatch.setattr(identification, "identify_captures", refuse)
    time_s = np.arange(2000) * BENCH.servo_period_s
    command_m = 0.5 * span_m * np.sin(2.0 * np.pi * 3.0 * time_s)
    file = tmp_path / "run.h5"
    write_capture(file, Capture(time_s, command_m, command_m, table_position_m=command_m))
    with pytest.raises(NotIdentifiable) as refused:
        identification.identify_files([file], "paper")
    notes = getattr(refused.value, "__notes__", [])
    assert sum("are its positions in m?" in note for note in notes) == n_told
    assert any("Nothing moves" in note for note in notes) is (span_m == 0.0)


@pytest.mark.parametrize(
    ("added_um", "mark", "told"),
    [(0.0, {}, False), (0.5, {}, False), (3.0, {}, True), (0.0, {"compensation": "on"}, True)],
)
def test_runs_with_a_compensation_on_are_named(
    monkeypatch: pytest.MonkeyPatch, added_um: float, mark: dict[str, str], *, told: bool
) -> None:
    """A law that feeds torque forward may add less than a count to the command."""
    statements: list[str] = []

    def keep(found: _Found, *_: object, **__: object) -> None:
        statements.extend(found.statements)

    monkeypatch.setattr(identify, "identify", lambda *_, **__: _Found(("one thing",)))
    monkeypatch.setattr(identify, "to_model_file", keep)
    time_s = np.arange(200) * BENCH.servo_period_s
    still = np.zeros(200)
    run = Capture(time_s, still, still, desired_position_m=still + added_um * 1e-6, attributes=mark)
    identification.identify_captures([Capture(time_s, still, still), run], BENCH, names=["a", "b"])
    assert ("1 of 2 captures were made with a compensation on (b)" in " ".join(statements)) is told
    assert statements[-1] == "one thing"


def test_a_diagnosis_names_every_run_with_a_compensation_on_and_takes_none_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    @dataclass(frozen=True)
    class Outcome:
        bench_name: str = ""
        model_path: Path | None = None
        remark: str = ""

    monkeypatch.setattr(diagnosis, "diagnose_captures", lambda *_, **__: Outcome())
    time_s = np.arange(200) * BENCH.servo_period_s
    paths = [tmp_path / f"{name}.h5" for name in "abc"]
    for path, added_um in zip(paths, (0.0, 3.0, 4.0), strict=True):
        at = 1e-3 * np.sin(time_s) + (ord(path.stem) - ord("a")) * 1e-6
        added = at + added_um * 1e-6
        run = Capture(
            time_s,
            at,
            at,
            table_position_m=at,
            desired_position_m=added,
            attributes={"start_utc": f"2026-03-01T10:0{ord(path.stem) - ord('a')}:00Z"},
        )
        write_capture(path, run)
    found = diagnosis.diagnose_files(paths[:2], paths[2:], "paper")
    assert "2 of 3 captures were made with a compensation on: b.h5, c.h5." in found.remark
    assert diagnosis.diagnose_files(paths[:1], (), "paper").remark == ""
    write_capture(tmp_path / "a.csv", read_capture(paths[0]))
    for fit, judge in (([*paths[:1], tmp_path / "a.csv"], ()), (paths[:1], [tmp_path / "a.csv"])):
        with pytest.raises(ConfigError, match=r"a\.csv is \S*a\.h5"):
            diagnosis.diagnose_files(fit, judge, "paper")
