"""How well does an identified drive predict motions that it was not fitted to?

    python tools/acceptance/prediction_table.py run --out prediction.jsonl --seeds 5
    python tools/acceptance/prediction_table.py report --out prediction.jsonl

Every case is a bench drawn within its tolerances (``paper``, ``paper_x4``), a friction form of the
simulated plant (code that shares nothing with the model), the default campaign as captures, what
``pmac-comp identify`` makes of them by default, and a set of unseen motions across the travel. The
model sees the commands of those motions only. Judged is the dynamic mechanical tracking error,
table minus motor without the static map and a constant: ``left`` on the plant's unquantised
positions, ``measured`` on what encoder and scale read; the floor is what the sensors' rounding
alone makes of it. One line per case is appended, so that a run goes on where it stopped.
"""

import argparse
import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ModelError
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify import Identification, identify, identify_with_friction
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.expected import expected_response
from pmac_comp.physics.signals import trajectory as tr
from pmac_comp.simulator.plant import kernel_ballscrew as k
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.plant.ballscrew import BallscrewPlant
from pmac_comp.simulator.plant.effects import PlantEffects
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture, run_closed_loop
from pmac_comp.workflow.motion.campaigns import calibration_motions

AIM_um = 0.2
AUTO = ("auto",)
BENCHES = ("paper", "paper_x4")
# Amplitude in mm and frequency in Hz within 3000 rpm and the rated torque.
SINUSOIDS = (
    (10, 0.5), (10, 1.0), (10, 2.0), (10, 3.0), (10, 5.0), (25, 1.0), (25, 3.0), (50, 1.0),
    (100, 0.5),
)  # fmt: skip


@dataclass(frozen=True)
class Friction:
    """A friction form of the plant, and the effects with which the model is also fitted."""

    effects: PlantEffects | None
    named: tuple[str, ...] = ()


FRICTION: Mapping[str, Friction] = {
    "base": Friction({}),
    "lugre": Friction(
        {
            "presliding": {"distance_um": 10.0},
            "stribeck": {"excess_N": 15.0, "speed_m_per_s": 0.005},
        },
    ),
    "gms": Friction({"presliding": {"distance_um": 20.0, "elements": 8.0}}),
    "rotary": Friction(
        {"presliding": {"distance_um": 8.0, "place": "rotary"}}
    ),
    # The drive of the paper: presliding at guide and screw at once.
    "paper": Friction({"stribeck": {"excess_N": 15.0, "speed_m_per_s": 0.005}}),
    # Everything that the demo's drive hides.
    "default": Friction(
        None,
        ("presliding", "stribeck", "post_reversal_dip", "friction_per_rev", "cogging",
         "bias_force"),
    ),
}  # fmt: skip


def unseen(bench: Bench, seed: int) -> dict[str, tr.Trajectory]:
    """Motions for judging, places and sizes drawn by the seed; names are ``class: detail``."""
    rng = np.random.default_rng([seed, 99])
    period = bench.servo_period_s
    low, high = bench.travel.min_mm / 1e3, bench.travel.max_mm / 1e3
    motions = {}
    for place in (0.15, 0.5, 0.85):
        for kind, smooth_s in (("jerk-limited", 0.02), ("jerk-unlimited", 0.0)):
            distance, speed = rng.uniform(0.05, 0.15), rng.uniform(0.1, 0.5)
            acceleration = rng.uniform(1.0, 5.0)
            middle = low + place * (high - low)
            start = np.clip(middle - 0.5 * distance, low, high - distance)
            name = f"trapezoid {kind}: {speed:.2f} m/s {acceleration:.1f} m/s2 at {middle:.2f}"
            motions[name] = tr.trapezoid(
                period_s=period, distance_m=distance, speed_m_per_s=speed,
                acceleration_m_per_s2=acceleration, s_curve_s=smooth_s, start_m=float(start),
            )  # fmt: skip
    for amplitude_mm, frequency in SINUSOIDS:
        reach = 1.05 * amplitude_mm / 1e3
        motions[f"sinusoid: {amplitude_mm} mm {frequency:g} Hz"] = tr.sinusoid(
            period_s=period, amplitude_m=amplitude_mm / 1e3, frequency_Hz=frequency,
            cycles=max(3.0, 2.0 * frequency), centre_m=rng.uniform(low + reach, high - reach),
        )  # fmt: skip
    motions["multisine: 0.5 to 4 Hz"] = tr.multisine(
        period_s=period, amplitude_m=0.04, frequencies_Hz=list(rng.uniform(0.9, 1.1, 4)
        * np.array([0.5, 1.1, 2.3, 4.1])), duration_s=5.0,
        centre_m=rng.uniform(low + 0.05, high - 0.05), seed=seed,
    )  # fmt: skip
    for speed in (1e-3, 5e-3):
        motions[f"triangle: {speed * 1e3:g} mm/s"] = tr.triangle(
            period_s=period, amplitude_m=2.0 * speed, speed_m_per_s=speed, cycles=1,
            centre_m=rng.uniform(low + 0.02, high - 0.02),
        )  # fmt: skip
    return motions


def judged(
    plant: BallscrewPlant,
    bench: Bench,
    found: Identification,
    motions: Mapping[str, tr.Trajectory],
) -> dict[str, dict[str, float]]:
    """Per motion: rms of the error, of what the prediction leaves, and of what sensors add, um."""
    if found.model is None:
        raise ModelError("The identification holds no model.")
    rows = {}
    for name, motion in motions.items():
        run = run_closed_loop(bench, plant, motion.position_m)
        true = run["true_table_position_m"] - run["true_motor_position_m"]
        seen = run["table_position_m"] - run["motor_position_m"]
        rounding = seen - true
        if found.static_map is not None:
            true = true - found.static_map.error_m(run["true_table_position_m"])
        predicted = expected_response(found.model, motion.position_m).mechanical_error_m
        rows[name] = {
            "error_um": rms_um(true),
            "left_um": rms_um(true - predicted),
            "measured_um": rms_um(true + rounding - predicted),
            "floor_um": rms_um(rounding),
        }
    return rows


def rms_um(values: FloatArray) -> float:
    """Rms without the mean, um."""
    return UM_PER_M * float(np.std(values))


def plant_of(bench: Bench, kind: str, seed: int) -> BallscrewPlant:
    """Plant of a friction form."""
    plant = make_plant(bench, effects=FRICTION[kind].effects, seed=seed)
    if kind == "paper":
        _soften(plant)
    return plant


def _soften(plant: BallscrewPlant) -> None:
    """LuGre bristles, usual figures, at guide, nut and motor."""
    par = plant.par
    par[[k.P_GUIDE_BRISTLE, k.P_NUT_BRISTLE, k.P_MOTOR_BRISTLE]] = 1.0
    par[k.P_GUIDE_BREAK] = par[k.P_GUIDE_LEVEL] / 4.5e6  # sigma0, N/m
    par[k.P_GUIDE_DAMPING] = 1500.0  # sigma1, N s/m
    par[[k.P_NUT_BREAK, k.P_MOTOR_BREAK]] = 5e-3  # rad
    par[[k.P_NUT_DAMPING, k.P_MOTOR_DAMPING]] = 0.01
    plant.reset()


def _identified(captures: list[Capture], bench: Bench, effects: tuple[str, ...]) -> Identification:
    """What ``pmac-comp identify`` does by default (``auto``), or with effects by name."""
    if effects == AUTO:
        return identify_with_friction(captures, bench)
    model = DriveModel.base(bench)
    for effect in effects:
        model = model.with_effect(effect)
    return identify(captures, bench, model=model)


def case(name: str, kind: str, seed: int, effects: tuple[str, ...]) -> dict[str, Any]:
    """One bench, one friction form, one model: what it leaves on every unseen motion."""
    bench = load_bench(name)
    plant = plant_of(bench, kind, seed)
    captures = [closed_loop_capture(bench, plant, m.position_m) for m in calibration_motions(bench)]
    result: dict[str, Any] = {"bench": name, "kind": kind, "seed": seed, "effects": list(effects)}
    began = time.process_time()
    try:
        found = _identified(captures, bench, effects)
    except ModelError as error:
        return {**result, "refused": error.message}
    result["cpu_s"] = time.process_time() - began
    if found.model is not None:
        result["found"] = list(found.model.effects)
    return {**result, "motions": judged(plant, bench, found, unseen(bench, seed))}


def plan(benches: list[str], kinds: list[str], seeds: int) -> Iterator[tuple[Any, ...]]:
    """Cases in an order that fills the table evenly."""
    for seed in range(1, seeds + 1):
        for kind in kinds:
            for name in benches:
                yield name, kind, seed, AUTO
                if FRICTION[kind].named:
                    yield name, kind, seed, FRICTION[kind].named


def read(path: Path) -> list[dict[str, Any]]:
    """Cases done so far."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]


def run(args: argparse.Namespace) -> None:
    """Do the cases that are not done yet."""
    done = {(r["bench"], r["kind"], r["seed"], tuple(r["effects"])) for r in read(args.out)}
    for one in plan(args.bench, args.kind, args.seeds):
        if one in done:
            continue
        row = case(*one)
        with args.out.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(row) + "\n")
        lefts = [m["left_um"] for m in row.get("motions", {}).values()]
        said = row.get("refused") or f"left {np.mean(lefts):.3f}, worst {max(lefts):.3f} um"
        print(*one[:3], *one[3], "->", *row.get("found", ())[2:], said, flush=True)


def table(rows: list[dict[str, Any]]) -> str:
    """Table for people: one line per bench, friction form, model and class of motion."""
    groups: dict[tuple[str, str, str, str], list[dict[str, float]]] = {}
    refused = 0
    for row in rows:
        refused += "refused" in row
        model = "by default" if tuple(row["effects"]) == AUTO else "effects named"
        for name, figures in row.get("motions", {}).items():
            key = (row["bench"], row["kind"], model, name.partition(":")[0])
            groups.setdefault(key, []).append(figures)
    text = [
        f"{'bench':9s} {'plant':8s} {'model':17s} {'motion':25s} {'n':>3s} {'error':>6s} "
        f"{'left':>6s} {'worst':>6s} {'<= 0.2':>7s} {'measured ok':>11s}"
    ]
    for key, figures in sorted(groups.items()):
        left = np.array([f["left_um"] for f in figures])
        limit = np.array([np.hypot(f["floor_um"], AIM_um) for f in figures])
        seen = np.array([f["measured_um"] for f in figures]) <= limit
        error = float(np.mean([f["error_um"] for f in figures]))
        text.append(
            f"{key[0]:9s} {key[1]:8s} {key[2]:17s} {key[3]:25s} {left.size:3d} {error:6.2f} "
            f"{left.mean():6.3f} {left.max():6.3f} {100 * np.mean(left <= AIM_um):6.0f}% "
            f"{100 * np.mean(seen):10.0f}%"
        )
    text.append(f"{len(rows)} cases, {refused} refused; um rms")
    return "\n".join(text)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    runner, reporter = commands.add_parser("run"), commands.add_parser("report")
    runner.add_argument("--seeds", type=int, default=5)
    runner.add_argument("--bench", nargs="+", default=list(BENCHES))
    runner.add_argument("--kind", nargs="+", default=list(FRICTION), choices=list(FRICTION))
    for each in (runner, reporter):
        each.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    if args.command == "run":
        run(args)
    else:
        print(table(read(args.out)))


if __name__ == "__main__":
    main()
