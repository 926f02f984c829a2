"""Scores of the diagnosis campaign: rates with Wilson intervals, power curve, wrong cases."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from pmac_comp.physics.diagnose.statistics import wilson_interval

Row = Mapping[str, Any]
BAND = (2.7, 22.0)  # 3 to 20 times the noise, within the 10 % to which a size is set
_STEPS = (0.0, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, np.inf)

# Groups that data may justify as a tie.
TIES = (
    {"bias_force", "friction_asymmetry"},
    {"encoder_eccentricity", "lead_cyclic"},
    {"lead_linear", "scale_slope"},
    {"actuator_delay", "current_bandwidth"},
    {"backlash", "preload_loss"},
    # A nut with too little preload for the forces, whether it gives way at one or towards it.
    {"axial_stiffness_nonlinear", "preload_loss"},
    {"viscous", "channel_skew"},
)


def tied(one: str, other: str) -> bool:
    """Whether data may fail to separate two effects."""
    return any({one, other} <= group for group in TIES)


def ratio(row: Row) -> float:
    """Smallest of the hidden effects over the noise, as the generator measured it."""
    return float(min(row["over_noise"].values(), default=0.0))


def sized(row: Row) -> bool:
    """Whether all hidden effects are 3 to 20 times the noise."""
    return all(BAND[0] <= r <= BAND[1] for r in row["over_noise"].values())


def right(row: Row) -> bool:
    """First name right, justified ties credited; whatever else is said beside it."""
    truth = next(iter(row["hidden"]))
    if not row["named"]:
        return False
    group = next((g for g in row["tied"] if row["named"][0] in g), [row["named"][0]])
    return truth in group and all(n == truth or tied(n, truth) for n in group)


def settled(row: Row) -> bool:
    """First name right and nothing unknown left beside it."""
    return right(row) and row["verdict"] in {"named", "tie"}


def wrong(row: Row) -> bool:
    """A name claimed that is neither hidden nor tied with what is, under any verdict."""
    truths = list(row["hidden"])
    return any(n not in truths and not any(tied(n, t) for t in truths) for n in row["named"])


def both(row: Row) -> bool:
    """Every hidden effect named, or a look-alike in its place."""
    return all(any(n == t or tied(n, t) for n in row["named"]) for t in row["hidden"])


def rate(title: str, rows: Sequence[Row], hit: Callable[[Row], bool], aim: str = "") -> None:
    """One line: hits of cases with the Wilson interval."""
    hits, cases = sum(map(hit, rows)), len(rows)
    if not cases:
        print(f"{title}: no cases")
        return
    low, high = wilson_interval(hits, cases)
    print(
        f"{title}: {hits}/{cases} = {100 * hits / cases:.1f} % "
        f"(95 %: {100 * low:.1f} .. {100 * high:.1f}){f'   aim {aim}' if aim else ''}"
    )


def print_report(rows: Sequence[Row]) -> None:
    """Everything, aim by aim."""
    by_kind = {kind: [r for r in rows if r["kind"] == kind] for kind in {r["kind"] for r in rows}}
    single = [*by_kind.get("hidden", []), *by_kind.get("ladder", [])]
    inside = [r for r in single if sized(r)]
    rate("first name right, 3 to 20 times the noise", inside, right, ">= 97 %")
    rate("  ... and nothing unknown beside it", inside, settled)
    rate("wrong name claimed, all sizes, any verdict", single, wrong, "<= 2 %")
    clean = by_kind.get("clean", [])
    rate("false naming on clean data", clean, lambda r: bool(r["named"]), "<= 1 %")
    rate("clean called none", clean, lambda r: r["verdict"] == "none")
    left_out = [r for r in by_kind.get("left-out", []) if sized(r)]
    rate("left out of the library: unknown", left_out, _unknown, ">= 95 %")
    rate("  ... or a tie that holds its name, as it has an exact twin", left_out, honest)
    rate("left out of the library: a wrong name claimed", left_out, lambda r: bool(r["named"]))
    rate("both of two found", [r for r in by_kind.get("pair", []) if sized(r)], both, ">= 90 %")
    _gap(inside)
    _parameters(single)
    _cost(rows)
    power_curve(single)
    confusion(single)
    wrong_cases([r for r in rows if _missed(r)])


def _unknown(row: Row) -> bool:
    return bool(row["verdict"] == "unknown")


def honest(row: Row) -> bool:
    """An effect out of the library answered as unknown, or by its own name in a tie.

    No data separates a slope of the screw from one of the scale: whichever of the two the library
    lacks, the answer is both of them.
    """
    return _unknown(row) or any(set(row["left_out"]) & set(group) for group in row["tied"])


def _gap(inside: Sequence[Row]) -> None:
    calm = [r for r in inside if right(r) and not set(r["hidden"]) & {"backlash", "preload_loss"}]
    for key, what in (
        ("noise_floor_um", "the noise floor it states   aim <= 1.05"),
        ("generator_noise_um", "the noise that the generator put in"),
    ):
        shares = [r["gap_after_um"] / r[key] for r in calm]
        if shares:
            print(f"median gap after {np.median(shares):.3f} times {what} ({len(shares)} cases)")


def _parameters(single: Sequence[Row]) -> None:
    known = [r for r in single if r["parameter"] and ratio(r) >= 6.0]
    rate("parameter within 5 % above 6 times the noise", known, lambda r: _error(r) < 0.05)
    if known:
        print(f"  median error {100 * np.median([_error(r) for r in known]):.1f} %")
        for name, errors in sorted(_errors_by_name(known).items()):
            print(f"    {name}: " + ", ".join(f"{100 * e:.1f} %" for e in errors))
    covered = [r for r in single if r["parameter"] and right(r)]
    rate("intervals that cover", covered, _covers, "93 .. 97 %")


def _errors_by_name(rows: Sequence[Row]) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    for row in rows:
        found.setdefault(row["parameter"]["name"], []).append(_error(row))
    return found


def _error(row: Row) -> float:
    p = row["parameter"]
    return float(abs(p["value"] / p["truth"] - 1.0))


def _covers(row: Row) -> bool:
    p = row["parameter"]
    return bool(p["lower95"] <= p["truth"] <= p["upper95"])


def _cost(rows: Sequence[Row]) -> None:
    if not rows:
        return
    cpu, wall = ([r[key] for r in rows] for key in ("cpu_s", "seconds"))
    memory = max(r["peak_memory_MB"] for r in rows)
    print(
        f"cost per case: cpu median {np.median(cpu):.0f} s, largest {max(cpu):.0f} s; wall median "
        f"{np.median(wall):.0f} s, largest {max(wall):.0f} s; peak memory {memory:.0f} MB"
    )


def power_curve(single: Sequence[Row]) -> None:
    """Named right against effect over noise."""
    print("power: effect over noise -> first name right")
    for low, high in pairwise(_STEPS):
        part = [r for r in single if low <= ratio(r) < high]
        if part:
            rate(f"  {low:g} to {high:g}", part, right)


def confusion(single: Sequence[Row]) -> None:
    """Hidden effect against what was said, one line per effect."""
    print("confusion: hidden -> verdict and names (cases)")
    counts: dict[str, Counter[str]] = {}
    for row in single:
        said = f"{row['verdict']}: {' + '.join(row['named']) or '-'}"
        counts.setdefault(next(iter(row["hidden"])), Counter())[said] += 1
    for name in sorted(counts):
        print(f"  {name}: " + "; ".join(f"{k} ({v})" for k, v in counts[name].most_common()))


def _missed(row: Row) -> bool:
    if row["kind"] == "clean":
        return bool(row["verdict"] != "none")
    if row["kind"] == "left-out":
        return sized(row) and not honest(row)
    if row["kind"] == "pair":
        return sized(row) and not both(row)
    return wrong(row) or (sized(row) and not settled(row))


def wrong_cases(rows: Sequence[Row]) -> None:
    """Every case that misses its aim, with what its evidence says of the reason."""
    print(f"cases that miss their aim: {len(rows)}")
    for row in rows:
        hidden = ", ".join(
            f"{name} {row['over_noise'].get(name, float('nan')):.1f}x" for name in row["hidden"]
        )
        print(
            f"  {row['kind']} {row['seed']} ({row['bench']}) {hidden or 'clean'} -> "
            f"{row['verdict']} {' + '.join(row['named']) or '-'}; gap {row['gap_before_um']:.3f} "
            f"-> {row['gap_after_um']:.3f}, floor {row['noise_floor_um']:.3f} um; {reason(row)}"
        )


def reason(row: Row) -> str:
    """Where the truth was lost: not screened in, beaten in the refit, or left with a remainder."""
    evidence = [dict(zip(_EVIDENCE, e, strict=True)) for e in row["evidence"]]
    found = []
    for name in row["hidden"]:
        own = [e for e in evidence if e["name"] == name]
        if name in row["left_out"]:
            found.append("not in the library")
        elif not own:
            found.append(f"{name} earned nothing on the screen")
        elif name not in row["named"] and any(e["status"] in _ACCEPTED for e in own):
            found.append(f"{name} was accepted, but not claimed beside a larger remainder")
        elif any(e["status"] in _ACCEPTED for e in own):
            found.append(f"{name} was found, a remainder was called unknown or more was added")
        elif all(e["status"] == "screened" for e in own):
            found.append(f"{name} did not reach the full refit")
        else:
            found.append(f"{name} lost the refit: {_beaten(own, evidence)}")
    return "; ".join(found) or f"left: {'; '.join(row['left'][:1]) or 'not localised'}"


_ACCEPTED = {"chosen", "tied"}
_EVIDENCE = ("name", "round", "status", "heldout", "screen", "p", "gap")


def _beaten(own: Sequence[Row], evidence: Sequence[Row]) -> str:
    mine = next(e for e in own if e["status"] == "lost")
    best = max(
        (e for e in evidence if e["round"] == mine["round"] and e["status"] != "screened"),
        key=lambda e: e["heldout"] if np.isfinite(e["heldout"]) else -np.inf,
    )
    if best["name"] == mine["name"]:
        return f"held-out gain {mine['heldout']:.3g} and p {mine['p']:.2g} earned no place"
    return f"held-out gain {mine['heldout']:.3g} against {best['heldout']:.3g} of {best['name']}"
