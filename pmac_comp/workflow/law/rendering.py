"""The law and the lead map in counts and servo cycles: physics becomes controller data here."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ConfigError
from pmac_comp.base.units import MM_PER_M, UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.machine.controller.contents.comp_table import CT16_PER_CT, CompTable, Table
from pmac_comp.machine.controller.contents.law_bank import LawParameters
from pmac_comp.physics.compensate.exact import faded
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.workflow.bench.scales import Scales

_MOST_ENTRIES = 4000
_SPARE_ENTRIES = 8
_SEAM_KNOTS = 2  # beyond the travel at each end, at least
_SEAM_FRAC = 0.25  # of the bench's largest slope, for what runs back beyond the travel
_LEAST_AT_ZERO = 0.02  # of the compliance at the law's origin
_KNOTS_PER_TURN_FRAC = 0.05
CAM_RUN_UP_CYCLES = 16  # the time motor reaches its speed before the motion starts, and after it
_CAM_SPACING_CYCLES = 4  # of cam entries: linear between them is 0.6 % off at 20 Hz


def law_parameters(law: CompensationLaw, scales: Scales) -> LawParameters:
    """Law of a bank in counts and servo cycles (SC).

    With K counts per m, T the servo period and q the torque of a DAC unit, a quantity per
    (m/s2) becomes one per (count/SC^2) by 1/(K T^2), and a correction in m becomes counts by K. The
    elastic terms and what they are held against are those at position zero.
    """
    K = 1.0 / scales.motor_m_per_ct
    T = scales.period_s
    q = scales.torque_Nm_per_dac
    pass_s = law.every_cycles * T
    degrees_per_ct = 360.0 / (law.turn_m * K)
    zero = _at_position_zero(law)
    return LawParameters(
        A0=zero * law.inertia_s2 / T**2,
        V0=zero * law.viscous_s / T,
        S0=zero * law.coulomb_m * K,
        C1=law.compliance_slope_per_m / zero / K,
        S_INV=1.0 / (law.breakaway_m * K),
        J0=law.jerk_s3 / T**3,
        L1=law.lookahead_s / T,
        JL=law.jerk_limit_m_per_s3 * K * T**3,
        TJ=law.torque_inertia_Nm_s2_per_m / (K * T**2 * q),
        TK=law.torque_jerk_Nm_s3_per_m / (K * T**3 * q),
        TI=law.torque_impulse_Nm_s3_per_m / (K * T**3 * q),
        TF=law.torque_turning_Nm_s / (T * q),
        TL=law.torque_turned_Nm_s / (T * q),
        SL=law.coulomb_lag_s / (law.coulomb_lag_s + pass_s),
        TB=law.torque_viscous_Nm_s_per_m / (K * T * q),
        TC=law.torque_coulomb_Nm / q,
        TE=law.torque_load_Nm_s2_per_m / (K * T**2 * q),
        NR=law.turn_order * degrees_per_ct,
        **_of_turn(law, K, T, q),
        TH=law.ripple_Nm / q,
        NH=law.ripple_order * degrees_per_ct,
        PH=math.degrees(law.ripple_phase_rad),
        T_INV=1.0 / (law.torque_breakaway_m * K),
        T0=(law.torque_constant_Nm - law.torque_place_Nm_per_m * law.origin_m) / q,
        T_LIMIT=law.torque_limit_Nm / q,
        **(_of_gap(law, K, zero, pass_s, q) if law.gap_half_m > 0.0 else {}),
        VU=zero * law.viscous_uneven_s / T,
        TU=law.torque_uneven_Nm_s_per_m / (K * T * q),
        **(_of_ripple(law, K, T, q) if law.turn_share != 0.0 else {}),
        RF=law.rest_fade_per_s * T,
        UF=law.rest_unwind_per_s * T,
        **(_of_bed(law, K, zero, T, q) if law.bed_share > 0.0 else {}),
        **(_of_drag(law, K, zero, q) if law.drag_m > 0.0 else {}),
        SX=zero * law.stribeck_m * K,
        TX=law.torque_stribeck_Nm / q,
        SS=1.0 / (law.stribeck_speed_m_per_s * pass_s * K) if law.has_stribeck else 0.0,
        TP=law.torque_place_Nm_per_m / (K * q),
    )


def _of_bed(
    law: CompensationLaw, ct_per_m: float, zero: float, period_s: float, torque_per_dac_Nm: float
) -> dict[str, float]:
    """Coefficients of the bed that swings."""
    pass_s = law.every_cycles * period_s
    correction_s2, torque = zero * law.inertia_s2, law.torque_bed_Nm_s2_per_m / torque_per_dac_Nm
    return {
        "BS": correction_s2 * law.bed_share / period_s**2,
        "BD": law.bed_damping_per_s * pass_s,
        "BO": law.bed_stiffness_per_s2 * pass_s**2,
        "BT": torque / (correction_s2 * ct_per_m) if correction_s2 > 0.0 else 0.0,
    }


def _of_drag(
    law: CompensationLaw, ct_per_m: float, zero: float, torque_per_dac_Nm: float
) -> dict[str, float]:
    """Coefficients of what drags at the table, which take the places of a bed."""
    correction_ct = zero * law.drag_m * ct_per_m
    return {
        "BS": -law.drag_distance_m * ct_per_m,
        "BD": correction_ct,
        "BT": law.torque_drag_Nm / torque_per_dac_Nm / correction_ct,
    }


def _of_ripple(
    law: CompensationLaw, ct_per_m: float, period_s: float, torque_per_dac_Nm: float
) -> dict[str, float]:
    """Coefficients of torque that ripples, which take a place of friction by the turn."""
    dac_per_m = 1.0 / (ct_per_m * torque_per_dac_Nm)
    return {
        "RS": law.turn_share,
        "RT": law.torque_loop_Nm_s2_per_m * dac_per_m / period_s**2,
        "RV": law.torque_loop_Nm_s_per_m * dac_per_m / period_s,
    }


def _of_turn(
    law: CompensationLaw, ct_per_m: float, period_s: float, torque_per_dac_Nm: float
) -> dict[str, float]:
    """Friction by the turn, or the wave against the lead's wobble: that has TR below zero."""
    phase_deg = math.degrees(law.turn_phase_rad)
    if not law.is_wobble:
        return {"TR": law.turn_friction_Nm / torque_per_dac_Nm, "PR": phase_deg}
    per_speed_cubed = law.torque_wobble_Nm_s3_per_m3 / (ct_per_m * period_s) ** 3
    return {"TR": -per_speed_cubed / torque_per_dac_Nm, "PR": phase_deg + 180.0}


def _of_gap(
    law: CompensationLaw, ct_per_m: float, zero: float, pass_s: float, torque_per_dac_Nm: float
) -> dict[str, float]:
    """Coefficients of the gap of a nut, whose places other terms have where there is none."""
    return {
        "GH": law.gap_half_m * ct_per_m,
        "GW": zero * law.gap_width_m * ct_per_m,
        "GL": pass_s / (law.gap_lag_s + pass_s),
        "GB": zero * law.gap_load_m * ct_per_m,
        "TG": law.gap_torque_Nm / torque_per_dac_Nm,
    }


def _at_position_zero(law: CompensationLaw) -> float:
    """Compliance at position zero over that at the law's origin.

    Raises
    ------
    ConfigError
        There is no screw at position zero.
    """
    zero = 1.0 - law.compliance_slope_per_m * law.origin_m
    if zero < _LEAST_AT_ZERO:
        raise ConfigError(
            f"The compliance of the screw, {law.compliance_slope_per_m:+.3g} 1/m of that at "
            f"{law.origin_m * MM_PER_M:.0f} mm, is {zero:.2g} of it at position zero: zero lies "
            "beyond the screw.",
            code="PC-DYN-023",
            hint="Home the axis so that zero lies within its travel, and calibrate again.",
        )
    return zero


T_co = TypeVar("T_co", bound=Table, covariant=True)


@dataclass(frozen=True)
class RenderedTable(Generic[T_co]):
    """A map as a controller table.

    Parameters
    ----------
    table : CompTable or BacklashTable
        What is uploaded.
    quantisation_um : float
        Largest rounding of an entry.
    """

    table: T_co
    quantisation_um: float


def lead_spacing_m(bench: Bench) -> float:
    """Distance between the knots of a lead table: a twentieth of the pitch where that many fit."""
    reach_mm = max(abs(bench.travel.min_mm), abs(bench.travel.max_mm))
    least_m = 2.0 * reach_mm / MM_PER_M / (_MOST_ENTRIES - _SPARE_ENTRIES)
    spacing_m = max(_KNOTS_PER_TURN_FRAC * bench.pitch_m, least_m)
    return math.ceil(spacing_m / bench.motor_resolution_m - 1e-9) * bench.motor_resolution_m


def lead_table(lead: LeadMap, bench: Bench, *, by_desired: bool = True) -> RenderedTable[CompTable]:
    """COMP table that takes a lead map away: entries are minus the error, in 1/16 count.

    The table spans the travel with a spacing or more to spare at each end; negative positions use
    its far end (roll-over), where both ends meet the correction runs back to itself through the
    positions that are never reached.

    Raises
    ------
    ConfigError
        The travel needs more entries than fit.
    """
    zero = lead.at(np.zeros(1))[0]
    scales = Scales.of(bench)
    exact, span_ct = entries_over_travel(lambda x: zero - lead.at(x), lead.spacing_m, bench)
    entries = np.round(exact).astype(np.int64)
    entries[-1] = 0
    table = CompTable(
        motor=bench.encoder.motor_number,
        entries=tuple(int(e) for e in entries),
        span_ct=span_ct,
        by_desired=by_desired,
    )
    rounding = float(np.max(np.abs(entries - exact))) / CT16_PER_CT
    return RenderedTable(table, rounding * scales.motor_m_per_ct * UM_PER_M)


def entries_over_travel(
    value_m: Callable[[FloatArray], FloatArray], spacing_m: float, bench: Bench
) -> tuple[FloatArray, int]:
    """Unrounded entries in 1/16 count of a length (m at m) over the travel, and the span in counts.

    Raises
    ------
    ConfigError
        The travel needs more entries than fit.
    """
    scales = Scales.of(bench)
    low, high = bench.travel_m
    reach = max(abs(low), abs(high)) + _SEAM_KNOTS * spacing_m
    # The zero of the motor is knot 0; both signs get the same number of knots.
    half = math.ceil(reach / spacing_m)
    if 2 * half <= _MOST_ENTRIES:
        half = min(_MOST_ENTRIES // 2, half + _more_for_the_seam(value_m, reach, spacing_m, bench))
    if 2 * half > _MOST_ENTRIES:
        raise ConfigError(
            f"The travel needs {2 * half} entries of {spacing_m * MM_PER_M:g} mm.",
            code="PC-LEAD-010",
            hint="Use a larger spacing.",
        )
    spacing_ct = round(scales.counts(spacing_m))
    knots = np.arange(1, 2 * half + 1)
    signed = np.where(knots <= half, knots, knots - 2 * half)
    exact = value_m(signed * spacing_m) / scales.motor_m_per_ct * CT16_PER_CT
    return _seam(exact, half, spacing_ct, bench, scales), 2 * half * spacing_ct


def _more_for_the_seam(
    value_m: Callable[[FloatArray], FloatArray], reach_m: float, spacing_m: float, bench: Bench
) -> int:
    """Knots more at each end, so that what runs back there is far below the largest slope.

    How steep it is says nothing of the screw: in few knots a long lead error would pass the limit.
    """
    ends_m = value_m(np.array([-reach_m, reach_m]))
    gentle = _SEAM_FRAC * bench.safety.max_slope_um_per_mm * MM_PER_M / UM_PER_M
    knots = math.ceil(0.5 * float(np.ptp(ends_m)) / gentle / spacing_m)
    return max(0, knots - _SEAM_KNOTS)


def _seam(
    exact: np.ndarray, half: int, spacing_ct: int, bench: Bench, scales: Scales
) -> np.ndarray:
    """Entries beyond the travel blended so that the two ends of the table meet."""
    reach_m = max(abs(end_m) for end_m in bench.travel_m)
    used = math.ceil(scales.counts(reach_m) / spacing_ct)
    out = exact.copy()
    if half - used < 1:
        return out
    first, last = out[used - 1], out[2 * half - used - 1]
    out[used : 2 * half - used - 1] = np.linspace(first, last, 2 * (half - used) + 1)[1:-1]
    return out


@dataclass(frozen=True)
class CamShape:
    """How a motor counts time.

    Parameters
    ----------
    ct_per_cycle : int
        Counts of the time motor per servo cycle.
    motion_cycles : int
        Servo cycles of the motion.
    rest_cycles : int
        Servo cycles at full speed after it.
    spacing_cycles : int
        Servo cycles between entries.
    """

    ct_per_cycle: int
    motion_cycles: int
    rest_cycles: int
    spacing_cycles: int

    @property
    def total_cycles(self) -> int:
        """Servo cycles that the table spans; the ramps at both ends count half."""
        return self.motion_cycles + self.rest_cycles + CAM_RUN_UP_CYCLES


def cam_shape(n_samples: int, bench: Bench) -> CamShape:
    """Time base of a motion of ``n_samples`` servo cycles.

    The time motor runs at the highest speed of the bench, so the limit of the slope in um per mm
    holds for the correction as it does for a table over position: at most as many um per second
    as a table of that slope would give there. The table is as long as the travel at least.

    Raises
    ------
    ConfigError
        The motion is too long to be described by the entries that fit.
    """
    scales = Scales.of(bench)
    fastest = scales.counts(bench.safety.max_speed_mm_per_s / MM_PER_M) * scales.period_s
    ct_per_cycle = max(1, math.floor(fastest))
    travel_ct = scales.counts((bench.travel.max_mm - bench.travel.min_mm) / MM_PER_M)
    moving = n_samples - 1
    least = max(moving + CAM_RUN_UP_CYCLES, math.ceil(travel_ct / ct_per_cycle))
    spacing = max(_CAM_SPACING_CYCLES, math.ceil(least / _MOST_ENTRIES))
    if spacing > 2 * _CAM_SPACING_CYCLES:
        raise ConfigError(
            f"A motion of {moving * scales.period_s:.1f} s is too long for a cam.",
            code="PC-CAM-001",
            hint="Use --route program, or --route law for motions of any length.",
        )
    total = spacing * math.ceil(least / spacing)
    return CamShape(ct_per_cycle, moving, total - moving - CAM_RUN_UP_CYCLES, spacing)


def cam_table(correction_m: FloatArray, bench: Bench) -> RenderedTable[CompTable]:
    """COMP table of the time motor that adds a correction (m, at every servo cycle) to the axis.

    Outside the motion all entries are zero.
    """
    scales = Scales.of(bench)
    shape = cam_shape(correction_m.size, bench)
    n = correction_m.size
    step = shape.spacing_cycles
    cycle = np.arange(1, shape.total_cycles // step + 1) * step - CAM_RUN_UP_CYCLES // 2
    at = np.interp(cycle, np.arange(n), faded(correction_m), left=0.0, right=0.0)
    exact = at / scales.motor_m_per_ct * CT16_PER_CT
    entries = np.round(exact).astype(np.int64)
    table = CompTable(
        motor=bench.controller.cam_motor_number,
        entries=tuple(int(e) for e in entries),
        span_ct=shape.total_cycles * shape.ct_per_cycle,
        target=bench.encoder.motor_number,
        by_desired=True,
    )
    rounding = float(np.max(np.abs(entries - exact))) / CT16_PER_CT
    return RenderedTable(table, rounding * scales.motor_m_per_ct * UM_PER_M)
