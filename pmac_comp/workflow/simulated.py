"""The simulated card from the workflow's side: in this process, or served to others.

What lives here: the clock that lets simulated time pass while the host waits, and the option
handling of ``sim``. What may not: anything of the card itself.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.resources import firmware_path
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.transport.pair import PairTransport
from pmac_comp.machine.transport.url import Endpoint

if TYPE_CHECKING:
    from pmac_comp.simulator.card import Card

_REQUEST_CYCLES = 2  # servo cycles that a request takes: the host is never infinitely fast


class CardClock:
    """Clock of an embedded card: waiting runs its servo cycles, nothing else moves time."""

    def __init__(self, card: "Card") -> None:
        self._card = card
        self._left_s = 0.0

    def now_s(self) -> float:
        """Simulated time in s."""
        return self._card.time_s

    def sleep_s(self, duration_s: float) -> None:
        """Let simulated time pass; fractions of a servo period are kept for the next wait."""
        self._left_s += max(0.0, duration_s)
        cycles = int(self._left_s / self._card.bench.servo_period_s)
        self._left_s -= cycles * self._card.bench.servo_period_s
        if cycles:
            self._card.run_cycles(cycles)


def make_card(
    bench: Bench,
    *,
    plant: str | None = None,
    servo: Path | None = None,
    dpram: str | None = None,
    flash: Path | None = None,
) -> "Card":
    """Card with the drive of a plant file, or the bench's own."""
    from pmac_comp.simulator.card import Card
    from pmac_comp.simulator.plant.door import load_plant

    return Card(
        bench,
        plant=None if plant is None else load_plant(plant, bench),
        servo_source=None if servo is None else servo.read_text(encoding="utf-8"),
        dpram=dpram,
        flash=flash,
    )


@contextmanager
def embedded(card: "Card") -> Iterator[Commander]:
    """Conversation with a card in this process over its packet port, in simulated time."""
    from pmac_comp.simulator.sessions import EthernetSession

    session = EthernetSession(card)

    def peer(data: bytes) -> bytes:
        if data:
            card.run_cycles(_REQUEST_CYCLES)
        return session.receive(data)

    clock = CardClock(card)
    try:
        with Commander(PairTransport(peer, clock), clock=clock) as link:
            yield link
    finally:
        session.close()


@contextmanager
def open_embedded(bench: Bench, endpoint: Endpoint) -> Iterator[Commander]:
    """Conversation with a fresh card of a bench, set up as the bench file says."""
    del endpoint
    with embedded(make_card(bench)) as link:
        yield link


def default_servo() -> Path:
    """Source of the open servo that comes with the installation."""
    return firmware_path("feedforward_servo.txt")
