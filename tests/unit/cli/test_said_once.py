"""What commands say before and after they act: refusals before questions, notes once."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pmac_comp.cli import app
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import read_capture
from pmac_comp.workflow.capture import capturing
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.simulated import embedded, make_card
from pmac_comp.workflow.controller import commissioning
from pmac_comp.workflow.verification import verify
from pmac_comp.workflow.verification.result import Verification

PAPER = load_bench("paper")
SINE = "sine:amplitude_mm=1,frequency_Hz=4,cycles=2"


def ended(words: list[str]) -> int:
    """Exit code of a command."""
    with pytest.raises(SystemExit) as left:
        app.main(words)
    return int(left.value.code or 0)


def test_setup_refuses_an_enabled_motor_before_it_asks(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with embedded(make_card(PAPER)) as link:
        axis = Axis(link, PAPER)
        link.write_buffer(["I116=400"])
        axis.enable()

        @contextmanager
        def same(*_: object) -> Iterator[Axis]:
            yield axis

        monkeypatch.setattr(commissioning, "open_axis", same)
        assert ended(["setup", "tcp://card:1", "--bench", "paper"]) == 6
        said = capsys.readouterr()
        assert "is enabled" in said.err
        assert "Nobody can answer here" not in said.err
        assert said.out == ""
        # Looking is allowed, and so is asking where nothing would change.
        assert ended(["setup", "tcp://card:1", "--bench", "paper", "--dry-run"]) == 0
        link.write_buffer(["I116=500"])
        assert ended(["setup", "tcp://card:1", "--bench", "paper"]) == 0


def test_notes_of_a_capture_are_said_once_and_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["capture", "sim://", "--bench", "paper", "--motion", SINE, "--yes"]
    assert ended([*words, "--out", str(tmp_path / "runs")]) == 0
    said = capsys.readouterr()
    assert (said.err + said.out).count("has not been homed") == 1
    assert said.err.count("note: ") == 1
    (path,) = (tmp_path / "runs").glob("*.h5")
    assert read_capture(path).n > 0


def test_a_dry_run_into_a_folder_with_runs_is_refused_as_the_capture_would_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["capture", "tcp://192.0.2.1:1025", "--bench", "paper", "--motion", SINE, "--dry-run"]
    folder = tmp_path / "runs"
    assert ended([*words, "--out", str(folder)]) == 0
    assert not folder.exists()
    folder.mkdir()
    plan = capturing.plan_capture("paper", campaign="", motions=(SINE,))
    plan.files(folder)[0].touch()
    assert ended([*words, "--out", str(folder)]) == 2
    assert "of an earlier capture" in capsys.readouterr().err


def test_verify_says_where_the_runs_went(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        verify, "verify_on_controller", lambda *_, **__: Verification((), 0.0, simulated=True)
    )
    monkeypatch.setattr("pmac_comp.workflow.previews.preview_verification", _no_plan)
    monkeypatch.setattr("pmac_comp.workflow.compensation.file.named_compensation", lambda _: None)
    folder = tmp_path / "verified"
    words = ["verify", "sim://", "--bench", "paper", "--yes"]
    assert ended([*words, "--out", str(folder)]) == 0
    assert f"runs and result: {folder}" in capsys.readouterr().out
    assert ended(words) == 0
    assert "runs and result" not in capsys.readouterr().out


def test_what_a_comparison_of_stored_runs_would_leave_aside_is_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    stored = ["--bench", "paper", "--before", "a.h5", "--after", "b.h5"]
    of_runs = ("--repeats", "2"), ("--static", "5"), ("--seed", "0"), ("--refine", "3")
    motion = ("--motion", "triangle:amplitude_mm=2")
    for more in (["--out", "folder"], ["tcp://card"], *of_runs, motion):
        assert ended(["verify", *more, *stored]) == 2
        said = capsys.readouterr().err
        assert "PC-CLI-016" in said
        assert more[0].replace("tcp://card", "a URL") in said


@pytest.mark.parametrize("route", ["law", "servo", "table"])
@pytest.mark.parametrize(
    ("option", "value"), [("--command", "triangle:amplitude_mm=2"), ("--aim", "mechanical")]
)
def test_what_only_a_known_motion_uses_is_refused_for_other_routes(
    *, route: str, option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["compensate", "--bench", "paper", "--model", "none.json", "--route", route]
    assert ended([*words, option, value]) == 2
    said = capsys.readouterr().err
    assert "PC-CLI-016" in said
    assert option in said
    assert ended(words) != 0
    assert "PC-CLI-016" not in capsys.readouterr().err


class _NoPlan:
    """A plan without motions."""

    def rows(self) -> list[tuple[object, ...]]:
        return []

    def lines(self) -> list[str]:
        return []


def _no_plan(*_: object, **__: object) -> _NoPlan:
    return _NoPlan()
