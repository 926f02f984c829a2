"""Old against new: the compensation on a controller beside one in a file, as numbers and curves.

Tables are compared over the travel in both directions, laws along a reference motion that takes
the axis to its usual speed and acceleration, a known motion over its time. All of it is computed by
the host's own reading of what the card holds; nothing moves.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import MM_PER_M, UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.contents.comp_table import (
    CT16_PER_CT,
    BacklashTable,
    CompTable,
    Table,
    TableKind,
)
from pmac_comp.machine.controller.contents.law_bank import LawParameters, evaluate
from pmac_comp.machine.controller.contents.programs import is_present
from pmac_comp.machine.controller.contents.table_set import read_tables
from pmac_comp.machine.controller.law import law_state
from pmac_comp.physics.signals import trajectory as tr
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_to_look
from pmac_comp.workflow.capture.session import open_axis
from pmac_comp.workflow.compensation.cam import render_cam
from pmac_comp.workflow.compensation.file import Compensation, read_compensation
from pmac_comp.workflow.compensation.program import draw_motion
from pmac_comp.workflow.compensation.tables import tables_of
from pmac_comp.workflow.controller.law_rows import Row, law_rows
from pmac_comp.workflow.controller.owners import is_of_axis
from pmac_comp.workflow.law.rendering import law_parameters
from pmac_comp.workflow.law.routes import MOTION_ROUTES, TORQUE_ROUTES

_POINTS = 1201
_REFERENCE_m_per_s2 = 5.0
_COLUMNS = ("quantity", "old", "new", "unit")


@dataclass(frozen=True)
class Curve:
    """One quantity before and after over a coordinate, all shape (n,)."""

    name: str
    unit: str
    along: FloatArray
    along_unit: str
    old: FloatArray
    new: FloatArray

    @property
    def largest_change(self) -> float:
        """Largest difference in the unit of the curve."""
        return float(np.max(np.abs(self.new - self.old))) if self.new.size else 0.0

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        return {
            "name": self.name,
            "unit": self.unit,
            "along": self.along,
            "along_unit": self.along_unit,
            "old": self.old,
            "new": self.new,
            "largest_change": self.largest_change,
        }


@dataclass(frozen=True)
class Difference:
    """Rows of numbers (quantity, old, new, unit) and the curves behind them."""

    rows: tuple[Row, ...]
    curves: tuple[Curve, ...]

    @property
    def largest_change_um(self) -> float:
        """Largest change of any correction of position."""
        return max((c.largest_change for c in self.curves if c.unit == "um"), default=0.0)

    def lines(self) -> list[str]:
        """The largest changes, for people."""
        return [f"largest change of {c.name}: {c.largest_change:.3g} {c.unit}" for c in self.curves]

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        return {
            "rows": [
                dict(zip(("quantity", "old", "new", "unit"), r, strict=True)) for r in self.rows
            ],
            "curves": [curve.as_result() for curve in self.curves],
            "largest_change_um": self.largest_change_um,
        }


def difference(url: str, bench: str, new: Path) -> Difference:
    """Old against new on a controller; nothing is changed."""
    compensation = read_compensation(new)
    with open_axis(url, bench) as axis:
        return difference_on(axis, context_to_look(axis), compensation)


def difference_on(axis: Axis, context: Context, compensation: Compensation) -> Difference:
    """Old against new on a connected axis."""
    bench = axis.bench
    cam_motor = bench.controller.cam_motor_number
    keys = [(TableKind.COMP, axis.motor), (TableKind.BLCOMP, axis.motor)]
    cam_keys = [] if cam_motor == axis.motor else [(TableKind.COMP, cam_motor)]
    there = [t for t in read_tables(axis.link, [*keys, *cam_keys]) if is_of_axis(axis, t)]
    meant = list(tables_of(compensation, bench))
    acts = float(axis.link.query("I51")[0]) != 0.0
    old = there if acts else []
    kept = [t for t in old if _is_kept(t, meant, compensation)]
    rows = _table_rows(axis, old, [*meant, *kept])
    curves = _table_curves(axis, old, [*meant, *kept])
    head = law_state.read_law_head(axis.link, context.block)
    bank = law_state.read_bank(axis.link, context.block, head.bank) if head.is_armed else None
    fresh = None
    if compensation.route in TORQUE_ROUTES:
        fresh = law_parameters(compensation.law, axis.scales)
    after = bank if fresh is None else fresh
    if after is not None:
        clamp = compensation.law.amplitude_limit_m / axis.scales.motor_m_per_ct
        rows += law_rows(axis, bank, after)
        curves += _law_curves(axis, (bank, head.clamp_ct), (after, clamp))
    if compensation.route in MOTION_ROUTES:
        curves += [_motion_curve(axis, compensation, old)]
    return Difference(tuple(rows), tuple(curves))


def _is_kept(table: Table, meant: list[Table], compensation: Compensation) -> bool:
    """Whether a table on the card stays beside the new ones."""
    replaced = any((t.kind, t.motor) == (table.kind, table.motor) for t in meant)
    without = table.kind is TableKind.BLCOMP and compensation.lead is not None
    return not replaced and not without


def _of_axis(axis: Axis, tables: list[Table]) -> list[Table]:
    return [t for t in tables if t.motor == axis.motor]


def _table_rows(axis: Axis, old: list[Table], new: list[Table]) -> list[Row]:
    rows: list[Row] = []
    to_um = axis.scales.motor_m_per_ct * UM_PER_M / CT16_PER_CT
    for kind, name in ((TableKind.COMP, "lead table"), (TableKind.BLCOMP, "backlash table")):
        pair = [next((t for t in _of_axis(axis, s) if t.kind is kind), None) for s in (old, new)]
        if pair == [None, None]:
            continue
        values = [np.zeros(1) if t is None else np.asarray(t.entries) * to_um for t in pair]
        counts = [0 if t is None else len(t.entries) for t in pair]
        rows.append((f"{name}, entries", counts[0], counts[1], ""))
        low, high = [float(v.min()) for v in values], [float(v.max()) for v in values]
        rows.append((f"{name}, lowest", low[0], low[1], "um"))
        rows.append((f"{name}, highest", high[0], high[1], "um"))
        steep = [0.0 if t is None else _steepest(axis, t) for t in pair]
        rows.append((f"{name}, steepest", steep[0], steep[1], "um/mm"))
    return rows


def _steepest(axis: Axis, table: Table) -> float:
    """Largest slope between two knots within the travel, um per mm."""
    spacing_ct = table.span_ct / len(table.entries)
    limits = axis.scales.limits(axis.bench)
    first, last = (
        np.trunc(end / spacing_ct) for end in (limits.min_position_ct, limits.max_position_ct)
    )
    knots_ct = spacing_ct * np.arange(first, last + 1)
    values_ct = np.zeros(knots_ct.size)
    if isinstance(table, CompTable):
        values_ct = table.correction_ct(knots_ct)
    elif isinstance(table, BacklashTable):
        values_ct = table.backlash_ct(knots_ct)
    return float(np.max(np.abs(np.diff(values_ct)))) / spacing_ct * UM_PER_M / MM_PER_M


def _table_curves(axis: Axis, old: list[Table], new: list[Table]) -> list[Curve]:
    travel = axis.bench.travel
    position = np.linspace(travel.min_mm, travel.max_mm, _POINTS)
    counts = position / MM_PER_M / axis.scales.motor_m_per_ct
    to_um = axis.scales.motor_m_per_ct * UM_PER_M

    def given(tables: list[Table], *, forward: bool) -> FloatArray:
        total = np.zeros(position.size)
        for table in _of_axis(axis, tables):
            if isinstance(table, CompTable):
                total += table.correction_ct(counts) * to_um
            elif isinstance(table, BacklashTable) and not forward:
                total -= table.backlash_ct(counts) * to_um
        return total

    if not _of_axis(axis, old) and not _of_axis(axis, new):
        return []
    one_way = not any(isinstance(t, BacklashTable) for t in (*old, *new))
    both = [
        Curve(
            "the tables' correction" + ("" if one_way else ", upwards" if up else ", downwards"),
            "um",
            position,
            "mm",
            given(old, forward=up),
            given(new, forward=up),
        )
        for up in (True, False)
    ]
    return both[:1] if one_way else both


def reference_motion(bench: Bench) -> tr.Trajectory:
    """Move there and back at the usual speed and acceleration, in the middle of the travel."""
    low, high = bench.travel_m
    return tr.trapezoid(
        period_s=bench.servo_period_s,
        distance_m=0.3 * (high - low),
        speed_m_per_s=0.6 * bench.usable_speed_m_per_s,
        acceleration_m_per_s2=min(_REFERENCE_m_per_s2, bench.safety.max_acceleration_m_per_s2),
        s_curve_s=0.015,
        start_m=low + 0.35 * (high - low),
    )


def _law_curves(
    axis: Axis, old: tuple[LawParameters | None, float], new: tuple[LawParameters, float]
) -> list[Curve]:
    motion = reference_motion(axis.bench)
    counts = motion.position_m / axis.scales.motor_m_per_ct
    nothing = np.zeros(counts.size)
    sides: list[tuple[FloatArray, FloatArray]] = []
    for bank, clamp_ct in (old, new):
        if bank is None:
            sides.append((nothing, nothing))
            continue
        out = evaluate(bank, counts, clamp_ct=clamp_ct)
        to_um = axis.scales.motor_m_per_ct * UM_PER_M
        sides.append((out.correction_ct * to_um, out.torque_dac * axis.scales.torque_Nm_per_dac))
    names = (
        ("the law's correction on a reference move", "um"),
        ("the law's torque on a reference move", "Nm"),
    )
    return [
        Curve(name, unit, motion.time_s, "s", sides[0][k], sides[1][k])
        for k, (name, unit) in enumerate(names)
    ]


def _motion_curve(axis: Axis, compensation: Compensation, old: list[Table]) -> Curve:
    """Correction of the known motion over time; what an earlier cam gave is shown beside it.

    What an earlier program drew is not told by its lines: beside another one it counts from none.
    """
    drawn = draw_motion(compensation, axis.bench)
    new = (drawn.drawn.position_m - drawn.motion.position_m) * UM_PER_M
    if compensation.route == "program":
        before = new if is_present(axis.link, drawn.program) else np.zeros(new.size)
    else:
        before = _before_cam(axis, compensation, old, new)
    time_s = drawn.motion.trajectory.time_s
    return Curve("the correction of the known motion", "um", time_s, "s", before, new)


def _before_cam(
    axis: Axis, compensation: Compensation, old: list[Table], new_um: FloatArray
) -> FloatArray:
    """Correction of the cam that acts, um, at the samples of the new one, shape (n,)."""
    meant = render_cam(compensation, axis.bench)
    if meant.table.table in old and is_present(axis.link, meant.program):
        return new_um
    number = axis.bench.controller.cam_motor_number
    cam = next((t for t in old if t.motor == number and isinstance(t, CompTable)), None)
    if not isinstance(cam, CompTable):
        return np.zeros(new_um.size)
    place = np.arange(new_um.size) / max(1, new_um.size - 1) * cam.span_ct
    return cam.correction_ct(place) * axis.bench.motor_resolution_m * UM_PER_M
