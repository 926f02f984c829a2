"""Look-alikes: which effects leave the same trace, and the run that tells them apart.

What lives here: groups and experiments. The effects' own words come from the library. May import
``physics.model`` and ``result``.
"""

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass

from pmac_comp.base.units import MM_PER_M, UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.diagnose.localise import TURNED
from pmac_comp.physics.diagnose.result import SeparatingExperiment
from pmac_comp.physics.model import slots
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import Effect

# Exact twins: no run of this axis alone separates them (both are one slope of the scale reading).
_TWINS = (frozenset({"lead_linear", "scale_slope"}),)

# Groups that ordinary data may fail to separate: the same line, step or wave in one quantity.
_GROUPS = (
    frozenset({"bias_force", "friction_asymmetry"}),
    frozenset({"encoder_eccentricity", "lead_cyclic"}),
    frozenset({"actuator_delay", "current_bandwidth"}),
    frozenset({"backlash", "preload_loss"}),
    frozenset({"channel_skew", "viscous"}),
    *_TWINS,
)

_SLOW_mm_per_s = 40.0
_STROKE_s = 2.0


@dataclass(frozen=True)
class _Room:
    """What the bench allows: travel in mm, speed in mm/s, acceleration in m/s2."""

    low_mm: float
    high_mm: float
    pitch_mm: float
    speed_mm_per_s: float
    acceleration_m_per_s2: float

    @classmethod
    def of(cls, bench: Bench) -> "_Room":
        return cls(
            bench.travel.min_mm,
            bench.travel.max_mm,
            bench.screw.pitch_mm,
            bench.usable_speed_m_per_s * MM_PER_M,
            bench.safety.max_acceleration_m_per_s2,
        )

    @property
    def span_mm(self) -> float:
        """Length of the travel."""
        return self.high_mm - self.low_mm

    def place(self, share: float) -> float:
        """Position at a share of the travel from its middle, -0.5 to 0.5."""
        return 0.5 * (self.low_mm + self.high_mm) + share * self.span_mm

    def stroke(self, share: float, speed_mm_per_s: float) -> str:
        """There and back over a share of the travel."""
        distance = share * self.span_mm
        speed = min(speed_mm_per_s, 0.9 * self.speed_mm_per_s)
        acceleration = min(2.0, 0.4 * self.acceleration_m_per_s2)
        return (
            f"trapezoid:distance_mm={distance:.4g},speed_mm_per_s={speed:.4g},"
            f"acceleration_m_per_s2={acceleration:.4g},start_mm={self.place(-0.5 * share):.4g}"
        )

    def sine(self, amplitude_mm: float, frequency_Hz: float, share: float, cycles: int) -> str:
        """Sinusoid within speed and acceleration."""
        omega = 2.0 * math.pi * frequency_Hz
        amplitude = min(
            amplitude_mm,
            0.08 * self.span_mm,
            0.8 * self.speed_mm_per_s / omega,
            800.0 * self.acceleration_m_per_s2 / omega**2,
        )
        return (
            f"sine:amplitude_mm={amplitude:.4g},frequency_Hz={frequency_Hz:.4g},"
            f"cycles={cycles},centre_mm={self.place(share):.4g}"
        )

    def triangle(self, amplitude_mm: float, speed_mm_per_s: float, share: float = 0.0) -> str:
        """Back and forth at one slow speed."""
        amplitude = min(amplitude_mm, 0.08 * self.span_mm)
        acceleration = min(0.5, 0.4 * self.acceleration_m_per_s2)
        return (
            f"triangle:amplitude_mm={amplitude:.4g},speed_mm_per_s={speed_mm_per_s:.4g},cycles=2,"
            f"centre_mm={self.place(share):.4g},acceleration_m_per_s2={acceleration:.4g}"
        )


_Motions = Callable[[_Room], tuple[str, ...]]


def _map(room: _Room) -> tuple[str, ...]:
    return (room.stroke(0.98, min(_SLOW_mm_per_s, 0.3 * room.speed_mm_per_s)),)


def _speeds(room: _Room) -> tuple[str, ...]:
    top = room.speed_mm_per_s
    longest = _STROKE_s / room.span_mm
    speeds = [share * top for share in (0.01, 0.05, 0.2, 0.5, 0.9)]
    return tuple(room.stroke(min(0.5, longest * speed), speed) for speed in speeds)


def _turns(room: _Room) -> tuple[str, ...]:
    return (room.triangle(1.5 * room.pitch_mm, 5.0), room.stroke(0.9, 0.8 * room.speed_mm_per_s))


def _tones(room: _Room) -> tuple[str, ...]:
    return tuple(room.sine(0.02, f, 0.0, int(2 * f)) for f in (20.0, 40.0, 80.0))


def _loads(room: _Room) -> tuple[str, ...]:
    return (
        room.triangle(0.05, 0.5),
        room.triangle(0.2, 0.5),
        room.sine(0.02 * room.span_mm, 2.0, 0.0, 8),
        room.sine(0.02 * room.span_mm, 5.0, 0.0, 16),
    )


def _rising(room: _Room) -> tuple[str, ...]:
    return tuple(room.sine(0.02 * room.span_mm, f, 0.0, 12) for f in (2.0, 3.0, 4.0, 5.0, 6.0))


def _both_ends(room: _Room) -> tuple[str, ...]:
    return tuple(room.sine(0.05 * room.span_mm, 2.0, share, 8) for share in (-0.4, 0.4))


def _survey(room: _Room) -> tuple[str, ...]:
    """What tells most where no pair is in question: slow, fast, both ends, whole travel."""
    return (*_map(room), room.triangle(2.0, 2.0), *_both_ends(room), room.sine(5.0, 5.0, 0.0, 16))


# Words and motions, in the options of the capture command, per pair.
_EXPERIMENTS: Mapping[frozenset[str], tuple[str, _Motions]] = {
    frozenset({"lead_linear", "scale_slope"}): (
        "Measure the table against a laser or a second scale, or run the slow map once cold and "
        "once warm: the slope of a scale grows 8-11 um/m per K, that of the screw with the "
        "screw's own temperature. No motion of this axis alone separates them.",
        _map,
    ),
    frozenset({"bias_force", "friction_asymmetry"}): (
        "Run the same stroke at several speeds in both directions: a bias shifts the torque by "
        "the same amount at every speed, an asymmetry grows with speed.",
        _speeds,
    ),
    frozenset({"encoder_eccentricity", "lead_cyclic"}): (
        "Run slowly over a few turns and fast over the travel: an eccentric encoder "
        "moves the motor through the servo and fades above the bandwidth, lead does not. Or turn "
        "the encoder on its shaft by 180 degrees: only the eccentricity turns with it.",
        _turns,
    ),
    frozenset({"actuator_delay", "current_bandwidth"}): (
        "Excite the torque at rising frequencies: the phase of a delay grows in proportion to "
        "frequency, that of a current loop levels off.",
        _tones,
    ),
    frozenset({"backlash", "preload_loss"}): (
        "Reverse gently and hard: a gap takes its full width at any force, a lost preload gives "
        "way more the larger the force. Or push the table by the loading screws at standstill, "
        "both ways and in steps: a gap gives way without force.",
        _loads,
    ),
    frozenset({"axial_stiffness_nonlinear", "preload_loss"}): (
        "Push the table by the loading screws at standstill in small steps up to the largest "
        "force of the runs, both ways: a preload that is lost beyond a force gives two straight "
        "lines with a corner, a contact that softens gives a curve. Or repeat one sinusoid at "
        "rising frequency: below the corner the table lags in proportion to the force.",
        _rising,
    ),
    frozenset({"channel_skew", "viscous"}): (
        "Repeat one sinusoid at both ends of the travel: viscous deformation grows along the "
        "screw, skew does not. Or swap the latch order of the two channels.",
        _both_ends,
    ),
}


def _twice(room: _Room) -> tuple[str, ...]:
    return (*_map(room), *_map(room))


def _everywhere(room: _Room) -> tuple[str, ...]:
    """The whole travel slowly and fast, and reversals at both ends and in the middle."""
    fast = room.stroke(0.98, 0.5 * room.speed_mm_per_s)
    return (*_map(room), fast, *_both_ends(room), room.sine(0.05 * room.span_mm, 2.0, 0.0, 8))


# What tells most of a rest without a name, by the coordinate that holds most of it.
_TELLING: Mapping[str, tuple[str, _Motions]] = {
    "position": (
        "Cross the whole travel slowly, both ways, twice: what stays at its place is told from "
        "what depends on direction or changes with time. Where such a run is among these already, "
        "what stays at its place is an error of the lead of no listed shape: `pmac-comp compensate "
        "--slow` takes it away with a table, whatever its shape.",
        _twice,
    ),
    TURNED: (
        "Cross the whole travel slowly and fast, both ways, and reverse at both ends and in the "
        "middle: friction that differs by place comes back at its place at any speed, and the "
        "torque shows it there; what grows with speed or force does not. Where such runs are among "
        "these already, look at guide, wipers and nut at that place.",
        _everywhere,
    ),
    "screw_angle": (
        "Run slowly over a few turns and fast over the travel: what goes with the angle alone is "
        "told from what the loop makes of it.",
        _turns,
    ),
    "speed": (
        "Run the same stroke at speeds from a hundredth of the largest to nearly all of it, both "
        "ways, and stand still in between: what depends on speed is told from what comes after a "
        "rest.",
        _speeds,
    ),
    "direction": (
        "Run the same stroke at several speeds in both directions: what changes with direction "
        "alone is told from what grows with speed.",
        _speeds,
    ),
    "distance_since_reversal": (
        "Reverse gently and hard, in strokes of tens of micrometres and of millimetres: what "
        "depends on the distance since a turn is told from what depends on the force.",
        _loads,
    ),
    "force": (
        "Repeat one sinusoid at rising frequency: what grows with the force in proportion is told "
        "from what sets in beyond one.",
        _rising,
    ),
    "acceleration": (
        "Repeat one sinusoid at both ends of the travel and at rising frequency: what the length "
        "of the screw carries is told from what the mass does elsewhere.",
        lambda room: (*_both_ends(room), *_rising(room)),
    ),
    "frequency": (
        "Excite the axis at rising frequencies and stop hard: the frequency at which it rings, and "
        "how long, tells which mass on which spring.",
        _tones,
    ),
    "time": (
        "Repeat the same slow run with minutes in between: what drifts is told from what comes "
        "back with the motion.",
        _twice,
    ),
}


def telling_experiment(coordinate: str, bench: Bench) -> SeparatingExperiment | None:
    """The run that tells most of what has no name, by the coordinate that holds most of it.

    Parameters
    ----------
    coordinate : str
        Of the first region of what is left.
    bench : Bench
        Travel and limits that the motions keep to.

    Returns
    -------
    SeparatingExperiment or None
        For no effect in particular; None of a coordinate that no run sets apart.
    """
    if coordinate not in _TELLING:
        return None
    text, motions = _TELLING[coordinate]
    return SeparatingExperiment((), text, motions(_Room.of(bench)))


def justified(one: str, other: str) -> bool:
    """Whether a tie of two effects may be named without further proof that data cannot decide."""
    return any({one, other} <= group for group in _GROUPS)


def alike(one: str, other: str, library: Mapping[str, Effect]) -> bool:
    """Whether two effects are known to leave similar traces."""
    pair = {one, other}
    if any(pair <= group for group in _GROUPS):
        return True
    return any(
        name in library and (pair - {name}) <= set(library[name].look_alikes) for name in pair
    )


def exact_twins(name: str) -> tuple[str, ...]:
    """Effects that no data separates from this one, whether they were offered or not."""
    return tuple(sorted(t for group in _TWINS if name in group for t in group - {name}))


@dataclass(frozen=True)
class SwingingMass:
    """A mass on a spring on the table that no motor and no scale tells from a swinging bed."""

    mass_kg: float
    frequency_Hz: float


def swinging_mass(model: DriveModel) -> SwingingMass:
    """The part of the table's mass that would have to swing in place of a model's bed, and how.

    Exact, damping included: with the bed's deflection as ``m / M`` of that of the swinging mass m,
    both give the same motion of the table relative to the bed for the same force on it.

    Source
    ------
    Elimination of either deflection from the equations of motion; M is the whole table in both.
    """
    share = model.parameters["base_mode.mass_ratio"]
    whole_kg = float(model.kernel_vector()[slots.M_TABLE])
    own_Hz = model.parameters["base_mode.frequency_Hz"] / math.sqrt(1.0 + share)
    return SwingingMass(whole_kg * share / (1.0 + share), own_Hz)


def tilt_um_per_m_per_s2(model: DriveModel) -> float:
    """What a scale would have to misread by the acceleration in place of a model's windup, um.

    The torque that passes the coupling turns the screw and drives the table: most of its wind-up
    goes with the acceleration, as does a table, head or bracket that tilts.
    """
    vector = model.kernel_vector()
    lead = vector[slots.LEAD]
    carried = vector[slots.J_COUPLING] + vector[slots.J_SCREW] + lead**2 * vector[slots.M_TABLE]
    return float(UM_PER_M * model.parameters["coupling_windup.compliance_rad_per_Nm"] * carried)


def windup_lags_s(model: DriveModel) -> tuple[float, float]:
    """By how much the table lags per speed as viscous friction winds a model's coupling up.

    With none and with all of the shaft's on the screw's side of the coupling: runs tell little of
    where it acts.
    """
    vector = model.kernel_vector()
    table = vector[slots.LEAD] ** 2 * vector[slots.GUIDE + slots.VISCOUS]
    shaft = vector[slots.NUT + slots.VISCOUS] + vector[slots.MOTOR + slots.VISCOUS]
    compliance = model.parameters["coupling_windup.compliance_rad_per_Nm"]
    return float(compliance * table), float(compliance * (table + shaft))


def unlisted_twins(model: DriveModel, claimed: Collection[str]) -> tuple[str, ...]:
    """Sentences on causes out of the library that leave the trace of a claimed effect."""
    told = {"base_mode": _told_of_swinging, "coupling_windup": _told_of_tilting}
    return tuple(tell(model) for name, tell in told.items() if name in claimed)


def _told_of_swinging(model: DriveModel) -> str:
    twin = swinging_mass(model)
    return (
        f"A mass of {twin.mass_kg:.3g} kg that swings at {twin.frequency_Hz:.3g} Hz on a spring on "
        "the table leaves exactly the trace of this base_mode: no motor encoder and no scale tells "
        "them apart. An accelerometer on the bed does, or the same run with what hangs loose on "
        "the table clamped."
    )


def _told_of_tilting(model: DriveModel) -> str:
    return (
        "A table, scale head or bracket that tilts by "
        f"{tilt_um_per_m_per_s2(model):.2g} um per m/s2 of acceleration leaves nearly the trace of "
        "this coupling_windup, and only friction tells them apart: torque at standstill winds the "
        "coupling up and tilts nothing. Turn the motor by torque steps with the nut side clamped, "
        "or read the table by a second scale at another height."
    )


def separating_experiment(
    effects: Iterable[str], library: Mapping[str, Effect], bench: Bench
) -> SeparatingExperiment:
    """The run that would tell the effects apart.

    Parameters
    ----------
    effects : iterable of str
        A group of look-alikes.
    library : Mapping of str to Effect
        Effects with their own experiments.
    bench : Bench
        Travel and limits that the motions keep to.

    Returns
    -------
    SeparatingExperiment
        The pair's own experiment where there is one, else those of the effects with a survey of
        slow and fast motions at several places. Motions are options of ``pmac-comp capture``.
    """
    group = tuple(dict.fromkeys(effects))
    room = _Room.of(bench)
    for pair, (text, motions) in _EXPERIMENTS.items():
        if pair <= set(group):
            return SeparatingExperiment(group, text, motions(room))
    words = [f"{name}: {library[name].separating_experiment}" for name in group if name in library]
    return SeparatingExperiment(group, "; ".join(words), _survey(room))
