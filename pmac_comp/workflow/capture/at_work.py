"""One command at a time at a card: whoever measures or changes it keeps others out.

A measurement borrows a coordinate system and a motion program, and compares runs with and without
what is on the card. Between two of its runs the axis rests, so that nothing else would refuse an
upload, a removal or a second measurement from another terminal: the runs would then be told as
with a compensation that was not there any more. On this host a lock keeps others out, by the
address of the card and by its identity in the folder; other hosts are kept out by the lease on the
card, which a measurement holds throughout.
"""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress

from pmac_comp.base.errors import PmacCompError, SafetyRefusal
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.lease import card_lock, host_lock
from pmac_comp.machine.controller.change.verdict import untouched
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.law.block_use import law_over_refusals
from pmac_comp.machine.controller.settings.settings_upload import running_refusals
from pmac_comp.machine.controller.settings.temporary import standing
from pmac_comp.machine.controller.tables.table_status import read_head
from pmac_comp.machine.controller.tables.upload_checks import buffer_refusals
from pmac_comp.machine.transport.url import card_address, parse_url
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of

_SCOPE = ".work"


@contextmanager
def at_work(axis: Axis, url: str) -> Iterator[None]:
    """Nobody else of this host measures or changes the card meanwhile.

    Parameters
    ----------
    axis : Axis
        Connected; one of its locks lies in its journal's folder.
    url : str
        Where it is; a card in this process (``sim://``) is nobody else's.

    Raises
    ------
    LeaseHeld
        Another terminal is at work on this controller.
    SafetyRefusal
        The law of another bench file works with variables of the axis' block.
    """
    with nullcontext() if _is_own(url) else _alone(axis, url):
        yield


@contextmanager
def _alone(axis: Axis, url: str) -> Iterator[None]:
    """``at_work`` at a card that others may reach."""
    with card_lock(card_address(url)), host_lock(context_of(axis, axis.setup.store), _SCOPE):
        _require_free_block(axis)
        yield
        axis.release_axis()  # what was borrowed is back before somebody else may begin


def require_free_block(axis: Axis, url: str) -> None:
    """Refuse what writes, or plans to, where the law of another bench file works in the block.

    Raises
    ------
    SafetyRefusal
        It does.
    """
    if not _is_own(url):
        _require_free_block(axis)


def _require_free_block(axis: Axis) -> None:
    """The same for a card that others may reach."""
    with untouched():
        block = LawBlock.from_p_block(axis.bench.controller.p_block)
        raise_all(law_over_refusals(axis.link, block), "Work on this axis")


@contextmanager
def measuring(axis: Axis, url: str) -> Iterator[None]:
    """The same for runs: nobody else may be at the card as they begin, and no host may come.

    Raises
    ------
    LeaseHeld, ForeignChange
        Another host measures or changes, or left a change unfinished.
    SafetyRefusal
        A motion program, data gathering or an open buffer of somebody else.
    """
    if _is_own(url):
        yield
        return
    with _alone(axis, url):
        with untouched():
            raise_all(_others_refusals(axis, context_of(axis, axis.setup.store)), "The measurement")
            axis.setup.hold_card(axis.link, axis.bench, axis.identity, axis.address)
        try:
            yield
        except (PmacCompError, KeyboardInterrupt) as error:
            axis.release_after(error)  # what was borrowed is back before somebody else may begin
            with suppress(PmacCompError):
                axis.setup.let_go(axis.link)
            raise
        axis.release_axis()
        axis.setup.let_go(axis.link)


def _is_own(url: str) -> bool:
    """Whether the card is made in this process for the bench file: nobody else reaches it."""
    return parse_url(url).scheme == "sim"


def _others_refusals(axis: Axis, context: Context) -> list[SafetyRefusal]:
    """What somebody else runs; what a killed measurement of this folder left is taken off first.

    Its motion may still run: nothing begins before that has ended.
    """
    if standing(context):
        return running_refusals(axis.link)
    return [*running_refusals(axis.link), *buffer_refusals(read_head(axis.link, context))]
