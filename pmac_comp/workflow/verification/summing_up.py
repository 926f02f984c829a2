"""From the runs of all motions, without and with compensation, to a verification.

What lives here: what both ways to a verification share, fresh runs (``verify``) and stored ones
(``verify_stored``). What may not: the statistics (``outcome``), the verdict (``result``).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.exact import Aim
from pmac_comp.workflow.accuracy.late_scale import scale_age_s, scale_remarks
from pmac_comp.workflow.accuracy.outcome import MotionOutcome, Ratio, error_signals, sensor_floor_um
from pmac_comp.workflow.accuracy.own_ringing import own_ringing_remarks
from pmac_comp.workflow.accuracy.ringing import RingingOutcome, ringing_of
from pmac_comp.workflow.accuracy.static_check import StaticOutcome, approaches
from pmac_comp.workflow.compensation.file import Compensation, edited_remarks
from pmac_comp.workflow.verification.learning import learned_remarks
from pmac_comp.workflow.verification.result import Verification, static_remarks, verdict_remarks

Pair = tuple[list[Capture], list[Capture]]  # runs of one motion without and with compensation


def summed_up(
    outcomes: Sequence[MotionOutcome],
    groups: Sequence[Pair],
    bench: Bench,
    compensation: Compensation | None,
    *,
    simulated: bool,
    ringing: RingingOutcome | None = None,
    static: StaticOutcome | None = None,
    remarks: Sequence[str] = (),
) -> Verification:
    """Verification of outcomes and their runs; all motions together beside each one."""
    lead = None if compensation is None else compensation.lead
    table = None if compensation is None else compensation.table_correction(bench)
    age_s = scale_age_of(compensation)
    first = [[error_signals(c, lead, None, age_s) for c in pair[0]] for pair in groups]
    second = [[error_signals(c, lead, table, age_s) for c in pair[1]] for pair in groups]
    told: list[str] = []
    if compensation is not None:
        told = [*scale_remarks(compensation.law), *edited_remarks(compensation)]
        told += learned_remarks(compensation)

    def together(which: str) -> Ratio | None:
        if not first or not second:
            return None
        sides = [[getattr(s, which) for run in runs for s in run] for runs in (first, second)]
        found = Ratio.of(sides[0], sides[1], bench.servo_period_s)
        return found if math.isfinite(found.value) else None

    floor = sensor_floor_um(bench)
    own = own_ringing_remarks(outcomes, first, second, floor, bench.servo_period_s)
    found = Verification(
        tuple(outcomes),
        floor,
        simulated,
        tuple(c for pair in groups for c in pair[0]),
        tuple(c for pair in groups for c in pair[1]),
        lead,
        table,
        age_s,
        route="" if compensation is None else compensation.route,
        aim=Aim.TOTAL if compensation is None else compensation.aim,
        mechanical=together("mechanical_m"),
        total=together("total_m"),
        static=static,
        ringing=ringing,
    )
    verdict = verdict_remarks(outcomes, floor, holds_lag=found.holds_lag)
    return replace(found, remarks=(*verdict, *own, *told, *static_remarks(static), *remarks))


def scale_age_of(compensation: Compensation | None) -> float:
    """Time by which the scale is read after the encoder, as the compensation file says."""
    return 0.0 if compensation is None else scale_age_s(compensation.law.provenance)


def ringing_outcome(bench: Bench, pair: Pair) -> RingingOutcome:
    """What rings in runs of the ringing motion, beside the resonance that the bench file states."""
    return ringing_of(*pair, bench.known.resonance_Hz)


def static_outcome(pair: Pair) -> StaticOutcome | None:
    """Positioning of the sides that have two runs or more; None where neither has."""
    before, after = (None if len(side) < 2 else approaches(side) for side in pair)
    if before is None and after is None:
        return None
    return StaticOutcome(before, after, (*pair[0], *pair[1]))
