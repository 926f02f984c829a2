"""Commands per second over the packet port, ours beside dls-pmaclib's, asking one server the same.

Both clients talk to one ``pmac-comp sim`` on loopback. dls-pmaclib runs in the environment of the
real clients (``.venv-clients``, or ``PMAC_COMP_CLIENTS`` names its Python); without it only our
own figures are shown. Ratios within one run are what counts; the machine's own speed cancels.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SINGLE = 1500
BULK = 4000
LINES = 2000

THEIRS = """
import json, sys, time
from dls_pmaclib.dls_pmacremote import PmacEthernetInterface

port, single, bulk, lines = map(int, sys.argv[1:])
link = PmacEthernetInterface(verbose=False)
link.setConnectionParams("127.0.0.1", port)
problem = link.connect()
if problem:
    sys.exit(str(problem))
out = {}

def clock(name, count, act):
    best = 0.0
    for _ in range(3):
        start = time.perf_counter()
        act()
        best = max(best, count / (time.perf_counter() - start))
    out[name] = best

def ask(count):
    for k in range(count):
        answer, good = link.sendCommand(f"P{k % 1000}")
        assert good, answer

clock("single questions", single, lambda: ask(single))
clock("bulk reads", bulk, lambda: ask(bulk))
series = [(k + 1, f"P{k % 1000}={k}") for k in range(lines)]
clock("download lines", lines, lambda: [step for step in link.sendSeries(series)])
link.disconnect()
print(json.dumps(out))
"""


def rate(count: int, act: Callable[[], object]) -> float:
    """Times a second, best of three: other work on the machine only ever slows it."""
    best = 0.0
    for _ in range(3):
        start_s = time.perf_counter()
        act()
        best = max(best, count / (time.perf_counter() - start_s))
    return best


def ours(port: int) -> dict[str, float]:
    from pmac_comp.machine.client.commander import Commander

    with Commander.open(f"tcp://127.0.0.1:{port}", timeout_s=10.0) as commander:
        return {
            "single questions": rate(
                SINGLE, lambda: [commander.query(f"P{k % 1000}") for k in range(SINGLE)]
            ),
            "bulk reads": rate(
                BULK, lambda: commander.query_many(f"P{k % 1000}" for k in range(BULK))
            ),
            "download lines": rate(
                LINES, lambda: commander.write_buffer([f"P{k % 1000}={k}" for k in range(LINES)])
            ),
            "memory bytes": rate(
                1_600_000, lambda: [commander.get_memory(0, 16_000) for _ in range(100)]
            ),
        }


def clients_python() -> str | None:
    named = os.environ.get("PMAC_COMP_CLIENTS")
    path = Path(named) if named else ROOT / ".venv-clients" / "bin" / "python"
    return str(path) if path.exists() else None


def theirs(port: int, python: str) -> dict[str, float]:
    arguments = [str(n) for n in (port, SINGLE, BULK, LINES)]
    done = subprocess.run(
        [python, "-c", THEIRS, *arguments], capture_output=True, text=True, check=False, timeout=300
    )
    if done.returncode:
        sys.exit(f"dls-pmaclib failed: {done.stderr.strip().splitlines()[-1:]}")
    figures: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return figures


def main() -> None:
    command = [sys.executable, "-m", "pmac_comp.cli.app", "sim", "--tcp", "0", "--speed", "real"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        ready = json.loads(server.stdout.readline() if server.stdout else "")
        port = (
            int(ready["tcp"].rsplit(":", 1)[-1]) if isinstance(ready["tcp"], str) else ready["tcp"]
        )
        mine = ours(port)
        python = clients_python()
        other = theirs(port, python) if python else {}
    finally:
        server.terminate()
        server.wait(10)
    print(f"{'per second':<18}{'pmac_comp':>12}{'dls-pmaclib':>13}{'ratio':>8}   aim")
    aims = {"single questions": "1", "bulk reads": "10", "download lines": "10"}
    for name, value in mine.items():
        reference = other.get(name)
        beside = f"{reference:13.0f}{value / reference:8.1f}" if reference else " " * 21
        print(f"{name:<18}{value:12.0f}{beside}   {aims.get(name, '')}")


if __name__ == "__main__":
    main()
