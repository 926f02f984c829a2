"""A commander on a scripted card over a link with faults, in virtual time."""

from collections.abc import Iterable

from pmac_comp.base.clock import VirtualClock
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.transport.base import Framing
from pmac_comp.machine.transport.pair import PairTransport
from pmac_comp.machine.transport.tap import Fault, FaultyTransport
from tests.contract.scripted_card import LinePort, PacketPort, ScriptedCard

TIMEOUT_s = 3.0
PORTS = {Framing.PACKETS: PacketPort, Framing.LINES: LinePort}


class LinkBench:
    """A conversation whose link gets its faults once it is open, counted from then on.

    ``at_opening`` are those it is opened under.
    """

    def __init__(
        self,
        framing: Framing,
        *,
        card: ScriptedCard | None = None,
        checksum: bool = False,
        faults: Iterable[Fault] = (),
        at_opening: Iterable[Fault] = (),
    ) -> None:
        self.clock = VirtualClock()
        self.card = card or ScriptedCard()
        pair = PairTransport(PORTS[framing](self.card), self.clock, framing=framing)
        self.tap = FaultyTransport(pair, at_opening)
        self.commander = Commander(
            self.tap, clock=self.clock, timeout_s=TIMEOUT_s, checksum=checksum
        )
        self.break_link(faults)

    def break_link(self, faults: Iterable[Fault]) -> None:
        """Apply faults; their positions count from the next byte in each direction."""
        self.tap.sent = self.tap.received = 0
        self.tap.schedule(faults)
