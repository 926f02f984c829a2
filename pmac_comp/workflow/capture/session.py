"""Connections for the workflow: one URL, one axis; ``sim://`` opens a card in this process."""

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from pmac_comp.base.clock import Clock
from pmac_comp.base.errors import PmacCompError
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.card.identity import read_identity
from pmac_comp.machine.transport.url import card_address, parse_url
from pmac_comp.workflow.capture.axis import Axis


@contextmanager
def open_link(url: str, bench: Bench, *, clock: Clock | None = None) -> Iterator[Commander]:
    """Conversation with what a URL names, closed afterwards."""
    if parse_url(url).scheme == "sim":
        from pmac_comp.workflow.capture.simulated import open_embedded

        with open_embedded(bench, parse_url(url)) as link:
            yield link
        return
    with Commander.open(url, clock=clock) as link:
        yield link


@contextmanager
def open_axis(url: str, bench: str | Bench, *, clock: Clock | None = None) -> Iterator[Axis]:
    """Axis of a bench behind a URL; the identity of the controller is checked first."""
    loaded = bench if isinstance(bench, Bench) else load_bench(bench)
    with ExitStack() as stack:
        link = stack.enter_context(open_link(url, loaded, clock=clock))
        identity = read_identity(link)
        # A card of this process is nobody else's.
        apart = identity.is_alone or parse_url(url).scheme == "sim"
        address = "" if apart else card_address(url)
        axis = Axis(link, loaded, identity.fingerprint, identity.is_simulated, address)
        if parse_url(url).scheme == "sim":
            # What a run borrows ends with the card, and cards of other processes have its name.
            axis.setup.store = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        try:
            yield axis
        except (PmacCompError, KeyboardInterrupt) as error:
            axis.release_after(error)
            raise
        axis.release_axis()
