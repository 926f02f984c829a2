"""Motions of a bench on which laws are fitted and judged in a model, one sample per servo period.

What lives here: how far, fast and hard they are, and where in the travel; places and reaches are
shares of the travel, speeds and accelerations shares of the highest. What may not: motions that a
controller runs (``workflow.motion.campaigns``): a law is verified on none of these.
"""

import math
from collections.abc import Sequence
from itertools import cycle

from pmac_comp.files.bench import Bench
from pmac_comp.physics.model.chain import velocity_gains
from pmac_comp.physics.signals.trajectory import Trajectory, sinusoid, trapezoid

HARD_MOVE_m_per_s2 = 5.0  # no move is harder, whatever a bench allows
MOVE_S_CURVE_s = 0.015  # in which a move reaches its acceleration
_HARD_SINE_m_per_s2 = 10.0
_RAMP_ROOM = 1.4  # times the cycles of a ramp: of what a sinusoid may reach
_SINE_ROOM = 0.9  # a sinusoid that grows or fades asks for more than in full swing
_DWELL_s = 0.1
# Of a move of a drive whose nut has play, as long as those of people: where the nut comes to stand
# in its gap lasts as long. Of others the fit would hide what fades at a rest in its friction.
DWELL_WITH_GAP_s = 0.2
# On half as many moves a law that takes up play was found that leaves twice as much of one beside
# them: where the nut comes to stand is chance. Sinusoids are more often slow, where it hardly
# crosses.
_JUDGING_MOVES, _JUDGING_SINES, _SMALL_SINES = 6, 6, 10
_JUDGING_MOVES_WITH_PLAY, _JUDGING_SINES_WITH_PLAY, _SMALL_SINES_WITH_PLAY = 32, 12, 8
_SLOWEST_Hz, _FASTEST_Hz, _MORE_SLOW = 0.7, 5.0, 1.5  # of a large sinusoid that judges
# Few of the sequence are as fast: without these the total error of the fastest was given away for
# the mechanical error of others (0.29 of the baseline's in place of 0.16).
_FASTEST = ((1.0, 1.0, 0.5), (1.0, 0.5, 0.2), (0.9, 1.0, 0.8))
# Small ones: judged on none, laws were found that leave two to three times their aim of such.
_SMALL_SLOWEST_Hz, _SMALL_FASTEST_Hz = 0.4, 1.6
_SMALLEST_m, _SMALL_WIDEST_m, _THRESHOLD_WIDEST_m = 0.008, 0.03, 0.1
# Times the acceleration at which the nut changes its flank.
_THRESHOLD_FROM, _THRESHOLD_TO, _THRESHOLD_SLOWEST_Hz = 1.0, 1.8, 0.3
_LAG_SHARE = 0.75  # of the peak torque; a law needs the rest for inertia and friction


def reached_speed_m_per_s(bench: Bench) -> float:
    """Highest speed up to which a law's torque makes up for what the loop's damping takes.

    The usable speed of most benches. Without velocity feed-forward a law may reach a tenth of that:
    fitted on motions beyond, on which its torque clamps, it is wrong on those within reach too.
    """
    lacking_Nm_s_per_m = abs(velocity_gains(bench).lacking_Nm_s_per_m)
    most_Nm = _LAG_SHARE * bench.drive.torque_limit_Nm
    fastest_m_per_s = bench.usable_speed_m_per_s
    if lacking_Nm_s_per_m * fastest_m_per_s <= most_Nm:
        return fastest_m_per_s
    return most_Nm / lacking_Nm_s_per_m


def design_motions(bench: Bench, *, dwell_s: float = _DWELL_s) -> tuple[Trajectory, ...]:
    """Motions on which the coefficients of a law are refined, over the range that one reaches.

    Sinusoids from slow to the acceleration limit and jerk-limited moves, fast and slow, hard and
    soft, at places over the travel. Two of them are long and slow: on those a load holds the nut
    near the force at which it changes its flank. The moves differ in how long they accelerate and
    cruise, down to none: what one crossing of a gap leaves swings on into the next, and on too few
    moves the fit makes that come out by their times, half above its aim on others.

    Parameters
    ----------
    bench : Bench
        Travel, limits, period.
    dwell_s : float
        Rest before, between and after the moves.
    """
    low_m, high_m = bench.travel_m
    middle_m, span_m = 0.5 * (low_m + high_m), high_m - low_m
    fastest_m_per_s = reached_speed_m_per_s(bench)

    def sine(amplitude_m: float, frequency_Hz: float, place: float, cycles: float) -> Trajectory:
        return sinusoid(
            period_s=bench.servo_period_s,
            amplitude_m=min(amplitude_m, 0.2 * span_m, _largest_sine_m(bench, frequency_Hz)),
            frequency_Hz=frequency_Hz,
            cycles=cycles,
            centre_m=middle_m + place * span_m,
            dwell_s=0.05,
        )

    def move(fast: float, hard: float, place: float, far: float = 0.2) -> Trajectory:
        return trapezoid(
            period_s=bench.servo_period_s,
            distance_m=far * span_m,
            speed_m_per_s=0.8 * fast * fastest_m_per_s,
            acceleration_m_per_s2=_hardest_move_m_per_s2(bench) * hard,
            s_curve_s=MOVE_S_CURVE_s,
            start_m=middle_m + place * span_m,
            dwell_s=dwell_s,
        )

    return (
        sine(0.010, 1.0, 0.0, 2.0),
        sine(0.010, 2.0, -0.3, 3.0),
        sine(0.010, 5.0, 0.0, 5.0),
        sine(0.025, 2.0, 0.25, 3.0),
        sine(0.050, 0.8, 0.0, 2.0),
        move(1.0, 1.0, -0.3),
        move(0.5, 0.5, 0.1),
        move(0.7, 0.35, 0.2),
        move(0.5, 0.8, -0.4),
        sine(0.045, 0.7, 0.2, 2.0),
        move(0.7, 1.0, 0.1),
        move(0.9, 0.4, 0.2, far=0.05),
        move(0.5, 0.75, -0.2, far=0.06),
        move(0.95, 0.85, 0.05, far=0.25),
    )


def resting_moves(bench: Bench, *, n_moves: int, dwell_cycles: int) -> tuple[Trajectory, ...]:
    """Moves there and back, of a bench's usual distances, speeds and places, and their rests.

    Parameters
    ----------
    bench : Bench
        Travel, limits, period.
    n_moves : int
        How many; they are spread evenly over what is usual.
    dwell_cycles : int
        Servo cycles of each rest.
    """
    from scipy.stats.qmc import Halton

    low_m, high_m = bench.travel_m
    span_m, fastest_m_per_s = high_m - low_m, reached_speed_m_per_s(bench)
    drawn = Halton(4, scramble=False).random(n_moves)
    return tuple(
        trapezoid(
            period_s=bench.servo_period_s,
            distance_m=(0.05 + 0.15 * distance) * span_m,
            speed_m_per_s=(0.2 + 0.6 * fast) * fastest_m_per_s,
            acceleration_m_per_s2=(0.3 + 0.7 * hard) * _hardest_move_m_per_s2(bench),
            s_curve_s=MOVE_S_CURVE_s,
            start_m=low_m + (0.05 + 0.7 * place) * span_m,
            dwell_s=dwell_cycles * bench.servo_period_s,
        )
        for distance, fast, hard, place in drawn
    )


def judging_motions(
    bench: Bench, *, thresholds_m_per_s2: Sequence[float] = ()
) -> tuple[Trajectory, ...]:
    """Motions by which a law is chosen and bettered, beside those that it is fitted on.

    Moves and sinusoids spread over what is usual: large sinusoids near what speed and acceleration
    allow, and small slow ones, of whose error friction makes nearly all. With play others whose
    acceleration just overcomes friction and load: the nut changes its flank near the ends of their
    strokes and has long to do it.

    Parameters
    ----------
    bench : Bench
        Travel, limits, period.
    thresholds_m_per_s2 : sequence of float
        Where the nut has play, accelerations of the table, in size, at which it changes its flank.
    """
    from scipy.stats.qmc import Halton

    low_m, high_m = bench.travel_m
    span_m, play = high_m - low_m, bool(thresholds_m_per_s2)

    def sine(
        amplitude_m: float, frequency_Hz: float, place: float, ramp_cycles: float = 0.5
    ) -> Trajectory:
        # One that grows within half a cycle accelerates by a third more meanwhile.
        most_m = min(1.0, _RAMP_ROOM * ramp_cycles) * _largest_sine_m(bench, frequency_Hz)
        amplitude_m = min(amplitude_m, 0.1 * span_m, most_m)
        return sinusoid(
            period_s=bench.servo_period_s,
            amplitude_m=amplitude_m,
            frequency_Hz=frequency_Hz,
            cycles=1.0,
            ramp_cycles=ramp_cycles,
            centre_m=low_m + 1.2 * amplitude_m + place * (span_m - 2.4 * amplitude_m),
            dwell_s=0.05,
        )

    def large(fast: float, wide: float, place: float) -> Trajectory:
        frequency_Hz = _between(_SLOWEST_Hz, _FASTEST_Hz, fast**_MORE_SLOW)
        most_m = min(0.05, 0.1 * span_m, _largest_sine_m(bench, frequency_Hz))
        # Those at the limits grow no faster: that would accelerate them beyond.
        return sine((0.7 + 0.3 * wide) * most_m, frequency_Hz, place, ramp_cycles=1.0)

    def small(fast: float, wide: float, place: float) -> Trajectory:
        frequency_Hz = _between(_SMALL_SLOWEST_Hz, _SMALL_FASTEST_Hz, fast)
        amplitude_m = _between(_SMALLEST_m, _SMALL_WIDEST_m, wide)
        return sine(amplitude_m, frequency_Hz, place)

    def at_threshold(
        threshold_m_per_s2: float, more: float, wide: float, place: float
    ) -> Trajectory:
        times = _THRESHOLD_FROM + more * (_THRESHOLD_TO - _THRESHOLD_FROM)
        amplitude_m = _between(_SMALLEST_m, _THRESHOLD_WIDEST_m, wide)
        frequency_Hz = math.sqrt(times * threshold_m_per_s2 / amplitude_m) / (2.0 * math.pi)
        # A load as large as friction leaves no threshold one way.
        frequency_Hz = min(max(frequency_Hz, _THRESHOLD_SLOWEST_Hz), _FASTEST_Hz)
        return sine(amplitude_m, frequency_Hz, place)

    n_moves = _JUDGING_MOVES_WITH_PLAY if play else _JUDGING_MOVES
    n_large = _JUDGING_SINES_WITH_PLAY if play else _JUDGING_SINES
    n_small = _SMALL_SINES_WITH_PLAY if play else _SMALL_SINES
    dwell_s = DWELL_WITH_GAP_s if play else _DWELL_s
    # The first point of the sequence is its corner.
    drawn = Halton(3, scramble=False).random(max(n_large, n_small) + 1)[1:]
    return (
        *resting_moves(bench, n_moves=n_moves, dwell_cycles=round(dwell_s / bench.servo_period_s)),
        *(large(*point) for point in (*drawn[:n_large], *_FASTEST)),
        *(small(*point) for point in drawn[:n_small]),
        *(
            at_threshold(threshold, *point)
            for threshold, point in zip(cycle(thresholds_m_per_s2), drawn[:n_small], strict=False)
        ),
    )


def _between(lowest: float, highest: float, share: float) -> float:
    """Value that lies a share of the way from lowest to highest, by equal ratios."""
    return float(lowest * (highest / lowest) ** share)


def fastest_move(bench: Bench) -> Trajectory:
    """A long move at the highest speed that a law reaches, in the middle of the travel."""
    low_m, high_m = bench.travel_m
    reach_m = 0.4 * (high_m - low_m)
    return trapezoid(
        period_s=bench.servo_period_s,
        distance_m=reach_m,
        speed_m_per_s=reached_speed_m_per_s(bench),
        acceleration_m_per_s2=_hardest_move_m_per_s2(bench),
        s_curve_s=MOVE_S_CURVE_s,
        start_m=0.5 * (low_m + high_m - reach_m),
        dwell_s=0.05,
    )


def _largest_sine_m(bench: Bench, frequency_Hz: float) -> float:
    """Largest amplitude of a sinusoid whose speed and acceleration a law reaches."""
    omega = 2.0 * math.pi * frequency_Hz
    hardest_m_per_s2 = min(bench.safety.max_acceleration_m_per_s2, _HARD_SINE_m_per_s2)
    return min(
        _SINE_ROOM * reached_speed_m_per_s(bench) / omega,
        _SINE_ROOM * hardest_m_per_s2 / omega**2,
    )


def _hardest_move_m_per_s2(bench: Bench) -> float:
    return min(HARD_MOVE_m_per_s2, bench.safety.max_acceleration_m_per_s2)
