"""All compensation tables of a compensation, in the form that goes onto the card."""

from pmac_comp.files.bench import Bench
from pmac_comp.machine.controller.contents.comp_table import Table
from pmac_comp.machine.controller.contents.safety import check_sums
from pmac_comp.workflow.bench.scales import Scales
from pmac_comp.workflow.compensation.cam import render_cam
from pmac_comp.workflow.compensation.file import Compensation


def tables_of(compensation: Compensation, bench: Bench) -> tuple[Table, ...]:
    """Lead table and backlash table of the axis, and the cam of the time motor."""
    lead, backlash = compensation.table(bench), compensation.backlash_table(bench)
    found: list[Table] = []
    if lead is not None:
        found.append(lead.table)
    if backlash is not None:
        found.append(backlash.table)
    if compensation.route == "cam":
        found.append(render_cam(compensation, bench).table.table)
    return tuple(found)


def sum_remarks(compensation: Compensation, bench: Bench) -> list[str]:
    """That the tables of a compensation add up beyond the limit, which `upload` will refuse."""
    own = tables_of(compensation, bench)
    refusals = check_sums(own, own, Scales.of(bench).limits(bench))
    return [f"`upload` will refuse this: {r.message} {r.hint}" for r in refusals]
