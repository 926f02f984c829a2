"""What goes wrong in a first hour: wrong files, wrong bench, pipes. One clear error each."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.workflow.compensation_file import Compensation, write_compensation

pytestmark = pytest.mark.system


def run(*words: str, cwd: Path, said: bytes = b"") -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-m", "pmac_comp", *words],
        capture_output=True,
        cwd=cwd,
        timeout=240,
        check=False,
        input=said,
    )


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
    assert code in done.stderr.decode()
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
    done = run("terminal", "sim://", "--json", cwd=tmp_path, said=b"I130\nNONSENSE\n")
    answers = json.loads(done.stdout)
    assert [a["command"] for a in answers] == ["I130", "NONSENSE"]
    assert answers[0]["answer"] == ["139449"]
    assert "ERR003" in answers[1]["answer"][0]


def test_only_commands_with_a_dry_run_advise_it(tmp_path: Path) -> None:
    assert b"--dry-run" not in run("rollback", "sim://", cwd=tmp_path).stderr
    capture = run(
        "capture", "sim://", "-b", "paper", "--motion", "sine:amplitude_mm=2", cwd=tmp_path
    )
    assert b"--dry-run" in capture.stderr
