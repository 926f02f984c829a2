"""Progress: it moves while nobody calls, its shares only grow, and a file of it stays short."""

import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pmac_comp.base.errors import LinkLost
from pmac_comp.cli import output, progress
from pmac_comp.cli.progress import ProgressLines
from pmac_comp.workflow.controller import safekeeping


class Clock:
    """Time that passes when it is told to."""

    now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr(progress, "time", found)
    return found


@pytest.fixture(autouse=True)
def _ended() -> Iterator[None]:
    yield
    ProgressLines.stop()
    ProgressLines.is_open = False


def on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> ProgressLines:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    return ProgressLines()


def test_an_error_begins_on_a_line_of_its_own_below_the_progress(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    on_a_terminal(monkeypatch)("writing", 0.3)
    output.say("error: link lost")
    output.say("second")
    assert capsys.readouterr().err.endswith("writing\nerror: link lost\nsecond\n")


def test_it_fits_a_narrow_terminal_and_a_dumb_one_gets_plain_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "30")
    on_a_terminal(monkeypatch)("verifying sine 12.1 mm 2.45 Hz at 24 mm", 0.3)
    assert len(capsys.readouterr().err.removeprefix("\r\x1b[K")) < 30
    ProgressLines.stop()
    monkeypatch.setenv("TERM", "dumb")
    ProgressLines()("verifying", 0.3)
    assert capsys.readouterr().err.endswith("verifying\n")


def test_work_of_minutes_leaves_few_lines_in_a_file(
    clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    """As `identify` reports: many short rounds, and "refined 100 %" after each fit."""
    show = ProgressLines()
    for _ in range(30):
        for number in range(1, 6):
            show(f"round {number}", number / 20.0)
            clock.now_s += 0.5
        show("refined", 1.0)
        clock.now_s += 0.5
    lines = capsys.readouterr().err.splitlines()
    assert 8 <= len(lines) <= 10  # of 90 s
    assert "refined" not in "".join(lines)
    assert not any("%" in line for line in lines)
    seconds = [int(re.findall(r"\d+", line)[0]) for line in lines]
    assert seconds == sorted(seconds)


def test_shares_of_a_step_only_grow_and_one_that_comes_again_is_numbered(
    clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    show = ProgressLines()
    told = [("law", 0.1), ("law", 0.5), ("law", 0.2), ("law", 0.9), ("map", 0.6), ("law", 0.0)]
    for step, fraction in [*told, ("law", 0.3)]:
        show(step, fraction)
        clock.now_s += 31.0
    shown = [line.partition("] ")[2] for line in capsys.readouterr().err.splitlines()]
    assert shown == [
        "law",
        "law  50 %",
        "law  50 %",
        "law  90 %",
        "map",
        "law (2)",
        "law (2)  30 %",
    ]


def test_a_line_goes_on_by_itself_while_nobody_calls(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "_TICK_s", 0.02)
    monkeypatch.setattr(progress, "_REWRITE_s", 0.01)
    show = on_a_terminal(monkeypatch)
    show("one long piece of work", -1.0)
    time.sleep(0.3)
    assert capsys.readouterr().err.count("one long piece") > 3
    output.show_error(LinkLost("gone", code="PC-LNK-002"), as_json=False)
    time.sleep(0.1)
    assert "one long piece" not in capsys.readouterr().err.partition("error:")[2]


def test_steps_of_a_terminal_stay_only_where_they_took_long(
    monkeypatch: pytest.MonkeyPatch, clock: Clock, capsys: pytest.CaptureFixture[str]
) -> None:
    show = on_a_terminal(monkeypatch)
    for step, lasts_s in (("short", 0.5), ("long", 20.0), ("last", 1.0)):
        show(step, -1.0)
        clock.now_s += lasts_s
    show.close()
    lines = capsys.readouterr().err.split("\n")
    assert [line.rpartition("] ")[2] for line in lines] == ["long", "last", ""]


def test_a_backup_tells_how_much_of_it_is_read(tmp_path: Path) -> None:
    told: list[tuple[str, float]] = []
    safekeeping.backup_to_file(
        "sim://", "paper", tmp_path / "b.json", progress=lambda *step: told.append(step)
    )
    for name in ("reading variables, 1 of 2", "reading variables, 2 of 2"):
        shares = [fraction for step, fraction in told if step == name]
        assert shares == sorted(shares)
        assert len(set(shares)) > 100
        assert shares[-1] == 1.0
