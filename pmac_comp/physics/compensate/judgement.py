"""What a law leaves of motions in a model, as shares of its aims, and how that is judged.

What lives here: the aims, the errors by the closed loop of a model, one figure for all of them.
What may not: how a law is changed for it (``design``, ``search``).
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from functools import partial

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.compensate.evaluation import evaluate_law
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import LoopRunner
from pmac_comp.physics.signals.trajectory import Trajectory

# What a good law leaves: a tenth of the mechanical error or this much, a fifth of the total error.
# Residuals count as shares of that, so that slow motions are not drowned by fast ones.
_MECHANICAL_FRAC = 0.1
_TOTAL_FRAC = 0.2
_LEAST_MECHANICAL_m = 0.15e-6
_LEAST_TOTAL_m = 1e-6
# Power of the shares of the aims that are taken together where laws are judged.
WORST_FOREMOST = 6
_DECIMATION = 4  # residual samples per servo cycle that enter the fit


def errors_on(
    loop: LoopRunner,
    motions: Sequence[Trajectory],
    latency_cycles: int,
    threads: Executor,
    *,
    with_torque: bool,
) -> Callable[[CompensationLaw], list[tuple[FloatArray, ...]]]:
    """What laws leave of the errors of motions (``errors_of``), each of shape (n,).

    Of each kind of error, the mechanical and the total one, an array for every motion. A law
    without torque is judged by the mechanical error alone, as it has no say in the other.
    """
    wanted = [aims(loop, motion) for motion in motions]
    n_kinds = 2 if with_torque else 1

    def of(law: CompensationLaw) -> list[tuple[FloatArray, ...]]:
        one = partial(errors_of, law, loop, latency_cycles)
        return list(zip(*threads.map(one, motions, wanted), strict=True))[:n_kinds]

    return of


def judged(errors: Sequence[Sequence[FloatArray]]) -> float:
    """How much errors of each kind, shape (n,) each, are beyond their aims, the worst foremost.

    Which of two fits errs less on what they were fitted on says little of other motions: one of
    four fifths of the cost was found to leave twice as much of some. What of a kind is beyond its
    aims counts by its logarithm: where no law reaches one of them (a nut in its play beside
    Stribeck friction, 3.5 of the mechanical one), the total error was given away for a little less
    of that (0.4 of before).
    """
    means = [worst_foremost(kind) for kind in errors]
    return sum(mean if mean <= 1.0 else 1.0 + math.log(mean) for mean in means)


def worst_foremost(errors: Sequence[FloatArray]) -> float:
    """Mean of a power of the norms of errors, shape (n,) each, which are shares of their aims."""
    with np.errstate(over="ignore"):
        return float(np.mean([np.linalg.norm(error) ** WORST_FOREMOST for error in errors]))


def aims(loop: LoopRunner, motion: Trajectory) -> tuple[float, float]:
    """Mechanical and total error in m that would be a good result for a motion."""
    before = loop(motion.position_m, None, None)
    mechanical = float(np.std(before.table_position_m - before.motor_position_m))
    total = float(np.std(before.table_position_m - motion.position_m))
    return (
        max(_MECHANICAL_FRAC * mechanical, _LEAST_MECHANICAL_m),
        max(_TOTAL_FRAC * total, _LEAST_TOTAL_m),
    )


def errors_of(
    law: CompensationLaw,
    loop: LoopRunner,
    latency_cycles: int,
    motion: Trajectory,
    aim: tuple[float, float],
) -> tuple[FloatArray, FloatArray]:
    """Residual mechanical and total error of a motion, shape (n,) each.

    Their norms are shares of their aims.
    """
    residual_m, total_m = left_by(law, loop, motion, latency_cycles)
    # Where the nut stood before the run began, or where the load let it, is no error of the law.
    residual_m = residual_m - residual_m.mean()
    both = (residual_m / aim[0])[::_DECIMATION], ((total_m - total_m[0]) / aim[1])[::_DECIMATION]
    return both[0] / math.sqrt(both[0].size), both[1] / math.sqrt(both[1].size)


def left_by(
    law: CompensationLaw, loop: LoopRunner, motion: Trajectory, latency_cycles: int
) -> tuple[FloatArray, FloatArray]:
    """Residual mechanical and total error in m of one motion with a law, shape (n,) each."""
    sent = evaluate_law(
        law, motion.position_m, motion.sample_period_s, latency_cycles=latency_cycles
    )
    signals = loop(motion.position_m, motion.position_m + sent.correction_m, sent.torque_Nm)
    residual_m = signals.table_position_m - signals.motor_position_m + sent.correction_m
    return residual_m, signals.table_position_m - motion.position_m
