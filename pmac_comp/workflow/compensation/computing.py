"""From a model and captures to a compensation.

What lives here: the order of the steps, and what of a law PLC 0 has time for. What may not: the
design of the law (``physics.compensate``), files (``compensate``), words (``text``),
registers, conversations.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pmac_comp.base.progress import Progress
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.machine.controller.card.processor_load import ProcessorLoad
from pmac_comp.physics.compensate.creep import with_creep
from pmac_comp.physics.compensate.exact import Aim, exact_correction, faded
from pmac_comp.physics.compensate.grip import gripping_model
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap, LeadWave
from pmac_comp.physics.compensate.loop import load_torque_Nm, model_loop
from pmac_comp.physics.compensate.resting import with_unwinding
from pmac_comp.physics.compensate.trim import TRIM_EXPLAINED, shows_reversal, trimmed_law, with_drag
from pmac_comp.physics.compensate.wobble import WORTH, with_wobble
from pmac_comp.physics.model import slots
from pmac_comp.workflow.compensation.file import EXACT, Compensation, check_route
from pmac_comp.workflow.compensation.foreseen import check_options, check_slow_runs, require_motion
from pmac_comp.workflow.compensation.repeated import with_offset
from pmac_comp.workflow.law.backlash import has_backlash
from pmac_comp.workflow.law.beyond_model import shown_by_runs
from pmac_comp.workflow.law.dynamic_law import (
    GAVE_WAY,
    NO_TIME_FOR_DRAG,
    dynamic_law,
    turn_errors,
    with_unmodelled,
    without_fed_forward,
    wobble_of,
)
from pmac_comp.workflow.law.law_cost import ASKED, fitting_cycles
from pmac_comp.workflow.law.rendering import lead_table
from pmac_comp.workflow.law.routes import LATENCY_CYCLES, MOTION_ROUTES, TORQUE_ROUTES
from pmac_comp.workflow.law.static_map import Limit, bench_map, static_map
from pmac_comp.workflow.motion.approach import approach
from pmac_comp.workflow.motion.motions import Motion, is_allowed

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

CUT_FRAC = 0.999  # of the limit: what reaches it was cut
_CyclesOf = Callable[[CompensationLaw], int]  # servo cycles between passes that leave time
_DRAGS_m = 0.15e-6  # a drag that makes more than that, the aim of e_r, is worth fewer passes
_SHAKES = 0.6  # of an aim: a wobble that makes more is worth fewer passes of a law


def compute_compensation(
    bench: Bench,
    model: "DriveModel",
    *,
    route: str,
    slow: tuple[Capture, ...] = (),
    captures: tuple[Capture, ...] = (),
    motion: Motion | None = None,
    aim: Aim = Aim.TOTAL,
    every_cycles: int = 1,
    provenance: dict[str, Any] | None = None,
    limit: Limit = Limit.REFUSE,
    load: ProcessorLoad | None = None,
    progress: Progress | None = None,
) -> Compensation:
    """Law, lead map and backlash of a model and slow runs for a route.

    Parameters
    ----------
    bench, model
        What is known, and the identified drive.
    route : str
        One of ``ROUTES``.
    slow : tuple of Capture
        Slow runs in both directions; none means no table.
    captures : tuple of Capture
        Relaxed runs without compensation: the law's offset terms are corrected by what the model
        leaves of them.
    motion : Motion or None
        The one motion of ``cam`` and ``program``.
    aim : Aim
        What their correction takes away: the total error, with the loop's lag in it, or e_r.
    every_cycles : int
        Servo cycles between two passes of the law on the controller (route ``law``); more where
        its passes would take all of the processor's time.
    provenance : dict, optional
        Where the figures come from.
    limit : Limit
        What to do where slow runs do not cover the travel.
    load : ProcessorLoad or None
        How busy the card is, where one is connected; else the bench file's clock tells what fits.
    progress : callable, optional
        Called with a step and a fraction.

    Raises
    ------
    ConfigError
        ``cam`` or ``program`` without a motion, ``table`` without slow runs.
    NotIdentifiable
        The slow runs give no map, or one of a part of the travel only.
    """
    check_route(route)
    check_options(bench, route, motion, every_cycles)
    check_slow_runs(bench, route, slow, whole_travel=limit is Limit.REFUSE)
    shown = shown_by_runs(
        bench, model, captures, slow, with_gap=route != "table", progress=progress
    )
    model, captures, slow = shown.model, shown.captures, shown.slow
    cycles_of = partial(fitting_cycles, bench, load=load)
    law = _law_that_fits(
        bench,
        model,
        route,
        captures,
        slow,
        cycles_of,
        every_cycles=every_cycles,
        provenance={**(provenance or {}), **shown.noted},
        progress=progress,
    )
    model = gripping_model(model, law)
    if progress is not None and slow:
        progress("mapping the lead error", 0.6)
    per_turn_m = turn_errors(bench, model, law, captures, slow)

    def mapped(law: CompensationLaw) -> LeadMap | None:
        """Lead map beside a law: what the law carries must not be in the tables as well."""
        return static_map(bench, route, slow, law, limit, per_turn_m) if slow else None

    lead = mapped(law)
    wave = wobble_of(bench, lead)
    if route in MOTION_ROUTES:
        backlash = _takes_up(model, law, route, captures, lead)
        law = with_unmodelled(bench, law, model, captures, lead)
        known = require_motion(route, motion)
        return _for_motion(bench, model, route, law, lead, known, aim, backlash=backlash)
    if captures:
        if progress is not None:
            progress("holding the law against the captures", 0.8)
        law, explained = trimmed_law(law, model_loop(model, wave), captures, lead)
        law = law.noting({TRIM_EXPLAINED: explained})
        lead = mapped(law)
    loop = model_loop(without_fed_forward(model))
    law = with_unwinding(law, loop, bench, LATENCY_CYCLES[route], load_torque_Nm(model))
    law = with_creep(law, captures, lead)
    more = _against_wobble(bench, model, route, law, wave)
    law = more if route != "law" or cycles_of(more) <= law.every_cycles else law
    if captures:
        law = _with_drag_that_fits(cycles_of, model, route, law, captures, lead, wave)
        lead = mapped(law) if law.drag_m > 0.0 else lead
        law = with_unmodelled(bench, law, model, captures, lead)
    backlash = _takes_up(model, law, route, captures, lead)
    return Compensation(route, law, lead, backlash=backlash)


def _with_drag_that_fits(
    cycles_of: _CyclesOf,
    model: "DriveModel",
    route: str,
    law: CompensationLaw,
    captures: tuple[Capture, ...],
    lead: LeadMap | None,
    wave: LeadWave | None,
) -> CompensationLaw:
    """A law with what drags at the table, or with a note of it where PLC 0 has no time for it."""
    more = _with_drag(model, law, captures, lead, wave)
    if route != "law" or cycles_of(more) <= law.every_cycles:
        return more
    return law.noting({NO_TIME_FOR_DRAG: more.drag_m})


def _with_drag(
    model: "DriveModel",
    law: CompensationLaw,
    captures: tuple[Capture, ...],
    lead: LeadMap | None,
    wave: LeadWave | None,
) -> CompensationLaw:
    """A law with what drags at the table over millimetres, where the captures show it."""
    mass_kg = model.kernel_vector()[slots.M_TABLE]
    torque = mass_kg * model.bench.lead_m_per_rad
    return with_drag(law, model_loop(model, wave), captures, lead, torque_Nm_s2_per_m=torque)


def _against_wobble(
    bench: Bench,
    model: "DriveModel",
    route: str,
    law: CompensationLaw,
    wave: LeadWave | None,
    worth: float = WORTH,
) -> CompensationLaw:
    """A law with torque that helps the loop to follow the table, where it shakes the axis."""
    if wave is None or route not in TORQUE_ROUTES:
        return law
    model = without_fed_forward(model)
    more = with_wobble(
        law,
        bench,
        wave,
        model_loop(model),
        model_loop(model, wave),
        latency_cycles=LATENCY_CYCLES[route],
        worth=worth,
    )
    if more == law or law.turn_friction_Nm == law.turn_share == 0.0:
        return more
    return more.noting({GAVE_WAY: True})


def _takes_up(
    model: "DriveModel",
    law: CompensationLaw,
    route: str,
    captures: tuple[Capture, ...],
    lead: LeadMap | None,
) -> bool:
    """Whether a backlash table takes the difference of the directions away.

    For the route ``table`` that is all of it; beside a law or a known motion the rest of it, which
    the other runs must show too.
    """
    if lead is None or not has_backlash(lead, route):
        return False
    return route == "table" or shows_reversal(law, model_loop(model), captures, lead)


def _law_that_fits(
    bench: Bench,
    model: "DriveModel",
    route: str,
    captures: tuple[Capture, ...],
    slow: tuple[Capture, ...],
    cycles_of: _CyclesOf,
    *,
    every_cycles: int,
    provenance: dict[str, Any],
    progress: Progress | None,
) -> CompensationLaw:
    """Law of a route, for fewer passes than asked where those would take the whole processor.

    Also where it needs a wave against the wobble of the lead, or a drag, which are added later.
    """
    designed = partial(dynamic_law, bench, model, route, (*captures, *slow), progress=progress)
    law = designed(every_cycles=every_cycles, provenance=provenance)
    if route != "law":
        return law
    lead = bench_map(bench, slow) if slow else None
    wave = wobble_of(bench, lead)
    whole = _against_wobble(bench, model, route, law, wave, _SHAKES)
    dragging = _with_drag(model, whole, captures, lead, wave)
    fitting = cycles_of(dragging if dragging.drag_m > _DRAGS_m else whole)
    if fitting == every_cycles:
        return law
    slower = {**provenance, ASKED: every_cycles}
    return designed(every_cycles=fitting, faster=law, provenance=slower)


def _for_motion(
    bench: Bench,
    model: "DriveModel",
    route: str,
    law: CompensationLaw,
    lead: LeadMap | None,
    motion: Motion,
    aim: Aim,
    *,
    backlash: bool,
) -> Compensation:
    beside_um = _lead_most_um(bench, lead) if route == "cam" and lead is not None else 0.0
    limit_m = max(0.0, bench.safety.max_correction_um - beside_um) / UM_PER_M
    # A run meets its start out of a jog and a rest: that friction and integrator are in its error.
    learned = partial(
        exact_correction,
        model_loop(model),
        motion.position_m,
        bench.servo_period_s,
        aim=aim,
        lead_in_m=approach(bench, float(motion.position_m[0])),
        may_run=lambda offset_m: is_allowed(with_offset(motion, offset_m), bench),
    )
    exact = learned(limit_m=limit_m)
    said: dict[str, Any] = {"aim": aim.value, "motion": motion.name}
    said["room_um"] = limit_m * UM_PER_M
    said["error_um"] = list(exact.history_um)
    if np.any(np.abs(faded(exact.correction_m)) > CUT_FRAC * limit_m):
        uncut_um = float(np.max(np.abs(faded(learned().correction_m)))) * UM_PER_M
        said["needed_um"] = uncut_um + beside_um
    return Compensation(
        route,
        law.noting({EXACT: said}),
        lead,
        motion_time_s=motion.trajectory.time_s,
        motion_position_m=motion.position_m,
        motion_correction_m=exact.correction_m,
        backlash=backlash,
    )


def _lead_most_um(bench: Bench, lead: LeadMap) -> float:
    """Largest correction of the lead table, which stands beside a cam: together they are limited.

    A cam goes by time and the table by place, so that what both have at most adds up.
    """
    largest_ct = lead_table(lead, bench).table.largest_correction_ct
    return largest_ct * bench.motor_resolution_m * UM_PER_M
