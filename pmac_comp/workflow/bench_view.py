"""A bench file for people: every key with where its value comes from, and what follows."""

import math
from typing import Any

from pydantic import BaseModel

from pmac_comp.base.units import MM_PER_M, UM_PER_M, US_PER_S
from pmac_comp.files.bench import Bench

_RESONANCE_MARGIN = 0.25


def bench_rows(bench: Bench) -> list[tuple[str, Any, str, str]]:
    """Every key with its value, ``file`` or ``default``, and what it is."""
    return _rows(bench, "")


def _rows(table: BaseModel, prefix: str) -> list[tuple[str, Any, str, str]]:
    out: list[tuple[str, Any, str, str]] = []
    for name, field in type(table).model_fields.items():
        if name == "text":
            continue
        value = getattr(table, name)
        if isinstance(value, BaseModel):
            out += _rows(value, f"{prefix}{name}.")
            continue
        origin = "file" if name in table.model_fields_set else "default"
        shown = f"{len(value)} I-variables" if name == "ivariables" else value
        if isinstance(value, float):
            shown = f"{value:.10g}"  # as in the file, not rounded for a table
        out.append((prefix + name, shown, origin, field.description or ""))
    return out


def derived(bench: Bench) -> dict[str, float]:
    """Quantities that follow from a bench file."""
    out = {
        "servo_period_us": bench.servo_period_s * US_PER_S,
        "servo_rate_Hz": 1.0 / bench.servo_period_s,
        "lead_mm_per_rad": bench.lead_m_per_rad * MM_PER_M,
        "encoder_count_um": bench.motor_resolution_m * UM_PER_M,
        "screw_rigidity_EA_N": bench.screw_rigidity_N,
        "torsional_rigidity_GJ_Nm2": bench.torsional_rigidity_Nm2,
    }
    compliance = compliance_m_per_N(bench)
    if compliance is not None:
        out["compliance_at_mid_travel_nm_per_N"] = compliance * 1e9
    resonance = resonance_Hz(bench)
    if resonance is not None:
        out["first_resonance_at_mid_travel_Hz"] = resonance
    return out


def compliance_m_per_N(bench: Bench) -> float | None:
    """Axial compliance from motor to table at mid travel in m/N (ballscrew facts 2.8)."""
    nominal = bench.nominal
    if nominal.axial_stiffness_N_per_um is None or nominal.torsional_stiffness_Nm_per_rad is None:
        return None
    x = bench.screw_position_m(bench.mid_travel_m)
    torsion = 1.0 / nominal.torsional_stiffness_Nm_per_rad + x / bench.torsional_rigidity_Nm2
    axial = 1.0 / (nominal.axial_stiffness_N_per_um * 1e6) + x / bench.screw_rigidity_N
    return axial + bench.lead_m_per_rad**2 * torsion


def resonance_Hz(bench: Bench) -> float | None:
    """First resonance with the motor free, two-mass formula (ballscrew facts 2.7)."""
    compliance, nominal = compliance_m_per_N(bench), bench.nominal
    if compliance is None or nominal.table_mass_kg is None or nominal.motor_inertia_kgm2 is None:
        return None
    rotary = nominal.motor_inertia_kgm2 + (nominal.screw_inertia_kgm2 or 0.0)
    return (
        math.sqrt((1.0 / nominal.table_mass_kg + bench.lead_m_per_rad**2 / rotary) / compliance)
        / 2.0
        / math.pi
    )


def tuned_motors(bench: Bench) -> list[int]:
    """Motors whose proportional gain (Ixx30) the bench file states."""
    names = [name for name in bench.controller.ivariables if name[-2:] == "30"]
    return [number for number in range(1, 33) if f"I{number}30" in names]


def remarks(bench: Bench) -> list[str]:
    """Where the figures of a bench file do not fit each other."""
    out: list[str] = []
    computed, stated = resonance_Hz(bench), bench.known.resonance_Hz
    if computed and stated and abs(computed / stated - 1.0) > _RESONANCE_MARGIN:
        out.append(
            f"mass and stiffness give a resonance of {computed:.0f} Hz, [known] resonance_Hz says "
            f"{stated:.0f} Hz"
        )
    rounded = bench.controller.servo_period_us * 1e-6
    if abs(bench.servo_period_s / rounded - 1.0) > 1e-3:
        out.append(
            f"I10 gives a servo period of {bench.servo_period_s * 1e6:.3f} us, servo_period_us "
            f"says {bench.controller.servo_period_us:g} us; I10 is used"
        )
    ends = [bench.screw_position_m(mm / 1e3) for mm in (bench.travel.min_mm, bench.travel.max_mm)]
    if min(ends) < 0.0 or max(ends) > bench.screw.length_mm / 1e3:
        out.append(
            f"the travel puts the nut at {min(ends) * 1e3:.0f} to {max(ends) * 1e3:.0f} mm of a "
            f"{bench.screw.length_mm:g} mm screw; check bearing_to_table_zero_mm"
        )
    tuned = tuned_motors(bench)
    if tuned and bench.encoder.motor_number not in tuned:
        out.append(
            f"[controller.ivariables] holds gains of motor #{tuned[0]}, [encoder] motor_number is "
            f"{bench.encoder.motor_number}: are encoder and scale swapped?"
        )
    if bench.scale is None:
        out.append("there is no [scale]: compensation at the table cannot be identified or checked")
    if bench.controller.kind == "pmac" and bench.controller.ivariables.get("I8", 2.0) != 0.0:
        out.append("I8 is not 0: the route law will not run every servo cycle")
    return out
