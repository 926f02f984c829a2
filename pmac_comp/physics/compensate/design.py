"""Coefficients of the compensation law from a drive model.

What lives here: the start from the closed forms (regression of the simulated mechanical error on
acceleration, velocity and direction), the refinement of all coefficients through the closed loop
of the model (``loop``). What may not: captures, counts, the search from there for what leaves least
of the worst motions (``search``). Imports ``physics.signals``, ``files`` and ``base``.

The refinement is what makes the law right with the loop around it: latency of the door, current
loop, delay and the controller's own feed-forward all act in the simulation, so the coefficients
that undo them come out instead of being assumed.

The look-ahead is not among them: it is the time from the law to the shaft, which the model knows.
A model with sharp friction hardly tells it from break-away distances (0.7 ms of it change what the
law leaves of the model's errors by a few per cent), and friction that a drive really has turned out
a third worse with what was fitted so.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.progress import Progress, untold
from pmac_comp.base.threads import working
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.physics.compensate.constant import LEAST_LOAD_FRAC
from pmac_comp.physics.compensate.delay import nominal_delay_s
from pmac_comp.physics.compensate.free import (
    LAG_SCALES,
    TURNING_SCALES,
    LEAST_COULOMB_m,
    free_coefficients,
    with_free,
)
from pmac_comp.physics.compensate.judgement import aims, errors_of, errors_on, judged
from pmac_comp.physics.compensate.law import REST_STEPS, CompensationLaw
from pmac_comp.physics.compensate.loop import LoopRunner
from pmac_comp.physics.compensate.motions import (
    DWELL_WITH_GAP_s,
    design_motions,
    judging_motions,
)
from pmac_comp.physics.compensate.search import polished
from pmac_comp.physics.signals.trajectory import Trajectory

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

# Once it is fitted: blurred it hedges between the motions, but force crosses a gap at once, and on
# plants slow sinusoids are up to a third better with it sharp. Other motions pay 0-3 % for it, with
# Stribeck friction or a small load beside the play up to 15 %.
_SHARPENED_FRAC = 0.4
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
_FLANK_FRAC = 0.8  # of what friction winds up: where the fit begins
_CROSSING_FRAC = 0.2  # of friction's torque is held back in a crossing: where the fit begins
_START_BREAKAWAY_m = 1.2e-6
_START_LAG_s = 1e-3  # where the search begins
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
_SMOOTH_FRAC = 0.8  # of v_c: where the law's curve is nearest to the hyperbolic tangent


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
            values = {name: getattr(faster, name) for name in free_coefficients(start)[0]}
            again.append(replace(start, **values))
        candidates = [first, *(_sharpened(fitted(a)) for a in again)]
    judging = motions or judging_motions(bench, thresholds_m_per_s2=thresholds_m_per_s2)
    with working() as threads:
        errors = errors_on(loop, judging, latency_cycles, threads, with_torque=with_torque)
        best = min(candidates, key=lambda law: judged(errors(law)))
        best = replace(best, coulomb_lag_s=_START_LAG_s if bed is None else 0.0)
        # More than the model's friction pushes a drive loose as it comes to rest.
        most_Nm = start.torque_coulomb_Nm / _START_FRICTION_FRAC
        return polished(best, errors, progress, most_Nm=most_Nm)


def _changes_flank_m_per_s2(gap: NutGap, law: CompensationLaw) -> tuple[float, ...]:
    """Accelerations of the table, in size, at which its nut changes the flank."""
    holds_m_per_s2 = law.coulomb_m / law.inertia_s2
    return tuple(abs(gap.load_m_per_s2 + way * holds_m_per_s2) for way in (1.0, -1.0))


def _sharpened(law: CompensationLaw) -> CompensationLaw:
    return replace(law, gap_width_m=_SHARPENED_FRAC * law.gap_width_m)


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

    sizes, lowest = free_coefficients(start)
    for name in (*held, *TURNING_SCALES, *LAG_SCALES):
        sizes.pop(name, None)
    names, size = list(sizes), np.array(list(sizes.values()))
    first = np.array([getattr(start, name) for name in names]) / size
    lower = np.array([lowest.get(name, -np.inf) for name in names]) / size
    counts = (_MOVE_COUNTS if _has_steps(motion) else 1.0 for motion in motions)
    wanted = [(motion, aims(loop, motion), n) for motion, n in zip(motions, counts, strict=True)]

    def residual(point: FloatArray) -> FloatArray:
        law = with_free(start, names, point * size)
        left = ((errors_of(law, loop, latency_cycles, m, aim), n) for m, aim, n in wanted)
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
    return with_free(start, names, solved.x * size)


def _has_steps(motion: Trajectory) -> bool:
    """Whether the jerk of a motion steps."""
    jerk = np.diff(motion.position_m, 3)
    return _largest(np.diff(jerk)) > _STEP_FRAC * _largest(jerk)
