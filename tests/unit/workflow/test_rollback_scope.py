"""``rollback`` takes back the last upload and nothing older, and nothing of another controller."""

from types import SimpleNamespace

import pytest

from pmac_comp.base.errors import ForeignChange
from pmac_comp.workflow import deploy as d
from pmac_comp.workflow import upload_flow as flow


def _upload(store, controller, *names):
    with d._one_upload(SimpleNamespace(store=store, controller=controller)):
        for name in names:
            (store / name).write_text("{}")


def test_a_later_table_upload_does_not_bring_an_older_law_back(tmp_path):
    _upload(tmp_path, "card", "c-1.tables.json", "c-2.law.json")
    _upload(tmp_path, "card", "c-3.tables.json")
    backups = flow._last_backups(SimpleNamespace(store=tmp_path, controller="card"))
    assert flow._of_kind(backups, "tables") == tmp_path / "c-3.tables.json"
    assert flow._of_kind(backups, "law") is None


def _broken_upload(store):
    with d._one_upload(SimpleNamespace(store=store, controller="card")):
        (store / "c-1.tables.json").write_text("{}")
        raise RuntimeError("link lost")


def test_an_upload_that_fails_still_notes_its_backup(tmp_path):
    with pytest.raises(RuntimeError, match="link lost"):
        _broken_upload(tmp_path)
    backups = flow._last_backups(SimpleNamespace(store=tmp_path, controller="card"))
    assert [path.name for path in backups] == ["c-1.tables.json"]


def test_the_upload_of_another_controller_is_not_rolled_back(tmp_path):
    _upload(tmp_path, "card 1", "c-1.tables.json")
    with pytest.raises(ForeignChange, match="another controller"):
        flow._last_backups(SimpleNamespace(store=tmp_path, controller="card 2"))
