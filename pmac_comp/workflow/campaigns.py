"""Proposed motions: for calibration, for the lead error, for verification drawn by a seed."""

import math

import numpy as np

from pmac_comp.base.errors import ConfigError
from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.signals import trajectory as tr
from pmac_comp.workflow.motions import Motion
from pmac_comp.workflow.ringing import RINGING_NAME
from pmac_comp.workflow.static_check import STATIC_NAME

# A sinusoid that grows or fades within a cycle is accelerated by this much more than A omega^2.
_RAMP_ACCELERATION = 1.113


def calibration_motions(bench: Bench) -> list[Motion]:
    """Proposed campaign: several amplitudes and frequencies at three places of the travel.

    Fits the travel, the safety limits and the rated speed of the bench. In one sinusoid the way
    of the motion and its speed go together (correlation 0.9): amplitudes and frequencies part them.
    """
    low, high = bench.travel_m
    middle, span = 0.5 * (low + high), high - low
    period = bench.servo_period_s
    speed = bench.usable_speed_m_per_s
    acceleration = min(bench.safety.max_acceleration_m_per_s2, 8.0)

    def sine(name: str, amplitude: float, frequency: float, place: float, n: float) -> Motion:
        omega = 2.0 * math.pi * frequency
        room = min(0.15, 0.95 * (0.5 - abs(place))) * span
        amplitude = min(amplitude, room, 0.9 * speed / omega, 0.85 * acceleration / omega**2)
        shape = tr.sinusoid(
            period_s=period,
            amplitude_m=amplitude,
            frequency_Hz=frequency,
            cycles=n,
            centre_m=middle + place * span,
        )
        return Motion(name, shape)

    def move(name: str, distance: float, fraction: float, start: float) -> Motion:
        shape = tr.trapezoid(
            period_s=period,
            distance_m=distance * span,
            speed_m_per_s=fraction * speed,
            acceleration_m_per_s2=min(3.0, acceleration),
            s_curve_s=0.02,
            start_m=middle + start * span,
        )
        return Motion(name, shape)

    slow = tr.triangle(
        period_s=period,
        amplitude_m=min(2e-3, 0.05 * span),
        speed_m_per_s=min(2e-3, speed),
        cycles=2,
        centre_m=middle,
        acceleration_m_per_s2=min(0.5, acceleration),
    )
    return [
        sine("sine_low_end", 0.010, 4.0, -0.40, 8.0),
        sine("sine_middle", 0.012, 3.5, 0.0, 8.0),
        sine("sine_high_end", 0.010, 4.0, 0.40, 8.0),
        sine("sine_long", 0.050, 0.7, 0.0, 3.0),
        sine("sine_small", 0.004, 1.0, 0.1, 4.0),
        move("move_long", 0.75, 0.7, -0.38),
        move("move_slow", 0.15, 0.1, -0.1),
        Motion("triangle_slow", slow),
    ]


def require_scale(bench: Bench, what: str) -> None:
    """Refuse what needs the position of the table on a bench that has none, before anything moves.

    Raises
    ------
    ConfigError
        The bench file has no [scale].
    """
    if bench.scale is None:
        raise ConfigError(
            f"The bench file has no [scale]: {what} needs the position of the table.",
            code="PC-WRK-005",
            hint="State the scale in [scale]. Without one `pmac-comp capture` and `identify` "
            "remain, for an axis that is stated as one mass (no axial_stiffness_N_per_um in "
            "[nominal]). Nothing was moved.",
        )


def lead_motions(bench: Bench) -> list[Motion]:
    """One slow run over the travel and back."""
    low, high = bench.travel_m
    margin = 1e-4  # a cyclic lead that ends before the travel does is an error of its full size
    shape = tr.trapezoid(
        period_s=bench.servo_period_s,
        distance_m=high - low - 2.0 * margin,
        speed_m_per_s=min(0.06, 0.3 * bench.usable_speed_m_per_s),
        acceleration_m_per_s2=min(0.5, bench.safety.max_acceleration_m_per_s2),
        s_curve_s=0.05,
        start_m=low + margin,
    )
    return [Motion("lead_run", shape)]


def verification_motions(
    bench: Bench, seed: int, *, n_sine: int = 3, n_move: int = 3
) -> list[Motion]:
    """Motions drawn by a seed: sinusoids within the rated speed and jerk-limited trapezoids."""
    rng = np.random.default_rng(seed)
    low, high = bench.travel_m
    span, speed = high - low, bench.usable_speed_m_per_s
    allowed = bench.safety.max_acceleration_m_per_s2
    acceleration = min(allowed, 10.0)
    period = bench.servo_period_s
    motions: list[Motion] = []
    for _ in range(n_sine):
        frequency = float(np.exp(rng.uniform(np.log(0.7), np.log(5.0))))
        omega = 2.0 * math.pi * frequency
        most = min(0.05, 0.1 * span, 0.95 * speed / omega, 0.98 * acceleration / omega**2)
        amplitude = float(rng.uniform(0.7, 1.0)) * most
        amplitude = min(amplitude, allowed / (_RAMP_ACCELERATION * omega**2))
        centre = float(rng.uniform(low + 1.2 * amplitude, high - 1.2 * amplitude))
        name = (
            f"sine {amplitude * MM_PER_M:.1f} mm {frequency:.2f} Hz at {centre * MM_PER_M:.0f} mm"
        )
        cycles = max(3.0, min(6.0, math.ceil(1.5 * frequency)))
        shape = tr.sinusoid(
            period_s=period,
            amplitude_m=amplitude,
            frequency_Hz=frequency,
            cycles=cycles,
            centre_m=centre,
        )
        motions.append(Motion(name, shape))
    for _ in range(n_move):
        distance = float(rng.uniform(0.05, 0.3)) * span
        v = float(rng.uniform(0.3, 0.95)) * speed
        a = float(rng.uniform(0.3, 1.0)) * min(5.0, acceleration)
        start = float(rng.uniform(low, high - distance))
        name = f"move {distance * MM_PER_M:.0f} mm {v * MM_PER_M:.0f} mm/s {a:.1f} m/s2"
        shape = tr.trapezoid(
            period_s=period,
            distance_m=distance,
            speed_m_per_s=v,
            acceleration_m_per_s2=a,
            s_curve_s=0.015,
            start_m=start,
        )
        motions.append(Motion(name, shape))
    return motions


def positioning_motion(bench: Bench, *, n_targets: int = 7) -> Motion:
    """One run of ISO 230-2: up through all targets and down again, with an overrun at both ends.

    The targets are not at multiples of the pitch, so that a periodic error is met at different
    phases (ISO 230-2:2014, clause 5.3.1).
    """
    low, high = bench.travel_m
    span = high - low
    step = 0.9 * span / (n_targets - 1)
    start = low + 0.05 * span
    phase = np.modf(np.arange(n_targets) * 0.6180339887)[0] - 0.5
    targets = start + step * np.arange(n_targets) + phase * min(bench.pitch_m, 0.2 * step)
    overrun = 0.02 * span
    stops = [targets[0] - overrun, *targets, targets[-1] + overrun, *targets[::-1]]
    shape = tr.staircase(
        period_s=bench.servo_period_s,
        positions_m=[*stops, targets[0] - overrun],
        speed_m_per_s=0.6 * bench.usable_speed_m_per_s,
        acceleration_m_per_s2=min(2.0, bench.safety.max_acceleration_m_per_s2),
        s_curve_s=0.03,
        dwell_s=0.4,
    )
    return Motion(STATIC_NAME, shape)


def ringing_motion(bench: Bench) -> Motion:
    """A move whose acceleration jumps: no S-curve, so that it excites the drive's resonance."""
    low, high = bench.travel_m
    shape = tr.trapezoid(
        period_s=bench.servo_period_s,
        distance_m=0.15 * (high - low),
        speed_m_per_s=0.4 * bench.usable_speed_m_per_s,
        acceleration_m_per_s2=min(3.0, bench.safety.max_acceleration_m_per_s2),
        start_m=low + 0.4 * (high - low),
        dwell_s=0.3,
    )
    return Motion(RINGING_NAME, shape)
