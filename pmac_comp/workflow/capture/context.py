"""What a look at an axis or a change of it needs: limits, names, the folder of its journal.

And what acts on it. Who may change it is ``at_work``'s.
"""

from dataclasses import replace
from pathlib import Path

from pmac_comp.base.progress import Progress
from pmac_comp.files.resources import DEFAULT_JOURNAL
from pmac_comp.machine.controller.card.variables import read_one
from pmac_comp.machine.controller.change.alike import known_in_folder
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journal import require_folder
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.law import law_state
from pmac_comp.workflow.capture.axis import Axis


def context_to_look(axis: Axis, store: Path = DEFAULT_JOURNAL) -> Context:
    """Limits and names of an axis in a folder, which need not be there."""
    context = Context(
        block=LawBlock.from_p_block(axis.bench.controller.p_block),
        limits=axis.scales.limits(axis.bench),
        store=store,
        servo_period_s=axis.scales.period_s,
        controller=axis.identity or "controller",
    )
    return known_in_folder(axis.link, context, axis.address)


def context_of(axis: Axis, store: Path, progress: Progress | None = None) -> Context:
    """Limits, folder and names for changes of an axis."""
    require_folder(store)
    axis.setup.store = store

    def told(step: str, done: int, total: int) -> None:
        if progress is not None:
            progress(step, done / max(total, 1))

    return replace(context_to_look(axis, store), progress=told)


def acting(axis: Axis, context: Context) -> tuple[bool, bool]:
    """Whether a law acts, and whether tables do."""
    law = law_state.read_law_head(axis.link, context.block).is_armed
    return law, read_one(axis.link, "I51") == 1.0
