"""What goes wrong in a first hour: wrong files, wrong bench, pipes. One clear error each."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.workflow.compensation.file import Compensation, write_compensation
from tests.system.command import run

pytestmark = pytest.mark.system


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("capture", "sim://", "--bench", "paper", "--recover", "nope.log"), "PC-CLI-003"),
        (("restore", "sim://", "nope.pmc", "--dry-run"), "PC-BCK-011"),
        (("restore", "sim://", "binary.pmc", "--yes"), "PC-BCK-011"),
        (("diff", "sim://", "c.json", "--plot", "d.xyz"), "PC-CLI-004"),
        (("verify",), "PC-CLI-011"),
    ],
)
def test_wrong_input_is_no_bug_and_leaves_nothing(
    tmp_path: Path, words: tuple[str, ...], code: str
) -> None:
    (tmp_path / "binary.pmc").write_bytes(b"\xff\xfe\x00")
    done = run(*words, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert code in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["binary.pmc"]


@pytest.mark.parametrize("verb", ["upload", "diff"])
def test_compensation_of_another_bench_is_refused(tmp_path: Path, verb: str) -> None:
    law = CompensationLaw(
        inertia_s2=1e-6, provenance={"bench_digest": load_bench("paper_x4").digest}
    )
    write_compensation(tmp_path / "c.json", Compensation("law", law))
    refused = run(verb, "sim://", "c.json", "--bench", "paper", "--json", cwd=tmp_path)
    assert refused.returncode == 2
    assert json.loads(refused.stdout)["error"]["code"] == "PC-DEP-003"
    words = (verb, "sim://", "c.json", "--bench", "paper_x4", "--json")
    done = run(*words, *(["--dry-run"] if verb == "upload" else []), cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_terminal_in_a_pipe_answers_as_json(tmp_path: Path) -> None:
    done = run("terminal", "sim://", "--json", cwd=tmp_path, said="I130\nNONSENSE\n")
    assert done.returncode == 5
    answers = json.loads(done.stdout)
    assert [a["command"] for a in answers] == ["I130", "NONSENSE"]
    assert answers[0]["answer"] == ["139449"]
    assert "ERR003" in answers[1]["answer"][0]


def test_lines_from_a_pipe_are_all_sent_and_a_refused_one_is_in_the_exit_code(
    tmp_path: Path,
) -> None:
    done = run("terminal", "sim://", cwd=tmp_path, said="NONSENSE\nI130\n")
    assert done.returncode == 5
    assert "refused NONSENSE" in done.stderr
    assert done.stdout.splitlines()[1:] == ["139449"]
    assert run("terminal", "sim://", cwd=tmp_path, said="I130\n").returncode == 0


def test_a_command_that_cannot_ask_advises_its_dry_run(tmp_path: Path) -> None:
    capture = run(
        "capture", "sim://", "-b", "paper", "--motion", "sine:amplitude_mm=2", cwd=tmp_path
    )
    assert "--dry-run" in capture.stderr


@pytest.mark.parametrize(
    "how", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_interrupted_capture_stops_the_axis(tmp_path: Path, how: signal.Signals) -> None:
    serve = [sys.executable, "-m", "pmac_comp", "sim", "--tcp", "0"]
    with subprocess.Popen(serve, stdout=subprocess.PIPE, text=True) as sim:
        try:
            assert sim.stdout is not None
            url = json.loads(sim.stdout.readline())["tcp"]
            motion = "sine:amplitude_mm=10,frequency_Hz=1,cycles=60"
            words = ["capture", url, "-b", "paper", "--motion", motion, "--yes"]
            with subprocess.Popen(
                [sys.executable, "-m", "pmac_comp", *words], cwd=tmp_path, stderr=subprocess.PIPE
            ) as going:
                wait_until(lambda: state_of(url, tmp_path) == "moving")
                time.sleep(1.0)  # past the move to the start
                going.send_signal(how)
                _, said = going.communicate(timeout=30)
            assert going.returncode == 130
            assert b"interrupted" in said
            # stopped in closed loop, then left as it was found
            wait_until(lambda: state_of(url, tmp_path) != "moving")
            wait_until(lambda: state_of(url, tmp_path) == "killed")
        finally:
            sim.kill()


def state_of(url: str, cwd: Path) -> str:
    found = json.loads(run("status", url, "--json", cwd=cwd).stdout)
    return str(found["motors"][0]["state"])


def wait_until(true: Callable[[], bool]) -> None:
    end_s = time.monotonic() + 60.0
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.1)
