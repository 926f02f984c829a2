"""What compensation reaches at the table, for each route, bench and plant, before and after.

    python tools/acceptance/compensation_table.py --out compensation_table.jsonl
    python tools/acceptance/compensation_table.py --benches paper_x4 --routes law --plants default

The whole job runs on the simulated card in this process: calibration captures, identification of
the base model with the form of friction that the captures show (as `identify` does), law and
tables, upload, fresh runs before and after on motions drawn by a seed (``--motions listed``: on a
fixed list of sinusoids about mid travel, small and slow ones among them). The errors are those of
the plant's unquantised positions, in the terms of README, Words. One line per motion is appended,
so that an interrupted run goes on where it stopped; the table is printed at the end (``--report``
prints it alone). Drawn and listed motions go to files of their own.

Aims: e_r at most a tenth of e, or 0.15 um where that is more (0.30 um with 10 000 counts per turn
or fewer), ``worst`` the largest share of that; total error at most a fifth of the baseline's on
``law`` and ``servo``. The other routes report what they reach. Single runs of a motion differ by
what the encoder's counts make of where the loop stands when it begins, up to a tenth: ``--repeats``
takes them together. ``promise`` is how often the measured e_r and total stay below the upper end of
what was promised, the sensors' steps apart.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.machine.controller.card.identity import read_identity
from pmac_comp.physics.signals.trajectory import sinusoid
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.plant.door import load_plant
from pmac_comp.simulator.plant.effects import PLANT_EFFECTS
from pmac_comp.workflow.accuracy.outcome import sensor_floor_um
from pmac_comp.workflow.capture.axis import Axis, run_all
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import TruthRecorder, default_servo, embedded
from pmac_comp.workflow.compensation.computing import compute_compensation
from pmac_comp.workflow.controller.deploy import deploy
from pmac_comp.workflow.model.identification import Friction, identify_captures
from pmac_comp.workflow.motion.campaigns import (
    calibration_motions,
    lead_motions,
    verification_motions,
)
from pmac_comp.workflow.motion.motions import Motion
from pmac_comp.workflow.verification.verify import verify_axis

Effects = Mapping[str, Mapping[str, float | str]]
PLANTS: dict[str, Effects | None] = {
    "default": None,  # friction that dips and grips, cogging, bias, lead
    "bare": {},
    "hertz": {
        "presliding": {"distance_um": 20.0, "place": "guide"},
        "axial_stiffness_nonlinear": {"preload_N": 1200.0},
        "friction_asymmetry": {},
        "cogging": {"amplitude_Nm": 0.05, "order_per_rev": 6.0},
    },
    "late": {
        "stribeck": {"excess_N": 25.0, "speed_m_per_s": 0.01},
        "actuator_delay": {"time_us": 650.0},
        "viscous_nonlinear": {},
        "torque_ripple": {},
        "lead_cyclic": {"amplitude_um": 3.0, "order_per_rev": 1.0},
    },
    "nut": {
        "presliding": {"distance_um": 30.0, "place": "nut"},
        "friction_per_rev": {"amplitude_Nm": 0.05, "order_per_rev": 1.0},
        "payload": {"mass_kg": 15.0},
        "nut_efficiency": {},
    },
    "loose": {"backlash": {"gap_um": 2.0}},  # unnamed: neither model nor bench file knows of it
    "worn": {"backlash": {"gap_um": 4.0}},
    "hung": {"backlash": {"gap_um": 4.0}, "bias_force": {"force_N": 150.0}},  # the same, hanging
}
ROUTES = ("law", "servo", "table", "cam", "program")
# Amplitude in mm and frequency in Hz, within 3000 rpm on a pitch of 10 mm: for a screw of 1 m the
# mechanical error goes from 1 um rms, nearly all of it friction, to 15 um, nearly all inertia.
LISTED = (
    (10, 0.5),
    (10, 1),
    (10, 2),
    (10, 3),
    (10, 5),
    (25, 1),
    (25, 3),
    (50, 1),
    (100, 0.5),
)


def plant_of(name: str, bench: Bench, seed: int) -> Any:
    """Plant of the list above, with one effect of the plug-in, or of a person's own file."""
    if name in PLANTS:
        return make_plant(bench, effects=PLANTS[name], seed=seed)
    effect, _, values = name.partition(":")
    if effect in PLANT_EFFECTS:
        given = dict(pair.split("=", 1) for pair in values.split(",") if pair)
        return make_plant(bench, effects={effect: given}, seed=seed)
    return load_plant(name, bench)


@contextmanager
def axis_on(bench: Bench, plant: Any, *, servo: bool) -> Iterator[tuple[Axis, TruthRecorder]]:
    """Axis, set up and enabled, of a fresh card with this plant."""
    source = default_servo().read_text(encoding="utf-8") if servo else None
    card = Card(bench, plant=plant, servo_source=source)
    recorder = TruthRecorder(card)
    with embedded(card) as link, tempfile.TemporaryDirectory() as folder:
        axis = Axis(link, bench, read_identity(link).fingerprint, simulated=True)
        axis.setup.store = Path(folder)  # another table may run beside this one
        axis.enable()
        yield axis, recorder


def calibrated(
    bench: Bench, plant: str, seed: int, friction: Friction = "coulomb"
) -> tuple[list[Any], list[Any], Any]:
    """Captures, slow runs and the identified model of a plant."""
    with axis_on(bench, plant_of(plant, bench, seed), servo=False) as (axis, _):
        captures = run_all(axis, calibration_motions(bench))
        slow = run_all(axis, lead_motions(bench))
    return (
        captures,
        slow,
        identify_captures(captures, bench, friction=friction).identification.model,
    )


def listed_motions(bench: Bench) -> list[Motion]:
    """Sinusoids of the list, about the middle of the travel."""
    return [
        Motion(
            f"sine {amplitude_mm} mm {frequency_Hz} Hz",
            sinusoid(
                period_s=bench.servo_period_s,
                amplitude_m=amplitude_mm / MM_PER_M,
                frequency_Hz=frequency_Hz,
                cycles=3.0,
                centre_m=bench.mid_travel_m,
            ),
        )
        for amplitude_mm, frequency_Hz in LISTED
    ]


def motions_of(bench: Bench, args: Any) -> list[Motion]:
    """Motions of the table."""
    if args.motions == "listed":
        return listed_motions(bench)
    return verification_motions(bench, args.motions_seed, n_sine=args.n, n_move=args.n)


def rows_of(
    bench: Bench, plant: str, seed: int, route: str, found: tuple[Any, Any, Any], args: Any
) -> list[dict[str, Any]]:
    """One row per motion of a route on a plant."""
    captures, slow, model = found
    motions = motions_of(bench, args)
    compensation = compute_compensation(
        bench,
        model,
        route=route,
        slow=tuple(slow),
        captures=tuple(captures),
        motion=motions[0],
        every_cycles=args.every if route == "law" else 1,
    )
    with (
        tempfile.TemporaryDirectory() as folder,
        axis_on(bench, plant_of(plant, bench, seed), servo=route == "servo") as (axis, recorder),
    ):
        context = context_of(axis, Path(folder))
        if route == "servo":
            axis.link.command(f"I{axis.motor}59=1")
        deploy(axis, compensation, context)
        measured = verify_axis(
            axis,
            context,
            compensation,
            motions,
            repeats=args.repeats,
            drive=model,
            truth=recorder.truth,
        )
    return [{**outcome.as_result(), "kept": kept(outcome, bench)} for outcome in measured.motions]


def kept(outcome: Any, bench: Bench) -> bool | None:
    """Whether the measured result lies within what was promised, sensor steps apart."""
    judged = outcome.promise_kept(sensor_floor_um(bench))
    return None if judged is None else bool(judged)


def aim_um(bench: Bench, e_um: float) -> float:
    """Largest e_r that meets the aim."""
    return max(0.1 * e_um, 0.30 if bench.encoder.counts_per_rev <= 10_000 else 0.15)


def report(path: Path) -> str:
    """Table of a result file."""
    groups: dict[tuple[str, str, int, str, int], list[dict[str, Any]]] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        key = (row["bench"], row["plant"], row["seed"], row["route"], row["every"])
        groups.setdefault(key, []).append(row)
    text = [
        f"{'bench':9s} {'plant':10s} seed {'route':9s} {'e um':>11s} {'e_r um':>11s} "
        f"{'met':>7s} {'worst':>5s} {'total um':>11s} {'after':>11s} {'ratio':>11s} "
        f"{'<=0.2':>7s} {'promise':>8s}"
    ]
    for (name, plant, seed, route, every), rows in groups.items():
        bench = load_bench(name)
        true = [row["truth"] for row in rows if row["truth"] is not None]
        e, after = column(true, "e_before_um"), column(true, "e_r_after_um")
        before, total = column(true, "total_before_um"), column(true, "total_after_um")
        shares = after / np.array([aim_um(bench, value_um) for value_um in e])
        met, worst = int(np.sum(shares <= 1.0)), float(np.max(shares, initial=0.0))
        ratio = total / before
        word = [row["kept"] for row in rows if row["kept"] is not None]
        label = route if every == 1 else f"{route}/{every}"
        text.append(
            f"{name:9s} {Path(plant).stem:10s} {seed:4d} {label:9s} {span(e)} {span(after)} "
            f"{met:3d}/{len(true):<3d} {worst:5.2f} {span(before)} {span(total)} {span(ratio)} "
            f"{int(np.sum(ratio <= 0.2)):3d}/{len(true):<3d} {sum(word):4d}/{len(word):<3d}"
        )
    return "\n".join(text)


def column(rows: list[dict[str, float]], name: str) -> np.ndarray:
    return np.array([row[name] for row in rows])


def span(values: np.ndarray) -> str:
    return f"{values.min():5.2f}-{values.max():5.2f}" if values.size else f"{'-':>11s}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--benches", nargs="+", default=["paper", "paper_x4"])
    parser.add_argument(
        "--plants",
        nargs="+",
        default=list(PLANTS),
        help="names, EFFECT[:PARAMETER=VALUE,...] or FILE[:FACTORY]",
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--routes", nargs="+", default=list(ROUTES), choices=ROUTES)
    parser.add_argument("--friction", default="auto", choices=("auto", "coulomb"),
                        help="form of friction of the model, as `identify --friction`")  # fmt: skip
    parser.add_argument("--every", type=int, default=1, help="servo cycles between two passes")
    parser.add_argument("--n", type=int, default=6, help="sinusoids, and as many moves")
    parser.add_argument("--repeats", type=int, default=1, help="pairs of runs of each motion")
    parser.add_argument("--motions", default="drawn", choices=("drawn", "listed"))
    parser.add_argument("--motions-seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("compensation_table.jsonl"))
    parser.add_argument("--report", action="store_true", help="print the table of --out only")
    args = parser.parse_args()
    if not args.report:
        fill(args)
    print(report(args.out))


def fill(args: Any) -> None:
    """Run what the result file does not hold yet."""
    lines = args.out.read_text(encoding="utf-8").splitlines() if args.out.exists() else []
    rows = map(json.loads, lines)
    done = {(r["bench"], r["plant"], r["seed"], r["route"], r["every"]) for r in rows}
    for name in args.benches:
        for plant in args.plants:
            for seed in args.seeds:
                keys = [(name, plant, seed, route, args.every) for route in args.routes]
                wanted = [key for key in keys if key not in done]
                if not wanted:
                    continue
                bench = load_bench(name)
                found = calibrated(bench, plant, seed, args.friction)
                for key in wanted:
                    start = time.process_time()
                    made = rows_of(bench, plant, seed, key[3], found, args)
                    names = ("bench", "plant", "seed", "route", "every")
                    head = dict(zip(names, key, strict=True))
                    with args.out.open("a", encoding="utf-8") as stream:
                        stream.writelines(json.dumps({**head, **row}) + "\n" for row in made)
                    print(f"{key}: {time.process_time() - start:.0f} s CPU", flush=True)


if __name__ == "__main__":
    main()
