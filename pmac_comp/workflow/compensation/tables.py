"""All compensation tables of a compensation, in the form that goes onto the card."""

from pmac_comp.files.bench import Bench
from pmac_comp.machine.controller.contents.comp_table import Table
from pmac_comp.machine.controller.contents.safety import check_sums, check_table
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


def refused_remarks(compensation: Compensation, bench: Bench) -> list[str]:
    """What `upload` will refuse of the tables of a compensation, each and all together."""
    own, limits = tables_of(compensation, bench), Scales.of(bench).limits(bench)
    refusals = [r for table in own for r in check_table(table, limits)]
    refusals += check_sums(own, own, limits)
    return [f"`upload` will refuse this: {r.message} {r.hint}" for r in refusals]
