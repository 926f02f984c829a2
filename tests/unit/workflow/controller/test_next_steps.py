"""Advice after an upload names the model by a path that exists, or says that one is to be given."""

from pathlib import Path

import pytest

from pmac_comp.base.errors import ControllerState
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller.deploy import Deployment
from pmac_comp.workflow.controller.upload_flow import look_after, next_steps


def steps_after(folder: Path, *, persist: bool) -> list[str]:
    done = Deployment(ControllerState.NEW, (), motor=1, acts=True)
    new, store = Compensation("law", CompensationLaw()), Path("kept")
    file = folder / "c.json"
    return list(next_steps("sim://", "paper", file, store, new, done, persist=persist))


def check_line(folder: Path) -> str:
    law = CompensationLaw(provenance={"model": "model.json"})
    done = Deployment(ControllerState.NEW, (), motor=1, acts=True)
    steps = next_steps(
        "sim://", "paper", folder / "c.json", Path("kept"), Compensation("law", law), done
    )
    return next(line for line in steps if line.startswith("Check it"))


@pytest.mark.parametrize(
    ("state", "said"),
    [("OLD", "Look at it: pmac-comp status"), ("DISABLED", "stood before: pmac-comp rollback")],
)
def test_what_follows_a_change_that_was_settled(state: str, said: str) -> None:
    line = look_after("tcp://card:1", "my bench.toml", Path("kept"), state)
    assert said in line
    assert line.endswith("tcp://card:1 --bench 'my bench.toml' --journal kept")


def test_a_model_in_the_working_folder_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.json").write_text("{}")
    assert check_line(tmp_path / "elsewhere").endswith("--model model.json")


def test_a_model_that_lies_elsewhere_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert "--model with the path of model.json" in check_line(tmp_path)


def test_what_was_saved_is_taken_back_with_a_save(tmp_path: Path) -> None:
    *_, plain = steps_after(tmp_path, persist=False)
    *_, saved = steps_after(tmp_path, persist=True)
    assert plain == "Take it back: pmac-comp rollback sim:// --bench paper --journal kept"
    assert saved == f"{plain} --persist"
