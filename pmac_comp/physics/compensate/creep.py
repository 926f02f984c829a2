"""Friction that lets go at rest, found in captures.

What lives here: how fast a drive creeps while its command rests, and the law that then lets go as
well. What may not: the model's fit, controllers.

Coulomb friction holds a drive at rest against whatever pushes it, up to its level. Friction of
grease, or of seals, can be a curve through zero speed, which ``identify`` looks for; this is for
models that hold none. Pushed with half of it such a drive creeps on, v = v_c atanh(T / F) for F
tanh(v / v_c). A law that goes on sending friction's torque at rest pushes such a drive out of its
place: by 7 to 10 um within 0.2 s where friction turns over within 0.2 mm/s, 0.46 of the total error
without compensation.

Torque and speed of the motor over rests tell the two apart. On simulated cards a drive that creeps
over 0.2 mm/s came out with 0.205 +- 0.005 mm/s, and seven that hold (presliding over 10 and 30 um,
play, a load) as such.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.evaluation import REST_CYCLES, friction_state
from pmac_comp.physics.compensate.free import FASTEST_FADE_per_s
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.physics.signals.rests import (
    moving_of,
    rests_of,
    slow_motion_at_rest,
    speed_by_push,
)

CREEP = "creep"  # of a law's provenance
_LEAST_BINS = 8
_LEAST_m_per_s = 0.01e-3  # pushed with all of friction; less moves nothing far while a rest lasts
_SURE = 5.0  # standard deviations
_LEAST_EXPLAINED = 0.5  # of the speeds' squares: friction that lets go in jerks explains less
_HELD_SHARE = 0.5  # of the table's lag by friction: less at rest, and the guide creeps too


@dataclass(frozen=True)
class Creep:
    """Speed in m/s of a resting drive that is pushed with its friction torque, and two deviations.

    And the share of the table's lag by friction that rests leave, where it is known.
    """

    speed_m_per_s: float
    two_std_m_per_s: float
    held_share: float = 1.0


def with_creep(
    law: CompensationLaw, captures: Sequence[Capture], lead: LeadMap | None = None
) -> CompensationLaw:
    """Law that lets go of friction at rest where the drive does.

    Parameters
    ----------
    law : CompensationLaw
        With all its other coefficients.
    captures : sequence of Capture
        Runs without compensation, with torque and with rests.
    lead : LeadMap or None
        Static error.

    Returns
    -------
    CompensationLaw
        The law itself where the drive holds, where its friction is nothing at rest already, or
        where the captures do not tell.
    """
    if law.is_smooth:
        return law
    found = creep_at_rest(law, captures, lead)
    if found is None:
        return law
    law = law.with_values(rest_fade_per_s=max(law.rest_fade_per_s, FASTEST_FADE_per_s))
    if found.held_share < _HELD_SHARE:
        law = law.with_values(rest_unwind_per_s=max(law.rest_unwind_per_s, FASTEST_FADE_per_s))
    return law.noting({CREEP: asdict(found)})


def creep_at_rest(
    law: CompensationLaw, captures: Sequence[Capture], lead: LeadMap | None = None
) -> Creep | None:
    """How fast a drive creeps at rest; None where it holds, or where captures do not tell.

    Parameters
    ----------
    law : CompensationLaw
        Its friction torque is the push, its load what is none.
    captures, lead
        As in ``with_creep``.
    """
    if law.torque_coulomb_Nm <= 0.0:
        return None
    rests = [_pushed(law, capture) for capture in captures]
    push, speed = np.concatenate(rests, axis=1) if rests else np.zeros((2, 0))
    slope = None if push.size < _LEAST_BINS else speed_by_push(push, speed)
    if slope is None or slope.explained < _LEAST_EXPLAINED:
        return None
    if slope.value < max(_LEAST_m_per_s, _SURE * slope.std):
        return None
    return Creep(slope.value, 2.0 * slope.std, _held_share(law, captures, lead))


def _pushed(law: CompensationLaw, capture: Capture) -> FloatArray:
    """Push in shares of the friction torque and speed in m/s at rests of a run, shape (2, n)."""
    torque_Nm, speed_m_per_s, place_m = slow_motion_at_rest(capture)
    load_Nm = law.torque_constant_Nm + law.torque_place_Nm_per_m * (place_m - law.origin_m)
    return np.stack([(torque_Nm - load_Nm) / law.torque_coulomb_Nm, speed_m_per_s])


def _held_share(law: CompensationLaw, captures: Sequence[Capture], lead: LeadMap | None) -> float:
    """Share of the table's lag by friction that rests leave; 1 where captures do not tell."""
    product, square = 0.0, 0.0
    for capture in captures:
        r, period = capture.commanded_position_m, capture.sample_period_s
        rests = [rest for rest in rests_of(r, period) if rest.stop - rest.start > REST_CYCLES]
        if capture.table_position_m is None or not rests:
            continue
        error_m = capture.table_position_m - capture.motor_position_m
        error_m = error_m - (0.0 if lead is None else lead.at(r))
        error_m = error_m - error_m[moving_of(r.size, rests)].mean()
        state = friction_state(np.gradient(r, period), law.breakaway_m, period)
        lag_m = -law.coulomb_m * (1.0 + law.compliance_slope_per_m * (r - law.origin_m)) * state
        for rest in rests:
            end = slice(rest.start + int(REST_CYCLES), rest.stop)
            product += float(lag_m[end] @ error_m[end])
            square += float(lag_m[end] @ lag_m[end])
    return product / square if square > 0.0 else 1.0
