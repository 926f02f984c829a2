"""A bench file for people: every key with where its value comes from, and what follows."""

import math
from typing import Any

from pydantic import BaseModel

from pmac_comp.base.units import MM_PER_M, UM_PER_M, US_PER_S
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.contents.servo_source import servo_source
from pmac_comp.physics.model.chain import compliance_at_mid_travel_m_per_N, first_mode_rad_per_s


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
    """Axial compliance from motor to table at mid travel in m/N, ``None`` where not stated."""
    nominal = bench.nominal
    if nominal.axial_stiffness_N_per_um is None or nominal.torsional_stiffness_Nm_per_rad is None:
        return None
    return compliance_at_mid_travel_m_per_N(
        bench,
        nominal.axial_stiffness_N_per_um * UM_PER_M,
        nominal.torsional_stiffness_Nm_per_rad,
    )


def resonance_Hz(bench: Bench) -> float | None:
    """First resonance with the motor free, two-mass formula, ``None`` where not stated."""
    compliance, nominal = compliance_m_per_N(bench), bench.nominal
    if compliance is None or nominal.table_mass_kg is None or nominal.motor_inertia_kgm2 is None:
        return None
    rotary = nominal.motor_inertia_kgm2 + (nominal.screw_inertia_kgm2 or 0.0)
    mode = first_mode_rad_per_s(bench, rotary, nominal.table_mass_kg, compliance)
    return mode / (2.0 * math.pi)


def tuned_motors(bench: Bench) -> list[int]:
    """Motors whose proportional gain (Ixx30) the bench file states."""
    names = [name for name in bench.controller.ivariables if name[-2:] == "30"]
    return [number for number in range(1, 33) if f"I{number}30" in names]


def as_result(bench: Bench) -> dict[str, Any]:
    """Every key of a bench file and what follows from it, for ``--json``."""
    return {**bench.model_dump(mode="json", exclude={"text"}), "derived": derived(bench)}


def servo_result(name: str) -> dict[str, Any]:
    """The open servo's source for the block of a bench file, for ``--json``."""
    block = LawBlock.from_p_block(load_bench(name).controller.p_block)
    return {"bench": name, "first_p": block.first, "text": servo_source(block)}
