"""The paper's bench on an embedded card, set up and enabled, for every test of the bridge."""

from collections.abc import Iterator

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.simulator.card.card import Card
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.simulated import TruthRecorder, embedded, make_card

BENCH = load_bench("paper")


@pytest.fixture
def card() -> Card:
    return make_card(BENCH)


@pytest.fixture
def recorder(card: Card) -> TruthRecorder:
    """Unquantised positions of the card's plant over the first two minutes."""
    return TruthRecorder(card, 120.0)


@pytest.fixture
def axis(card: Card) -> Iterator[Axis]:
    with embedded(card) as link:
        found = Axis(link, BENCH, "test", simulated=True)
        found.enable()
        yield found
