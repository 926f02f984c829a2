"""Commands that a careful user would run, computed apart from those of the program."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pmac_comp.files.bench import Bench

Command = NDArray[np.float64]
TAU = 2.0 * np.pi


def smooth(x: Command) -> Command:
    """Ramp from 0 to 1 with zero slope at both ends."""
    y = np.clip(x, 0.0, 1.0)
    return np.asarray(y**3 * (10 - 15 * y + 6 * y * y))


def grid(bench: Bench, seconds: float) -> Command:
    """Sample times of a run in s."""
    return bench.servo_period_s * np.arange(int(seconds / bench.servo_period_s))


def sine(
    bench: Bench, amplitude_m: float, frequency_Hz: float, seconds: float, centre_m: float
) -> Command:
    """Sinusoid that fades in and out over one period."""
    t = grid(bench, seconds)
    envelope = smooth(t * frequency_Hz) * smooth((seconds - t) * frequency_Hz)
    return np.asarray(centre_m + amplitude_m * envelope * np.sin(TAU * frequency_Hz * t))


def tones(bench: Bench, seconds: float, centre_m: float, rng: np.random.Generator) -> Command:
    """Four sinusoids of random frequency and phase."""
    t = grid(bench, seconds)
    f = rng.uniform([0.3, 0.9, 2.0, 4.0], [0.6, 1.6, 3.5, 7.0])
    a = np.array([0.025, 0.010, 0.0025, 0.0005])
    phases = rng.uniform(0, TAU, 4)
    total = (a[:, None] * np.sin(TAU * f[:, None] * t + phases[:, None])).sum(axis=0)
    return np.asarray(centre_m + smooth(t / 0.5) * smooth((seconds - t) / 0.5) * total)


def strokes(
    bench: Bench, centre_m: float, half_m: float, speeds: Sequence[float], acceleration: float
) -> Command:
    """Back and forth between two ends at the given speeds, jerk limited."""
    ends = [centre_m + half_m * (-1.0) ** (i + 1) for i in range(len(speeds) + 1)]
    return through(bench, ends, speeds, acceleration)


def through(
    bench: Bench, places_m: Sequence[float], speeds: Sequence[float], acceleration: float
) -> Command:
    """S-curve moves from place to place with a short rest at each, speeds in turn."""
    ts = bench.servo_period_s
    parts = [np.full(int(0.1 / ts), places_m[0])]
    for i, (here, there) in enumerate(pairwise(places_m)):
        distance, speed = abs(there - here), speeds[i % len(speeds)]
        ramp = min(1.5 * speed / acceleration, distance / speed)
        cruise = max(0.0, distance / speed - ramp)
        t = ts * np.arange(max(2, int((2 * ramp + cruise) / ts)))
        step = np.cumsum(smooth(t / ramp) * smooth((2 * ramp + cruise - t) / ramp))
        parts.append(here + (there - here) * step / step[-1])
        parts.append(np.full(int(0.05 / ts), there))
    return np.concatenate(parts)


def staircase(bench: Bench, seconds: float, rng: np.random.Generator) -> Command:
    """Steps over most of the travel and back, again and again."""
    low, high = bench.travel.min_mm * 0.8e-3, bench.travel.max_mm * 0.8e-3
    up = np.linspace(low, high, int(rng.integers(5, 9)))
    places = np.tile(np.concatenate([up, up[-2:0:-1]]), 5)
    return cut(bench, through(bench, places.tolist(), [0.2, 0.35], 3.0), seconds)


def cut(bench: Bench, command: Command, seconds: float) -> Command:
    """The command's first seconds."""
    return np.ascontiguousarray(command[: int(seconds / bench.servo_period_s)])


def campaign(bench: Bench, seed: int, *, seconds: float = 10.0) -> list[Command]:
    """Six commands for fitting: three places, several speeds and shapes."""
    rng = np.random.default_rng([seed, 1])
    ends = rng.uniform(0.18, 0.24)
    slow = [0.002, 0.003, 0.005, 0.008, 0.02, 0.02, 0.04]
    commands = [
        sine(bench, 0.012, rng.uniform(2.5, 3.5), seconds, -ends),
        sine(bench, 0.012, rng.uniform(2.5, 3.5), seconds, ends),
        sine(bench, 0.045, rng.uniform(0.7, 1.1), seconds, rng.uniform(-0.05, 0.05)),
        tones(bench, seconds, rng.uniform(-0.1, 0.1), rng),
        strokes(bench, 0.0, 0.2, [0.25, 0.25, 0.4, 0.4, 0.12, 0.3], rng.uniform(2.0, 4.0)),
        strokes(bench, rng.uniform(-0.1, 0.1), 0.006, slow, 1.0),
    ]
    return [cut(bench, c, seconds) for c in commands]


def judging_campaign(bench: Bench, seed: int, *, seconds: float = 10.0) -> list[Command]:
    """Three commands for validation, of other sizes, places and shapes."""
    rng = np.random.default_rng([seed, 2])
    moves = strokes(bench, 0.0, 0.15, [0.2, 0.35, 0.1, 0.3], rng.uniform(2.0, 4.0))
    commands = [
        sine(bench, 0.025, rng.uniform(1.2, 2.0), seconds, rng.uniform(-0.2, 0.2)),
        moves if rng.random() < 0.5 else staircase(bench, seconds, rng),
        tones(bench, seconds, rng.uniform(-0.15, 0.15), rng),
    ]
    return [cut(bench, c, seconds) for c in commands]
