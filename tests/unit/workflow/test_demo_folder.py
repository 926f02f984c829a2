"""The demo writes its runs over its own earlier ones, and over nothing that was measured."""

from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import ConfigError
from pmac_comp.files import capture_formats
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


def test_runs_are_not_read_whole_to_learn_their_source(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_in(tmp_path, "simulated controller and drive, gathered at the servo rate")
    monkeypatch.setattr(capture_formats, "read_hdf5", lambda _path: pytest.fail("read whole"))
    with pytest.raises(Started):
        demo.run_demo(tmp_path)


def test_a_file_that_cannot_be_opened_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "calibration_01.h5").write_bytes(b"cut off")
    with pytest.raises(ConfigError, match="calibration_01"):
        demo.run_demo(tmp_path)


def test_a_file_is_no_folder_for_the_demo(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("")
    with pytest.raises(ConfigError, match="is a file"):
        demo.run_demo(tmp_path / "a.csv")


def test_the_demo_can_be_run_again_into_its_folder(tmp_path: Path) -> None:
    run_in(tmp_path, "simulated controller and drive, gathered at the servo rate")
    with pytest.raises(Started):
        demo.run_demo(tmp_path)
