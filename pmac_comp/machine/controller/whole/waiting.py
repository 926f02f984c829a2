"""Which changes of a controller wait to be settled, of this folder or elsewhere.

And who may settle them: nothing is written back over what somebody else has changed since.
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager

from pmac_comp.base.errors import ControllerState, ForeignChange, PmacCompError, SafetyRefusal
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.claim import claim_refusal, read_claim, release_claim
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journal import Journal
from pmac_comp.machine.controller.change.journals import (
    DAMAGED,
    ROLLED_BACK,
    ChangeKind,
    damage_refusals,
    journal_names,
    journals,
    number_in,
    number_of,
    own_numbers,
    torn_refusals,
)
from pmac_comp.machine.controller.change.lease import (
    begun_elsewhere,
    give_back,
    host_lock,
    read_change,
    read_change_and_claim,
    release_lease,
    take_lease,
)
from pmac_comp.machine.controller.change.transaction import FOUND
from pmac_comp.machine.controller.change.verdict import mark_left
from pmac_comp.machine.controller.settings.temporary import standing
from pmac_comp.machine.controller.tables.table_status import table_status
from pmac_comp.machine.controller.whole.parts import Part, parts_of, unsettled, what_stands


def one_at_a_time(context: Context) -> AbstractContextManager[None]:
    """Between the parts of an upload, too, nobody else of this folder may upload or recover."""
    return host_lock(context, ".upload")


def waiting_refusals(
    link: Link, context: Context, found: tuple[int, int] | None = None
) -> list[SafetyRefusal]:
    """Refusals of a change while another one, of this folder or elsewhere, has not ended.

    ``found`` is what ``read_change_and_claim`` found, if it has been asked already.
    """
    number, claimed = found or read_change_and_claim(link, context)
    elsewhere = _of_elsewhere(number, context)
    other = claim_refusal(claimed, context)
    torn = torn_refusals(context)
    for refusal in torn:
        if refusal.code != DAMAGED:  # else nobody knows what waits
            tell_what_stands(link, context, refusal)
    return [
        *torn,
        *([begun_elsewhere(elsewhere)] if elsewhere else []),
        *([other] if other else []),
    ]


def tell_what_stands(
    link: Link, context: Context, error: PmacCompError, upload: Sequence[Part] = ()
) -> None:
    """Say on an error what was seen of the changes that wait, else of an upload or the tables."""
    torn = {group.group for group in torn_groups(context)}
    parts = [p for p in parts_of(context) if p.journal.group in torn]
    parts += [p for p in unsettled(context) if p.journal.group not in torn]
    try:
        if parts or torn or upload:
            state, words = what_stands(link, context, parts or upload)
        else:
            decision = table_status(link, context).decision
            state, words = decision.state, f"tables: {decision.state.value}, {decision.reason}"
    except PmacCompError as second:
        error.add_note(f"What stands could not be read: {second.message}")
        mark_left(error, error.left or ControllerState.DISABLED, confirmed=False)
        return
    mark_left(error, state, confirmed=True)
    error.context["stands"] = words
    error.hint = f"{error.advice} Seen to stand: {words}.".strip()


def open_elsewhere(link: Link, context: Context) -> int:
    """Number of a change that another folder or host began and did not end, 0 for none."""
    return _of_elsewhere(read_change(link, context), context)


def _of_elsewhere(number: int, context: Context) -> int:
    return number if number > 0 and number not in own_numbers(context) else 0


def torn_groups(context: Context) -> list[Journal]:
    """Uploads of this folder that began and did not end, oldest first."""
    return [j for j in journals(context) if j.kind == ChangeKind.GROUP.value and j.is_open]


def waiting(context: Context) -> list[Journal]:
    """Journals of what a recovery would write back."""
    return [part.journal for part in waiting_parts(context)]


def waiting_parts(context: Context) -> list[Part]:
    """What a recovery would write back: parts of torn uploads, and changes of their own."""
    groups = {group.group for group in torn_groups(context)}
    parts = [p for p in parts_of(context) if p.journal.group in groups and p.closing != ROLLED_BACK]
    return [*parts, *(p for p in unsettled(context) if p.journal.group not in groups)]


def left_open(context: Context) -> tuple[str, ...]:
    """Changes of this folder that began and did not end, in words; ``recover`` settles them."""
    damaged = damage_refusals(context)
    if damaged:
        return (f"{damaged[0].context['journal']} is damaged",)
    torn = torn_groups(context)
    if torn:
        begin = torn[-1].first()
        name = "" if begin is None else begin.data.get("name", "")
        return (f"an upload ({name}) was interrupted",)
    open_parts = [f"a change of {p.kind.value} was interrupted" for p in unsettled(context)]
    if standing(context):
        open_parts.append("axis definitions of a measurement stand")
    return tuple(open_parts)


def number_since_ours(link: Link, context: Context) -> int:
    """Number of a change that another folder or host made since ours, 0 for none."""
    return _since_ours(read_change(link, context), context)


def _since_ours(last: int, context: Context) -> int:
    """Number of a change that another folder or host made since ours, 0 for none.

    Otherwise a change of this folder was the last, or, after a reset, the number on the controller
    is an older one that stood there before them.
    """
    number = abs(last)
    seen = {abs(int(str(e.data.get(FOUND, 0)))) for j in journals(context) for e in j.entries()}
    return 0 if number in own_numbers(context) | seen else number


def reset_since(context: Context, group: Journal, number: int) -> bool:
    """Whether a reset took away the numbers of an upload of this folder and of all behind it."""
    names = journal_names(context)
    since = names[names.index(group.path.name) :]
    return abs(number) not in {group.group, *map(number_in, since)}


def changed_elsewhere(number: int) -> ForeignChange:
    """Refusal to write back what stood before somebody else's change."""
    return ForeignChange(
        f"Another folder or host has changed this controller (number {number}) since; what stood "
        "before is not written back over it.",
        code="PC-REC-004",
        hint="Look at what stands (`pmac-comp status`, `backup`). `pmac-comp recover --keep` takes "
        "it as it is and closes what was left open here; `pmac-comp remove` takes it off.",
        context={"number": number},
    )


def take_over(link: Link, context: Context, journal: Journal) -> int:
    """Number and claim of what is written back, as between the parts of an upload.

    Returns
    -------
    int
        Number that stood there.

    Raises
    ------
    LeaseHeld, ForeignChange
        Somebody else changes the controller, or has changed it since; nothing was changed.
    """
    number = journal.group or number_of(journal)
    _, found = take_lease(link, context, number, lambda n: n in own_numbers(context))
    since = _since_ours(found, context)
    release_lease(link, context, number=found if since else None)
    if since:
        raise changed_elsewhere(since)
    return found


def end_change(link: Link, context: Context) -> None:
    """Give the lease back, and say on the controller that our last change has ended."""
    number = read_change(link, context)
    if number in own_numbers(context):
        release_lease(link, context, number=-number)
    else:  # killed before the number was written
        give_back(link, context)
        release_claim(link, context, read_claim(link))
