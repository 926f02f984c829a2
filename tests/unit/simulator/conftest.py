"""A card of the paper's bench and a way to talk to it."""

from collections.abc import Callable

import pytest

from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.simulator.card.card import Card

Ask = Callable[[str], str]


@pytest.fixture(scope="session")
def bench() -> Bench:
    return load_bench("paper")


@pytest.fixture
def card(bench: Bench) -> Card:
    return Card(bench)


@pytest.fixture
def ask(card: Card) -> Ask:
    """Send one line; the answer with CR shown as blank and ACK removed, errors as ERRnnn."""
    port = card.port()

    def send(text: str) -> str:
        reply = port.line(text).decode("latin-1")
        return reply.replace("\x07", "").replace("\r", " ").replace("\x06", "").strip(" ")

    return send
