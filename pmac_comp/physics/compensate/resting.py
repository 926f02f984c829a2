"""What is left of the table's lag while the command rests, from a drive model.

What lives here: the regression of the lag that the model leaves at rests on what the law would
hold. What may not: captures, counts.

As a drive comes to rest the screw unwinds and the table comes along, at once or within some
hundredths of a second, where the motion ended hard (``law``). How far hangs on every figure of a
move where a nut has play (0.4 to 0.7 in the same drive), so the fit's few moves do not tell the
mean, and the fit would trade it for something else. On simulated cards what is left on average lies
within 0.2 of it, at the worst 0.3: coarse counts of an encoder shake a drive loose, fine ones do
not, and friction that grips over a distance may hold more than its model. Runs without compensation
do not tell it: in them 0.65 to 1.3 are left where 0.37 to 0.95 are with it.
"""

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.compensate.evaluation import REST_CYCLES, end_hardness, evaluate_law
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import LoopRunner
from pmac_comp.physics.compensate.motions import resting_moves
from pmac_comp.physics.signals.rests import moving_of, rests_of
from pmac_comp.physics.signals.trajectory import Trajectory

_N_MOVES = 24
_DWELL_CYCLES = 250  # of those the last ones count, once friction has faded
_COUNTED_CYCLES = 100
_LEAST_LEFT_FRAC = 0.05


def with_unwinding(
    law: CompensationLaw,
    loop: LoopRunner,
    bench: Bench,
    latency_cycles: int,
    load_Nm: float = 0.0,
) -> CompensationLaw:
    """The law with the fading of the table's friction at rest that the model shows on average.

    Parameters
    ----------
    law : CompensationLaw
        With all its other coefficients.
    loop : LoopRunner
        Closed loop of the model, without what it has by the turn.
    bench : Bench
        Travel, limits, period.
    latency_cycles : int
        Servo cycles by which the door delivers late.
    load_Nm : float
        Torque that holds the constant load of the model.
    """
    # What is sent for what captures show beyond the model would push the model about.
    own = law.without_turn().with_values(
        torque_place_Nm_per_m=0.0,
        torque_uneven_Nm_s_per_m=0.0,
        viscous_uneven_s=0.0,
        torque_constant_Nm=load_Nm,
    )
    from scipy.optimize import minimize_scalar

    moves = resting_moves(bench, n_moves=_N_MOVES, dwell_cycles=_DWELL_CYCLES)
    runs = [_lags(own, loop, move, latency_cycles) for move in moves]
    held, left, hardness = (np.concatenate(column) for column in zip(*runs, strict=True))
    held, left = held - held.mean(), left - left.mean()
    if not held.any():
        return law
    cycles = REST_CYCLES - 1.0
    most = 1.0 - _LEAST_LEFT_FRAC ** (1.0 / cycles)

    def missed(fade: float) -> float:
        return float(np.sum((left - held * (1.0 - fade * hardness) ** cycles) ** 2))

    fade = float(minimize_scalar(missed, bounds=(0.0, most), method="bounded").x)
    return law.with_values(rest_unwind_per_s=fade / bench.servo_period_s)


def _lags(
    law: CompensationLaw, loop: LoopRunner, motion: Trajectory, latency: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """At each rest of a move, in m: the lag by friction if it were held, and what is left of it.

    And how hard the move ended.
    """
    r, period_s = motion.position_m, motion.sample_period_s

    def correction_m(law: CompensationLaw) -> FloatArray:
        return evaluate_law(law, r, period_s, latency_cycles=latency).correction_m

    sent = evaluate_law(law, r, period_s, latency_cycles=latency)
    signals = loop(r, r + sent.correction_m, sent.torque_Nm)
    held_m = correction_m(law.with_values(rest_unwind_per_s=0.0))
    at_once = 1.0 / (law.every_cycles * period_s)
    friction_m = held_m - correction_m(law.with_values(rest_unwind_per_s=at_once))
    # What held friction would leave of the error; in motion, on average, nothing.
    error_m = signals.table_position_m - signals.motor_position_m + held_m
    rests = rests_of(r, period_s)
    error_m = error_m - error_m[moving_of(r.size, rests)].mean()
    ends = [slice(rest.stop - _COUNTED_CYCLES, rest.stop) for rest in rests[1:]]
    held = np.array([friction_m[end].mean() for end in ends])
    left = held - np.array([error_m[end].mean() for end in ends])
    return held, left, end_hardness(law, r, period_s)[[end.stop - 1 for end in ends]]
