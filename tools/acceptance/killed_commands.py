"""Acceptance of F29 from outside: commands killed at random instants on a served simulated card.

Each round starts a command as a person does (a process of its own), kills it with SIGKILL after a
random share of its time, tries an upload on top, which must be refused while something is left
open, recovers, and compares the whole card with what stood before and with what was meant: it must
be one of them, exactly. Then the command has to work. Rounds go over TCP, a serial line (pty) or a
hop over SSH; one JSON line is printed for each.

    python killed_commands.py --links tcp pty ssh --rounds 15
    python killed_commands.py --links ssh --rounds 30 --seed 7
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import paramiko

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.settings.backup import Backup, compare, read_backup
from pmac_comp.workflow.compensation.file import Compensation, write_compensation
from tests.compensations import friction_law, lead_map
from tests.faults.openssh import trusting
from tests.faults.ssh_gateway import SECRET, USER, Gateway

LINKS = ("tcp", "pty", "ssh")
LONG = "sine:amplitude_mm=2,frequency_Hz=2,cycles=10"
SHORT = "sine:amplitude_mm=1,frequency_Hz=8,cycles=6"  # what the card itself holds (serial lines)
FIRST = ("upload law", "rollback", "upload table", "restore", "verify", "capture")
ALIVE = {"I129"}  # the torque that an armed law writes in every cycle
UNSETTLED = "PC-TXN-010"  # code of an upload beside one that waits for `recover`
STEPS = "PC-SAF-004"  # code of a switch that would move the axis at once
FLAGS = {
    "upload law": ("upload", "{url}", "law.json", "--yes"),
    "upload table": ("upload", "{url}", "table.json", "--yes"),
    "rollback": ("rollback", "{url}", "--yes"),
    "restore": ("restore", "{url}", "start.json", "--bench", "paper", "--yes"),
    "capture": (
        *("capture", "{url}", "--bench", "paper", "--motion", "{motion}"),
        *("--yes", "--out", "runs-{n}"),
    ),
    "verify": (
        *("verify", "{url}", "--compensation", "{file}", "--motion", "{motion}"),
        *("--repeats", "1", "--static", "0", "--yes"),
    ),
}


def write_compensations(folder: Path) -> None:
    for route, slope in (("law", 20.0), ("table", 35.0)):
        lead = lead_map(slope, reversal_um=-4.0)
        write_compensation(
            folder / f"{route}.json",
            Compensation(route, friction_law(), lead, backlash=route == "law"),
        )


def require(condition: object, *said: object) -> None:
    """End the campaign where a round cannot be judged."""
    if not condition:
        raise RuntimeError(" ".join(map(str, said)))


@dataclass
class Site:
    """A served card, the way to it, and the folder where a person works."""

    folder: Path
    url: str
    direct: str
    took_s: dict[str, float] = field(default_factory=dict)
    n_commands: int = 0
    file: str = "table.json"  # the compensation that stands
    code: int = 0  # how the last command ended, negative for a signal

    def start(self, *words: str) -> subprocess.Popen[str]:
        self.n_commands += 1
        filled = [
            w.replace("{url}", self.url)
            .replace("{n}", str(self.n_commands))
            .replace("{file}", self.file)
            .replace("{motion}", SHORT if self.url.startswith("serial") else LONG)
            for w in words
        ]
        return subprocess.Popen(
            [sys.executable, "-m", "pmac_comp", *filled],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=self.folder,
            env={**os.environ, "BENCH_SECRET": SECRET},
        )

    def run(self, *words: str) -> tuple[int, str, str]:
        process = self.start(*words)
        said, complaint = process.communicate(timeout=600)
        return process.returncode, said, complaint

    def told(self, *words: str) -> dict[str, Any]:
        """What a command that succeeds says as JSON."""
        code, said, complaint = self.run(*words, "--json")
        require(code == 0, words, said[-800:], complaint[-800:])
        found: dict[str, Any] = json.loads(said)
        return found

    def status(self) -> dict[str, Any]:
        return self.told("status", "{url}")

    def closed(self) -> None:
        """Motor 1 in closed loop, by hand."""
        require(self.run("terminal", "{url}", "-c", "#1J/")[0] == 0, "the loop does not close")
        time.sleep(0.5)

    def card(self) -> Backup:
        """All that stands on the card, but for the variables of the manifest."""
        with Commander.open(self.direct, timeout_s=20.0) as link:
            return read_backup(link, p_range=(7100, 7199), with_q=False)

    def ended(self, name: str, share: float) -> str:
        """Start a command and kill it after a share of its time; how it ended.

        Its time counts from the first word it says: starting Python is not what is asked here.
        """
        process = self.start(*FLAGS[name])
        if process.stderr is not None:
            process.stderr.readline()
        start_s = time.monotonic()
        try:
            said = process.communicate(timeout=share * self.took_s.get(name, 8.0))
            self.took_s[name] = time.monotonic() - start_s
        except subprocess.TimeoutExpired:
            process.kill()
            said = process.communicate()
        self.code = process.returncode
        took = f"{name}: {process.returncode} after {time.monotonic() - start_s:.2f} s"
        return took if process.returncode <= 0 else f"{took} {said}"

    def succeeds(self, name: str) -> None:
        """A command runs to its end; on a busy machine the card may be too slow for it once."""
        for _ in range(3):
            done = self.ended(name, 100.0)
            if self.code == 0:
                self.file = FLAGS[name][2]
                return
            print(done[:1500], flush=True)
            self.recovered()
            self.closed()
        raise RuntimeError(done)

    def recovered(self) -> str:
        """Recover until it is done, as its refusals say.

        While an axis or a motion program runs it is waited for; where switching off would step
        the axis the motor is killed first.
        """
        end_s = time.monotonic() + 120.0
        while True:
            code, said, complaint = self.run("recover", "{url}", "--json")
            if code == 0:
                return str(json.loads(said)["verdict"])
            told = said + complaint
            if STEPS in told:
                self.run("terminal", "{url}", "-c", "#1K")
            waits = any(word in told for word in (STEPS, "move", "motion program runs"))
            require(waits and time.monotonic() < end_s, "recover", told)
            time.sleep(0.5)


@contextmanager
def served(folder: Path, kind: str) -> Iterator[Site]:
    command = [sys.executable, "-m", "pmac_comp", "sim", "--tcp", "0", "--pty"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder) as sim:
        told = json.loads(sim.stdout.readline() if sim.stdout is not None else "{}")
        try:
            if kind == "ssh":
                port = int(told["tcp"].rpartition(":")[2])
                reachable = {("127.0.0.1", port)}
                front = Gateway(paramiko.ECDSAKey.generate(), reachable=reachable)
                known = trusting(folder, front.known_hosts_line)
                hop = f"ssh://{USER}@127.0.0.1:{front.port}/127.0.0.1:{port}"
                url = f"{hop}?known_hosts={known}&password_env=BENCH_SECRET"
                yield Site(folder, url, told["tcp"])
                front.close()
            else:
                yield Site(folder, told[kind], told["tcp"])
        finally:
            sim.kill()


def differing(a: Backup, b: Backup) -> list[str]:
    """Items that differ."""
    return [d.item for d in compare(a, b) if d.item not in ALIVE]


@dataclass(frozen=True)
class Round:
    """One command killed on its way, and what came of it."""

    link: str
    how: str
    left_open: str
    on_top: str
    verdict: str
    wrong: str

    @property
    def is_good(self) -> bool:
        """Whether nothing is wrong with it."""
        return not self.wrong


def killed(site: Site, link: str, name: str, share: float, goal: Backup | None) -> Round:
    """Kill a command, try another on top, recover, and judge the whole card."""
    if name == "restore":
        site.run("terminal", "{url}", "-c", "#1K")
    else:
        site.closed()
    before = site.card()
    how = site.ended(name, share)
    code = site.code
    left_open, left = site.status()["compensation"]["left_open"], site.card()
    torn = left_open != "nothing" and "measurement" not in left_open
    on_top = second(site) if torn else "not tried"
    wrong = [] if on_top != "accepted" else ["an upload was accepted on top"]
    wrong += [f"it ended by itself with exit {code}"] if code > 0 else []
    wrong += [] if on_top == "not tried" or not differing(left, site.card()) else ["it wrote"]
    verdict = site.recovered()
    now = site.status()["compensation"]
    if (now["left_open"], now["lease"]) != ("nothing", "free"):
        wrong.append(f"left after recover: {now['left_open']}, lease {now['lease']}")
    if verdict not in {"OLD", "NEW"}:
        wrong.append(f"verdict {verdict}")
    found = site.card()
    missing = {k: differing(v, found) for k, v in {"before": before, "goal": goal}.items() if v}
    # The goal of an upload is judged by uploading it again: nothing must change then.
    judged_later = goal is None and verdict == "NEW" and name.startswith("upload")
    if all(missing.values()) and not judged_later:
        wrong.append(f"half-changed: { ({k: v[:5] for k, v in missing.items()}) }")
    return Round(link, how, left_open, on_top, verdict, "; ".join(wrong))


def second(site: Site) -> str:
    """An upload beside what was left open: refused, or why not."""
    code, said, complaint = site.run(*FLAGS["upload table"], "--json")
    if code == 0:
        return "accepted"
    told = said + complaint
    return "refused" if UNSETTLED in told else f"exit {code}: {told[-200:]}"


def campaign(link: str, rounds: int, seed: int) -> Iterator[Round]:
    """Rounds over one kind of link, on one card."""
    rng = np.random.default_rng([seed, LINKS.index(link)])
    with tempfile.TemporaryDirectory() as folder, served(Path(folder), link) as site:
        write_compensations(site.folder)
        site.closed()
        site.told("backup", "{url}", "--out", "start.json")
        start = undo = site.card()
        for name in ("upload table", "upload law"):
            undo = site.card()
            site.succeeds(name)
        for k in range(rounds):
            name = FIRST[k] if k < len(FIRST) else str(rng.choice([*FLAGS, "upload law"]))
            goal = {"rollback": undo, "restore": start}.get(name)
            found = killed(site, link, name, rng.random(), goal)
            yield found
            if name not in {"verify", "capture"}:
                site.closed()
                undo = site.card()
                again = name if name.startswith("upload") else "upload law"
                site.succeeds(again)
                if again == name and found.verdict == "NEW" and differing(undo, site.card()):
                    yield Round(link, found.how, "", "", "NEW", "NEW was not what was meant")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the rounds that were asked for; 1 if one of them went wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--links", nargs="+", choices=LINKS, default=list(LINKS))
    parser.add_argument("--rounds", type=int, default=15, help="per link")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args(arguments)
    ended: Counter[str] = Counter()
    bad = 0
    for link in chosen.links:
        for found in campaign(link, chosen.rounds, chosen.seed):
            print(json.dumps(vars(found)), flush=True)
            ended[f"{link} {found.verdict}"] += 1
            bad += not found.is_good
    print(json.dumps({"rounds": sum(ended.values()), "ended": ended, "bad": bad}), flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
