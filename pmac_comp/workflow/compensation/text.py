"""A compensation in figures and words for people.

What lives here: what its law, its motion and its tables do, and what its limits cut. What may not:
the computing (``computing``), what is promised of it (``promises``).
"""

import math
from typing import Any

import numpy as np

from pmac_comp.base.units import MM_PER_M, MS_PER_S, UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.machine.controller.contents.comp_table import CT16_PER_CT
from pmac_comp.physics.compensate.exact import faded
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.motions import HARD_MOVE_m_per_s2, MOVE_S_CURVE_s
from pmac_comp.physics.compensate.trim import TRIM_EXPLAINED
from pmac_comp.workflow.compensation.cam import render_cam
from pmac_comp.workflow.compensation.computing import CUT_FRAC
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.compensation.program import draw_motion
from pmac_comp.workflow.law.backlash import has_backlash
from pmac_comp.workflow.law.routes import TORQUE_ROUTES
from pmac_comp.workflow.law.static_map import covered_m


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
    explained = law.provenance.get(TRIM_EXPLAINED, 0.0)
    if explained:
        out["corrected by the captures, share of the rest explained %"] = 100.0 * explained
    out |= {
        "friction torque Nm": law.torque_coulomb_Nm,
        "friction grips over um": law.torque_breakaway_m * UM_PER_M,
        "friction torque fades at rest 1/s": law.rest_fade_per_s,
        "friction offset fades at rest after a hard end 1/s": law.rest_unwind_per_s,
        "look-ahead ms": law.lookahead_s * MS_PER_S,
    }
    return out | _describe_turn(law) | _describe_torque(law) | _describe_elastic(law)


def _describe_turn(law: CompensationLaw) -> dict[str, float]:
    """Torque of a law that repeats with the turn of the screw."""
    out: dict[str, float] = {}
    if law.ripple_Nm != 0.0:
        out[f"cogging {law.ripple_order:.0f} times a turn, amplitude Nm"] = law.ripple_Nm
    times = f"{abs(law.turn_order):.0f} times a turn"
    if law.turn_friction_Nm != 0.0:
        what = "cogging" if law.is_second_cogging else "friction that changes"
        out[f"{what} {times}, amplitude Nm"] = law.turn_friction_Nm
    if law.is_wobble:
        out[f"against the lead's wobble {times}, at full speed Nm"] = (
            law.torque_wobble_Nm_s3_per_m3 * law.valid_speed_m_per_s**3
        )
    if law.turn_share != 0.0:
        out[f"torque that ripples {times}, share of it %"] = 100.0 * law.turn_share
    return out


def _describe_torque(law: CompensationLaw) -> dict[str, float]:
    """Torque of a law that not every drive needs: at jerks, by place, by direction."""
    out: dict[str, float] = {}
    if law.torque_impulse_Nm_s3_per_m != 0.0:
        # By the step of the jerk with which a hard move begins.
        kick_Nm = law.torque_impulse_Nm_s3_per_m * HARD_MOVE_m_per_s2 / MOVE_S_CURVE_s
        out["impulse against ringing as a hard move begins, one pass, Nm"] = kick_Nm
    if law.torque_turning_Nm_s != 0.0:
        # Of all friction, from one way to the other.
        what = "impulse against ringing as friction turns over"
        out[f"{what}, mNm s"] = 2e3 * law.torque_turning_Nm_s
        out[f"{what}, a pass later, mNm s"] = 2e3 * law.torque_turned_Nm_s
    if law.torque_place_Nm_per_m != 0.0:
        lead_m_per_rad = law.turn_m / (2.0 * math.pi)
        out["load that rises along the travel N/m"] = law.torque_place_Nm_per_m / lead_m_per_rad
    if law.torque_uneven_Nm_s_per_m != 0.0:
        out["friction more in positive direction Nm/(m/s)"] = law.torque_uneven_Nm_s_per_m
        out["friction more in positive direction um/(m/s)"] = law.viscous_uneven_s * UM_PER_M
    return out


def _describe_elastic(law: CompensationLaw) -> dict[str, float]:
    """What else of a nut with play, of friction and of a bed a law takes away."""
    out: dict[str, float] = {}
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
    """Friction of a law beside its levels: its lag, near standstill, and over millimetres."""
    out: dict[str, float] = {}
    if law.coulomb_lag_s > 0.0:
        out["friction offset follows with a lag of ms"] = law.coulomb_lag_s * MS_PER_S
    if law.is_smooth:
        out["friction sets in over the speed mm/s"] = law.stribeck_speed_m_per_s * MM_PER_M
    elif law.has_stribeck:
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
        share = float(np.mean(sent_um > CUT_FRAC * room_um))
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
