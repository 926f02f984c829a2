"""Coefficients of the compensation law from a drive model.

What lives here: the start from the closed forms (regression of the simulated mechanical error on
acceleration, velocity and direction), the refinement of all coefficients through the closed loop
of the model (``loop``), and the search for what leaves least of the worst motions. What may not:
captures, counts. Imports ``physics.signals``, ``files`` and ``base``.

The refinement is what makes the law right with the loop around it: latency of the door, current
loop, delay and the controller's own feed-forward all act in the simulation, so the coefficients
that undo them come out instead of being assumed.

The look-ahead is not among them: it is the time from the law to the shaft, which the model knows.
A model with sharp friction hardly tells it from break-away distances (0.7 ms of it change what the
law leaves of the model's errors by a few per cent), and friction that a drive really has turned out
a third worse with what was fitted so.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.errors import NonFinite
from pmac_comp.base.progress import Progress, untold
from pmac_comp.base.threads import working
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.compensate.constant import LEAST_LOAD_FRAC
from pmac_comp.physics.compensate.delay import nominal_delay_s
from pmac_comp.physics.compensate.evaluation import evaluate_law
from pmac_comp.physics.compensate.law import REST_STEPS, CompensationLaw
from pmac_comp.physics.compensate.loop import LoopRunner
from pmac_comp.physics.compensate.motions import (
    DWELL_WITH_GAP_s,
    design_motions,
    judging_motions,
)
from pmac_comp.physics.signals.trajectory import Trajectory

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

# What a good law leaves: a tenth of the mechanical error or this much, a fifth of the total error.
# Residuals count as shares of that, so that slow motions are not drowned by fast ones.
_MECHANICAL_FRAC = 0.1
_TOTAL_FRAC = 0.2
_LEAST_MECHANICAL_m = 0.15e-6
_LEAST_TOTAL_m = 1e-6
LEAST_COULOMB_m = 0.05e-6  # of a law with a gap: it tells the flank
# A model knows when the force turns to the sample, a drive's friction does not: narrower, down to
# where the model likes it best, leaves a tenth more of plants. On a light axis friction winds up
# less than this, and a flank that it cannot fill would never be reached.
_LEAST_WIDTH_m = 0.3e-6
_LEAST_WIDTH_FRAC = 0.3  # of what friction winds up
# Once it is fitted: blurred it hedges between the motions, but force crosses a gap at once, and on
# plants slow sinusoids are up to a third better with it sharp. Other motions pay 0-3 % for it, with
# Stribeck friction or a small load beside the play up to 15 %.
_SHARPENED_FRAC = 0.4
# Power of the shares of the aims that are taken together where laws are judged.
_WORST_FOREMOST = 6
# The search that betters the judgement: its rounds, when it ends, the steps of its slopes in the
# usual changes or, where friction turns over, as a share of the way, and what it tries in a round.
_MOST_ROUNDS, _LEAST_GAIN_FRAC = 10, 0.01
_SLOPE_STEP, _SLOPE_SHARE = 0.02, 0.01
_DAMPINGS, _STRIDES = (1e-3, 1e-2, 1e-1, 1.0), (1.0, 0.3)
_NEGLIGIBLE = 1e-12  # of the curvature in all: that of a coefficient that changes nothing
# What the motions that judge tell little of. A constant torque that is not the load's passes for
# friction at the next rest: with 150 N on the nut totals rose by half.
_TOLD_BY_RESTS = ("rest_fade_per_s", "torque_constant_Nm")
_TURNS_OVER_WITHIN = ("breakaway_m", "torque_breakaway_m")
# How friction turns over, which a fit by squares settles on large motions.
_FRICTION = (
    "coulomb_m",
    "breakaway_m",
    "stribeck_m",
    "torque_coulomb_Nm",
    "torque_breakaway_m",
    "torque_stribeck_Nm",
    "stribeck_speed_m_per_s",
)
_SHARP = ("gap_width_m", "breakaway_m", "torque_breakaway_m")  # with play, which no fit finds
# The search is judged on small slow motions too, which a fit by squares hardly feels: friction may
# turn over sooner than a fit is let.
_LEAST_BREAKAWAY_JUDGED_m = 0.2e-6
_FLANK_FRAC = 0.8  # of what friction winds up: where the fit begins
_CROSSING_FRAC = 0.2  # of friction's torque is held back in a crossing: where the fit begins
_START_BREAKAWAY_m = 1.2e-6
_START_FRICTION_FRAC = 0.9  # of the friction torque that the model has in motion
_TORQUE_FRAC = 0.9  # of the drive's limit: the rest is left to the loop
# Of the regression of the start: friction turns over within this speed, and has all its level
# beyond that.
_TURNS_OVER_m_per_s = 2e-3
_CLEAR_m_per_s = 1e-2
_ENDS = 5  # samples at both ends of a motion, where differences are one-sided
_UNIFORM_COLUMNS = [0, 2, 4, 6]  # those that do not change along the travel
# A move counts twice: its steps of the jerk ring the drive and send the nut across its gap, which
# is what limits a law, and there are more sinusoids.
_MOVE_COUNTS = 2.0
_STEP_FRAC = 0.5  # of the largest jerk within a sample: that of a sinusoid is smooth
# The law's jerk limit over the largest of the motions it is fitted on: what steps of the
# acceleration ring falls with it (half above the drive's own at 1.5, a fifth at 1.02).
_JERK_ROOM = 1.02
_MOST_STEPS = 20
_FEW_STEPS = 4  # from a start that is nearly right
_USUAL_STEPS = 8.0
_DECIMATION = 4  # residual samples per servo cycle that enter the fit

# Free coefficients with the size of a typical change.
_OFFSET_SCALES = {
    "inertia_s2": 2e-6,
    "viscous_s": 4e-6,
    "coulomb_m": 1e-6,
    "compliance_slope_per_m": 1.0,
    "jerk_s3": 1e-9,
    "breakaway_m": 1e-5,
}
_TORQUE_SCALES = {
    "torque_inertia_Nm_s2_per_m": 0.02,
    "torque_jerk_Nm_s3_per_m": 5e-4,
    "torque_impulse_Nm_s3_per_m": 1e-3,
    "torque_viscous_Nm_s_per_m": 0.2,
    "torque_coulomb_Nm": 0.2,
    "torque_load_Nm_s2_per_m": 0.02,
    "torque_breakaway_m": 1e-5,
    "torque_constant_Nm": 0.02,
    "rest_fade_per_s": 5.0,
}
# Left to the search: a fit by squares would give away how fast friction fades at a rest for these.
_TURNING_SCALES = {"torque_turning_Nm_s": 2e-5, "torque_turned_Nm_s": 2e-5}
_LAG_SCALES, _START_LAG_s = {"coulomb_lag_s": 1e-4}, 1e-3
_GAP_SCALES = {"gap_half_m": 1e-6, "gap_width_m": 0.5e-6, "gap_lag_s": 1e-3}
_GAP_TORQUE_SCALES = {"gap_torque_Nm": 0.1}
_GAP_LOAD_SCALES = {"gap_load_m": 0.5e-6}
_STRIBECK_SCALES = {"stribeck_m": 0.5e-6, "stribeck_speed_m_per_s": 5e-3}
_STRIBECK_TORQUE_SCALES = {"torque_stribeck_Nm": 0.05}
_SMOOTH_SCALES, _SLOWEST_SMOOTH = {"stribeck_speed_m_per_s": 1e-3}, 5e-5
_SMOOTH_FRAC = 0.8  # of v_c: where the law's curve is nearest to the hyperbolic tangent
_BED_TORQUE_SCALES = {"torque_bed_Nm_s2_per_m": 0.02}
_LOWEST = {
    "breakaway_m": 0.5e-6,
    "torque_breakaway_m": 0.5e-6,
    "rest_fade_per_s": 4.5,  # 0.82 are left: with all of it the motor creeps on
    "gap_half_m": 0.0,
    "gap_lag_s": 0.0,
    "coulomb_lag_s": 0.0,
    "stribeck_m": 0.0,
    "torque_stribeck_Nm": 0.0,
    "stribeck_speed_m_per_s": 1e-3,
}
# Gone in ten servo cycles; a pass that takes away more than there is would swing.
FASTEST_FADE_per_s = 400.0


@dataclass(frozen=True)
class NutGap:
    """Clearance of a nut.

    Parameters
    ----------
    half_m : float
        Half of it.
    edge_m_per_s2 : float
        Acceleration of the table whose force takes all of it up; 0 for play, which has no width.
    load_m_per_s2 : float
        Acceleration of the table whose force is the constant load on the nut.
    stiff : LoopRunner
        Loop of the model without it, which the regression starts from.
    """

    half_m: float
    edge_m_per_s2: float
    load_m_per_s2: float
    stiff: LoopRunner


@dataclass(frozen=True)
class SwungBed:
    """Machine bed that swings: what it makes of the table's acceleration relative to it.

    Parameters
    ----------
    share : float
        Its acceleration as the table begins to accelerate, over the table's, reversed.
    damping_per_s, stiffness_per_s2 : float
        Of the bed with the table on it.
    torque_Nm_s2_per_m : float
        Torque at the motor of the table's mass.
    """

    share: float
    damping_per_s: float
    stiffness_per_s2: float
    torque_Nm_s2_per_m: float


@dataclass(frozen=True)
class Stribeck:
    """Friction that is higher near standstill.

    Parameters
    ----------
    guide_frac : float
        At the guide, what it has at rest beyond its level in motion, as a share of that.
    torque_Nm : float
        The same of all friction, at the motor.
    speed_m_per_s : float
        Speed at which 1/e of it is left.
    """

    guide_frac: float
    torque_Nm: float
    speed_m_per_s: float


@dataclass(frozen=True)
class SmoothFriction:
    """Friction F tanh(v / v_c).

    Parameters
    ----------
    speed_m_per_s : float
        v_c at the table.
    """

    speed_m_per_s: float


def design_law(
    bench: Bench,
    loop: LoopRunner,
    *,
    delay_s: float | None = None,
    latency_cycles: int = 1,
    with_torque: bool = True,
    every_cycles: int = 1,
    gap: NutGap | None = None,
    bed: SwungBed | None = None,
    stribeck: Stribeck | SmoothFriction | None = None,
    load_Nm: float = 0.0,
    faster: CompensationLaw | None = None,
    motions: Sequence[Trajectory] | None = None,
    provenance: dict[str, Any] | None = None,
    progress: Progress | None = None,
) -> CompensationLaw:
    """Law whose coefficients remove the model's mechanical and control error.

    Parameters
    ----------
    bench : Bench
        Limits, travel, period.
    loop : LoopRunner
        Closed loop of the model (``model_loop``).
    delay_s : float, optional
        From torque command to shaft (``drive_delay_s``); by the bench file if not given.
    latency_cycles : int
        Servo cycles by which the door delivers late (1 for PLC 0, 0 for the open servo).
    with_torque : bool
        Whether the route carries torque feed-forward.
    every_cycles : int
        Servo cycles between two passes of the law.
    gap : NutGap, optional
        Clearance of the nut.
    bed : SwungBed, optional
        Bed that swings.
    stribeck : Stribeck or SmoothFriction, optional
        Friction that is another near standstill.
    load_Nm : float
        Torque that holds the constant load of the model: a law with torque sends it.
    faster : CompensationLaw, optional
        Law of the same model that is computed more often, from where one with a gap is fitted too.
    motions : sequence of Trajectory, optional
        Where the coefficients are refined and judged; if not given,
        ``design_motions`` and ``judging_motions``.
    provenance : dict, optional
        Kept with the law.
    progress : callable, optional
        Called with a step and a fraction.

    Raises
    ------
    ModelError
        The model gives no finite response.
    """
    chosen = tuple(motions or _fitted_on(bench, with_gap=gap is not None))
    start = start_law(
        bench,
        loop if gap is None else gap.stiff,
        chosen,
        delay_s=delay_s,
        latency_cycles=latency_cycles,
        with_torque=with_torque,
    )
    start = replace(
        start,
        every_cycles=every_cycles,
        lookahead_s=start.lookahead_s + _held_s(bench, every_cycles),
        provenance=dict(provenance or {}),
        jerk_limit_m_per_s3=_JERK_ROOM * max(_largest_jerk(motion) for motion in chosen),
    )
    if with_torque:
        # Less is nothing beside friction: the fit would make of it what suits its motions.
        counts = abs(load_Nm) > LEAST_LOAD_FRAC * start.torque_coulomb_Nm
        start = replace(start, torque_constant_Nm=load_Nm if counts else 0.0)
    if gap is not None:
        start = _taking_up(gap, start)
    if bed is not None:
        start = _swinging(bed, start)
    if isinstance(stribeck, SmoothFriction):
        start = start.as_smooth(_SMOOTH_FRAC * stribeck.speed_m_per_s)
    elif stribeck is not None:
        start = _gripping_slow(stribeck, start)
    fitted = partial(
        _refined, loop=loop, motions=chosen, latency_cycles=latency_cycles, progress=progress
    )
    law = fitted(start)
    candidates = [law]
    play = gap is not None and gap.edge_m_per_s2 == 0.0
    thresholds_m_per_s2 = _changes_flank_m_per_s2(gap, start) if gap is not None and play else ()
    if play:
        # What a nut does in its gap jumps with the coefficients, and the fit ends in one of many
        # valleys, which one is chance. From there with the crossing made sharp it finds another;
        # not with the fade that it ended on, near whose limits it stays.
        first = _sharpened(law)
        again = [replace(first, rest_fade_per_s=start.rest_fade_per_s)]
        if faster is not None:
            values = {name: getattr(faster, name) for name in _free(start)[0]}
            again.append(replace(start, **values))
        candidates = [first, *(_sharpened(fitted(a)) for a in again)]
    judging = motions or judging_motions(bench, thresholds_m_per_s2=thresholds_m_per_s2)
    with working() as threads:
        errors = _errors_on(loop, judging, latency_cycles, threads, with_torque=with_torque)
        best = min(candidates, key=lambda law: _judged(errors(law)))
        best = replace(best, coulomb_lag_s=_START_LAG_s if bed is None else 0.0)
        # More than the model's friction pushes a drive loose as it comes to rest.
        most_Nm = start.torque_coulomb_Nm / _START_FRICTION_FRAC
        return _polished(best, errors, progress, most_Nm=most_Nm)


def _changes_flank_m_per_s2(gap: NutGap, law: CompensationLaw) -> tuple[float, ...]:
    """Accelerations of the table, in size, at which its nut changes the flank."""
    holds_m_per_s2 = law.coulomb_m / law.inertia_s2
    return tuple(abs(gap.load_m_per_s2 + way * holds_m_per_s2) for way in (1.0, -1.0))


def _sharpened(law: CompensationLaw) -> CompensationLaw:
    return replace(law, gap_width_m=_SHARPENED_FRAC * law.gap_width_m)


def _errors_on(
    loop: LoopRunner,
    motions: Sequence[Trajectory],
    latency_cycles: int,
    threads: Executor,
    *,
    with_torque: bool,
) -> Callable[[CompensationLaw], list[tuple[FloatArray, ...]]]:
    """What laws leave of the errors of motions (``_errors``).

    A law without torque is judged by the mechanical error alone, as it has no say in the other.
    """
    wanted = [aims(loop, motion) for motion in motions]
    n_kinds = 2 if with_torque else 1

    def of(law: CompensationLaw) -> list[tuple[FloatArray, ...]]:
        one = partial(_errors, law, loop, latency_cycles)
        return list(zip(*threads.map(one, motions, wanted), strict=True))[:n_kinds]

    return of


def _judged(errors: Sequence[Sequence[FloatArray]]) -> float:
    """How much errors of each kind are beyond their aims, the worst foremost.

    Which of two fits errs less on what they were fitted on says little of other motions: one of
    four fifths of the cost was found to leave twice as much of some. What of a kind is beyond its
    aims counts by its logarithm: where no law reaches one of them (a nut in its play beside
    Stribeck friction, 3.5 of the mechanical one), the total error was given away for a little less
    of that (0.4 of before).
    """
    means = [_worst_foremost(kind) for kind in errors]
    return sum(mean if mean <= 1.0 else 1.0 + math.log(mean) for mean in means)


def _worst_foremost(errors: Sequence[FloatArray]) -> float:
    """Mean of a power of errors as shares of their aims."""
    with np.errstate(over="ignore"):
        return float(np.mean([np.linalg.norm(error) ** _WORST_FOREMOST for error in errors]))


def _polished(
    law: CompensationLaw,
    errors: Callable[[CompensationLaw], list[tuple[FloatArray, ...]]],
    progress: Progress | None,
    *,
    most_Nm: float = math.inf,
) -> CompensationLaw:
    """The law with the coefficients that are judged best, found by search from its own.

    The sums of squares of a fit weigh what is far within its aim as much as what is beyond it. Here
    each error weighs as much as makes its square the power by which it is judged (iteratively
    reweighted least squares), and of Levenberg's and Marquardt's steps the one is taken that is
    judged best. A tenth to two fifths less is left of the worst of motions that it never saw: with
    play of moves, without of small slow sinusoids. Slopes are taken over steps that a nut's
    crossings of its gap and friction that turns over within a sample do not blur.
    """
    sizes, lowest = _free(law)
    for name in _TOLD_BY_RESTS:
        sizes.pop(name, None)
    lowest |= dict.fromkeys(_TURNS_OVER_WITHIN, _LEAST_BREAKAWAY_JUDGED_m)
    if law.gap_half_m > 0.0:
        lowest["gap_width_m"] *= _SHARPENED_FRAC
    names = list(sizes)
    lower = np.array([lowest.get(name, -np.inf) for name in names])
    highest = {"torque_coulomb_Nm": max(most_Nm, law.torque_coulomb_Nm)}
    upper = np.array([highest.get(name, np.inf) for name in names])
    tell = progress or untold

    def at(point: FloatArray) -> CompensationLaw:
        return _with_values(law, names, np.clip(point, lower, upper))

    best = point = np.array([getattr(law, name) for name in names])
    left = errors(law)
    for k in range(_MOST_ROUNDS):
        tell("polishing the law", (k + 1) / (_MOST_ROUNDS + 1))
        steps = np.array([_slope_step(name, sizes, at(point)) for name in names])
        before = _judged(left)
        for change in _changes(errors, at, point, steps, left):
            there = np.clip(point + change, lower, upper)
            try:
                found = errors(at(there))
            except NonFinite:
                continue  # a step too far: the loop of the model ran away
            if _judged(found) < _judged(left):
                best, left = there, found
        if before - _judged(left) < _LEAST_GAIN_FRAC * min(before, 1.0):
            break
        point = best
    return at(best)


def _slope_step(name: str, sizes: Mapping[str, float], law: CompensationLaw) -> float:
    if name in _TURNS_OVER_WITHIN:
        return float(_SLOPE_SHARE * getattr(law, name))
    return _SLOPE_STEP * sizes[name]


def _changes(
    errors: Callable[[CompensationLaw], list[tuple[FloatArray, ...]]],
    at: Callable[[FloatArray], CompensationLaw],
    point: FloatArray,
    steps: FloatArray,
    left: Sequence[Sequence[FloatArray]],
) -> list[FloatArray]:
    """Steps of Levenberg and Marquardt from a point, of several dampings and lengths."""
    weights = [
        np.linalg.norm(error) ** (_WORST_FOREMOST // 2 - 1) / math.sqrt(max(1.0, mean))
        for kind in left
        for mean in [_worst_foremost(kind)]
        for error in kind
    ]

    def weighed(parts: Sequence[Sequence[FloatArray]]) -> FloatArray:
        pairs = zip(weights, chain(*parts), strict=True)
        return np.concatenate([weight * part for weight, part in pairs])

    now = weighed(left)
    slopes = np.stack([weighed(errors(at(point + d))) - now for d in np.diag(steps)], axis=1)
    curvature, gradient = slopes.T @ slopes, slopes.T @ now
    own = np.diag(curvature)
    if not own.any():
        return []  # nothing that a coefficient has a say in is left
    own = np.diag(own + _NEGLIGIBLE * own.sum())
    full = [-np.linalg.solve(curvature + damping * own, gradient) * steps for damping in _DAMPINGS]
    return [stride * change for change in full for stride in _STRIDES]


def _taking_up(gap: NutGap, law: CompensationLaw) -> CompensationLaw:
    """The law with the gap of a nut, as its fit begins."""
    coulomb_m = max(law.coulomb_m, LEAST_COULOMB_m)
    # What has no width of its own: over a part of what friction winds up.
    width_m = max(_FLANK_FRAC * coulomb_m, law.inertia_s2 * gap.edge_m_per_s2)
    return replace(
        law,
        gap_half_m=gap.half_m,
        gap_width_m=width_m,
        gap_load_m=law.inertia_s2 * gap.load_m_per_s2,
        gap_lag_s=law.lookahead_s,  # the motor crosses no sooner than it answers
        gap_torque_Nm=-_CROSSING_FRAC * law.torque_coulomb_Nm,
        coulomb_m=coulomb_m,
    )


def _swinging(bed: SwungBed, law: CompensationLaw) -> CompensationLaw:
    """The law with a bed that swings, as its fit begins."""
    return replace(
        law,
        bed_share=bed.share,
        bed_damping_per_s=bed.damping_per_s,
        bed_stiffness_per_s2=bed.stiffness_per_s2,
        torque_bed_Nm_s2_per_m=bed.torque_Nm_s2_per_m if law.torque_limit_Nm > 0.0 else 0.0,
    )


def _gripping_slow(stribeck: Stribeck, law: CompensationLaw) -> CompensationLaw:
    """The law with friction that is higher near standstill, as its fit begins."""
    return replace(
        law,
        stribeck_m=stribeck.guide_frac * abs(law.coulomb_m),
        torque_stribeck_Nm=stribeck.torque_Nm if law.torque_limit_Nm > 0.0 else 0.0,
        stribeck_speed_m_per_s=stribeck.speed_m_per_s,
    )


def _largest_jerk(motion: Trajectory) -> float:
    """Largest jerk in m/s3 of a motion as a law sees it, by differences at the sample period."""
    return _largest(np.diff(motion.position_m, 3) / motion.sample_period_s**3)


def _largest(values: FloatArray) -> float:
    """Largest size of values."""
    return float(np.max(np.abs(values)))


def slower_law(
    bench: Bench,
    law: CompensationLaw,
    loop: LoopRunner,
    every_cycles: int,
    *,
    latency_cycles: int = 1,
    motions: Sequence[Trajectory] | None = None,
) -> CompensationLaw:
    """The law fitted anew for a door that computes it less often, from a law for every cycle."""
    later_s = _held_s(bench, every_cycles) - _held_s(bench, law.every_cycles)
    start = replace(
        law,
        every_cycles=every_cycles,
        lookahead_s=law.lookahead_s + later_s,
    )
    chosen = tuple(motions or _fitted_on(bench, with_gap=law.gap_half_m > 0.0))
    held = _SHARP if law.gap_half_m > 0.0 else _FRICTION
    return _refined(start, loop, chosen, latency_cycles, None, most_steps=_FEW_STEPS, held=held)


def _fitted_on(bench: Bench, *, with_gap: bool) -> tuple[Trajectory, ...]:
    return design_motions(bench, dwell_s=DWELL_WITH_GAP_s) if with_gap else design_motions(bench)


def _held_s(bench: Bench, every_cycles: int) -> float:
    """By how much a value that is held for some cycles is late on average, s."""
    return 0.5 * (every_cycles - 1) * bench.servo_period_s


def start_law(
    bench: Bench,
    loop: LoopRunner,
    motions: Sequence[Trajectory],
    *,
    delay_s: float | None = None,
    latency_cycles: int = 1,
    with_torque: bool = True,
) -> CompensationLaw:
    """Law by regression of what the model does on what its motor does, before it is refined.

    Source
    ------
    Closed forms of the elastic chain in ``model.quasi_static``.
    """
    period = bench.servo_period_s
    rows, errors, torques = [], [], []
    for motion in motions:
        signals = loop(motion.position_m, None, None)
        row, clear = _regressors(signals.motor_position_m, period, bench.mid_travel_m)
        error = signals.table_position_m - signals.motor_position_m
        rows.append(row[clear])
        errors.append((error - error[0])[clear])
        torques.append(signals.torque_Nm[clear])
    matrix = np.concatenate(rows)
    inertia_s2, rise, viscous_s, _, coulomb_m, _, _ = np.linalg.lstsq(
        matrix, -np.concatenate(errors), rcond=None
    )[0].tolist()
    _, _, friction_Nm, jerk_Nm_s3_per_m = np.linalg.lstsq(
        matrix[:, _UNIFORM_COLUMNS], np.concatenate(torques), rcond=None
    )[0].tolist()
    ahead_s = nominal_delay_s(bench) if delay_s is None else delay_s
    law = CompensationLaw(
        inertia_s2=inertia_s2,
        viscous_s=viscous_s,
        coulomb_m=coulomb_m,
        compliance_slope_per_m=rise / inertia_s2 if inertia_s2 > 0.0 else 0.0,
        breakaway_m=_START_BREAKAWAY_m,
        lookahead_s=latency_cycles * period + ahead_s,
        origin_m=bench.mid_travel_m,
        turn_m=bench.pitch_m,
        rest_step_m=REST_STEPS * bench.motor_resolution_m,
        amplitude_limit_m=bench.safety.max_correction_um / UM_PER_M,
        valid_speed_m_per_s=max(_largest(m.velocity_m_per_s) for m in motions),
        valid_acceleration_m_per_s2=max(_largest(m.acceleration_m_per_s2) for m in motions),
    )
    if not with_torque:
        return law
    return replace(
        law,
        torque_jerk_Nm_s3_per_m=jerk_Nm_s3_per_m,
        torque_coulomb_Nm=_START_FRICTION_FRAC * friction_Nm,
        torque_breakaway_m=_START_BREAKAWAY_m,
        torque_limit_Nm=_TORQUE_FRAC * bench.drive.torque_limit_Nm,
    )


def _regressors(
    position_m: FloatArray, period_s: float, origin_m: float
) -> tuple[FloatArray, BoolArray]:
    """Columns a, a x, v, v x, s, s x, jerk of a smooth motion and where direction is clear."""
    v = np.gradient(position_m, period_s)
    a = np.gradient(v, period_s)
    j = np.gradient(a, period_s)
    x = position_m - origin_m
    s = np.tanh(v / _TURNS_OVER_m_per_s)
    moving = np.abs(v) > _CLEAR_m_per_s
    moving[:_ENDS] = moving[-_ENDS:] = False
    return np.column_stack([a, a * x, v, v * x, s, s * x, j]), moving


def _refined(
    start: CompensationLaw,
    loop: LoopRunner,
    motions: Sequence[Trajectory],
    latency_cycles: int,
    progress: Progress | None,
    *,
    most_steps: int = _MOST_STEPS,
    held: Sequence[str] = (),
) -> CompensationLaw:
    """The law whose free coefficients, but those held, leave the least of motions' errors."""
    from scipy.optimize import least_squares

    sizes, lowest = _free(start)
    for name in (*held, *_TURNING_SCALES, *_LAG_SCALES):
        sizes.pop(name, None)
    names, size = list(sizes), np.array(list(sizes.values()))
    first = np.array([getattr(start, name) for name in names]) / size
    lower = np.array([lowest.get(name, -np.inf) for name in names]) / size
    counts = (_MOVE_COUNTS if _has_steps(motion) else 1.0 for motion in motions)
    wanted = [(motion, aims(loop, motion), n) for motion, n in zip(motions, counts, strict=True)]

    def residual(point: FloatArray) -> FloatArray:
        law = _with_values(start, names, point * size)
        left = ((_errors(law, loop, latency_cycles, m, aim), n) for m, aim, n in wanted)
        return np.concatenate([n * error for both, n in left for error in both])

    tell = progress or untold

    def stepped(intermediate_result: "OptimizeResult") -> None:
        tell("computing the law", min(0.99, intermediate_result.nit / _USUAL_STEPS))

    tell("computing the law", 0.0)
    with working() as threads:
        solved = least_squares(
            residual,
            np.maximum(first, lower + 0.05),
            bounds=(lower, np.inf),
            diff_step=[1e-3],
            max_nfev=most_steps,
            xtol=1e-4,
            ftol=1e-3,
            workers=threads.map,
            callback=stepped,
        )
    return _with_values(start, names, solved.x * size)


def _free(start: CompensationLaw) -> tuple[dict[str, float], dict[str, float]]:
    """Coefficients of a law that are fitted, with the size of a typical change, and their bounds.

    Of a term that the law begins without, none is free.
    """
    has_torque = start.torque_limit_Nm > 0.0
    sizes = {**_OFFSET_SCALES, **(_TORQUE_SCALES | _TURNING_SCALES if has_torque else {})}
    if start.torque_constant_Nm == 0.0:
        # A drive without load is the same both ways: a constant would fit the motions, not it.
        sizes.pop("torque_constant_Nm", None)
    lowest = dict(_LOWEST)
    if start.gap_half_m > 0.0:
        sizes |= _GAP_SCALES | (_GAP_TORQUE_SCALES if has_torque else {})
        sizes |= _GAP_LOAD_SCALES if start.gap_load_m != 0.0 else {}
        lowest["coulomb_m"] = LEAST_COULOMB_m
        lowest["gap_width_m"] = min(_LEAST_WIDTH_m, _LEAST_WIDTH_FRAC * start.coulomb_m)
    if start.bed_share > 0.0:
        sizes |= _BED_TORQUE_SCALES if has_torque else {}
    else:
        sizes |= _LAG_SCALES
    if start.is_smooth:
        sizes |= _SMOOTH_SCALES
        sizes.pop("rest_fade_per_s", None)  # there is nothing at rest
        lowest["stribeck_speed_m_per_s"] = _SLOWEST_SMOOTH
    elif start.has_stribeck:
        sizes |= _STRIBECK_SCALES | (_STRIBECK_TORQUE_SCALES if has_torque else {})
    return sizes, lowest


def _with_values(law: CompensationLaw, names: Sequence[str], values: FloatArray) -> CompensationLaw:
    """The law with fitted coefficients."""
    given = dict(zip(names, values.tolist(), strict=True))
    # A limit here and none of the fit: near one that is not even reached it ends elsewhere.
    fade = min(given.get("rest_fade_per_s", law.rest_fade_per_s), FASTEST_FADE_per_s)
    return law.with_values(**given | {"rest_fade_per_s": fade})


def aims(loop: LoopRunner, motion: Trajectory) -> tuple[float, float]:
    """Mechanical and total error in m that would be a good result for a motion."""
    before = loop(motion.position_m, None, None)
    mechanical = float(np.std(before.table_position_m - before.motor_position_m))
    total = float(np.std(before.table_position_m - motion.position_m))
    return (
        max(_MECHANICAL_FRAC * mechanical, _LEAST_MECHANICAL_m),
        max(_TOTAL_FRAC * total, _LEAST_TOTAL_m),
    )


def _errors(
    law: CompensationLaw,
    loop: LoopRunner,
    latency_cycles: int,
    motion: Trajectory,
    aim: tuple[float, float],
) -> tuple[FloatArray, FloatArray]:
    """Residual mechanical error and total error of a motion; the norms are shares of their aims."""
    residual_m, total_m = _left(law, loop, motion, latency_cycles)
    # Where the nut stood before the run began, or where the load let it, is no error of the law.
    residual_m = residual_m - residual_m.mean()
    both = (residual_m / aim[0])[::_DECIMATION], ((total_m - total_m[0]) / aim[1])[::_DECIMATION]
    return both[0] / math.sqrt(both[0].size), both[1] / math.sqrt(both[1].size)


def _left(
    law: CompensationLaw, loop: LoopRunner, motion: Trajectory, latency_cycles: int
) -> tuple[FloatArray, FloatArray]:
    """Residual mechanical and total error in m of one motion with a law."""
    sent = evaluate_law(
        law, motion.position_m, motion.sample_period_s, latency_cycles=latency_cycles
    )
    signals = loop(motion.position_m, motion.position_m + sent.correction_m, sent.torque_Nm)
    residual_m = signals.table_position_m - signals.motor_position_m + sent.correction_m
    return residual_m, signals.table_position_m - motion.position_m


def _has_steps(motion: Trajectory) -> bool:
    """Whether the jerk of a motion steps."""
    jerk = np.diff(motion.position_m, 3)
    return _largest(np.diff(jerk)) > _STEP_FRAC * _largest(jerk)
