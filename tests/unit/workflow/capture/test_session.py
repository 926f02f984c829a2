"""A card in this process is nobody else's: two of them do not meet."""

from pathlib import Path

import pytest

from pmac_comp.machine.controller.settings.temporary import standing
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.session import open_axis


def test_two_cards_of_their_own_process_share_no_journal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Both have the same name; what one borrowed the other would take for left behind.
    monkeypatch.chdir(tmp_path)
    with open_axis("sim://", "paper") as one, open_axis("sim://", "paper") as other:
        assert one.identity == other.identity
        one.define_axis()
        other.define_axis()
        assert standing(context_of(one, one.setup.store))
        stores = {axis.setup.store for axis in (one, other)}
    assert len(stores) == 2
    assert not any(store.exists() for store in stores)
    assert list(tmp_path.iterdir()) == []
