"""Speed and accuracy of the compiled drive model, as ratios within one run.

Compares the closed loop with the same equations in C at -O3, with ``solve_ivp`` at equal accuracy
and with a converged solution; shows how cost grows with substeps, effects and length. Run as
``python tools/bench_model.py [--quick]``; needs a C compiler for the first part.
"""

import argparse
import ctypes
import json
import math
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numba import njit
from scipy.integrate import solve_ivp

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify import identify_with_friction
from pmac_comp.physics.model import kernel, kernel_chain
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.drive import DriveModel, simulate, simulate_many
from pmac_comp.physics.model.loop import NODE_SPACING_m
from pmac_comp.physics.signals import trajectory as tr
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.plant.effects import PlantEffects
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture

# Order of the enumeration in bench_model.c.
PARAMETERS = (
    s.PERIOD, s.LEAD, s.X_ORIGIN, s.CURRENT_RATE, s.DELAY, s.LIMIT, s.ACTUATOR_LIMIT, s.K_NUT,
    s.NUT_LOAD, s.MOTOR + s.LEVEL, s.NUT + s.LEVEL, s.GUIDE + s.LEVEL, s.KP, s.KI, s.KD, s.KVFF,
    s.KAFF, s.FRICTION_FF, s.OFFSET, s.INTEGRATOR_LIMIT,
)  # fmt: skip
MARGIN_m = 0.02  # step matrices are tabulated this far beyond the command
WITH_FORMS: PlantEffects = {
    "presliding": {"distance_um": 10.0},
    "stribeck": {"excess_N": 15.0, "speed_m_per_s": 0.005},
}


def cpu_s(work: Callable[[], object], *, repeats: int) -> float:
    """Least processor time of one call in s (of this thread, so that neighbours do not count)."""
    best = math.inf
    for _ in range(repeats):
        start = time.thread_time()
        work()
        best = min(best, time.thread_time() - start)
    return best


def compiled_c(folder: Path) -> ctypes.CDLL | None:
    """The C source beside this file, compiled; None without a compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        return None
    library = folder / "bench_model.so"
    source = Path(__file__).with_suffix(".c")
    flags = ["-O3", "-march=native", "-shared", "-fPIC", "-o", str(library)]
    subprocess.run([compiler, *flags, str(source), "-lm"], check=True)
    return ctypes.CDLL(str(library))


class Case:
    """One motion prepared for both kernels."""

    def __init__(self, model: DriveModel, motion: tr.Trajectory, n_sub: int) -> None:
        self.vector = model.kernel_vector()
        self.n_sub = n_sub
        self.desired = motion.position_m
        places = self.desired + self.vector[s.X_ORIGIN]
        low = math.floor((float(places.min()) - MARGIN_m) / NODE_SPACING_m)
        high = math.ceil((float(places.max()) + MARGIN_m) / NODE_SPACING_m)
        self.first = low * NODE_SPACING_m
        step_s = self.vector[s.PERIOD] / n_sub
        self.bank: FloatArray = kernel_chain.step_bank(
            self.vector, self.first, NODE_SPACING_m, high - low + 1, step_s
        )
        self.zeros = np.zeros(motion.n)
        self.out = np.zeros((5, motion.n))
        self.short = np.ascontiguousarray(self.vector[list(PARAMETERS)])
        self.rows, self.values = np.zeros((0, s.TERM_COLUMNS)), np.zeros((0, 1))

    def numba(self) -> FloatArray:
        kernel.run(
            self.vector, self.bank, self.first, NODE_SPACING_m, self.n_sub, self.desired,
            self.zeros, self.zeros, self.rows, self.values, 0.0, self.out,
        )  # fmt: skip
        return self.out

    def c(self, library: ctypes.CDLL) -> FloatArray:
        def pointer(array: FloatArray) -> object:
            return array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))

        library.run(
            pointer(self.short), pointer(self.bank), self.bank.shape[0],
            ctypes.c_double(self.first), ctypes.c_double(NODE_SPACING_m), self.n_sub,
            pointer(self.desired), pointer(self.zeros), pointer(self.zeros), self.desired.size,
            pointer(self.out),
        )  # fmt: skip
        return self.out


def against_c(model: DriveModel, motion: tr.Trajectory, repeats: int) -> dict[str, float]:
    case = Case(model, motion, model.substeps)
    ours = case.numba().copy()
    with tempfile.TemporaryDirectory() as folder:
        library = compiled_c(Path(folder))
        if library is None:
            return {}
        theirs = case.c(library).copy()
        # In turns, so that a change of clock speed meets both.
        pairs = [
            (cpu_s(case.numba, repeats=3), cpu_s(lambda: case.c(library), repeats=3))
            for _ in range(repeats)
        ]
    numba_s, c_s = min(a for a, _ in pairs), min(b for _, b in pairs)
    return {
        "time over C -O3": numba_s / c_s,
        "largest difference from C, nm": float(np.max(np.abs(ours[1] - theirs[1]))) * 1e9,
        "servo cycles per us of processor time": motion.n / numba_s / 1e6,
    }


def against_scipy(model: DriveModel) -> dict[str, float]:
    """The mechanics of a short stretch under a given torque, solved to the error of ours."""
    smooth = model.without_effect("coulomb").with_parameters({"chain.efficiency": 1.0})
    period = model.bench.servo_period_s
    motion = tr.sinusoid(
        period_s=period, amplitude_m=0.005, frequency_Hz=5.0, cycles=0.5, ramp_cycles=0.5,
        dwell_s=0.01,
    )  # fmt: skip
    response = simulate(smooth, motion)
    ours_s = cpu_s(lambda: simulate(smooth, motion), repeats=5)
    vector = smooth.kernel_vector()
    delay, rate = vector[s.DELAY], vector[s.CURRENT_RATE]
    torque = response.torque_command_Nm

    @njit
    def right_side(t: float, y: FloatArray) -> FloatArray:
        mass, damping, stiffness = kernel_chain.chain_matrices(vector, y[3] + vector[s.X_ORIGIN])
        cell = math.floor((t - delay) / period + 1e-9)
        held = torque[cell] if cell >= 0 else 0.0
        force = -damping @ y[4:8] - stiffness @ y[:4]
        force[0] += y[8]
        slope = np.empty(9)
        slope[:4] = y[4:8]
        slope[4:8] = np.linalg.solve(mass, force)
        slope[8] = rate * (held - y[8])
        return slope

    def solved(rtol: float) -> FloatArray:
        y, errors = np.zeros(9), [0.0]
        # Each piece has a constant torque: the solver never meets a jump.
        for k in range(motion.n - 1):
            edge = (k * period, (k + 1) * period)
            got = solve_ivp(right_side, edge, y, method="DOP853", rtol=rtol, atol=rtol * 1e-6)
            y = got.y[:, -1]
            errors.append(y[3] - vector[s.LEAD] * y[0])
        return np.asarray(errors)

    reference = solved(1e-9)
    target = float(np.std(response.mechanical_error_m - reference))
    for rtol in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7):
        start = time.thread_time()
        miss = float(np.std(solved(rtol) - reference))
        spent = time.thread_time() - start
        if miss <= max(target, 1e-10):
            break
    return {
        "solve_ivp (DOP853, compiled right side) over ours, time at equal accuracy": spent / ours_s,
        "mechanical error of ours, nm rms": target * 1e9,
        "mechanical error of solve_ivp, nm rms": miss * 1e9,
    }


def accuracy(model: DriveModel, motions: dict[str, tr.Trajectory]) -> dict[str, object]:
    found: dict[str, object] = {}
    for name, motion in motions.items():
        truth = simulate(model, motion, substeps=128).table_position_m
        base_s = cpu_s(partial(simulate, model, motion), repeats=3)
        found[name] = {
            f"{n} substeps": {
                "table error, nm rms": round(
                    float(np.std(simulate(model, motion, substeps=n).table_position_m - truth))
                    * 1e9,
                    3,
                ),
                "time over default": round(
                    cpu_s(partial(simulate, model, motion, substeps=n), repeats=3) / base_s, 2
                ),
            }
            for n in (1, 2, 4, 8, 16)
        }
    return found


def growth(model: DriveModel, motion: tr.Trajectory) -> dict[str, object]:
    base_s = cpu_s(lambda: simulate(model, motion), repeats=5)
    added: dict[str, float] = {}
    for name in ("stribeck", "presliding", "presliding_gms", "friction_per_rev", "cogging",
                 "lead_cyclic", "backlash"):  # fmt: skip
        grown = model.with_effect(name)
        simulate(grown, motion)
        added[name] = round(cpu_s(partial(simulate, grown, motion), repeats=3) / base_s, 2)
    lengths: dict[str, float] = {}
    for factor in (2, 4):
        longer = motion
        for _ in range(factor - 1):
            longer = longer.then(motion)
        spent = cpu_s(partial(simulate, model, longer), repeats=3)
        lengths[f"{factor} times as long"] = round(spent / base_s, 2)
    models = [model] * 40
    start = time.perf_counter()
    simulate_many(models, [motion], workers=1)
    one = time.perf_counter() - start
    start = time.perf_counter()
    simulate_many(models, [motion], workers=2)
    two = time.perf_counter() - start
    return {
        "one effect more, time over base": added,
        "length, time over base": lengths,
        "speed-up with two threads": round(one / two, 2),
    }


def six_captures(seconds: float, effects: PlantEffects) -> list[Capture]:
    """Six motions of the simulated plant, each cut to a length."""
    bench = load_bench("paper")
    period = bench.servo_period_s
    plant = make_plant(bench, effects=effects, seed=1)
    sines = [(0.01, 3.0, -0.25), (0.01, 3.0, 0.25), (0.05, 0.8, 0.0), (0.02, 1.5, 0.1)]
    motions = [
        tr.sinusoid(period_s=period, amplitude_m=a, frequency_Hz=f, cycles=seconds * f, centre_m=c)
        for a, f, c in sines
    ]
    motions += [
        tr.trapezoid(
            period_s=period, distance_m=0.4, speed_m_per_s=0.25, acceleration_m_per_s2=3.0,
            s_curve_s=0.02, start_m=-0.2, repeats=3,
        ),
        tr.triangle(period_s=period, amplitude_m=0.02, speed_m_per_s=0.016, cycles=2),
    ]  # fmt: skip
    captures = [closed_loop_capture(bench, plant, motion.position_m) for motion in motions]
    return [capture.slice(0, min(capture.n, round(seconds / period))) for capture in captures]


def identification(seconds: float) -> dict[str, dict[str, object]]:
    """Friction and stiffness from six captures, as ``pmac-comp identify`` finds them by default.

    On a drive with Coulomb friction, which the first fit settles, and on one with presliding and
    Stribeck friction, where forms are tried on halves of the captures. Processor time is that of
    all threads; on two idle cores the identification takes a little more than half of it (see the
    speed-up with two threads).
    """
    bench = load_bench("paper")
    drives: dict[str, PlantEffects] = {"Coulomb friction": {}, "presliding, Stribeck": WITH_FORMS}
    found = {}
    for name, effects in drives.items():
        captures = six_captures(seconds, effects)
        cpu, wall = time.process_time(), time.perf_counter()
        result = identify_with_friction(captures, bench)
        found[name] = {
            "captures": len(captures),
            "seconds of data": round(sum(c.n for c in captures) * bench.servo_period_s, 1),
            "processor time, s": round(time.process_time() - cpu, 2),
            "elapsed on this machine now, s": round(time.perf_counter() - wall, 2),
            "friction found": list(result.model.effects) if result.model is not None else [],
        }
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer repeats, shorter motions")
    parser.add_argument("--json", type=Path, default=None, help="also write the figures here")
    options = parser.parse_args()
    bench = load_bench("paper")
    period = bench.servo_period_s
    model = DriveModel.base(bench)
    cycles = 10.0 if options.quick else 46.0
    motion = tr.sinusoid(period_s=period, amplitude_m=0.01, frequency_Hz=5.0, cycles=cycles)
    motions = {
        "sinusoid 10 mm 5 Hz": motion,
        "trapezoid 0.3 m/s, 3 m/s2, jerk unlimited": tr.trapezoid(
            period_s=period, distance_m=0.1, speed_m_per_s=0.3, acceleration_m_per_s2=3.0
        ),
        "triangle 2 mm/s": tr.triangle(
            period_s=period, amplitude_m=0.002, speed_m_per_s=0.002, cycles=1
        ),
    }
    simulate(model, motion)
    result = {
        "against C": against_c(model, motion, 3 if options.quick else 10),
        "against SciPy": against_scipy(model),
        "accuracy and substeps": accuracy(model, motions),
        "growth": growth(model, motion),
        "identification of six captures (aim: under 15 s on two cores)": identification(
            3.0 if options.quick else 10.0
        ),
    }
    text = json.dumps(result, indent=2)
    print(text)
    if options.json is not None:
        options.json.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
