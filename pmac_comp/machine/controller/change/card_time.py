"""How long the controller itself had for something, on its own clock.

What lives here: deadlines for what the controller does by itself (ramps, programs that take a
value over). What may not: deadlines for answers, which are the host's (``base.clock``).
"""

from typing import Final

from pmac_comp.base.clock import Deadline
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.lease import read_clock
from pmac_comp.machine.controller.change.manifest import CLOCK_PER_s

_PATIENCE: Final = 10.0  # times the deadline, by the host, for a clock that stands still


class CardDeadline:
    """A time on the controller's own clock: a busy host or slow link takes nothing from it.

    Parameters
    ----------
    link : Link
        Conversation.
    duration_s : float
        Time in s that the controller has.
    """

    def __init__(self, link: Link, duration_s: float) -> None:
        self._link = link
        self._duration_s = duration_s
        self._start = read_clock(link)
        self._host = Deadline.after(link.clock, _PATIENCE * duration_s)

    def expired(self) -> bool:
        """Whether that time has passed, or the clock went back or stands: a reset."""
        passed_s = (read_clock(self._link) - self._start) / CLOCK_PER_s
        return not 0.0 <= passed_s < self._duration_s or self._host.expired()
