"""Whose tables stand on a card that carries several axes.

What lives here: whether a table corrects the axis of a bench file or another one. What may not:
motion programs (``motion_owners``), changing anything. Bench files of two axes may name the same
``cam_motor_number``: the motor that owns a table does not tell whom it corrects, its target does.
"""

from pmac_comp.base.errors import SafetyRefusal
from pmac_comp.machine.controller.contents.comp_table import CompTable, Table, TableKind
from pmac_comp.machine.controller.contents.table_set import read_table
from pmac_comp.workflow.capture.axis import Axis


def is_of_axis(axis: Axis, table: Table) -> bool:
    """Whether a table is one that uploads for this axis put on: its own, or its cam."""
    target = table.target if isinstance(table, CompTable) else table.motor
    ours = {axis.motor, axis.bench.controller.cam_motor_number}
    return target == axis.motor and table.motor in ours


def cam_of_another(axis: Axis) -> int | None:
    """Motor that the cam on the time motor of this bench file corrects, if it is another axis'."""
    number = axis.bench.controller.cam_motor_number
    if number == axis.motor:
        return None
    table = read_table(axis.link, TableKind.COMP, number)
    if not isinstance(table, CompTable) or table.target == axis.motor:
        return None
    return table.target


def time_motor_refusals(axis: Axis) -> list[SafetyRefusal]:
    """Refusal of a cam whose time motor carries the table of another axis."""
    other, number = cam_of_another(axis), axis.bench.controller.cam_motor_number
    if other is None:
        return []
    return [
        SafetyRefusal(
            f"Motor #{number} (cam_motor_number) carries a table that corrects motor #{other}; the "
            f"cam of motor #{axis.motor} would take its place.",
            code="PC-DEP-063",
            hint=f"Take that cam off first: `pmac-comp remove` with the bench file of motor "
            f"#{other}; or name another unused motor as cam_motor_number in [controller] of this "
            "bench file.",
        )
    ]
