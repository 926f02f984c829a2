"""Proposed motions: for calibration, for the lead error, for verification drawn by a seed."""

import math

import numpy as np

from pmac_comp.base.errors import ConfigError
from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.signals import trajectory as tr
from pmac_comp.workflow.accuracy.ringing import RINGING_NAME
from pmac_comp.workflow.accuracy.static_check import STATIC_NAME
from pmac_comp.workflow.motion.motions import Motion

# A sinusoid that grows or fades within a cycle is accelerated by this much more than A omega^2.
_RAMP_ACCELERATION = 1.113
# No motion is harder, whatever a bench allows.
_CALIBRATION_m_per_s2 = 8.0
_VERIFICATION_m_per_s2 = 10.0  # of its sinusoids
_GOLDEN = 0.6180339887  # multiples of it spread evenly over an interval


def calibration_motions(bench: Bench) -> list[Motion]:
    """Proposed campaign: several amplitudes and frequencies at three places of the travel.

    Fits the travel, the safety limits and the rated speed of the bench. In one sinusoid the way
    of the motion and its speed go together (correlation 0.9): amplitudes and frequencies part them.
    """
    low_m, high_m = bench.travel_m
    middle_m, span_m = 0.5 * (low_m + high_m), high_m - low_m
    fastest_m_per_s = bench.usable_speed_m_per_s
    hardest_m_per_s2 = min(bench.safety.max_acceleration_m_per_s2, _CALIBRATION_m_per_s2)

    def sine(
        name: str, amplitude_m: float, frequency_Hz: float, place: float, cycles: float
    ) -> Motion:
        """Sinusoid about a place: a share of the travel, from its middle."""
        omega = 2.0 * math.pi * frequency_Hz
        shape = tr.sinusoid(
            period_s=bench.servo_period_s,
            amplitude_m=min(
                amplitude_m,
                min(0.15, 0.95 * (0.5 - abs(place))) * span_m,
                0.9 * fastest_m_per_s / omega,
                0.85 * hardest_m_per_s2 / omega**2,
            ),
            frequency_Hz=frequency_Hz,
            cycles=cycles,
            centre_m=middle_m + place * span_m,
        )
        return Motion(name, shape)

    def move(name: str, distance: float, fast: float, start: float) -> Motion:
        """Move by a share of the travel at a share of the highest speed, from a place."""
        shape = tr.trapezoid(
            period_s=bench.servo_period_s,
            distance_m=distance * span_m,
            speed_m_per_s=fast * fastest_m_per_s,
            acceleration_m_per_s2=min(3.0, hardest_m_per_s2),
            s_curve_s=0.02,
            start_m=middle_m + start * span_m,
        )
        return Motion(name, shape)

    slow = tr.triangle(
        period_s=bench.servo_period_s,
        amplitude_m=min(2e-3, 0.05 * span_m),
        speed_m_per_s=min(2e-3, fastest_m_per_s),
        cycles=2,
        centre_m=middle_m,
        acceleration_m_per_s2=min(0.5, hardest_m_per_s2),
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
    low_m, high_m = bench.travel_m
    margin_m = 1e-4  # a cyclic lead that ends before the travel does is an error of its full size
    shape = tr.trapezoid(
        period_s=bench.servo_period_s,
        distance_m=high_m - low_m - 2.0 * margin_m,
        speed_m_per_s=min(0.06, 0.3 * bench.usable_speed_m_per_s),
        acceleration_m_per_s2=min(0.5, bench.safety.max_acceleration_m_per_s2),
        s_curve_s=0.05,
        start_m=low_m + margin_m,
    )
    return [Motion("lead_run", shape)]


def verification_motions(
    bench: Bench, seed: int, *, n_sine: int = 3, n_move: int = 3
) -> list[Motion]:
    """Motions drawn by a seed: sinusoids within the rated speed and jerk-limited trapezoids."""
    rng = np.random.default_rng(seed)
    sines = [_drawn_sine(bench, rng) for _ in range(n_sine)]
    return [*sines, *(_drawn_move(bench, rng) for _ in range(n_move))]


def _drawn_sine(bench: Bench, rng: np.random.Generator) -> Motion:
    """Sinusoid of 0.7 to 5 Hz, near the largest amplitude that travel and limits allow it."""
    low_m, high_m = bench.travel_m
    allowed_m_per_s2 = bench.safety.max_acceleration_m_per_s2
    frequency_Hz = float(np.exp(rng.uniform(np.log(0.7), np.log(5.0))))
    omega = 2.0 * math.pi * frequency_Hz
    most_m = min(
        0.05,
        0.1 * (high_m - low_m),
        0.95 * bench.usable_speed_m_per_s / omega,
        0.98 * min(allowed_m_per_s2, _VERIFICATION_m_per_s2) / omega**2,
    )
    amplitude_m = float(rng.uniform(0.7, 1.0)) * most_m
    amplitude_m = min(amplitude_m, allowed_m_per_s2 / (_RAMP_ACCELERATION * omega**2))
    centre_m = float(rng.uniform(low_m + 1.2 * amplitude_m, high_m - 1.2 * amplitude_m))
    name = (
        f"sine {amplitude_m * MM_PER_M:.1f} mm {frequency_Hz:.2f} Hz at "
        f"{centre_m * MM_PER_M:.0f} mm"
    )
    shape = tr.sinusoid(
        period_s=bench.servo_period_s,
        amplitude_m=amplitude_m,
        frequency_Hz=frequency_Hz,
        cycles=max(3.0, min(6.0, math.ceil(1.5 * frequency_Hz))),
        centre_m=centre_m,
    )
    return Motion(name, shape)


def _drawn_move(bench: Bench, rng: np.random.Generator) -> Motion:
    """Jerk-limited move of a twentieth to three tenths of the travel."""
    low_m, high_m = bench.travel_m
    distance_m = float(rng.uniform(0.05, 0.3)) * (high_m - low_m)
    speed_m_per_s = float(rng.uniform(0.3, 0.95)) * bench.usable_speed_m_per_s
    hardest_m_per_s2 = min(5.0, bench.safety.max_acceleration_m_per_s2)
    acceleration_m_per_s2 = float(rng.uniform(0.3, 1.0)) * hardest_m_per_s2
    start_m = float(rng.uniform(low_m, high_m - distance_m))
    name = (
        f"move {distance_m * MM_PER_M:.0f} mm {speed_m_per_s * MM_PER_M:.0f} mm/s "
        f"{acceleration_m_per_s2:.1f} m/s2"
    )
    shape = tr.trapezoid(
        period_s=bench.servo_period_s,
        distance_m=distance_m,
        speed_m_per_s=speed_m_per_s,
        acceleration_m_per_s2=acceleration_m_per_s2,
        s_curve_s=0.015,
        start_m=start_m,
    )
    return Motion(name, shape)


def positioning_motion(bench: Bench, *, n_targets: int = 7) -> Motion:
    """One run of ISO 230-2: up through all targets and down again, with an overrun at both ends.

    The targets are not at multiples of the pitch, so that a periodic error is met at different
    phases (ISO 230-2:2014, clause 5.3.1).
    """
    low_m, high_m = bench.travel_m
    span_m = high_m - low_m
    step_m = 0.9 * span_m / (n_targets - 1)
    first_m = low_m + 0.05 * span_m
    phase = np.modf(np.arange(n_targets) * _GOLDEN)[0] - 0.5
    near_m = phase * min(bench.pitch_m, 0.2 * step_m)
    targets_m = first_m + step_m * np.arange(n_targets) + near_m
    overrun_m = 0.02 * span_m
    below_m, above_m = targets_m[0] - overrun_m, targets_m[-1] + overrun_m
    shape = tr.staircase(
        period_s=bench.servo_period_s,
        positions_m=[below_m, *targets_m, above_m, *targets_m[::-1], below_m],
        speed_m_per_s=0.6 * bench.usable_speed_m_per_s,
        acceleration_m_per_s2=min(2.0, bench.safety.max_acceleration_m_per_s2),
        s_curve_s=0.03,
        dwell_s=0.4,
    )
    return Motion(STATIC_NAME, shape)


def ringing_motion(bench: Bench) -> Motion:
    """A move whose acceleration jumps: no S-curve, so that it excites the drive's resonance."""
    low_m, high_m = bench.travel_m
    shape = tr.trapezoid(
        period_s=bench.servo_period_s,
        distance_m=0.15 * (high_m - low_m),
        speed_m_per_s=0.4 * bench.usable_speed_m_per_s,
        acceleration_m_per_s2=min(3.0, bench.safety.max_acceleration_m_per_s2),
        start_m=low_m + 0.4 * (high_m - low_m),
        dwell_s=0.3,
    )
    return Motion(RINGING_NAME, shape)
