"""Commands per second over the packet port, and what a served card does under many clients.

Both clients talk to one ``pmac-comp sim`` on loopback, in turn. dls-pmaclib runs in the environment
of the real clients (``.venv-clients``, or ``PMAC_COMP_CLIENTS`` names its Python); without it only
our own figures are shown. Ratios within one run are what counts; the machine's speed cancels.
"""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pmac_comp.machine.client.commander import Commander

ROOT = Path(__file__).resolve().parent.parent
SINGLE = 200
BULK = 1000
LINES = 500
CHUNKS = 12
ROUNDS = 3
CLIENTS = 16
POLL = "i65???&1??%#1?PVF#2?PVF"
POLL_PERIOD_s = 0.1
# A table of points as a pre-compensated motion has it.
PROGRAM = [
    "OPEN PROG 99 CLEAR",
    "ABS PVT20",
    *(f"X{20.0 * k / LINES:.4f}:{1000.0 / LINES:.4f}" for k in range(LINES - 3)),
    "CLOSE",
]

THEIRS = """
import json, sys, time
from dls_pmaclib.dls_pmacremote import PmacEthernetInterface

port, single, bulk, lines, chunks = map(int, sys.argv[1:6])
link = PmacEthernetInterface(verbose=False)
link.setConnectionParams("127.0.0.1", port)
problem = link.connect()
if problem:
    sys.exit(str(problem))
out = {}

def clock(name, count, act):
    best = 0.0
    for _ in range(chunks):
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
def download(texts):
    series = [(k + 1, text) for k, text in enumerate(texts)]
    for step in link.sendSeries(series):
        assert step[0], step

clock("download lines", lines, lambda: download([f"P{k % 1000}={k}" for k in range(lines)]))
clock("program lines", lines, lambda: download(json.loads(sys.argv[6])))
link.disconnect()
print(json.dumps(out))
"""


@contextmanager
def served_card() -> Iterator[int]:
    """Port of a simulated card in a process of its own."""
    command = [sys.executable, "-m", "pmac_comp", "sim", "--tcp", "0", "--speed", "real"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            ready = json.loads(server.stdout.readline() if server.stdout else "")
            yield int(ready["tcp"].rsplit(":", 1)[-1])
        finally:
            server.terminate()


def rate(count: int, act: Callable[[], object]) -> float:
    """Times a second, the best of short runs: a busy machine leaves a quiet moment to some."""
    best_rate = 0.0
    for _ in range(CHUNKS):
        start_s = time.perf_counter()
        act()
        best_rate = max(best_rate, count / (time.perf_counter() - start_s))
    return best_rate


def ours(port: int) -> dict[str, float]:
    """Our rates, asked the way a program would."""
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
            "program lines": rate(LINES, lambda: commander.write_buffer(PROGRAM)),
            "memory bytes": rate(
                160_000, lambda: [commander.get_memory(0, 16_000) for _ in range(10)]
            ),
        }


def clients_python() -> str | None:
    named = os.environ.get("PMAC_COMP_CLIENTS")
    path = Path(named) if named else ROOT / ".venv-clients" / "bin" / "python"
    return str(path) if path.exists() else None


def theirs(port: int, python: str) -> dict[str, float]:
    arguments = [str(n) for n in (port, SINGLE, BULK, LINES, CHUNKS)]
    arguments.append(json.dumps(PROGRAM))
    done = subprocess.run(
        [python, "-c", THEIRS, *arguments], capture_output=True, text=True, check=False, timeout=300
    )
    if done.returncode:
        sys.exit(f"dls-pmaclib failed: {done.stderr.strip().splitlines()[-1:]}")
    figures: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return figures


def best(into: dict[str, float], figures: dict[str, float]) -> None:
    """Keep the best of several rounds: other work on the machine only ever slows."""
    for name, value in figures.items():
        into[name] = max(value, into.get(name, 0.0))


def many_clients(port: int, seconds: float = 5.0) -> tuple[float, float, float]:
    """Polls a second, share of servo cycles that came late or never, and worst answer in s."""
    url = f"tcp://127.0.0.1:{port}"
    links = [Commander.open(url, timeout_s=10.0) for _ in range(CLIENTS)]
    polls, worst = [0] * CLIENTS, [0.0] * CLIENTS
    stop_s = time.perf_counter() + seconds

    def poll(number: int) -> None:
        while time.perf_counter() < stop_s:
            start_s = time.perf_counter()
            links[number].query(POLL)
            took_s = time.perf_counter() - start_s
            worst[number] = max(worst[number], took_s)
            polls[number] += 1
            time.sleep(max(0.0, POLL_PERIOD_s - took_s))

    with Commander.open(url, timeout_s=10.0) as watch:
        period_s = float(watch.query("I10")[0]) / 8388608e3

        def cycles() -> tuple[float, int]:
            value = int(watch.query("RX$0")[0])
            return time.perf_counter(), value

        begin_s, first = cycles()
        threads = [threading.Thread(target=poll, args=(k,)) for k in range(CLIENTS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        end_s, last = cycles()
    for link in links:
        link.close()
    expected = (end_s - begin_s) / period_s
    passed = (last - first) % (1 << 24)
    return sum(polls) / seconds, 1.0 - passed / expected, max(worst)


def main() -> None:
    mine: dict[str, float] = {}
    other: dict[str, float] = {}
    python = clients_python()
    with served_card() as port:
        ours(port)
        for _ in range(ROUNDS):
            best(mine, ours(port))
            if python:
                best(other, theirs(port, python))
        polls, missed, worst_s = many_clients(port)
    print(f"{'per second':<18}{'pmac_comp':>12}{'dls-pmaclib':>13}{'ratio':>8}   aim")
    aims = {"single questions": "1", "bulk reads": "10", "download lines": "10"}
    aims["program lines"] = "10"
    for name, value in mine.items():
        reference = other.get(name)
        beside = f"{reference:13.0f}{value / reference:8.1f}" if reference else " " * 21
        print(f"{name:<18}{value:12.0f}{beside}   {aims.get(name, '')}")
    print(
        f"{CLIENTS} clients at 10 Hz: {polls:.0f} polls a second, slowest answer "
        f"{worst_s * 1e3:.1f} ms, servo cycles behind real time {100.0 * missed:.2f} %"
    )


if __name__ == "__main__":
    main()
