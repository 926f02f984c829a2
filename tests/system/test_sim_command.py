"""``pmac-comp sim`` as a user starts it: endpoints on one line, clients served, clean end."""

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pmac_comp.machine.client.commander import Commander

pytestmark = pytest.mark.system
COMMAND = [str(Path(sys.executable).with_name("pmac-comp")), "sim"]


@contextmanager
def started(*options: str) -> Iterator[tuple[subprocess.Popen[str], dict[str, str]]]:
    with subprocess.Popen(
        [*COMMAND, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        try:
            yield process, json.loads(process.stdout.readline())
        finally:
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=20)


def test_endpoints_serve_the_same_card(tmp_path: Path) -> None:
    flash, kept = tmp_path / "flash.bin", tmp_path / "sim.json"
    options = (
        "--json",
        str(kept),
        "--tcp",
        "0",
        "--udp",
        "0",
        "--ascii-port",
        "0",
        "--pty",
        "--flash",
        str(flash),
    )
    with started(*options, "--speed", "20", "--dpram", "small") as (process, told):
        assert told["ready"]
        assert not told["faults"]
        assert json.loads(kept.read_text()) == told
        for number, kind in enumerate(("tcp", "udp", "ascii", "pty")):
            with Commander.open(told[kind]) as link:
                link.command(f"P{number + 1}={number + 10}")
        with Commander.open(told["tcp"]) as link:
            assert link.query("P1..4") == ["10", "11", "12", "13"]
            assert link.query("I3 I4 I6 I9") == ["2", "0", "1", "2"]
            assert link.query("RHY$3F") == ["061000"]
            before = int(link.query("RX0")[0])
            link.command("P9=77")
            link.command("SAVE")
            assert int(link.query("RX0")[0]) > before
        assert process.poll() is None
    assert process.returncode == 0
    assert flash.exists()
    with (
        started("--tcp", "0", "--flash", str(flash)) as (_, told),
        Commander.open(told["tcp"]) as link,
    ):
        assert link.query("P9") == ["77"]


def test_port_in_use_is_a_link_error() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = subprocess.run(
            [*COMMAND, "--tcp", str(port)], capture_output=True, text=True, timeout=120, check=False
        )
    assert done.returncode == 3
    assert "cannot listen" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "options",
    [
        ["--speed", "fast"],
        ["--speed", "-1"],
        ["--bench", "nowhere"],
        ["--force", "missing.csv"],
    ],
)
def test_bad_options_are_usage_errors(options: list[str]) -> None:
    done = subprocess.run(
        [*COMMAND, "--tcp", "0", *options], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
