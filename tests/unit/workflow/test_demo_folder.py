"""The demo writes its runs over its own earlier ones, and over nothing that was measured."""

from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import ConfigError
from pmac_comp.files.capture import Capture, write_capture
from pmac_comp.workflow import demo


class Started(Exception):
    """The demo went on to the simulated card."""


@pytest.fixture(autouse=True)
def no_card(monkeypatch: pytest.MonkeyPatch) -> None:
    def started(*_arguments: object) -> None:
        raise Started

    monkeypatch.setattr(demo, "warm_up", started)


def run_in(folder: Path, source: str) -> Path:
    """The run that an earlier command left in a folder."""
    grid = 1e-3 * np.arange(5.0)
    path = folder / "calibration_01.h5"
    write_capture(path, Capture(grid, grid, grid, attributes={"source": source}))
    return path


def test_runs_of_a_real_axis_are_kept(tmp_path: Path) -> None:
    path = run_in(tmp_path, "gathered at the servo rate")
    before = path.read_bytes()
    with pytest.raises(ConfigError, match="calibration_01"):
        demo.run_demo(tmp_path)
    assert path.read_bytes() == before


def test_the_demo_can_be_run_again_into_its_folder(tmp_path: Path) -> None:
    run_in(tmp_path, "simulated controller and drive, gathered at the servo rate")
    with pytest.raises(Started):
        demo.run_demo(tmp_path)
