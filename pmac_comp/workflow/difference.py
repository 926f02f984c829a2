"""Old against new: the compensation on a controller beside one in a file, as numbers and curves."""

from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import MM_PER_M, UM_PER_M
from pmac_comp.machine.controller import law_upload
from pmac_comp.machine.controller.comp_table import TableKind
from pmac_comp.machine.controller.law_bank import LawParameters
from pmac_comp.machine.controller.table_set import read_tables
from pmac_comp.workflow.axis import Axis
from pmac_comp.workflow.compensation_file import (
    Compensation,
    read_compensation,
)
from pmac_comp.workflow.deploy import context_of
from pmac_comp.workflow.rendering import law_parameters
from pmac_comp.workflow.routes import TORQUE_ROUTES
from pmac_comp.workflow.session import open_axis


def difference(url: str, bench: str, new: Path) -> dict[str, Any]:
    """Old against new on the controller, as rows and as curves over position."""
    compensation = read_compensation(new)
    with open_axis(url, bench) as axis:
        context = context_of(axis)
        tables = read_tables(axis.link, [(TableKind.COMP, axis.motor)])
        head = law_upload.read_law_head(axis.link, context.block)
        bank = law_upload.read_bank(axis.link, context.block, head.bank)
        position, old_um, new_um = _table_curves(axis, compensation, list(tables))
        rows: list[tuple[Any, ...]] = [
            ("table entries", sum(len(t.entries) for t in tables), _entries(compensation, axis), "")
        ]
        if compensation.route in TORQUE_ROUTES:
            rows += _law_rows(bank, law_parameters(compensation.law, axis.scales))
    return {
        "rows": rows,
        "position_mm": position * MM_PER_M,
        "old_um": old_um,
        "new_um": new_um,
        "largest_change_um": float(np.max(np.abs(new_um - old_um))) if position.size else 0.0,
    }


def _entries(compensation: Compensation, axis: Axis) -> int:
    rendered = compensation.table(axis.bench)
    return 0 if rendered is None else len(rendered.table.entries)


def _table_curves(
    axis: Axis, compensation: Compensation, tables: list[Any]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    travel = axis.bench.travel
    position = np.linspace(travel.min_mm, travel.max_mm, 1201) / MM_PER_M
    counts = position / axis.scales.motor_m_per_ct
    to_um = axis.scales.motor_m_per_ct * UM_PER_M
    old = np.zeros(position.size)
    for table in tables:
        if hasattr(table, "correction_ct"):
            old += table.correction_ct(counts) * to_um
    correction = compensation.table_correction(axis.bench)
    new = np.zeros(position.size) if correction is None else correction(position) * UM_PER_M
    return position, old, new


def _law_rows(old: LawParameters | None, new: LawParameters) -> list[tuple[Any, ...]]:
    units = {
        "A0": "ct/(ct/SC2)", "V0": "ct/(ct/SC)", "S0": "ct", "L1": "SC",
        "TC": "DAC units", "TK": "DAC/(ct/SC3)",
    }  # fmt: skip
    return [
        (name, None if old is None else getattr(old, name), getattr(new, name), unit)
        for name, unit in units.items()
    ]
