"""The command line as a user runs it: text, exit codes, files; no controller but sim://."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.system.command import run

pytestmark = pytest.mark.system
CAPTURE_PLAN = ("capture", "sim://", "--bench", "paper", "--dry-run")


VERBS = [
    "demo", "sim", "doctor", "info", "status", "terminal", "backup", "restore", "capture",
    "identify", "compensate", "diff", "upload", "recover", "rollback", "verify", "diagnose",
    "improve", "predict", "compare", "report", "convert", "config",
]  # fmt: skip


def test_help_names_every_verb_and_loads_nothing_heavy() -> None:
    best_s = float("inf")
    for _ in range(3):
        before = os.times()
        done = run("--help")
        after = os.times()
        # CPU time of the child: what counts on a busy machine.
        best_s = min(best_s, after[2] + after[3] - before[2] - before[3])
    assert done.returncode == 0
    assert all(f" {verb} " in done.stdout for verb in VERBS)
    assert best_s < 0.4
    code = (
        "import sys, pmac_comp.cli.app; "
        "print([m for m in ('numpy','scipy','numba','h5py','matplotlib') if m in sys.modules])"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert loaded.stdout.strip() == "[]"


def test_every_verb_has_help() -> None:
    from typer.testing import CliRunner

    from pmac_comp.cli.app import app

    for verb in VERBS:
        done = CliRunner().invoke(app, [verb, "--help"])
        assert done.exit_code == 0, verb
        assert "Usage" in done.output, verb


def test_wrong_key_names_the_nearest_and_exits_2(tmp_path: Path) -> None:
    text = run("config", "example").stdout.replace("pitch_mm = 10.0", "pich_mm = 10.0")
    (tmp_path / "b.toml").write_text(text)
    done = run("config", "check", str(tmp_path / "b.toml"))
    assert done.returncode == 2
    assert "pich_mm" in done.stderr
    assert "nearest known key is 'pitch_mm'" in done.stderr
    assert "Traceback" not in done.stderr


def test_port_nobody_listens_on_exits_3() -> None:
    done = run("info", "tcp://127.0.0.1:9", "--json")
    assert done.returncode == 3
    assert json.loads(done.stdout)["error"]["class"] == "ConnectFailed"


def test_unknown_option_and_missing_argument_exit_2() -> None:
    assert run("info", "sim://", "--nope").returncode == 2
    assert run("identify").returncode == 2
    assert run("frobnicate").returncode == 2


def capture_text(*, column: str = "table_position_mm", bad: str = "", gap: bool = False) -> str:
    period = 3707733 / 8388608 / 1e3
    t = np.arange(400) * period
    if gap:
        t[200:] += 5 * period
    r = 10.0 * np.sin(2 * np.pi * 2.0 * t)
    rows = [f"{a:.9f},{b:.6f},{b:.6f},{b:.6f},0.1" for a, b in zip(t, r, strict=True)]
    if bad:
        rows[100] = f"{t[100]:.9f},{bad},0,0,0"
    header = f"time_s,commanded_position_mm,motor_position_mm,{column},torque_command_Nm"
    return "\n".join([header, *rows]) + "\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (capture_text(bad="nan"), "nan"),
        (capture_text(gap=True), "missing"),
        (capture_text().replace("motor_position_mm", "motor_mm"), "motor_position_mm"),
    ],
    ids=["nan", "gap", "column"],
)
def test_bad_capture_exits_8_and_writes_nothing(tmp_path: Path, text: str, said: str) -> None:
    source, target = tmp_path / "c.csv", tmp_path / "out.h5"
    source.write_text(text)
    done = run("convert", str(source), str(target))
    assert done.returncode == 8
    assert said in done.stderr
    assert not target.exists()
    identified = run("identify", str(source), "--bench", "paper", "--out", str(tmp_path / "m.json"))
    assert identified.returncode == 8
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.csv"]


def test_convert_there_and_back_keeps_every_number(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(capture_text())
    assert run("convert", "a.csv", "b.h5", cwd=tmp_path).returncode == 0
    done = run("convert", "b.h5", "c.csv", "--json", cwd=tmp_path)
    assert json.loads(done.stdout)["samples"] == 400
    first = np.genfromtxt(tmp_path / "a.csv", delimiter=",", skip_header=1)
    lines = [x for x in (tmp_path / "c.csv").read_text().splitlines() if not x.startswith("#")]
    again = np.genfromtxt(lines[1:], delimiter=",")
    assert first.shape == again.shape == (400, 5)
    np.testing.assert_allclose(again, first, rtol=0.0, atol=1e-9)


def test_looking_at_the_embedded_card() -> None:
    info = json.loads(run("info", "sim://", "--json").stdout)
    assert info["I10"] == 3707733
    status = json.loads(run("status", "sim://", "--json").stdout)
    assert [m["number"] for m in status["motors"]] == [1, 2]
    talk = run("terminal", "sim://", "-c", "I130", "-c", "NONSENSE")
    assert talk.returncode == 5
    assert "139449" in talk.stdout
    assert "ERR003" in talk.stdout
    assert "refused NONSENSE" in talk.stderr
    assert run("terminal", "sim://", "-c", "I130").returncode == 0


def test_what_follows_a_refused_command_is_not_sent() -> None:
    talk = run("terminal", "sim://", "-c", "NONSENSE", "-c", "I130", "--json")
    assert talk.returncode == 5
    (said,) = json.loads(talk.stdout)
    assert said["refused"]
    assert "1 more behind it were not sent" in talk.stderr


def test_asking_in_a_pipe_counts_as_no() -> None:
    done = run("capture", "sim://", "--bench", "paper", "--motion", "sine:amplitude_mm=2")
    assert done.returncode == 2
    assert "--yes" in done.stderr


def test_dry_run_shows_motions_and_moves_nothing(tmp_path: Path) -> None:
    done = run(
        "capture", "tcp://127.0.0.1:9", "--bench", "paper", "--dry-run", "--out", str(tmp_path)
    )
    assert done.returncode == 0
    assert "sine_middle" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_motion_beyond_the_travel_exits_6() -> None:
    done = run(
        "capture", "sim://", "--bench", "paper", "--yes", "--motion", "sine:amplitude_mm=500"
    )
    assert done.returncode == 6
    assert "travel" in done.stderr


@pytest.mark.emps
def test_emps_record_gives_the_published_parameters(tmp_path: Path, emps_file: Path) -> None:
    model, page = tmp_path / "m.json", tmp_path / "r.html"
    done = run(
        "identify", str(emps_file), "--bench", "emps", "--out", str(model), "--report", str(page),
        "--json",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)["parameters"]
    for name, published, reach in (
        ("mass_kg", 95.1089, 0.22),
        ("viscous_N_s_per_m", 203.5034, 2.3),
        ("coulomb_N", 20.3935, 0.2),
        ("offset_N", -3.1648, 0.09),
    ):
        assert abs(found[name]["value"] - published) < reach, name
        assert found[name]["std"] > 0.0
    assert json.loads(model.read_text())["parameters"].keys() == found.keys()
    html = page.read_text()
    assert html.count("<svg") >= 2
    assert "mass_kg" in html


def test_version_is_quick() -> None:
    start = time.monotonic()
    assert run("--version").stdout.strip() == "0.1.0"
    assert time.monotonic() - start < 10.0


@pytest.mark.skipif(os.name != "posix", reason="a pipe that its reader closes")
@pytest.mark.parametrize(
    ("words", "is_told"), [(("config", "show", "paper"), False), (CAPTURE_PLAN, True)]
)
def test_output_that_nobody_reads_on_ends_as_interrupted(
    *, words: tuple[str, ...], is_told: bool
) -> None:
    """Scripts with `| head` met a code that stands for nothing, and a traceback of Python."""
    read, write = os.pipe()
    os.close(read)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "pmac_comp", *words], stdout=write, stderr=subprocess.PIPE,
            text=True, check=False, timeout=300,
        )  # fmt: skip
    finally:
        os.close(write)
    assert done.returncode == 130
    assert ("interrupted" in done.stderr) is is_told
    assert "BrokenPipe" not in done.stderr
