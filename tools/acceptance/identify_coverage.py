"""Do the 95 % intervals of ``identify`` hold the truth 93-97 % of the time?

    python tools/acceptance/identify_coverage.py --benches 500 --out coverage.jsonl
    python tools/acceptance/identify_coverage.py --friction lugre --benches 40 --out lugre.jsonl

Each simulated bench has its own true quantities, drawn within the tolerances of the bench file, and
the plant is not the model that is fitted. One line per bench is appended, so that an interrupted
run goes on where it stopped. With ``--friction lugre`` the guide of the plant has presliding and
Stribeck friction of a size of its own, the captures are the default campaign, and ``identify``
chooses the form. The last lines give coverage per parameter and pooled, with its own 95 % interval
(Wilson).
"""

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np

from pmac_comp.base.errors import ModelError
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify import identify, identify_with_friction
from pmac_comp.physics.signals.trajectory import Trajectory, sinusoid, trapezoid, triangle
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.plant.ballscrew import DriveTruth
from pmac_comp.simulator.plant.effects import PlantEffects
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture
from pmac_comp.workflow.motion.campaigns import calibration_motions
from tests.generators.true_values import friction_of


def truth_si(truth: DriveTruth) -> dict[str, float]:
    """True quantities under the names of the model, SI."""
    return {
        "chain.motor_inertia_kgm2": truth.motor_inertia_kgm2,
        "chain.screw_inertia_kgm2": truth.screw_inertia_kgm2,
        "chain.table_mass_kg": truth.table_mass_kg,
        "chain.torsional_stiffness_Nm_per_rad": truth.torsional_stiffness_Nm_per_rad,
        "chain.axial_stiffness_N_per_m": truth.axial_stiffness_N_per_um * 1e6,
        "chain.screw_rigidity_N": truth.screw_rigidity_N,
        "chain.efficiency": truth.efficiency,
        "chain.current_bandwidth_Hz": truth.current_bandwidth_Hz,
        "chain.actuator_delay_s": truth.actuator_delay_us * 1e-6,
        "chain.damping_time_s": truth.damping_time_us * 1e-6,
        **friction_of(truth),
        "viscous.nut_Nms_per_rad": truth.nut_viscous_Nms_per_rad,
        "viscous.motor_Nms_per_rad": truth.motor_viscous_Nms_per_rad,
    }


def motions(bench: Bench, seed: int) -> list[Trajectory]:
    """Short runs at three places of the travel, drawn by the seed."""
    rng = np.random.default_rng([seed, 7])
    period = bench.servo_period_s

    def near(value: float) -> float:
        return float(value * rng.uniform(0.85, 1.15))

    return [
        sinusoid(period_s=period, amplitude_m=near(0.009), frequency_Hz=near(3.0), cycles=10,
                 centre_m=-0.25),
        sinusoid(period_s=period, amplitude_m=near(0.009), frequency_Hz=near(3.0), cycles=10,
                 centre_m=0.25),
        trapezoid(period_s=period, distance_m=near(0.45), speed_m_per_s=near(0.3),
                  acceleration_m_per_s2=near(3.0), s_curve_s=0.05, start_m=-0.25),
        triangle(period_s=period, amplitude_m=0.02, speed_m_per_s=near(0.04), cycles=2),
    ]  # fmt: skip


def captures_of(
    bench: Bench, seed: int, friction: str = "coulomb"
) -> tuple[list[Capture], dict[str, float]]:
    """Captures of one simulated bench and its truth."""
    effects, more = lugre(seed) if friction == "lugre" else ({}, {})
    plant = make_plant(bench, effects=effects, seed=seed)
    wanted = motions(bench, seed) if friction == "coulomb" else calibration_motions(bench)
    runs = [closed_loop_capture(bench, plant, run.position_m) for run in wanted]
    return runs, {**truth_si(plant.truth), **more}


def lugre(seed: int) -> tuple[PlantEffects, dict[str, float]]:
    """Presliding and Stribeck friction at the guide drawn by a seed, and their truth in SI."""
    rng = np.random.default_rng([seed, 11])
    distance_um, ratio = float(rng.uniform(5.0, 30.0)), float(rng.uniform(0.01, 0.1))
    excess_N, speed = float(rng.uniform(8.0, 25.0)), float(rng.uniform(0.003, 0.01))
    effects: PlantEffects = {
        "presliding": {"distance_um": distance_um, "damping_ratio": ratio},
        "stribeck": {"excess_N": excess_N, "speed_m_per_s": speed},
    }
    return effects, {
        "presliding.distance_m": distance_um * 1e-6,
        "presliding.damping_ratio": ratio,
        "stribeck.excess_N": excess_N,
        "stribeck.speed_m_per_s": speed,
    }


def trial(bench: Bench, seed: int, friction: str = "coulomb") -> dict[str, object]:
    """One bench: per parameter the error in standard deviations and whether the interval holds."""
    runs, truth = captures_of(bench, seed, friction)
    start = time.perf_counter()
    try:
        work = identify if friction == "coulomb" else identify_with_friction
        found = work(runs, bench)
    except ModelError as error:
        return {"seed": seed, "refused": type(error).__name__, "message": error.message}
    rows = {}
    for name, value in truth.items():
        estimate = found.parameters.get(name)
        if estimate is None:
            continue  # of a form that was not chosen
        rows[name] = {
            "z": (estimate.value - value) / estimate.std,
            "inside": bool(estimate.lower95 <= value <= estimate.upper95),
            "std_frac": estimate.std / abs(value),
            "informed": estimate.informed_frac,
        }
    seconds = time.perf_counter() - start
    effects = list(found.model.effects) if found.model is not None else []
    return {"seed": seed, "seconds": seconds, "effects": effects, "parameters": rows}


def wilson(inside: int, total: int) -> tuple[float, float]:
    """95 % interval of a proportion."""
    z, p = 1.959964, inside / total
    middle = (p + z**2 / (2 * total)) / (1 + z**2 / total)
    half = z * math.sqrt(p * (1 - p) / total + z**2 / (4 * total**2)) / (1 + z**2 / total)
    return middle - half, middle + half


def summary(path: Path) -> str:
    """Coverage table of a result file."""
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    good = [line for line in lines if "parameters" in line]
    text = [f"{len(good)} benches identified, {len(lines) - len(good)} refused"]
    total_in = total = 0
    for name in dict.fromkeys(name for line in good for name in line["parameters"]):
        rows = [line["parameters"][name] for line in good if name in line["parameters"]]
        inside = sum(row["inside"] for row in rows)
        total_in, total = total_in + inside, total + len(rows)
        z = np.array([row["z"] for row in rows])
        std = 100.0 * float(np.median([row["std_frac"] for row in rows]))
        text.append(
            f"{name:40s} {len(rows):4d} {100 * inside / len(rows):6.1f} %   z mean {z.mean():5.2f} "
            f"std {z.std():5.2f}   std {std:6.2f} % of the truth"
        )
    if total:
        low, high = wilson(total_in, total)
        text.append(f"pooled: {100 * total_in / total:.1f} % ({100 * low:.1f} to {100 * high:.1f})")
    return "\n".join(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--benches", type=int, default=500)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--bench", default="paper")
    parser.add_argument("--friction", choices=("coulomb", "lugre"), default="coulomb")
    parser.add_argument("--out", type=Path, default=Path("identify_coverage.jsonl"))
    given = parser.parse_args()
    bench = load_bench(given.bench)
    done = set()
    if given.out.exists():
        done = {json.loads(line)["seed"] for line in given.out.read_text().splitlines()}
    for seed in range(given.first, given.first + given.benches):
        if seed in done:
            continue
        row = json.dumps(trial(bench, seed, given.friction))
        with given.out.open("a") as stream:
            stream.write(row + "\n")
        print(f"bench {seed} done", flush=True)
    print(summary(given.out))


if __name__ == "__main__":
    main()
