"""Connections for the workflow: one URL, one axis; ``sim://`` opens a card in this process."""

from collections.abc import Iterator
from contextlib import contextmanager

from pmac_comp.base.clock import Clock
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.identity import read_identity
from pmac_comp.machine.transport.url import parse_url
from pmac_comp.workflow.axis import Axis


class ScaledClock:
    """Clock of a simulated card that runs faster than real time, seen from the host.

    Waits are shortened by the factor, so that a host that talks to the card over a socket waits
    in the card's time.
    """

    def __init__(self, clock: Clock, factor: float) -> None:
        self._clock = clock
        self._factor = factor

    def now_s(self) -> float:
        """Time of the card in s."""
        return self._clock.now_s() * self._factor

    def sleep_s(self, duration_s: float) -> None:
        """Wait for a duration in s of the card's time."""
        self._clock.sleep_s(duration_s / self._factor)


@contextmanager
def open_link(url: str, bench: Bench, *, clock: Clock | None = None) -> Iterator[Commander]:
    """Conversation with what a URL names, closed afterwards."""
    if parse_url(url).scheme == "sim":
        from pmac_comp.workflow.simulated import open_embedded

        with open_embedded(bench, parse_url(url)) as link:
            yield link
        return
    with Commander.open(url, clock=clock) as link:
        yield link


@contextmanager
def open_axis(url: str, bench: str | Bench, *, clock: Clock | None = None) -> Iterator[Axis]:
    """Axis of a bench behind a URL; the identity of the controller is checked first."""
    loaded = bench if isinstance(bench, Bench) else load_bench(bench)
    with open_link(url, loaded, clock=clock) as link:
        identity = read_identity(link)
        yield Axis(link, loaded, identity.fingerprint)
