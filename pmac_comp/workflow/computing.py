"""From a model and slow runs to a compensation: compute, limit, describe, say what it costs.

What lives here: the order of the steps and the words for people. What may not: the design of the
law (``physics.compensate``), registers, conversations.
"""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp.base.errors import ConfigError
from pmac_comp.base.progress import Progress
from pmac_comp.base.units import MM_PER_M, MS_PER_S, UM_PER_M
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture, predicted_remarks
from pmac_comp.machine.controller.comp_table import CT16_PER_CT
from pmac_comp.machine.controller.processor_load import ProcessorLoad
from pmac_comp.physics.compensate.exact import Aim, exact_correction, faded
from pmac_comp.physics.compensate.grip import gripping_model
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap, LeadWave
from pmac_comp.physics.compensate.loop import load_torque_Nm, model_loop
from pmac_comp.physics.compensate.motions import HARD_MOVE_m_per_s2, MOVE_S_CURVE_s
from pmac_comp.physics.compensate.resting import with_unwinding
from pmac_comp.physics.compensate.trim import shows_reversal, trimmed_law, with_drag
from pmac_comp.physics.compensate.unmodelled import model_law
from pmac_comp.physics.compensate.wobble import WORTH, with_wobble
from pmac_comp.physics.model import slots
from pmac_comp.workflow.approach import approach
from pmac_comp.workflow.backlash import has_backlash
from pmac_comp.workflow.bench_remarks import loop_remarks
from pmac_comp.workflow.beyond_model import made_with, shown_by_runs, shown_remarks
from pmac_comp.workflow.cam import render_cam
from pmac_comp.workflow.campaigns import verification_motions
from pmac_comp.workflow.compensation_file import (
    EXACT,
    Compensation,
    check_route,
    write_compensation,
)
from pmac_comp.workflow.dynamic_law import (
    GAVE_WAY,
    NO_TIME_FOR_DRAG,
    constant_remarks,
    drag_remarks,
    dynamic_law,
    law_remarks,
    turn_errors,
    with_unmodelled,
    without_fed_forward,
    wobble_of,
    wobble_remarks,
)
from pmac_comp.workflow.foreseen import (
    check_amplitude,
    check_options,
    check_slow_runs,
    check_uncompensated,
    require_motion,
    too_large,
)
from pmac_comp.workflow.law_cost import (
    ASKED,
    CHEAP_FRAC,
    CheaperLaw,
    cheaper_laws,
    cost_remarks,
    fitting_cycles,
    share_frac,
)
from pmac_comp.workflow.loose_nut import flank_remarks
from pmac_comp.workflow.motions import Motion, is_allowed, parse_motion
from pmac_comp.workflow.program import draw_motion
from pmac_comp.workflow.promises import Promiser, worse_known_remarks, worse_remarks
from pmac_comp.workflow.rendering import lead_table
from pmac_comp.workflow.repeated import with_offset
from pmac_comp.workflow.routes import LATENCY_CYCLES, MOTION_ROUTES, TORQUE_ROUTES
from pmac_comp.workflow.same_axis import captures_of
from pmac_comp.workflow.static_map import Limit, bench_map, covered_m, static_map
from pmac_comp.workflow.tables import sum_remarks

_CUT_FRAC = 0.999  # of the limit: what reaches it was cut
_CyclesOf = Callable[[CompensationLaw], int]  # servo cycles between passes that leave time
_DRAGS_m = 0.15e-6  # a drag that makes more than that, the aim of e_r, is worth fewer passes
_SHAKES = 0.6  # of an aim: a wobble that makes more is worth fewer passes of a law
_TRIM_EXPLAINED = "trim_explained"  # in a law's provenance: share of the rest that captures tell
_LIKE_VERIFIED = 0  # seed of motions on which a compensation is looked at before it is uploaded


def compute_compensation(
    bench: Bench,
    model: Any,
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
    lead = static_map(bench, route, slow, law, limit, per_turn_m) if slow else None
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
        law = law.noting({_TRIM_EXPLAINED: explained})
        # What the captures moved into the law must not stay in the backlash table as well.
        lead = static_map(bench, route, slow, law, limit, per_turn_m) if slow else None
    loop = model_loop(without_fed_forward(model))
    law = with_unwinding(law, loop, bench, LATENCY_CYCLES[route], load_torque_Nm(model))
    more = _against_wobble(bench, model, route, law, wave)
    law = more if route != "law" or cycles_of(more) <= law.every_cycles else law
    if captures:
        law = _with_drag_that_fits(cycles_of, model, route, law, captures, lead, wave)
        if law.drag_m > 0.0 and slow:
            lead = static_map(bench, route, slow, law, limit, per_turn_m)
        law = with_unmodelled(bench, law, model, captures, lead)
    backlash = _takes_up(model, law, route, captures, lead)
    return Compensation(route, law, lead, backlash=backlash)


def _with_drag_that_fits(
    cycles_of: _CyclesOf,
    model: Any,
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
    model: Any,
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
    model: Any,
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
    model: Any,
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
    model: Any,
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
    return designed(every_cycles=fitting, provenance={**provenance, ASKED: every_cycles})


def _for_motion(
    bench: Bench,
    model: Any,
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
    if np.any(np.abs(faded(exact.correction_m)) > _CUT_FRAC * limit_m):
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


def aim_of(text: str) -> Aim:
    """Aim by its name.

    Raises
    ------
    ConfigError
        No such aim.
    """
    try:
        return Aim(text)
    except ValueError as error:
        raise ConfigError(
            f"'{text}' is not an aim.",
            code="PC-DEP-012",
            hint="Use " + " or ".join(aim.value for aim in Aim) + ".",
        ) from error


def compensate_files(
    bench: str,
    model: Path,
    out: Path,
    *,
    route: str,
    slow: tuple[Path, ...] = (),
    captures: tuple[Path, ...] = (),
    command: str = "",
    aim: Aim = Aim.TOTAL,
    limit: Limit = Limit.REFUSE,
    every_cycles: int = 1,
    effects: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compute a compensation from files and describe it."""
    from pmac_comp.workflow.identification import load_model

    check_route(route)
    loaded = load_bench(bench)
    motion = parse_motion(command, loaded) if command else None
    check_options(loaded, route, motion, every_cycles)
    drive = load_model(model, loaded, effects=effects)
    slow_runs, runs = captures_of(slow, loaded), captures_of(captures, loaded)
    check_uncompensated(loaded, [*slow_runs, *runs], [path.name for path in (*slow, *captures)])
    if limit is Limit.REFUSE:
        check_amplitude(loaded, drive, route, motion, aim)
    compensation = compute_compensation(
        loaded,
        drive,
        route=route,
        slow=tuple(slow_runs),
        captures=tuple(runs),
        motion=motion,
        aim=aim,
        provenance={
            "bench_digest": loaded.digest,
            "model": model.name,
            "effects": list(drive.effects),
        },
        limit=limit,
        every_cycles=every_cycles,
        progress=progress,
    )
    cuts = limits_report(loaded, compensation)
    if cuts and limit is Limit.REFUSE:
        raise too_large(route, aim, "; ".join(cuts))
    # What cannot be rendered or drawn is refused before it is written.
    sums = sum_remarks(compensation, loaded)
    summary = describe(loaded, compensation) | _promised_of_motion(loaded, compensation, drive)
    write_compensation(out, compensation)
    offers: tuple[CheaperLaw, ...] = ()
    law = compensation.law
    if route == "law" and share_frac(loaded, law) > CHEAP_FRAC:
        whole = without_fed_forward(made_with(drive, law))
        own = model_law(law).with_values(torque_wobble_Nm_s3_per_m3=0.0)  # no table here
        offers = cheaper_laws(loaded, whole, own, progress, whole=law)
    return {
        "route": route,
        "file": out,
        "summary": summary,
        "remarks": [
            *predicted_remarks([*slow_runs, *runs]),
            *cuts,
            *sums,
            *table_remarks(loaded, compensation),
            *law_remarks(drive, route, has_captures=bool(captures), has_slow=bool(slow)),
            *constant_remarks(loaded, law),
            *wobble_remarks(law),
            *drag_remarks(law),
            *shown_remarks(law),
            *(flank_remarks(law) if route != "table" else ()),
            *loop_remarks(loaded, drive),
            *_expected_worse(loaded, compensation, drive),
            *cost_remarks(loaded, route, law, offers),
        ],
        "law": law.as_mapping() if route in TORQUE_ROUTES else None,
    }


def _expected_worse(bench: Bench, compensation: Compensation, drive: Any) -> list[str]:
    """Remarks on motions like those that ``verify`` draws, which the model expects to get worse."""
    promiser = Promiser.of(bench, compensation, drive)
    if promiser is None or bench.scale is None:
        return []
    if compensation.route in MOTION_ROUTES:
        return worse_known_remarks(promiser, compensation.aim)
    return worse_remarks(promiser, verification_motions(bench, _LIKE_VERIFIED))


def _promised_of_motion(bench: Bench, compensation: Compensation, drive: Any) -> dict[str, Any]:
    """What is promised for the one motion of a compensation, as `verify` will run it."""
    promiser = None if bench.scale is None else Promiser.of(bench, compensation, drive)
    said = None if promiser is None else promiser.of_known()
    if said is None:
        return {}
    aim = compensation.aim
    before, name = ("total_before", "total_after")
    if aim is Aim.MECHANICAL:
        before, name = ("e_before", "e_r_after")
    out = {
        f"{aim.value} error before um rms, promised": said[f"{before}_um"],
        f"{aim.value} error after um rms, promised": said[f"{name}_um"],
    }
    if f"{name}_upper_um" in said:
        out[f"{aim.value} error after um rms, at most"] = said[f"{name}_upper_um"]
    return out


def describe(bench: Bench, compensation: Compensation) -> dict[str, Any]:
    """Figures of a compensation for people."""
    if compensation.motion_position_m is not None:
        out = _describe_motion(bench, compensation)
    elif compensation.route in TORQUE_ROUTES:
        out = _describe_law(compensation)
    else:
        out = {"route": compensation.route}
    return out | _describe_static(bench, compensation)


def _describe_law(compensation: Compensation) -> dict[str, Any]:
    """Figures of ``law`` and ``servo``."""
    law = compensation.law
    out: dict[str, Any] = {
        "route": compensation.route,
        "told for the axis at mm": law.origin_m * MM_PER_M,
        "per acceleration um/(m/s2)": law.inertia_s2 * UM_PER_M,
        "per speed um/(m/s)": law.viscous_s * UM_PER_M,
        "friction um (each side)": law.coulomb_m * UM_PER_M,
        "change along the travel %/m": 100.0 * law.compliance_slope_per_m,
        "largest correction um": law.largest_correction_m * UM_PER_M,
        "clamp um": law.amplitude_limit_m * UM_PER_M,
        "fitted on motions up to m/s": law.valid_speed_m_per_s,
        "fitted on motions up to m/s2": law.valid_acceleration_m_per_s2,
    }
    explained = law.provenance.get(_TRIM_EXPLAINED, 0.0)
    if explained:
        out["corrected by the captures, share of the rest explained %"] = 100.0 * explained
    out["friction torque Nm"] = law.torque_coulomb_Nm
    out["friction grips over um"] = law.torque_breakaway_m * UM_PER_M
    out["friction torque fades at rest 1/s"] = law.rest_fade_per_s
    out["friction offset fades at rest 1/s"] = law.rest_unwind_per_s
    out["look-ahead ms"] = law.lookahead_s * MS_PER_S
    if law.ripple_Nm != 0.0:
        out[f"cogging {law.ripple_order:.0f} times a turn, amplitude Nm"] = law.ripple_Nm
    if law.turn_friction_Nm != 0.0:
        what = "cogging" if law.is_second_cogging else "friction that changes"
        times = f"{abs(law.turn_order):.0f} times a turn"
        out[f"{what} {times}, amplitude Nm"] = law.turn_friction_Nm
    if law.is_wobble:
        fastest_m_per_s = law.valid_speed_m_per_s
        out[f"against the lead's wobble {law.turn_order:.0f} times a turn, at full speed Nm"] = (
            law.torque_wobble_Nm_s3_per_m3 * fastest_m_per_s**3
        )
    if law.turn_share != 0.0:
        times = f"{law.turn_order:.0f} times a turn"
        out[f"torque that ripples {times}, share of it %"] = 100.0 * law.turn_share
    if law.torque_impulse_Nm_s3_per_m != 0.0:
        # By the step of the jerk with which a hard move begins.
        kick_Nm = law.torque_impulse_Nm_s3_per_m * HARD_MOVE_m_per_s2 / MOVE_S_CURVE_s
        out["impulse against ringing as a hard move begins, one pass, Nm"] = kick_Nm
    if law.torque_place_Nm_per_m != 0.0:
        lead_m_per_rad = law.turn_m / (2.0 * math.pi)
        out["load that rises along the travel N/m"] = law.torque_place_Nm_per_m / lead_m_per_rad
    if law.torque_uneven_Nm_s_per_m != 0.0:
        out["friction more in positive direction Nm/(m/s)"] = law.torque_uneven_Nm_s_per_m
        out["friction more in positive direction um/(m/s)"] = law.viscous_uneven_s * UM_PER_M
    if law.gap_half_m > 0.0:
        out["clearance of the nut um"] = 2.0 * law.gap_half_m * UM_PER_M
        out["taken up over um (each side)"] = law.gap_width_m * UM_PER_M
        out["taken up with a lag of ms"] = law.gap_lag_s * MS_PER_S
    out |= _describe_friction(law)
    if law.bed_share > 0.0:
        out["bed that swings, its share of the acceleration %"] = 100.0 * law.bed_share
        out["bed that swings Hz"] = math.sqrt(law.bed_stiffness_per_s2) / (2.0 * math.pi)
    if law.gap_load_m != 0.0:
        out["load on the nut, as its elastic error um"] = law.gap_load_m * UM_PER_M
    return out


def _describe_friction(law: CompensationLaw) -> dict[str, float]:
    """Friction of a law beside Coulomb's and viscous: near standstill, and over millimetres."""
    out: dict[str, float] = {}
    if law.has_stribeck:
        out["friction at rest beyond that um (each side)"] = law.stribeck_m * UM_PER_M
        out["friction torque at rest beyond that Nm"] = law.torque_stribeck_Nm
        out["fades with the speed mm/s"] = law.stribeck_speed_m_per_s * MM_PER_M
    if law.drag_m > 0.0:
        out["drag that turns over within mm"] = law.drag_distance_m * MM_PER_M
        out["that drag um (each side)"] = law.drag_m * UM_PER_M
        out["that drag's torque Nm"] = law.torque_drag_Nm
    return out


def _describe_motion(bench: Bench, compensation: Compensation) -> dict[str, Any]:
    """Figures of ``cam`` and ``program``."""
    position, correction = compensation.motion_position_m, compensation.motion_correction_m
    if position is None or correction is None:
        return {}
    history = compensation.exact.get("error_um", [math.nan])
    aim = compensation.aim.value
    out = {
        "route": compensation.route,
        "motion": f"{(position.size - 1) * bench.servo_period_s:.3f} s, {position.size} samples",
        "largest correction um": float(np.max(np.abs(faded(correction))) * UM_PER_M),
        f"{aim} error before um rms (as computed, on exact positions)": history[0],
        f"{aim} error after um rms (as computed, on exact positions)": min(history),
        "passes": len(history) - 1,
    }
    if compensation.route == "cam":
        return out | {"cam rounding um": render_cam(compensation, bench).table.quantisation_um}
    drawn = draw_motion(compensation, bench)
    return out | {
        "shape error of the PVT segments um": drawn.shape_error_um,
        "rounding of the program's positions um": drawn.rounding_um,
    }


def _describe_static(bench: Bench, compensation: Compensation) -> dict[str, Any]:
    """Figures of the tables."""
    rendered, back = compensation.table(bench), compensation.backlash_table(bench)
    if compensation.lead is None or rendered is None:
        return {}
    out: dict[str, Any] = {k.replace("_", " "): v for k, v in compensation.lead.summary().items()}
    out["table entries"] = len(rendered.table.entries)
    out["table rounding um"] = rendered.quantisation_um
    if back is not None:
        entries_um = (
            np.asarray(back.table.entries) / CT16_PER_CT * bench.motor_resolution_m * UM_PER_M
        )
        out["backlash um (from, to)"] = f"{entries_um.min():.2f}, {entries_um.max():.2f}"
        out["backlash table rounding um"] = back.quantisation_um
    return out


def limits_report(bench: Bench, compensation: Compensation) -> list[str]:
    """What of a compensation lies beyond the safety limits, in words; empty for nothing."""
    limit_um = bench.safety.max_correction_um
    correction = compensation.motion_correction_m
    if correction is not None:
        room_um = compensation.exact.get("room_um", limit_um)
        sent_um = np.abs(faded(correction)) * UM_PER_M
        share = float(np.mean(sent_um > _CUT_FRAC * room_um))
        cut = f"{100 * share:.1f} % of the motion is cut at max_correction_um = {limit_um:g} um"
        if room_um < limit_um:
            cut += f", of which the lead table beside it takes {limit_um - room_um:.3g} um"
        needed_um = compensation.exact.get("needed_um")
        if needed_um is not None:
            cut += f"; uncut all of it would take up to {needed_um:.3g} um"
        return [cut] if share else []
    law = compensation.law
    largest = law.largest_correction_m * UM_PER_M
    if compensation.route not in TORQUE_ROUTES or largest <= limit_um:
        return []
    return [
        f"at {law.valid_acceleration_m_per_s2:.3g} m/s2 the correction would be {largest:.1f} um, "
        f"the limit is {limit_um:g} um; it is clipped there"
    ]


def table_remarks(bench: Bench, compensation: Compensation) -> list[str]:
    """What the tables take away and what not, for people."""
    lead = compensation.lead
    if lead is None:
        return []
    mean_um = float(np.mean(lead.reversal_m) * UM_PER_M)
    if compensation.backlash and compensation.route == "table":
        out = [
            f"the two directions differ by {mean_um:.2f} um in the mean while the axis moves; that "
            "the backlash table takes away. At rest it holds the screw's wind-up, and the motor's "
            "own stop within its friction is left: where that had cancelled the wind-up, the "
            "reversal value of a positioning test grows"
        ]
    elif compensation.backlash:
        out = [
            f"the two directions differ by {mean_um:.2f} um in the mean; the backlash table takes "
            "what friction leaves of it away"
        ]
    else:
        why = "not worth a backlash table"
        if has_backlash(lead, compensation.route):
            why = "the other runs do not show it, so no backlash table puts it on every motion"
        out = [f"the two directions differ by {mean_um:.2f} um in the mean: {why}"]
    covered = covered_m(bench, lead)
    if covered is not None:
        out.append(
            f"the table corrects from {covered[0] * MM_PER_M:.1f} to {covered[1] * MM_PER_M:.1f} "
            "mm only, where it was measured; beyond, the correction fades to zero"
        )
    return out
