"""One terminal of this host at an axis: whoever measures or changes it keeps others out.

A measurement borrows a coordinate system and a motion program, and compares runs with and without
what is on the card. Between two of its runs the axis rests, so that nothing else would refuse an
upload, a removal or a second measurement from another terminal: the runs would then be told as
with a compensation that was not there any more.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from pmac_comp.machine.controller.lease import host_lock
from pmac_comp.machine.transport.url import parse_url
from pmac_comp.workflow.axis import Axis
from pmac_comp.workflow.deploy import context_of

_SCOPE = ".work"


@contextmanager
def at_work(axis: Axis, url: str) -> Iterator[None]:
    """Nobody else of this host and journal folder measures or changes the axis meanwhile.

    Parameters
    ----------
    axis : Axis
        Connected; the lock lies in its journal's folder.
    url : str
        Where it is; a card in this process (``sim://``) is nobody else's.

    Raises
    ------
    LeaseHeld
        Another terminal is at work on this controller.
    """
    if parse_url(url).scheme == "sim":
        yield
        return
    with host_lock(context_of(axis, axis.setup.store), _SCOPE):
        yield
        axis.release_axis()  # what was borrowed is back before somebody else may begin
