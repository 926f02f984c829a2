"""How a run meets its start: from a little way inside the travel, and how long it rests there.

What lives here: the distance and the times, and the command that they make. What may not: the
conversation that runs it (``axis``). The promise of a model simulates the same command.
"""

import math

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import MS_PER_S
from pmac_comp.files.bench import Bench
from pmac_comp.physics.signals.trajectory import trapezoid

RELAXED, APPROACHED = "relaxed", "approached"  # how a capture says that its run began
RUN_UP_m = 1e-3  # far beyond the distance in which friction turns over
SETTLE_s = 0.3  # after the jog to the start
PROGRAM_DWELL_s = 0.1  # the motion program begins with it
_PAUSE_s = 0.05  # until the jog inward is seen to be in position
_START_s = 0.1  # questions in between: gathering, the program's start
_JOG = {19: 0.15625, 20: 0.0, 21: 50.0, 22: 32.0}  # defaults: ct/ms2, ms, ms, ct/ms (pp. 100-102)


def run_up_m(bench: Bench, start_m: float) -> float:
    """Where a run comes from, m: inward of its start."""
    return start_m + math.copysign(RUN_UP_m, bench.mid_travel_m - start_m)


def approach(bench: Bench, start_m: float) -> FloatArray:
    """Command in m at the servo period before a run: inward and back, with the rests between.

    Parameters
    ----------
    bench : Bench
        Jog settings, counts, servo period.
    start_m : float
        First position of the motion.
    """
    period = bench.servo_period_s
    rest_s = SETTLE_s + PROGRAM_DWELL_s + _START_s
    speed, acceleration, s_curve_s = _jog(bench)
    body = trapezoid(
        period_s=period,
        distance_m=run_up_m(bench, start_m) - start_m,
        speed_m_per_s=speed,
        acceleration_m_per_s2=acceleration,
        s_curve_s=s_curve_s,
        start_m=start_m,
        dwell_s=_PAUSE_s,
    )
    rest = np.full(round((rest_s - _PAUSE_s) / period), start_m)
    return np.concatenate([body.position_m, rest])


def _jog(bench: Bench) -> tuple[float, float, float]:
    """Speed in m/s, acceleration in m/s2 and S-curve time in s of a jog (Ixx19 to Ixx22)."""
    motor, settings = bench.encoder.motor_number, bench.controller.ivariables
    rate, time_ms, part_ms, speed = (
        settings.get(f"I{motor}{n}", default) for n, default in _JOG.items()
    )
    per_ct_per_ms = bench.motor_resolution_m * MS_PER_S
    total_ms = max(time_ms, 2.0 * part_ms, 2.0 * bench.servo_period_s * MS_PER_S)
    wanted = speed / max(total_ms - part_ms, 0.5 * total_ms)
    if rate > 0.0:
        wanted = min(wanted, rate)
    return speed * per_ct_per_ms, wanted * per_ct_per_ms * MS_PER_S, part_ms / MS_PER_S
