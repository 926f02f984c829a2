"""Acceptance of the diagnosis: hidden effects, clean benches, effects out of the library, pairs.

Every case is a bench drawn within the tolerances of its file, with nothing, one or two effects
hidden in the simulated plant (code that shares nothing with the fitted model), six runs for fitting
and three for judging. Results go to a JSON-lines file, one line per case, so that the campaign can
be stopped and resumed; ``report`` prints rates with Wilson intervals, the confusion matrix and the
power curve.

    python diagnose_hidden.py run --out FILE --kind hidden --cases 200
    python diagnose_hidden.py run --out FILE --kind clean --cases 300
    python diagnose_hidden.py run --out FILE --kind left-out --cases 60
    python diagnose_hidden.py run --out FILE --kind pair --cases 60
    python diagnose_hidden.py report --out FILE
"""

import argparse
import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.physics.diagnose import Diagnosis, diagnose
from pmac_comp.physics.diagnose.statistics import wilson_interval
from pmac_comp.physics.model.effect import effect_library
from tests.generators.hidden_effects import EFFECTS, Case, make_case

# Groups that data may justify as a tie.
TIES = (
    {"bias_force", "friction_asymmetry"},
    {"encoder_eccentricity", "lead_cyclic"},
    {"lead_linear", "scale_slope"},
    {"actuator_delay", "current_bandwidth"},
    {"backlash", "preload_loss"},
    {"viscous", "channel_skew"},
)
BENCHES = ("paper", "paper_x4")


def plan(kind: str, seed: int) -> tuple[list[str], list[str], float, str]:
    """Effects hidden, effects left out of the library, strength and bench of a case."""
    rng = np.random.default_rng([seed, 17])
    names = sorted(EFFECTS)
    strength = float(np.exp(rng.uniform(np.log(0.4), np.log(2.5))))
    bench = BENCHES[seed % len(BENCHES)]
    first = names[seed % len(names)]
    if kind == "clean":
        return [], [], 1.0, bench
    if kind == "pair":
        second = str(rng.choice([n for n in names if n != first and not tied(n, first)]))
        return [first, second], [], 1.0, bench
    return [first], [first] if kind == "left-out" else [], strength, bench


def tied(one: str, other: str) -> bool:
    return any({one, other} <= group for group in TIES)


def one_case(kind: str, seed: int, seconds: float) -> dict[str, Any]:
    hidden, missing, strength, name = plan(kind, seed)
    bench = load_bench(name)
    case = make_case(bench, hidden, seed=seed, strength=strength, seconds=seconds)
    library = {k: v for k, v in effect_library().items() if k not in missing}
    began = time.monotonic()
    found = diagnose(case.fit, bench, validate=case.judge, effects=library)
    return {
        "kind": kind,
        "seed": seed,
        "bench": name,
        "hidden": {k: dict(v) for k, v in case.hidden.items()},
        "left_out": missing,
        "strength": strength,
        "verdict": found.verdict,
        "named": list(found.named),
        "tied": [list(g) for g in found.tied],
        "gap_before_um": found.gap_before_um,
        "gap_after_um": found.gap_after_um,
        "noise_floor_um": found.noise_floor_um,
        "true_noise_um": sensor_noise_um(case),
        "parameter": scored(found, bench, case),
        "seconds": time.monotonic() - began,
        "evidence": [
            [e.name, e.round, e.status, e.heldout_gain, e.screen_gain]
            for e in found.evidence
            if e.status != "screened"
        ],
    }


def sensor_noise_um(case: Case) -> float:
    """Rms of the judging tables' sensor error alone: the unavoidable part."""
    errors = [c.table_position_m - c.extra["true_table_position_m"] for c in case.judge]
    return float(1e6 * np.std(np.concatenate(errors)))


def scored(found: Diagnosis, bench: Bench, case: Case) -> dict[str, float] | None:
    """First parameter of the hidden effect: truth, estimate and interval in file units."""
    for name, values in case.hidden.items():
        for estimate in found.estimates:
            effect, _, parameter = estimate.name.partition(".")
            if effect == name and parameter in values:
                return {
                    "truth": float(values[parameter]),
                    "value": estimate.value,
                    "lower95": estimate.lower95,
                    "upper95": estimate.upper95,
                }
    return None


def run(args: argparse.Namespace) -> None:
    args.out.parent.mkdir(parents=True, exist_ok=True)
    done = {(r["kind"], r["seed"]) for r in read(args.out)}
    for seed in range(args.first, args.first + args.cases):
        if (args.kind, seed) in done:
            continue
        result = one_case(args.kind, seed, args.seconds)
        with args.out.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(result) + "\n")
        print(
            f"{args.kind} {seed} {list(result['hidden'])} -> {result['verdict']} "
            f"{result['named']} {result['tied']} gap {result['gap_before_um']:.3f} -> "
            f"{result['gap_after_um']:.3f} floor {result['noise_floor_um']:.3f} "
            f"{result['seconds']:.0f} s",
            flush=True,
        )


def read(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]


def ratio(r: dict[str, Any]) -> float:
    """Effect over noise after the base was refitted."""
    excess = max(0.0, r["gap_before_um"] ** 2 - r["noise_floor_um"] ** 2)
    return float(np.sqrt(excess) / r["noise_floor_um"])


def right(r: dict[str, Any]) -> bool:
    """First name right, justified ties credited."""
    truth = next(iter(r["hidden"]))
    if not r["named"]:
        return False
    group = next((g for g in r["tied"] if r["named"][0] in g), [r["named"][0]])
    return truth in group and all(n == truth or tied(n, truth) for n in group)


def wrong(r: dict[str, Any]) -> bool:
    """A name claimed that is neither hidden nor tied with what is."""
    truths = list(r["hidden"])
    claimed = r["named"] if r["verdict"] in {"named", "tie"} else []
    return any(n not in truths and not any(tied(n, t) for t in truths) for n in claimed)


def rate(title: str, hits: int, cases: int) -> None:
    low, high = wilson_interval(hits, cases)
    share = 100 * hits / cases if cases else float("nan")
    print(f"{title}: {hits}/{cases} = {share:.1f} % (95 %: {100 * low:.1f} .. {100 * high:.1f})")


def report(args: argparse.Namespace) -> None:
    rows = read(args.out)
    hidden = [r for r in rows if r["kind"] == "hidden"]
    sized = [r for r in hidden if ratio(r) >= 3.0]
    rate("first name right, 3 times the noise or more", sum(map(right, sized)), len(sized))
    rate("wrong name claimed, all sizes", sum(map(wrong, hidden)), len(hidden))
    clean = [r for r in rows if r["kind"] == "clean"]
    rate("false naming on clean data", sum(bool(r["named"]) for r in clean), len(clean))
    rate("clean called none", sum(r["verdict"] == "none" for r in clean), len(clean))
    out = [r for r in rows if r["kind"] == "left-out" and ratio(r) >= 3.0]
    rate("left out of the library: unknown", sum(r["verdict"] == "unknown" for r in out), len(out))
    pairs = [r for r in rows if r["kind"] == "pair"]
    rate("both of two found", sum(set(r["hidden"]) <= set(r["named"]) for r in pairs), len(pairs))
    power_curve(hidden)
    good = [r for r in sized if right(r)]
    if good:
        shares = [r["gap_after_um"] / r["noise_floor_um"] for r in good]
        print(f"median gap after over noise floor: {np.median(shares):.3f}")
    known = [r for r in hidden if r["parameter"] and ratio(r) >= 6.0]
    near = sum(abs(r["parameter"]["value"] / r["parameter"]["truth"] - 1) < 0.05 for r in known)
    rate("parameter within 5 % above 6 times the noise", near, len(known))
    covered = [r for r in hidden if r["parameter"] and right(r)]
    inside = sum(
        r["parameter"]["lower95"] <= r["parameter"]["truth"] <= r["parameter"]["upper95"]
        for r in covered
    )
    rate("intervals that cover", inside, len(covered))
    confusion(hidden)


def power_curve(hidden: list[dict[str, Any]]) -> None:
    print("power: effect over noise -> named right")
    for low, high in ((0, 1), (1, 2), (2, 3), (3, 5), (5, 10), (10, 20), (20, np.inf)):
        part = [r for r in hidden if low <= ratio(r) < high]
        if part:
            rate(f"  {low:g} to {high:g}", sum(map(right, part)), len(part))


def confusion(hidden: list[dict[str, Any]]) -> None:
    print("confusion: hidden -> verdict and names (cases)")
    counts: dict[str, Counter[str]] = {}
    for r in hidden:
        said = f"{r['verdict']}: {' + '.join(r['named']) or '-'}"
        counts.setdefault(next(iter(r["hidden"])), Counter())[said] += 1
    for name in sorted(counts):
        print(f"  {name}: " + "; ".join(f"{k} ({v})" for k, v in counts[name].most_common()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    runner = commands.add_parser("run")
    runner.add_argument("--kind", choices=["hidden", "clean", "left-out", "pair"], required=True)
    runner.add_argument("--cases", type=int, default=200)
    runner.add_argument("--first", type=int, default=0)
    runner.add_argument("--seconds", type=float, default=10.0)
    reporter = commands.add_parser("report")
    for each in (runner, reporter):
        each.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    (run if args.command == "run" else report)(args)


if __name__ == "__main__":
    main()
