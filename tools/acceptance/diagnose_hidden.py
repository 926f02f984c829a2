"""Acceptance of the diagnosis: hidden effects, clean benches, effects out of the library, pairs.

Every case is a bench drawn within the tolerances of its file, with nothing, one or two effects
hidden in the simulated plant (code that shares nothing with the fitted model), scaled until they
are 3 to 20 times the noise after a refit of the base (``ladder``: 0.7 to 20), six runs for fitting
and three for judging, with quantisation, jitter of the scale and a random force on the table.
Results go to a JSON-lines file, one line per case, so that the campaign can be stopped and resumed.
One process keeps little more than one core busy (28 s of CPU in 25 s): give as many workers as
there are cores, and 0.6 GB of memory each.

    python diagnose_hidden.py run --out FILE --kind hidden --cases 200 --workers 2
    python diagnose_hidden.py run --out FILE --kind clean --cases 300 --workers 2
    python diagnose_hidden.py run --out FILE --kind ladder --cases 100
    python diagnose_hidden.py run --out FILE --kind left-out --cases 60
    python diagnose_hidden.py run --out FILE --kind pair --cases 60
    python diagnose_hidden.py report --out FILE
"""

import argparse
import json
import multiprocessing
import os
import resource
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.diagnose import Diagnosis, diagnose
from pmac_comp.physics.model.effect import effect_library
from tests.generators.effects import EFFECTS
from tests.generators.hidden_effects import Case, make_case
from tools.acceptance.diagnose_scores import print_report, tied

BENCHES = ("paper", "paper_x4")
KINDS = ("hidden", "clean", "ladder", "left-out", "pair")
_SIZES = {"hidden": (3.0, 20.0), "left-out": (3.0, 20.0), "pair": (3.0, 20.0)}
_KB_PER_MB = 1024.0


def plan(kind: str, seed: int) -> tuple[list[str], list[float], str]:
    """Effects hidden, how many times the noise each shall be, and the bench of a case."""
    rng = np.random.default_rng([seed, 17])
    names = sorted(EFFECTS)
    low, high = _SIZES.get(kind, (0.7, 20.0))
    sizes = np.exp(rng.uniform(np.log(low), np.log(high), 2)).tolist()
    bench = BENCHES[int(rng.integers(len(BENCHES)))]
    first = names[seed % len(names)]
    if kind == "clean":
        return [], [], bench
    if kind == "pair":
        second = str(rng.choice([n for n in names if n != first and not tied(n, first)]))
        return [first, second], sizes, bench
    return [first], sizes[:1], bench


def one_case(kind: str, seed: int, seconds: float) -> dict[str, Any]:
    """Make one case, diagnose it and give back its row."""
    hidden, sizes, name = plan(kind, seed)
    bench = load_bench(name)
    case = make_case(bench, hidden, seed=seed, over_noise=sizes, seconds=seconds)
    missing = hidden if kind == "left-out" else []
    library = {k: v for k, v in effect_library().items() if k not in missing}
    began, cpu = time.monotonic(), time.process_time()
    found = diagnose(case.fit, bench, validate=case.judge, effects=library)
    return {
        "kind": kind,
        "seed": seed,
        "bench": name,
        "capture_s": seconds,
        "hidden": {k: dict(v) for k, v in case.hidden.items()},
        "wanted": sizes,
        "over_noise": dict(case.ratios),
        "generator_noise_um": case.noise_um,
        "left_out": missing,
        "verdict": found.verdict,
        "named": list(found.named),
        "tied": [list(g) for g in found.tied],
        "gap_before_um": found.gap_before_um,
        "gap_after_um": found.gap_after_um,
        "noise_floor_um": found.noise_floor_um,
        "parameter": scored(found, case),
        "findings": [f.text for f in found.findings],
        "left": [r.describe() for r in found.residual[:3]],
        "seconds": time.monotonic() - began,
        "cpu_s": time.process_time() - cpu,
        "peak_memory_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _KB_PER_MB,
        "evidence": [
            [e.name, e.round, e.status, e.heldout_gain, e.screen_gain, e.p_value, e.gap_um]
            for e in found.evidence
            if e.status != "screened" or e.name in hidden
        ],
    }


def scored(found: Diagnosis, case: Case) -> dict[str, Any] | None:
    """First parameter of a hidden effect that was named: truth, estimate, interval, file units."""
    for name, truth in case.truth.items():
        for estimate in found.estimates:
            effect, _, parameter = estimate.name.partition(".")
            if effect == name and parameter in truth:
                return {
                    "name": estimate.name,
                    "truth": truth[parameter],
                    "value": estimate.value,
                    "lower95": estimate.lower95,
                    "upper95": estimate.upper95,
                }
    return None


def run(args: argparse.Namespace) -> None:
    """Run the cases that the file does not hold yet."""
    args.out.parent.mkdir(parents=True, exist_ok=True)
    done = {(r["kind"], r["seed"]) for r in read(args.out)}
    seeds = range(args.first, args.first + args.cases)
    jobs = [(args.kind, s, args.seconds, args.out) for s in seeds if (args.kind, s) not in done]
    if args.workers == 1:
        for job in jobs:
            work(job)
        return
    with multiprocessing.get_context("spawn").Pool(args.workers) as pool:
        for _ in pool.imap_unordered(work, jobs):
            pass


def work(job: tuple[str, int, float, Path]) -> None:
    """One case to its line in the file; a single write, so that workers may share the file."""
    kind, seed, seconds, out = job
    result = one_case(kind, seed, seconds)
    line = (json.dumps(result) + "\n").encode()
    descriptor = os.open(out, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        os.write(descriptor, line)
    finally:
        os.close(descriptor)
    sizes = ", ".join(f"{k} {v:.1f}x" for k, v in result["over_noise"].items()) or "-"
    print(
        f"{kind} {seed} {sizes} -> {result['verdict']} {result['named']} {result['tied']} "
        f"gap {result['gap_before_um']:.3f} -> {result['gap_after_um']:.3f} "
        f"floor {result['noise_floor_um']:.3f} cpu {result['cpu_s']:.0f} s",
        flush=True,
    )


def read(path: Path) -> list[dict[str, Any]]:
    """Rows of a results file."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    runner = commands.add_parser("run")
    runner.add_argument("--kind", choices=KINDS, required=True)
    runner.add_argument("--cases", type=int, default=200)
    runner.add_argument("--first", type=int, default=0, help="first seed")
    runner.add_argument("--seconds", type=float, default=6.0, help="length of each capture")
    runner.add_argument("--workers", type=int, default=1, help="processes")
    reporter = commands.add_parser("report")
    for each in (runner, reporter):
        each.add_argument("--out", type=Path, required=True)
    args = parser.parse_args(arguments)
    if args.command == "run":
        run(args)
    else:
        print_report(read(args.out))


if __name__ == "__main__":
    main()
