"""Motions of one axis: named trajectories, their check, and their text on the command line."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import AmplitudeExceeded, ConfigError, MotorNotSafe, SafetyRefusal
from pmac_comp.base.units import MM_PER_M, MS_PER_S, S_PER_MIN
from pmac_comp.files.bench import Bench
from pmac_comp.physics.signals import trajectory as tr
from pmac_comp.physics.signals.trajectory import Trajectory

_WIGGLE_m = 150e-6
_WIGGLE_Hz = 6.0
_WIGGLE_s = 1.5
_WIGGLE_DECADES = 4.5  # natural ones: from 150 um to below 2 um
_REST_s = 0.1
_BETWEEN_s = 6.0  # jog to the start, rest, fading motion and reading out, as seen at servo rate


@dataclass(frozen=True)
class Motion:
    """A named trajectory on one bench."""

    name: str
    trajectory: Trajectory

    @property
    def position_m(self) -> FloatArray:
        """Commanded table position in m, shape (n,)."""
        return self.trajectory.position_m

    @property
    def duration_s(self) -> float:
        """Length in s."""
        return float(self.trajectory.time_s[-1])

    def row(self) -> tuple[str, float, float, float, float, float]:
        """Name, duration, range, peak speed and acceleration for people."""
        t = self.trajectory
        return (
            self.name,
            round(self.duration_s, 2),
            round(float(t.position_m.min()) * MM_PER_M, 3),
            round(float(t.position_m.max()) * MM_PER_M, 3),
            round(float(np.max(np.abs(t.velocity_m_per_s))) * MM_PER_M, 1),
            round(float(np.max(np.abs(t.acceleration_m_per_s2))), 3),
        )


def check_motion(motion: Motion, bench: Bench) -> None:
    """Refuse a motion that leaves the travel or passes the safety limits, all reasons at once."""
    t = motion.trajectory
    low, high = bench.travel_m
    speed = float(np.max(np.abs(t.velocity_m_per_s)))
    acceleration = float(np.max(np.abs(t.acceleration_m_per_s2)))
    refusals: list[SafetyRefusal] = []
    beyond = max(low - float(t.position_m.min()), float(t.position_m.max()) - high)
    if beyond > 1e-9:
        refusals.append(
            MotorNotSafe(
                f"{motion.name} runs from {t.position_m.min() * MM_PER_M:.1f} to "
                f"{t.position_m.max() * MM_PER_M:.1f} mm, {beyond * MM_PER_M:.3g} mm beyond the "
                f"travel of {low * MM_PER_M:g} to {high * MM_PER_M:g} mm.",
                code="PC-MOV-001",
                hint="Choose another centre or a shorter motion; the travel is [travel] of the "
                "bench file.",
            )
        )
    for value, limit, what, unit in (
        (speed * MM_PER_M, bench.safety.max_speed_mm_per_s, "speed", "mm/s"),
        (acceleration, bench.safety.max_acceleration_m_per_s2, "acceleration", "m/s2"),
    ):
        if value > limit * (1.0 + 1e-6):
            refusals.append(
                AmplitudeExceeded(
                    f"{motion.name}: {what} {value:.4g} {unit}, the limit is {limit:g} {unit}.",
                    code="PC-MOV-002",
                    hint="Choose a slower motion; the limits are [safety] of the bench file.",
                )
            )
    if refusals:
        raise SafetyRefusal(
            f"The motion {motion.name} is refused.",
            code="PC-MOV-000",
            hint="Choose a smaller motion or correct [travel] and [safety] in the bench file.",
            refusals=tuple(refusals),
        )


def is_allowed(motion: Motion, bench: Bench) -> bool:
    """Whether a motion stays within travel and safety limits."""
    try:
        check_motion(motion, bench)
    except SafetyRefusal:
        return False
    return True


# Specifications -----------------------------------------------------------------------------------

_Maker = Callable[[float, Mapping[str, float]], Trajectory]
# Keys of each kind of motion with their defaults; None: about the middle of the travel.
KEYS: Mapping[str, Mapping[str, float | None]] = {
    "sine": {"amplitude_mm": 10.0, "frequency_Hz": 1.0, "cycles": 4.0, "centre_mm": None},
    "trapezoid": {
        "distance_mm": 100.0,
        "speed_mm_per_s": 200.0,
        "acceleration_m_per_s2": 2.0,
        "s_curve_ms": 15.0,
        "start_mm": None,
        "repeats": 1.0,
    },
    "triangle": {
        "amplitude_mm": 10.0,
        "speed_mm_per_s": 5.0,
        "cycles": 2.0,
        "centre_mm": None,
        "acceleration_m_per_s2": 1.0,
    },
}


def _sine(period: float, v: Mapping[str, float]) -> Trajectory:
    return tr.sinusoid(
        period_s=period,
        amplitude_m=v["amplitude_mm"] / MM_PER_M,
        frequency_Hz=v["frequency_Hz"],
        cycles=v["cycles"],
        centre_m=v["centre_mm"] / MM_PER_M,
    )


def _trapezoid(period: float, v: Mapping[str, float]) -> Trajectory:
    return tr.trapezoid(
        period_s=period,
        distance_m=v["distance_mm"] / MM_PER_M,
        speed_m_per_s=v["speed_mm_per_s"] / MM_PER_M,
        acceleration_m_per_s2=v["acceleration_m_per_s2"],
        s_curve_s=v["s_curve_ms"] / MS_PER_S,
        start_m=v["start_mm"] / MM_PER_M,
        repeats=int(v["repeats"]),
    )


def _triangle(period: float, v: Mapping[str, float]) -> Trajectory:
    return tr.triangle(
        period_s=period,
        amplitude_m=v["amplitude_mm"] / MM_PER_M,
        speed_m_per_s=v["speed_mm_per_s"] / MM_PER_M,
        cycles=int(v["cycles"]),
        centre_m=v["centre_mm"] / MM_PER_M,
        acceleration_m_per_s2=v["acceleration_m_per_s2"],
    )


_MAKERS: Mapping[str, _Maker] = {"sine": _sine, "trapezoid": _trapezoid, "triangle": _triangle}


def parse_motion(text: str, bench: Bench) -> Motion:
    """Motion of ``kind:key=value,...`` or of a CSV file with a command.

    Raises
    ------
    ConfigError
        Unknown kind or key, or a value that is no number.
    """
    if text.lower().endswith((".csv", ".h5", ".hdf5")):
        return _motion_from_file(Path(text), bench)
    name, _, rest = text.partition(":")
    kind = name.strip().lower()
    maker = _MAKERS.get(kind)
    if maker is None:
        raise ConfigError(
            f"'{name}' is not a kind of motion.",
            code="PC-MOV-003",
            hint="Use " + ", ".join(_MAKERS) + " or the name of a CSV file.",
        )
    values = _key_values(rest, text)
    unknown = [key for key in values if key not in KEYS[kind]]
    if unknown:
        raise ConfigError(
            f"'{text}': a {kind} has no {', '.join(unknown)}.",
            code="PC-MOV-004",
            hint=f"Its keys are {', '.join(KEYS[kind])}.",
        )
    motion = Motion(text, maker(bench.servo_period_s, _whole(kind, values, bench)))
    check_motion(motion, bench)
    return motion


def _whole(kind: str, values: Mapping[str, float], bench: Bench) -> dict[str, float]:
    """Every value of a motion; it lies about the middle of the travel where no place is given."""
    stated = {key: value for key, value in KEYS[kind].items() if value is not None} | dict(values)
    middle_mm = bench.mid_travel_m * MM_PER_M
    if kind == "trapezoid":
        return {"start_mm": middle_mm - stated["distance_mm"] / 2.0, **stated}
    return {"centre_mm": middle_mm, **stated}


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(text)
    return number


def _key_values(text: str, whole: str) -> dict[str, float]:
    values: dict[str, float] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        key, _, value = item.partition("=")
        try:
            values[key.strip()] = _finite(value)
        except ValueError as error:
            raise ConfigError(
                f"'{whole}': '{item}' is not key=number.",
                code="PC-MOV-005",
                hint="For example: sine:amplitude_mm=10,frequency_Hz=2",
            ) from error
    return values


def _motion_from_file(path: Path, bench: Bench) -> Motion:
    from pmac_comp.workflow.motion.commands import read_command

    time_s, position = read_command(path)
    period = bench.servo_period_s
    n = math.floor((time_s[-1] - time_s[0]) / period) + 1
    grid = period * np.arange(n)
    from scipy.interpolate import CubicSpline

    motion = Motion(path.stem, Trajectory(grid, CubicSpline(time_s - time_s[0], position)(grid)))
    check_motion(motion, bench)
    return motion


def relaxing(motion: Motion) -> tuple[Motion, int]:
    """The motion with a fading wiggle and a short rest before it, and the sample it starts at.

    Friction remembers the approach: the drive stands wound up, and the integrator pushes against
    it. A wiggle that fades through the presliding distance leaves it relaxed, which is how a
    simulation starts.
    """
    period = motion.trajectory.sample_period_s
    t = np.arange(1, round(_WIGGLE_s / period)) * period
    rise = np.clip(t * _WIGGLE_Hz, 0.0, 1.0)
    fade = np.exp(-_WIGGLE_DECADES * t / _WIGGLE_s) * (1.0 - (t / _WIGGLE_s) ** 8)
    shape = _WIGGLE_m * rise**2 * (3.0 - 2.0 * rise) * fade * np.sin(2 * np.pi * _WIGGLE_Hz * t)
    start = motion.position_m[0]
    inward = 1.0 if np.mean(motion.position_m) >= start else -1.0
    rest = np.full(round(_REST_s / period), start)
    position = np.concatenate([[start], start + inward * shape, rest, motion.position_m])
    first = 1 + shape.size + rest.size
    grid = period * np.arange(position.size, dtype=np.float64)
    return Motion(motion.name, Trajectory(grid, position)), first


def motion_rows(motions: Sequence[Motion]) -> list[tuple[Any, ...]]:
    """Rows of a table of motions."""
    return [motion.row() for motion in motions]


_LEADING: Final = ("amplitude_mm", "frequency_Hz", "distance_mm", "speed_mm_per_s",
                   "acceleration_m_per_s2")  # fmt: skip
_IN_WORDS: Final = {"mm_per_s": "mm/s", "m_per_s2": "m/s2", "mm": "mm", "Hz": "Hz", "ms": "ms"}


def short_motion(name: str) -> str:
    """A motion that ``parse_motion`` takes in fewer words: ``sine 10 mm, 0.5 Hz``; others as is."""
    kind, _, rest = name.partition(":")
    pairs = [part.partition("=") for part in rest.split(",")]
    if kind not in KEYS or not all(key in KEYS[kind] for key, _, _ in pairs):
        return name
    said = []
    for key, _, value in pairs:
        end = next((end for end in _IN_WORDS if key.endswith(f"_{end}")), "")
        what = "" if key in _LEADING else key.removesuffix(f"_{end}").replace("_", " ")
        said.append(" ".join(filter(None, (what, value, _IN_WORDS.get(end)))))
    return f"{kind} {', '.join(said)}"


def time_needed(runs: Sequence[tuple[int, Motion]]) -> str:
    """How long a session takes, for people; how often each motion runs beside it."""
    number = sum(n for n, _ in runs)
    moving_s = sum(n * motion.duration_s for n, motion in runs)
    whole_min = (moving_s + number * _BETWEEN_s) / S_PER_MIN
    return (
        f"{moving_s / S_PER_MIN:.1f} min of motion in {number} run{'s' * (number != 1)}, about "
        f"{whole_min:.1f} min with the ways to their starts"
    )
