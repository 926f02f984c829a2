"""The law stopped for a sign test and set going again, also after a kill in between.

PLC 0 writes the master word every cycle: it must stand aside while the test does. A law that was
on the card before the upload is no part of it, so that the upload itself has to hold that it was
stopped: else ``recover`` would leave it so, and the motor where the test had put it.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from pmac_comp.base.errors import PmacCompError
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journal import Journal
from pmac_comp.machine.controller.change.journals import ChangeKind, journals
from pmac_comp.machine.controller.contents.settings import plc_runs
from pmac_comp.machine.controller.gather.gather import note_failure
from pmac_comp.machine.controller.law.law_arming import fade_by_hand
from pmac_comp.machine.controller.law.law_goal import followers, law_stands
from pmac_comp.machine.controller.law.law_state import read_law_head

_STOPPED: Final = "law stopped"
_GOES_ON: Final = "law goes on"
_PAUSE_s: Final = 0.01


@contextmanager
def law_aside(link: Link, context: Context) -> Iterator[None]:
    """Within ``with`` the law in PLC 0 does not run; the upload holds that on the disk."""
    upload = _upload_of(context)
    if upload is not None:
        upload.write(_STOPPED)
    link.command("DISABLE PLC 0")
    try:
        link.clock.sleep_s(_PAUSE_s)
        yield
    except PmacCompError as error:
        note_failure(error, lambda: _go_on(link, upload))
        raise
    except KeyboardInterrupt:
        _go_on(link, upload)
        raise
    _go_on(link, upload)


def set_going_again(link: Link, context: Context, upload: Journal) -> None:
    """End a sign test that was cut: its offset goes out slowly, and the law runs as before."""
    stopped = [e.step for e in upload.entries() if e.step in {_STOPPED, _GOES_ON}]
    if not stopped or stopped[-1] == _GOES_ON:
        return
    head = read_law_head(link, context.block)
    if law_stands(link, context.block) and not plc_runs(link, 0):
        if head.motor in followers(link):
            fade_by_hand(link, context, head)
        _go_on(link, upload)


def _go_on(link: Link, upload: Journal | None) -> None:
    link.command("ENABLE PLC 0")
    if upload is not None:
        upload.write(_GOES_ON)


def _upload_of(context: Context) -> Journal | None:
    """Journal of the upload of several parts that goes on, if one does."""
    if not context.group:
        return None
    groups = (j for j in reversed(journals(context)) if j.kind == ChangeKind.GROUP.value)
    return next((j for j in groups if j.group == context.group), None)
